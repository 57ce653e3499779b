"""Where a process spends its time: stationary and discounted occupation of finite processes and of records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from harness.errors import FitError, InputError, PlantError
from harness.models.analysis import Findings, Takes
from harness.options import check_options
from harness.signals import FloatArray

_GROWS = 10.0  # Range of the second half of a run in that of its first beyond which the plant runs away.


def stationary(transition: FloatArray, tolerance: float = 1e-9) -> FloatArray:
    """Return the stationary distribution (S,) of a chain (S, S).

    Raises InputError if there is more than one: parts of the chain that never reach each other.

    Examples
    --------
    >>> stationary(np.array([[0.9, 0.1], [0.3, 0.7]])).round(6).tolist()
    [0.75, 0.25]
    """
    count = len(transition)
    _, sizes, axes = np.linalg.svd(np.eye(count) - transition.T)
    if int(np.sum(sizes < tolerance)) > 1:
        raise InputError(
            "stationary distribution",
            expected="a chain with one recurrent class",
            got=f"{int(np.sum(sizes < tolerance))} classes that never reach each other",
            remedy="ask for a discounted occupation from a start, or for one class",
        )
    found = np.abs(axes[-1])
    return np.asarray(found / found.sum())


def discounted_occupation(transition: FloatArray, initial: FloatArray, discount: float) -> FloatArray:
    """Return ``(1 - discount) sum_k discount^k P(s[k] = s)`` (S,) from a first distribution (Puterman 1994, sec. 6.9).

    Examples
    --------
    >>> discounted_occupation(np.array([[0.0, 1.0], [0.0, 1.0]]), np.array([1.0, 0.0]), 0.5).tolist()
    [0.5, 0.5]
    """
    right = (1.0 - discount) * np.asarray(initial, dtype=float)
    return np.asarray(np.linalg.solve(np.eye(len(transition)) - discount * transition.T, right))


def ulam(samples: FloatArray, following: FloatArray, edges: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return the chain (B, B) between the boxes that samples (N, d) and their successors fall into, and its boxes.

    Ulam's method: the transfer operator of a continuous process on boxes, counted (Li 1976, *J. Approximation Theory*
    17; Dellnitz & Junge 1999, *SIAM J. Numerical Analysis* 36, sec. 4). Boxes that no sample left are left out; what
    would lead there is put on the others of the same box.

    - ``samples, following`` (N, d)
    - ``edges`` sequence of array: of the boxes along each axis
    - returns transition (B, B), boxes (B,) as flat indices of the grid
    """
    shape = tuple(len(edge) - 1 for edge in edges)

    def boxes(points: FloatArray) -> Any:
        index = [
            np.clip(np.searchsorted(edge, points[:, i], side="right") - 1, 0, shape[i] - 1)
            for i, edge in enumerate(edges)
        ]
        return np.ravel_multi_index(tuple(index), shape)

    here, there = boxes(samples), boxes(following)
    kept = np.unique(here)
    while True:
        fine = np.isin(here, kept) & np.isin(there, kept)
        smaller = np.unique(here[fine])
        if len(smaller) == len(kept):
            break
        kept = smaller
    table = np.zeros((len(kept), len(kept)))
    np.add.at(table, (np.searchsorted(kept, here[fine]), np.searchsorted(kept, there[fine])), 1.0)
    return table / table.sum(axis=1, keepdims=True), kept


