"""Linear models along a trajectory: coefficients of their own at every sample, from repetitions of one motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.algebra import divisor
from harness.errors import FitError
from harness.scoring import same_language
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.common.described import Described
from identifiers.common.excitation import Columns, refuse_feedback
from identifiers.common.named import wrong_options
from identifiers.common.normal import solved
from identifiers.common.one_step_estimate import EXACT
from identifiers.common.records import learnable
from identifiers.linear.arx import design, one_step
from identifiers.linear.iterative import TimeVarying

WIDTHS = (0, 1, 2, 4, 8, 16, 32, 64)
"""Half widths in samples over which coefficients are pooled, in doubling steps; a constant model is tried too."""
REPEATED = 3  # Repetitions from which on the motion that they share is told apart from how they depart from it.
_GAIN = 0.98  # A narrower window must lower the error on equations left out by this much, or its gain is chance.
_FOLDS = 3  # Every third equation is left out in turn.


@dataclass(frozen=True, eq=False)
class AlongTrajectoryModel(Described):
    """``y[k+1] = theta[k]' [lags of y, lags of u, 1]``; the state holds the lags, and k as its last component.

    Parameters
    ----------
    spec : PlantSpec
    coefficients : array (N, p, ny)
        At every sample; the last ones hold from there on.
    lags : int
    start : float
        Time [s] of sample 0 of the trajectory.
    notes : dict
    """

    spec: PlantSpec
    coefficients: FloatArray
    lags: int = 1
    start: float = 0.0
    notes: dict[str, Any] = field(default_factory=dict)
    kind = "along-trajectory"

    @property
    def burn_in(self) -> int:
        """Samples that the lags reach back."""
        return self.lags if self.lags > 1 else 0

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the state at the first sample of a record: its output, as if nothing had moved before."""
        same_language(self.spec, data)
        index = round((float(data.t[0]) - self.start) / self.spec.sample_time)
        past = np.tile(data.y[0], self.lags)
        return np.concatenate([past, np.zeros((self.lags - 1) * self.spec.nu), [float(index)]])

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the output (..., ny)."""
        return np.asarray(x[..., : self.spec.ny])

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next state (..., nx)."""
        ny, nu, lags = self.spec.ny, self.spec.nu, self.lags
        theta = self.coefficients[self._places(x)]
        u = np.broadcast_to(u, (*np.shape(x)[:-1], nu))
        past, pushed = x[..., : lags * ny], x[..., lags * ny : -1]
        rows = np.concatenate([past, u, pushed, np.ones((*past.shape[:-1], 1))], axis=-1)
        after = np.einsum("...p,...po->...o", rows, theta)
        inputs = np.concatenate([u, pushed], axis=-1)[..., : (lags - 1) * nu]
        return np.concatenate([after, past[..., : (lags - 1) * ny], inputs, x[..., -1:] + 1.0], axis=-1)

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the state (..., nx) after an output was seen: the output itself."""
        return np.concatenate([np.broadcast_to(y, (*x.shape[:-1], self.spec.ny)), x[..., self.spec.ny :]], axis=-1)

    def along(self, samples: int | None = None) -> TimeVarying:
        """Return matrices about the trajectory, whose states are the lags, for iterative learning."""
        ny, nu, lags = self.spec.ny, self.spec.nu, self.lags
        count = len(self.coefficients) + 1 if samples is None else samples
        theta = self.coefficients[np.minimum(np.arange(count), len(self.coefficients) - 1)].transpose(0, 2, 1)
        past, nx = lags * ny, lags * ny + (lags - 1) * nu
        a, b = np.zeros((count, nx, nx)), np.zeros((count, nx, nu))
        a[:, :ny, :past] = theta[:, :, :past]
        b[:, :ny] = theta[:, :, past : past + nu]
        a[:, :ny, past:] = theta[:, :, past + nu : past + lags * nu]
        a[:, ny:past, : past - ny] = np.eye(past - ny)
        if lags > 1:
            b[:, past : past + nu] = np.eye(nu)
            a[:, past + nu :, past : nx - nu] = np.eye((lags - 2) * nu)
        c = np.zeros((count, ny, nx))
        c[:, :, :ny] = np.eye(ny)
        return TimeVarying(a, b, c, np.zeros((count, ny, nu)))

    def _places(self, x: FloatArray) -> npt.NDArray[np.intp]:
        index = np.nan_to_num(np.asarray(x)[..., -1])
        return np.clip(np.round(index), 0, len(self.coefficients) - 1).astype(np.intp)


@dataclass(frozen=True)
class AlongTrajectory:
    """Linear time-varying model along a motion that was repeated, its coefficients pooled over neighbouring samples.

    Records are repetitions that begin at the same time. The model is learned from what differs between them: each
    sample has the mean of all repetitions as its constant, and the departures from it give the coefficients. The
    equations of all repetitions within a window about sample k are weighed by ``1 - (j / (h + 1))^2`` (Epanechnikov's
    kernel; Fan & Gijbels 1996, *Local Polynomial Modelling*) and solved by least squares. With
    less than three repetitions there are no such departures: then motion and coefficients are learned from the same
    equations, with a constant in each window.

    Parameters
    ----------
    order : int
        Past outputs and inputs in an equation; 1 where the state is measured.
    width : int, optional
        Half width h of the window in samples; 0 takes every sample by itself. By default the widest of 0, 1, 2, 4, ...
        64 or all samples (a time-invariant model) that foretells equations left out as well as the best within 2 %.
    least_excitation : float
        As of ``least-squares``, asked of what differs between the repetitions.

    Examples
    --------
    >>> from harness.signals import Channel
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> rng, records = np.random.default_rng(0), []
    >>> for _ in range(5):
    ...     u, y = rng.normal(size=(30, 1)), np.zeros((30, 1))
    ...     for k in range(29):
    ...         y[k + 1] = 0.5 * y[k] + (1.0 if k < 15 else -1.0) * u[k]
    ...     records.append(Trajectory(np.arange(30.0), u, y, spec))
    >>> model = AlongTrajectory().fit(records, rng=rng)
    >>> model.notes["width"], model.coefficients[[10, 20], 1, 0].round(9).tolist()
    (0, [1.0, -1.0])
    """

    order: int = 1
    width: int | None = None
    least_excitation: float = 2.0

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> AlongTrajectoryModel:
        """Return the model along the repeated motion."""
        what = "along-trajectory"
        if self.order < 1 or (self.width is not None and self.width < 0):
            raise wrong_options(self, what, "order at least 1, width at least 0", "order width")
        records, spec = learnable(trajectories, samples=self.order + 2, what=what)
        start = float(records[0].t[0])
        if any(abs(float(record.t[0]) - start) > 0.5 * spec.sample_time for record in records):
            raise FitError(
                f"{what}: records that begin at different times",
                expected=f"repetitions of one motion, all from {start:g} s",
                got=", ".join(f"{record.t[0]:g} s" for record in records[:5]),
                remedy="cut the records so that each repetition begins at the same time",
            )
        self._refuse_feedback(records, spec, what)
        if len(records) >= REPEATED:
            shortest = min(map(len, records))
            records = [record[:shortest] for record in records]
        equations = _Equations.of(records, self.order)
        total = sum(len(record) - self.order for record in records)
        if total < equations.gram.shape[-1]:
            raise FitError(
                f"{what}: fewer equations than coefficients",
                expected=f"at least {equations.gram.shape[-1]} samples",
                got=str(total),
                remedy="repeat the motion more often, or lower the order",
            )
        widths = (None, *(w for w in reversed(WIDTHS) if w < equations.gram.shape[1] // 2))
        errors: dict[str, float] = {}
        width = self.width
        if width is None:
            best: tuple[float, int | None] = (np.inf, None)
            for candidate in widths:
                error = equations.held_out_error(candidate)
                errors["all" if candidate is None else str(candidate)] = min(error, 1e300)
                if error < _GAIN * best[0]:
                    best = (error, candidate)
            width = best[1]
        coefficients = equations.complete(equations.solution(width, range(_FOLDS)))
        lead = np.repeat(coefficients[:1], self.order - 1, axis=0)  # no equation ends within the first lags
        notes = {
            "width": "all" if width is None else width,
            "width_error": errors,
            "repetitions": len(records),
            "samples": total,
        }
        return AlongTrajectoryModel(spec, np.concatenate([lead, coefficients]), self.order, start, notes)

    def _refuse_feedback(self, records: Sequence[Trajectory], spec: PlantSpec, what: str) -> None:
        """Refuse repetitions that differ only by what a controller makes of the outputs."""
        if len(records) < 2 or spec.nu == 0 or self.least_excitation <= 0:
            return
        shortest = min(map(len, records))
        cut = [record[:shortest] for record in records]
        means = [np.mean([getattr(record, name) for record in cut], axis=0) for name in ("u", "y")]
        apart = [replace(record, u=record.u - means[0], y=record.y - means[1]) for record in cut]
        for name in ("u", "y"):
            size, deviation = (np.concatenate([getattr(record, name) for record in part]) for part in (cut, apart))
            if np.all(np.abs(deviation).max(axis=0) <= EXACT * np.abs(size).max(axis=0)):
                raise FitError(
                    f"{what}: the repetitions do not differ",
                    expected="inputs and outputs that differ between repetitions",
                    got=f"{len(records)} repetitions with the same {'inputs' if name == 'u' else 'outputs'}",
                    remedy="add a random part to the input of each repetition",
                )
        solution = one_step(apart, self.order, False, 0.0, what)
        refuse_feedback(solution, Columns(spec, self.order), self.least_excitation, what)


@dataclass(frozen=True, eq=False)
class _Equations:
    """Sums of the equations at every sample, in folds: gram (F, N, p, p), right (F, N, p, ny), square (F, N, ny).

    With ``means`` (N, p), (N, ny) of the repetitions they are those of the departures from them.
    """

    gram: FloatArray
    right: FloatArray
    square: FloatArray
    weight: FloatArray
    means: tuple[FloatArray, FloatArray] | None

    @classmethod
    def of(cls, records: Sequence[Trajectory], lags: int) -> _Equations:
        """Return the sums."""
        apart = len(records) >= REPEATED
        rows = [(design(record, lags, not apart), record.y[lags:]) for record in records]
        means = None
        if apart:
            means = np.mean([phi for phi, _ in rows], axis=0), np.mean([after for _, after in rows], axis=0)
            rows = [(phi - means[0], after - means[1]) for phi, after in rows]
        longest, p, ny = max(len(phi) for phi, _ in rows), rows[0][0].shape[1], records[0].spec.ny
        gram = np.zeros((_FOLDS, longest, p, p))
        right, square = np.zeros((_FOLDS, longest, p, ny)), np.zeros((_FOLDS, longest, ny))
        for number, (phi, after) in enumerate(rows):
            index = np.arange(len(phi))
            fold = (index + number) % _FOLDS
            gram[fold, index] += phi[:, :, None] * phi[:, None, :]
            right[fold, index] += phi[:, :, None] * after[:, None, :]
            square[fold, index] += after**2
        spread = np.sqrt(square.sum(axis=(0, 1)) / sum(len(phi) for phi, _ in rows))
        return cls(gram, right, square, divisor(spread), means)

    def complete(self, theta: FloatArray) -> FloatArray:
        """Return the coefficients with that of the constant (N, p + 1, ny)."""
        if self.means is None:
            return theta
        level = self.means[1] - np.einsum("kp,kpo->ko", self.means[0], theta)
        return np.concatenate([theta, level[:, None]], axis=1)

    def solution(self, width: int | None, folds: Sequence[int]) -> FloatArray:
        """Return the coefficients (N, p, ny) of some folds."""
        gram, right = _pooled(self.gram[list(folds)].sum(0), width), _pooled(self.right[list(folds)].sum(0), width)
        found = np.empty_like(right)
        for k, (matrix, other) in enumerate(zip(gram, right, strict=True)):
            if width is None and k:
                found[k] = found[0]
                continue
            size = divisor(np.sqrt(np.diag(matrix)))
            found[k] = solved(matrix / np.outer(size, size), other / size[:, None]) / size[:, None]
        return found

    def held_out_error(self, width: int | None) -> float:
        """Return the mean squared error on equations left out, relative to the outputs; infinite where none is left."""
        lost = 0.0
        for fold in range(_FOLDS):
            theta = self.solution(width, [k for k in range(_FOLDS) if k != fold])
            miss = self.square[fold] - 2 * np.einsum("kpo,kpo->ko", theta, self.right[fold])
            miss = miss + np.einsum("kpo,kpq,kqo->ko", theta, self.gram[fold], theta)
            lost += float(np.sum(np.maximum(miss, 1e-20 * self.square[fold]) / self.weight**2))
        return lost if np.isfinite(lost) else np.inf


def _pooled(sums: FloatArray, width: int | None) -> FloatArray:
    """Return sums (N, ...) over a window about every sample, weighed by its distance."""
    if width is None:
        return np.broadcast_to(sums.sum(axis=0), sums.shape)
    found = np.zeros_like(sums)
    for shift in range(-width, width + 1):
        share = 1.0 - (shift / (width + 1)) ** 2
        low, high = max(0, -shift), len(sums) - max(0, shift)
        found[low:high] += share * sums[low + shift : high + shift]
    return found
