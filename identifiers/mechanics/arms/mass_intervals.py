"""How surely a record tells the masses of an arm: by itself, beside physics, beside shapes, beside the file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from harness.models.analysis import Findings, Takes
from harness.options import check_options
from harness.signals import Dataset, FloatArray
from identifiers.common.records import real_signals, usable
from identifiers.mechanics.arms.inertial import Inertial, TorqueEquations, speaks
from identifiers.mechanics.motion import Motion, Smoothing, noisier

if TYPE_CHECKING:
    from harness.physics.arms.arm import ArmModel
    from harness.physics.arms.inertial_fit import InertialProblem

QUANTILE = 1.96  # Of the normal distribution, for 95 %.
BLOCKS = 40  # Stretches of the records by which the colour of the errors is told.
VAST = 1e3  # Masses beyond so many times the file's count as without bound.
NONE = 1e-5  # Masses below this part of the file's count as nothing: ten times what the solver keeps of a body.
UNTOLD = 1e-10  # Share of a direction's information, of the largest one's, below which the data do not tell it.
KINDS = ("data alone", "+ positivity", "+ hull", "+ prior")  # What is known beside the data, more and more of it.
MEANT = ("", "bodies of positive density", "mass within the shapes", "the file, trusted to {trust:.0%}")
Interval = tuple[float, float]
COLOURS = ("#9aa5b1", "#3b82c4", "#2a9d6f", "#c2571a")


@dataclass(frozen=True)
class MassIntervals:
    """95 % intervals of every mass of an arm: from a record alone, and beside what else is known; with a picture.

    Torques along a motion tell combinations of the inertial parameters only. What they leave open is bounded by
    physics (a body has a positive density), by the shapes of the file (mass lies within them; Wensing, Kim & Slotine
    2018, *IEEE RA-L* 3:60, eq. 15), and by how far the file is believed (entropic prior; Lee, Wensing & Park 2019,
    *IEEE T-RO* 36:113). Intervals are those of the profile likelihood within these limits; errors that stay for a
    while count as fewer samples, and what noise of the positions and their smoothing change is uncertain as well.

    Parameters
    ----------
    model : str
        A named arm or a URDF or MJCF file.
    free : sequence of str, optional
        Joints whose bodies are free; the others stay as in the file. All that move by default.
    trust : float
        Relative standard deviation of the file's inertial parameters, for the last interval.
    motor_inertia : bool
        Whether rotors are fitted beside.
    smoothing : {"auto", "local", "spline", "kalman", "forward", "causal"}
        As of the lumped forms.

    Raises
    ------
    InputError
        If the records are not those of the arm, or an option is wrong.
    """

    takes: ClassVar[Takes] = "data"
    model: str = "iiwa"
    free: Sequence[str] | None = None
    trust: float = 0.3
    motor_inertia: bool = False
    smoothing: Smoothing = "auto"

    def channels(self) -> tuple[list[str], list[str]]:
        """Return the columns that it needs of a bare table, and those that it takes where they are there."""
        arm = self._arm()
        rates = [channel.name for channel in arm.states if channel not in arm.positions]
        return [channel.name for channel in arm.positions], rates

    def inputs(self) -> list[str]:
        """Return the torques."""
        return [channel.name for channel in self._arm().inputs]

    def of(self, subject: Dataset, *, rng: np.random.Generator) -> Findings:
        """Return the intervals, body by body."""
        from harness.physics.arms.inertial_fit import Bodies

        arm = self._arm()
        records, spec = usable(subject.estimation, samples=12, what="mass intervals")
        real_signals(spec, "mass intervals")
        speaks(arm, spec, "mass intervals")
        fit = Inertial(model=self.model, free=self.free, trust=self.trust, motor_inertia=self.motor_inertia,
                       smoothing=self.smoothing, intersample="zoh" if subject.intersample == "zoh" else "smooth",
                       hull=True)  # fmt: skip
        equations, moved = fit.prepared(arm, records)
        told = _Told.of(equations, moved)
        others = [
            fit.prepared(arm, [noisier(record, rng) for record in records], like=moved)[1],
            fit.prepared(arm, records, like=moved, coarser=True)[1],
        ]
        told = told.less_sure([_Told.of(equations, other).best - told.best for other in others])
        problem = fit.problem(arm, equations, told.gram, told.gram @ told.best)
        bodies = problem.bodies
        shaped = any(box is not None for box in bodies.boxes)
        plain = replace(problem, trust=None, bodies=Bodies(bodies.prior))
        problems = [plain, replace(problem, trust=None) if shaped else None, problem]
        names = [arm.arm.joints[body].name for body in equations.bodies]
        stated = bodies.prior[:, 0]
        ends = [self._ends(k, stated[k], told.interval(10 * k), problems) for k in range(len(names))]
        known = sum(interval is not None and np.isfinite(interval[1]) for interval, *_ in ends)
        words = [
            (f"{known} of {len(names)} masses are" if known else "no mass is") + " told by the data alone: a motion "
            "shows sums of masses, centres and inertias",
            f"errors stay alike for so long that {told.colour:.3g} samples count as one" if told.colour > 1 else "",
            "" if shaped else "the file states no shapes: mass may lie anywhere",
            "; ".join(self._legend()[1:]) + " (option trust)",
        ]
        rows = [
            {"body": name, "file [kg]": float(mass), **{
                f"{kind} [kg]": _shown(interval) for kind, interval in zip(KINDS, own, strict=True)
            }}
            for name, mass, own in zip(names, stated, ends, strict=True)
        ]  # fmt: skip
        finite = [[_finite(interval) for interval in own] for own in ends]
        details = {"bodies": names, "kinds": list(KINDS), "intervals": finite, "colour": told.colour}
        return Findings(
            f"masses of {arm.name}",
            rows,
            [text for text in words if text],
            details,
            lambda: _drawn(arm.name, names, stated, ends, self._legend()),
        )

    def _legend(self) -> list[str]:
        """Return what each of :data:`KINDS` means."""
        meant = [text.format(trust=self.trust) for text in MEANT]
        return [f"{kind}: {text}" if text else kind for kind, text in zip(KINDS, meant, strict=True)]

    def _arm(self) -> ArmModel:
        from harness.physics.arms.arm import load_arm

        check_options(self, "mass-intervals", trust="> 0")
        return load_arm(self.model)

    def _ends(
        self, body: int, stated: float, alone: Interval, problems: Sequence[InertialProblem | None]
    ) -> list[Interval | None]:
        """Return the intervals of one mass, for each of :data:`KINDS`; None where there is nothing to add."""
        from harness.physics.arms.inertial_fit import interval_of

        ends: list[Interval | None] = [alone]
        for problem in problems:
            if problem is None:
                ends.append(None)
                continue
            direction = np.zeros(problem.side.size)
            direction[10 * body] = 1.0
            low, high = interval_of(problem, direction, 0.5 * QUANTILE**2)
            ends.append((low if low > NONE * stated else 0.0, high if high < VAST * stated else np.inf))
        return ends


@dataclass(frozen=True, eq=False)
class _Told:
    """What records tell of the parameters: where they are likeliest, and how surely."""

    best: FloatArray  # (k,): By least squares, 0 in the directions that are not told
    gram: FloatArray  # (k, k): Information; 0 in those directions
    spread: FloatArray  # (k, r): A square root of the covariance in the others
    hidden: FloatArray  # (k, k - r): Directions that are not told, of parameters in units of their columns
    colour: float  # How many samples count as one

    @classmethod
    def of(cls, equations: TorqueEquations, moved: Sequence[Motion]) -> _Told:
        """Return what a motion tells, its errors taken for as many as count.

        How many do is the variance of the score of stretches over that of white errors (the sandwich of White 1982,
        *Econometrica* 50:1), its mean over the directions that are told.
        """
        gram, side, _ = equations.weighted(moved, True)
        size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        values, vectors = np.linalg.eigh(gram / np.outer(size, size))
        told = values > UNTOLD * values[-1]
        spread = vectors[:, told] / np.sqrt(values[told]) / size[:, None]
        best = spread @ (spread.T @ side)
        n, scores = equations.arm.n, []
        residuals = [equations.target(m) - (equations.rows(m.q, m.v, m.a) @ best).reshape(-1, n) for m in moved]
        every = np.concatenate(residuals)
        white = np.linalg.cholesky(np.linalg.inv(every.T @ every / len(every))).T
        length = max(len(every) // BLOCKS, 1)
        for m, residual in zip(moved, residuals, strict=True):
            for first in range(0, len(residual) - length + 1, length):
                part = slice(first, first + length)
                rows = white @ equations.rows(m.q[part], m.v[part], m.a[part]).reshape(length, n, -1)
                scores.append((rows.reshape(length * n, -1) @ spread).T @ (residual[part] @ white.T).ravel())
        colour = max(1.0, float(np.mean(np.sum(np.square(scores), axis=0))))
        return cls(best, gram / colour, spread * np.sqrt(colour), vectors[:, ~told], colour)

    def less_sure(self, shifts: Sequence[FloatArray]) -> _Told:
        """Return the same with an uncertainty (k,) more for each of several reasons, added to the covariance."""
        told = self.gram @ self.spread  # G S, with S S' the inverse of G where it has one
        apart = np.stack([told.T @ shift for shift in shifts], axis=1)
        inner = np.eye(self.spread.shape[1]) + apart @ apart.T  # covariance S inner S'
        gram = told @ np.linalg.solve(inner, told.T)
        return replace(self, gram=gram, spread=self.spread @ np.linalg.cholesky(inner))

    def interval(self, k: int) -> tuple[float, float]:
        """Return the interval of a parameter: all numbers where the records do not tell it."""
        if np.sum(self.hidden[k] ** 2) > np.sqrt(UNTOLD):
            return -np.inf, np.inf
        half = QUANTILE * float(np.linalg.norm(self.spread[k]))
        return float(self.best[k]) - half, float(self.best[k]) + half


def _shown(interval: Interval | None) -> str | None:
    """Return a cell of the table."""
    if interval is None:
        return None
    low, high = interval
    if np.isfinite(high):
        return f"{low:.3g} to {high:.3g}"
    return f"above {low:.3g}" if np.isfinite(low) else "no bound"


def _finite(interval: Interval | None) -> list[float | None] | None:
    """Return an interval for JSON: None where it has no end."""
    return None if interval is None else [end if np.isfinite(end) else None for end in interval]


def _drawn(
    arm: str, names: Sequence[str], stated: FloatArray, ends: Sequence[Sequence[Interval | None]], legend: Sequence[str]
) -> Any:
    """Return a figure: the intervals of every body, one below the other, the file's mass marked."""
    from harness.plots import sheet

    widest = 4 * float(stated.max())
    known = [interval[1] for own in ends for interval in own if interval is not None and interval[1] < widest]
    right = 1.1 * max([1.5 * float(stated.max()), *known])
    left = -0.1 * right
    figure = sheet(figsize=(8.0, 1.6 + 0.8 * len(names)), layout="constrained")
    axes = figure.subplots()
    for number, (mass, own) in enumerate(zip(stated, ends, strict=True)):
        for k, (kind, colour, interval) in enumerate(zip(legend, COLOURS, own, strict=True)):
            if interval is None:
                continue
            place, (low, high) = number + 0.19 * (k - 1.5), interval
            axes.plot([max(low, left), min(high, right)], [place, place], color=colour, lw=4, solid_capstyle="butt",
                      label=kind if number == 0 else None)  # fmt: skip
            for beyond, end, mark in ((low < left, left, "<"), (high > right, right, ">")):
                if beyond:
                    axes.plot([end], [place], mark, color=colour, ms=6, clip_on=False)
        axes.plot([mass, mass], [number - 0.42, number + 0.42], color="black", lw=1.2,
                  label="mass of the file" if number == 0 else None)  # fmt: skip
    axes.set_yticks(range(len(names)), names)
    axes.set_xlim(left, right)
    axes.invert_yaxis()
    axes.axvline(0.0, color="#cccccc", lw=0.8, zorder=0)
    axes.set_xlabel("mass [kg], 95 % intervals; an arrow goes on beyond the picture")
    axes.set_title(f"What tells the masses of {arm}")
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    return figure