@dataclass(frozen=True)
class Occupation:
    """Where a process is in the long run, or while a discount lasts; with a picture.

    Of a finite process: exactly, under a policy (actions at random by default). Of a continuous plant: its transfer
    operator between boxes is counted from sampled steps (Ulam's method) and its stationary density compared with the
    time that one long run really spends in the boxes.

    Parameters
    ----------
    discount : float, optional
        None gives the stationary distribution; else the discounted occupation from the first states, of a continuous
        plant from those in which it begins, by restarts.
    boxes : int
        Along each of the first two outputs of a continuous plant.
    samples : int
        Steps of a continuous plant that the operator is counted from.
    spread : float
        Standard deviation of the random inputs of a continuous plant, in units of their ranges.
    policy : sequence, optional
        Action of each state of a finite process.
    """

    takes: ClassVar[Takes] = "process"
    discount: float | None = None
    boxes: int = 20
    samples: int = 20_000
    spread: float = 0.3
    policy: Sequence[int] | None = None

    def of(self, subject: Any, *, rng: np.random.Generator) -> Findings:
        """Return the states or boxes that are visited most."""
        check_options(self, "occupation", discount=">= 0, < 1", boxes=">= 2", samples=">= 100")
        table = getattr(subject, "true_transition", getattr(subject, "transition", None))
        if table is not None and np.ndim(table) == 3:
            return self._finite(np.asarray(table, dtype=float), subject)
        if not hasattr(subject, "step") or not hasattr(subject, "reset"):
            raise InputError(
                "occupation", expected="a plant, or a finite model", got=type(subject).__name__, remedy="give one"
            )
        return self._sampled(subject, rng)

    def _finite(self, table: FloatArray, subject: Any) -> Findings:
        """Return the occupation of a finite process."""
        states, actions = table.shape[:2]
        if self.policy is not None and (len(self.policy) != states or not set(self.policy) <= set(range(actions))):
            raise InputError(
                "option policy",
                expected=f"{states} actions of 0 to {actions - 1}",
                got=str(list(self.policy)),
                remedy="correct it",
            )
        chosen = None if self.policy is None else np.asarray(self.policy, dtype=np.intp)
        chain = table.mean(axis=1) if chosen is None else table[np.arange(states), chosen]
        initial = getattr(subject, "initial", np.full(states, 1.0 / states))
        share = stationary(chain) if self.discount is None else discounted_occupation(chain, initial, self.discount)
        order = np.argsort(-share, kind="stable")
        rows = [{"state": int(i), "share": float(share[i])} for i in order]
        kind = "stationary distribution" if self.discount is None else f"occupation with discount {self.discount:g}"
        words = (f"{kind}: half of the time is spent in {_half(share)} of {states} states",)
        return Findings("occupation", rows, words, {"share": share}, lambda: _bars(share, kind))

    def _visited(self, plant: Any, rng: np.random.Generator) -> FloatArray:
        """Return the first two outputs (N, 2) under random inputs.

        With a discount every step is the last of its run with the rest of it as probability: the time spent anywhere is
        then the discounted occupation (Puterman 1994, sec. 5.3).
        """
        spec = plant.spec
        if self.policy is not None or any(channel.kind == "category" for channel in (*spec.inputs, *spec.outputs)):
            raise InputError(
                "occupation of a sampled plant", expected="real signals, and no policy", got=f"{spec}, {self.policy}",
                remedy="count a finite process with mdp-counting, and leave the policy of a continuous plant out",
            )  # fmt: skip
        size = np.array([1.0 if not np.isfinite(c.maximum) else c.maximum for c in spec.inputs])
        ends = (
            np.zeros(self.samples, dtype=bool) if self.discount is None else rng.random(self.samples) >= self.discount
        )
        rows = [plant.reset(rng=rng)]
        try:
            for row, end in zip(self.spread * size * rng.normal(size=(self.samples, spec.nu)), ends, strict=True):
                rows.append(plant.reset(rng=rng) if end else plant.step(row))
        except PlantError:  # it ran away: what comes after is no number
            rows.append(np.full(spec.ny, np.nan))
        return np.array(rows, dtype=float)[:, : min(2, spec.ny)]

    def _sampled(self, plant: Any, rng: np.random.Generator) -> Findings:
        """Return the occupation of a continuous plant on boxes of its first two outputs."""
        spec = plant.spec
        y = self._visited(plant, rng)
        half = len(y) // 2
        ranges = [np.ptp(part, axis=0) for part in (y[:half], y[half:])]
        if not np.isfinite(y).all() or (np.ptp(y, axis=0) == 0).any() or np.any(ranges[1] > _GROWS * ranges[0]):
            raise FitError(
                "occupation: the plant does not stay",
                expected="a run that stays within bounds and moves in every output",
                got="one that does not: it stands still, or its second half reaches beyond its first by far",
                remedy="choose a stable plant, its rates among the outputs, more spread, or a discount",
            )
        edges = [np.linspace(column.min(), column.max() + 1e-9, self.boxes + 1) for column in y.T]
        # Learned on the first half, judged on where the second half is.
        if self.discount is None:
            chain, kept = ulam(y[:half], y[1 : half + 1], edges)
            share = np.zeros(self.boxes ** y.shape[1])
            share[kept] = stationary(chain)
        else:
            share = np.histogramdd(y[:half], bins=edges)[0].ravel() / half
        seen = np.histogramdd(y[half:], bins=edges)[0].ravel()
        seen /= seen.sum()
        apart = 0.5 * float(np.abs(share - seen).sum())
        order = np.argsort(-share)[:10]
        where = np.array(np.unravel_index(order, (self.boxes,) * y.shape[1])).T
        found = [
            {
                **{
                    channel.name: float(0.5 * (edge[i] + edge[i + 1]))
                    for channel, edge, i in zip(spec.outputs, edges, index, strict=False)
                },
                "share": float(share[number]),
                "of the time seen": float(seen[number]),
            }
            for number, index in zip(order, where, strict=True)
        ]
        kind = "stationary density" if self.discount is None else f"occupation with discount {self.discount:g}"
        words = (
            f"{kind} on {self.boxes} boxes an axis from {half} steps: half of the time in "
            f"{_half(share)} of {np.count_nonzero(share)} boxes",
            f"the second half of the run is elsewhere with a share of {apart:.3g} (total variation)"
            + (": too few steps for these boxes, or a plant that drifts" if apart > 0.25 else ""),
        )
        shown = share.reshape((self.boxes,) * y.shape[1])
        names = [f"{c.name} [{c.unit}]" for c in spec.outputs[: y.shape[1]]]
        grid = [edge.tolist() for edge in edges]
        details = {"share": shown, "seen": seen.reshape(shown.shape), "edges": grid, "apart": apart}
        return Findings("occupation", found, words, details, lambda: _map(shown, edges, names))


def _half(share: FloatArray) -> int:
    """Return how many of the largest shares hold half."""
    return int(np.searchsorted(np.cumsum(np.sort(share)[::-1]), 0.5) + 1)


def _bars(share: FloatArray, title: str) -> Any:
    """Draw the share of each state."""
    from harness.plots import sheet

    drawing = sheet(figsize=(6, 4), layout="constrained")
    axes = drawing.subplots()
    axes.bar(np.arange(len(share)), share)
    axes.set(xlabel="state", ylabel="share of the time", title=title)
    return drawing


def _map(share: FloatArray, edges: Sequence[FloatArray], names: Sequence[str]) -> Any:
    """Draw a density on boxes of one or two outputs."""
    from harness.plots import sheet

    drawing = sheet(figsize=(6, 4), layout="constrained")
    axes = drawing.subplots()
    if share.ndim == 1:
        axes.stairs(share / np.diff(edges[0]), edges[0], fill=True)
        axes.set(xlabel=names[0], ylabel="density")
        return drawing
    area = np.outer(np.diff(edges[0]), np.diff(edges[1]))
    mesh = axes.pcolormesh(edges[0], edges[1], (share / area).T)
    drawing.colorbar(mesh, ax=axes, label="density")
    axes.set(xlabel=names[0], ylabel=names[1])
    return drawing
