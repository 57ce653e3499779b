"""Which postures calibrate an arm best: a design chosen among those that it can reach."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from harness.errors import InputError
from harness.models.analysis import Findings, Takes
from harness.options import check_options
from harness.signals import FloatArray
from identifiers.mechanics.arms.calibration import Calibrated

if TYPE_CHECKING:
    from harness.physics.arms.marked_arm import MarkedArm

TOLD = 1e-6
"""Singular value, of the largest one, below which no posture of the arm tells a direction of the parameters."""
PASSES = 20  # Times that every posture is offered for exchange, at most: three to six are enough.
CHANCE = 20  # Random designs that the chosen one is compared with.

Criterion = Literal["D", "A", "E"]


@dataclass(frozen=True)
class CalibrationPoses(Calibrated):
    """Postures that tell the geometry of an arm best, and how well they and random ones do.

    Of random postures within the limits of the joints those are kept that make the covariance of what can be told
    smallest, by exchange until no exchange betters it (Fedorov 1972, *Theory of Optimal Experiments*, sec. 3.3). ``D``:
    its determinant, which is the observability index O1 (Borm & Menq 1991, *Int. J. Robotics Res.* 10(5):539); ``A``:
    the mean variance; ``E``: the worst direction (O3). Parameters count in radians and in the reach of the arm.

    Parameters
    ----------
    postures : int
        How many are wanted.
    among : int
        How many random ones they are chosen from.
    criterion : {"D", "A", "E"}
    noise : float
        Standard deviation of a coordinate of the marker [m].
    turn_noise : float
        With ``pose``: standard deviation of the marker's orientation about each axis [rad].
    above : float, optional
        Least height of the marker [m]: below it is a table.
    reach : float
        Range of the readings of joints without limits [rad or m], to both sides.

    Raises
    ------
    InputError
        If an option is wrong, or the subject is no arm.
    """

    takes: ClassVar[Takes] = "definition"
    postures: int = 20
    among: int = 400
    criterion: Criterion = "D"
    noise: float = 1e-3
    turn_noise: float = 5e-3
    above: float | None = None
    reach: float = np.pi

    def of(self, subject: Any, *, rng: np.random.Generator) -> Findings:
        """Return the postures, and the deviations that they leave."""
        from harness.physics.arms.marked_arm import MarkedArm
        from harness.physics.arms.mechanism import arm_of

        own = arm_of(subject, "postures")
        check_options(self, "calibration-poses", postures=f">= 2, <= {self.among}", noise="> 0",
                      turn_noise="> 0")  # fmt: skip
        arm = MarkedArm(own, self.marker, pose=self.pose)
        names = self.free(arm)
        q, places = self._reachable(arm, rng)
        rows, free = self._rows(arm, names, q)
        _, singular, directions = np.linalg.svd(rows.reshape(-1, len(names)), full_matrices=False)
        told = directions[singular > TOLD * singular[0]]
        each = rows.shape[1]
        if each * self.postures < len(told):
            raise InputError(
                "option postures",
                expected=f"at least {-(-len(told) // each)}: {len(told)} directions can be told, {each} numbers a "
                "posture",
                got=str(self.postures),
                remedy="ask for more postures",
            )
        seen = rows @ told.T
        chance = [rng.choice(len(q), self.postures, replace=False).tolist() for _ in range(CHANCE)]
        begun = min(chance, key=lambda chosen: _cost(_information(seen, chosen), self.criterion))
        chosen = _exchanged(seen, begun, self.criterion)
        designs: list[list[int]] = [chosen, *chance]
        index = [self._index(seen, design) for design in designs]
        deviations = [self._deviations(arm, free, told, seen, design) for design in designs]
        usual = np.median(deviations[1:], axis=0)
        known = np.linalg.norm(told, axis=0) ** 2 > 1 - np.sqrt(TOLD)  # the others are told in sums only
        positions = [channel.name for channel in arm.arm.positions]
        table = [
            {**dict(zip(positions, map(float, q[k]), strict=True)),
             **{f"marker {axis} [m]": float(x) for axis, x in zip("xyz", places[k], strict=True)}}
            for k in chosen
        ]  # fmt: skip
        words = [
            f"{len(told)} of {len(names)} parameters' directions can be told from "
            f"{'poses' if self.pose else 'places'} of the marker",
            f"observability index O1 {index[0]:.3g}; of {CHANCE} random designs {np.median(index[1:]):.3g} "
            f"(best {max(index[1:]):.3g})",
            *self._promise([name for name, sure in zip(names, known, strict=True) if sure],
                           deviations[0][known], usual[known]),
        ]  # fmt: skip
        details = {"names": names, "postures": q[chosen], "deviations": deviations[0], "random": usual,
                   "told": [bool(sure) for sure in known], "index": index[0]}  # fmt: skip
        title = f"postures that calibrate {own.name}"
        return Findings(title, table, words, details, lambda: _drawn(title, names, known, deviations[0], usual))

    def _reachable(self, arm: MarkedArm, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Return random postures (among, n) within all limits, and the places of the marker."""
        bounds = [
            (joint.lower, joint.upper) if np.isfinite(joint.lower) else (-self.reach, self.reach)
            for joint in arm.arm.arm.moving
        ]
        low, high = np.array(bounds).T
        q = rng.uniform(low, high, size=(20 * self.among, arm.arm.n))
        places = arm.places(q)[:, :3]
        kept = np.nonzero(places[:, 2] >= (-np.inf if self.above is None else self.above))[0][: self.among]
        if len(kept) < self.among:
            raise InputError(
                "option above",
                expected="a height that the marker keeps in one of twenty random postures",
                got=f"{self.above} m, kept in {len(kept)} of {len(q)}",
                remedy="lower it, or leave it out",
            )
        return q[kept], places[kept]

    def _rows(self, arm: MarkedArm, names: Sequence[str], q: FloatArray) -> tuple[FloatArray, list[int]]:
        """Return the gradient of what is seen, in units of its noise, by the parameters in theirs (N, d, k)."""
        every = list(arm.parameters)
        free = [every.index(name) for name in names]
        _, gradient, _ = arm.jacobians(q, arm.vector(), free)
        noise = np.repeat([self.noise, self.turn_noise], 3)[: gradient.shape[1], None]
        return gradient * arm.scale[free] / noise, free

    def _index(self, seen: FloatArray, chosen: Sequence[int]) -> float:
        """Return O1: the geometric mean of the singular values over the root of the postures, noise as 1 mm."""
        _, size = np.linalg.slogdet(_information(seen, chosen) * (self.noise / 1e-3) ** 2)
        return float(np.exp(0.5 * size / seen.shape[2]) / np.sqrt(len(chosen)))

    def _deviations(
        self, arm: MarkedArm, free: Sequence[int], told: FloatArray, seen: FloatArray, chosen: Sequence[int]
    ) -> FloatArray:
        """Return the standard deviations (k,) that a design leaves, in what is told of every parameter."""
        inner = np.linalg.inv(_information(seen, chosen))
        return np.asarray(np.sqrt(np.einsum("di,de,ei->i", told, inner, told)) * arm.scale[list(free)])

    def _promise(self, names: Sequence[str], here: FloatArray, usual: FloatArray) -> list[str]:
        """Return how well what is told for itself will be known."""
        if not names:
            return ["no parameter is told for itself: fix some (option fixed)"]
        ratio = usual / here
        turns = [k for k, name in enumerate(names) if name.startswith(("offset", "tilt", "camera_r", "marker_r"))]
        worst = [f"{1e3 * max(here[k] for k in turns):.2g} mrad"] if turns else []
        others = [k for k in range(len(names)) if k not in turns]
        worst += [f"{1e3 * max(here[k] for k in others):.2g} mm"] if others else []
        return [
            f"with noise of {1e3 * self.noise:g} mm standard deviations of at most {' and '.join(worst)}; random "
            f"postures leave {np.median(ratio):.2g} times as much (up to {ratio.max():.2g})"
        ]


def _information(seen: FloatArray, chosen: Sequence[int]) -> FloatArray:
    """Return the information matrix (r, r) of postures."""
    rows = seen[list(chosen)].reshape(-1, seen.shape[2])
    return np.asarray(rows.T @ rows)


def _cost(information: FloatArray, criterion: Criterion) -> Any:
    """Return what is to be small, of matrices (..., r, r)."""
    values = np.maximum(np.linalg.eigvalsh(information), 1e-300)
    if criterion == "D":
        return -np.sum(np.log(values), axis=-1)
    return np.sum(1.0 / values, axis=-1) if criterion == "A" else -values[..., 0]


def _exchanged(seen: FloatArray, begun: Sequence[int], criterion: Criterion) -> list[int]:
    """Return a design that no exchange of one posture betters."""
    chosen = list(begun)
    each = seen.transpose(0, 2, 1) @ seen
    whole = _information(seen, chosen)
    for _ in range(PASSES):
        bettered = False
        for place, old in enumerate(chosen):
            costs = _cost(whole - each[old] + each, criterion)
            costs[[k for k in chosen if k != old]] = np.inf
            new = int(np.argmin(costs))
            if costs[new] < costs[old] - 1e-9 * abs(costs[old]):
                whole, chosen[place], bettered = whole - each[old] + each[new], new, True
        if not bettered:
            break
    return chosen


def _drawn(title: str, names: Sequence[str], known: FloatArray, here: FloatArray, usual: FloatArray) -> Any:
    """Return a figure: the deviation of every parameter that is told, of the design and of random postures."""
    from harness.plots import sheet

    figure = sheet(figsize=(8.0, 1.5 + 0.22 * max(int(np.sum(known)), 4)), layout="constrained")
    axes = figure.subplots()
    rows = np.nonzero(known)[0].tolist()
    for values, mark, label in ((usual, "o", "random postures (median)"), (here, "D", "chosen postures")):
        axes.semilogx(1e3 * values[rows], range(len(rows)), mark, ms=5, label=label)
    axes.set_yticks(range(len(rows)), [names[k] for k in rows])
    axes.invert_yaxis()
    axes.grid(axis="x", alpha=0.3)
    axes.set_xlabel("standard deviation [mrad or mm]")
    axes.set_title(title)
    axes.legend()
    return figure
