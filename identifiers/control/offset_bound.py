"""How large an offset of the sensors an LQR bears: linear, certified and simulated bounds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from harness.algebra import runge_kutta
from harness.errors import InputError
from harness.models.analysis import Findings, Takes
from harness.signals import FloatArray
from identifiers.control.invariant import Certificate, Ellipsoid, Loop, certified, widened

_SMALL, _FIRST = 1e-4, 0.05
"""Offset and level of the LQR's own cost with which the search for an ellipsoid begins, relative to a state of 1."""

_SHRUNK = (0.98, 0.95, 0.9)
"""What was found is certified at these shares of the offset, until one holds: between sampled points V' is larger."""

_STARTS = 2  # Searches for the ellipsoid whose centre may move, each on other points: some end in a corner.
_NEARLY = 0.98  # Part of a fall that an ellipsoid may reach.

_MARGINS = (5.0, 1.0)
"""The search begins with a wider margin: a narrow one from the start ends in a corner of what is possible."""

_WIDER, _GROWN, _BISECTIONS = 1.15, 100, 6
"""Steps by which an offset grows until something is lost, and halvings of the last step."""

_TOLERANCE = 1e-8  # Of a steady state, in the unit of each state.


@dataclass(frozen=True)
class OffsetBound:
    """The largest offset of the sensors under which a mechanism that is balanced by an LQR stays up, by several bounds.

    ``u = -K (x + d e)``: the sensors read the coordinates too large by d in the direction e; rates and inputs are
    exact, in continuous time. ``certified``: an ellipsoid about the target that no offset makes the state leave, from
    rest at the target or anywhere inside; found by linear programs, proved by Taylor models over all of its boundary
    (:mod:`identifiers.control.invariant`), so never too large. It holds for offsets that change as they like within
    ``+-d``, and, larger, for an offset that is constant and of the given sign. ``posture``: the largest constant offset
    whose steady posture is stable. ``simulated``: from rest the mechanism falls under the first constant offset, or
    under one that switches its sign so as to push outwards, of those tried; so never too small. ``linear``: the
    offset whose steady lean, by the linearised loop, is a fall. A mechanism that falls under 0.045 rad though the
    linear bound says 0.07, and stands at 0.04 though its posture is lost at 0.03: these are different questions.

    Parameters
    ----------
    target : mapping
        State to be held, by name, 0 for the others; an equilibrium under zero input.
    error : mapping
        Direction e: by how much each coordinate reads too large for d = 1; all of them 1 by default.
    q : sequence of float, optional
        Weights of the states; by default 10 for coordinates and 1 for the others.
    r : float or sequence
        Weights of the inputs: one number, or one each.
    fall : float
        Departure of the first coordinate that is a fall, in its unit.
    duration : float
        Of a simulation [s].
    margin : float
        How fast V must fall on the points that are looked at before the proof, relative to V [1/s]: less finds larger
        bounds and takes longer to prove.
    cells : int
        Pieces of the boundary that a proof may look at.
    """

    takes: ClassVar[Takes] = "definition"
    target: dict[str, float] = field(default_factory=dict)
    error: dict[str, float] = field(default_factory=dict)
    q: Sequence[float] | None = None
    r: float | Sequence[float] = 1.0
    fall: float = np.pi / 2
    duration: float = 20.0
    margin: float = 0.1
    cells: int = 3_000_000

    def of(self, subject: Any, *, rng: np.random.Generator) -> Findings:
        """Return the bounds, least first in what they ask of the offset."""
        bench = _Bench(self, subject)
        posture = bench.largest(lambda d: bench.steady(d)[1])
        bounds: dict[str, float] = {}
        sets: dict[str, tuple[Ellipsoid, Certificate]] = {}
        for name, moving in (("certified, changing", False), ("certified, constant", True)):
            sets[name] = bench.proved(moving, rng)
            bounds[name] = sets[name][0].high if sets[name][1].holds else 0.0
        shape = sets["certified, changing"][0]
        if bounds["certified, constant"] < bounds["certified, changing"]:  # what may change may stay
            sets["certified, constant"] = sets["certified, changing"]
            bounds["certified, constant"] = bounds["certified, changing"]
        bounds["posture"] = posture
        bounds["simulated, changing"] = bench.largest(lambda d: bench.simulated(d, shape)[1], _BELOW * posture)
        bounds["simulated, constant"] = bench.largest(lambda d: bench.simulated(d, None)[1], _BELOW * posture)
        bounds["linear"] = self.fall / abs(float(bench.gains[0])) if bench.gains[0] else np.inf
        return _findings(self, bench, bounds, sets)


class _Bench:
    """The loop, its linearisation and its simulation."""

    def __init__(self, options: OffsetBound, system: Any) -> None:
        import casadi as ca
        from scipy.linalg import LinAlgError, solve_continuous_are

        if not hasattr(system, "coordinates"):
            raise InputError(
                "offset-bound",
                expected="a mechanism whose equations are known",
                got=type(system).__name__,
                remedy="give a model by its name, such as acrobot",
            )
        names = [channel.name for channel in system.states]
        coordinates = [one.name for one in system.coordinates]
        unknown = sorted((set(options.target) - set(names)) | (set(options.error) - set(coordinates)))
        if unknown or not coordinates or min(options.fall, options.duration, options.margin) <= 0:
            raise InputError(
                "offset-bound",
                expected=f"a mechanism; target among {', '.join(names)}, error among {', '.join(coordinates)}; fall, "
                "duration and margin above 0",
                got=f"{', '.join(unknown) or 'known names'}; {len(coordinates)} coordinates; fall={options.fall}, "
                f"duration={options.duration}, margin={options.margin}",
                remedy="correct them",
            )
        self.options, self.system = options, system
        nx, nu = system.nx, system.nu
        target = np.array([float(options.target.get(name, 0.0)) for name in names])
        error = np.zeros(nx)
        for name in coordinates:
            error[names.index(name)] = float(options.error.get(name, 0.0 if options.error else 1.0))
        self.first = names.index(coordinates[0])
        x, u = ca.SX.sym("x", nx), ca.SX.sym("u", nu)
        f = ca.Function("f", [system.x, system.u, system.p, system.t], [system.upright(system.f)])
        rate = f(target + x, u, ca.DM(system.vector()), 0.0)
        slopes = ca.Function("A", [x, u], [ca.densify(ca.jacobian(rate, one)) for one in (x, u)])
        a, b = (one.full() for one in slopes(np.zeros(nx), np.zeros(nu)))
        usual = [10.0 if name in coordinates else 1.0 for name in names]
        given = np.asarray(usual if options.q is None else options.q, dtype=float)
        weights = np.diag(given), np.diag(np.broadcast_to(np.asarray(options.r, dtype=float), (nu,)))
        if given.shape != (nx,):
            raise InputError(
                "offset-bound: q", expected=f"{nx} weights, one for each state", got=str(given.tolist()),
                remedy="correct it",
            )  # fmt: skip
        try:
            self.cost = solve_continuous_are(a, b, *weights)
            np.linalg.cholesky(self.cost)
        except (LinAlgError, ValueError) as failed:
            raise InputError(
                "offset-bound", expected="a mechanism that an LQR can hold at the target", got=str(failed),
                remedy="choose another target, or weights that see every state",
            ) from failed  # fmt: skip
        gain = np.linalg.solve(weights[1], b.T @ self.cost)
        self.loop = Loop(x, u, rate, gain, error)
        self.gains = np.linalg.solve(a - b @ gain, b @ gain @ error)

    def steady(self, d: float) -> tuple[FloatArray, bool]:
        """Return the steady state under a constant offset, followed from none, and whether it is stable and no fall."""
        x: FloatArray = np.zeros(self.loop.nx)
        stable = True
        for part in np.linspace(0.0, d, _FOLLOWED)[1:]:
            for _ in range(_FOLLOWED):
                values, by_x, _ = (one.full() for one in self.loop.slopes(x, float(part)))
                step = np.linalg.solve(by_x, values[:, 0])
                x = x - step
                if np.abs(step).max() < _TOLERANCE:
                    break
            stable = bool(np.linalg.eigvals(self.loop.slopes(x, float(part))[1].full()).real.max() < 0)
            if not (stable and np.isfinite(x).all() and abs(x[self.first]) < self.options.fall):
                return x, False
        return x, stable

    def simulated(self, d: float, shape: Ellipsoid | None) -> tuple[FloatArray, bool]:
        """Return states (n, nx) from rest, and whether it stays up; with a shape d switches so that V grows."""
        p = np.zeros((self.loop.nx, self.loop.nx)) if shape is None else shape.lower @ shape.lower.T
        count = self.count
        switches = np.full((1, count), float(shape is not None))
        start = np.zeros(self.loop.nx)
        run = self.motion(start, np.full((1, count), d), np.tile(p, (1, count)), switches).full().T
        away = np.abs(run[:, self.first])
        fallen = ~(away < self.options.fall)
        return run[: int(np.argmax(fallen))] if fallen.any() else run, not fallen.any()

    @property
    def count(self) -> int:
        """Steps of a simulation."""
        return max(round(self.options.duration / _STEP), 1)

    @cached_property
    def motion(self) -> Any:
        """All steps of a simulation."""
        return self.stepping.mapaccum(self.count)

    @cached_property
    def stepping(self) -> Any:
        """One step of a simulation (classical Runge-Kutta) as a CasADi function of x, d, P and whether d switches."""
        import casadi as ca

        nx = self.loop.nx
        x, d, p, switches = ca.SX.sym("x", nx), ca.SX.sym("d"), ca.SX.sym("P", nx, nx), ca.SX.sym("s")
        by_d = self.loop.slopes(x, 0.0)[2]
        outwards = ca.if_else(ca.dot(p @ x, by_d) < 0, -1.0, 1.0)
        held = ca.if_else(switches > 0, d * outwards, d)
        after = runge_kutta(lambda at: self.loop.slopes(at, held)[0], x, _STEP)
        return ca.Function("step", [x, d, p, switches], [after], {"cse": True})

    def largest(self, holds: Callable[[float], bool], first: float = _SMALL) -> float:
        """Return the offset up to which something holds, of those tried from small to large."""
        good, bad = 0.0, first
        while bad > _SMALL and not holds(bad):
            bad /= 2.0  # begun too large
        for _ in range(_GROWN):
            if not holds(bad):
                break
            good, bad = bad, bad * _WIDER
        else:
            return np.inf
        for _ in range(_BISECTIONS):
            middle = 0.5 * (good + bad)
            good, bad = (middle, bad) if holds(middle) else (good, middle)
        return good

    def proved(self, moving: bool, rng: np.random.Generator) -> tuple[Ellipsoid, Certificate]:
        """Return the ellipsoid of the largest offset that is proved, and its certificate."""
        first = Ellipsoid(
            np.asarray(np.linalg.cholesky(self.cost / _FIRST), dtype=np.float64),
            np.zeros(self.loop.nx),
            _SMALL if moving else -_SMALL,
            _SMALL,
        )
        within = np.full(self.loop.nx, np.inf)
        within[self.first] = _NEARLY * self.options.fall
        tried = []
        for _ in range(_STARTS if moving else 1):
            one = first
            for factor in _MARGINS:
                margin = factor * self.options.margin
                one = widened(self.loop, one, moving=moving, margin=margin, within=within, rng=rng)
                tried.append(one)
        proof = Certificate(False, 0)
        for found in sorted(tried, key=lambda one: -one.high):  # a wider margin is proved where a narrow one is not
            for share in _SHRUNK:
                one = replace(found, low=share * found.low, high=share * found.high)
                inside = float(np.abs(one.centre[self.first]) + one.half_widths[self.first]) < self.options.fall
                proof = certified(self.loop, one, most=self.options.cells)
                proof = Certificate(proof.holds and inside, proof.cells)
                if proof.holds:
                    return one, proof
        return replace(tried[0], low=0.0, high=0.0), proof


_BELOW = 0.5  # Part of the largest offset of a stable posture with which simulations begin.
_FOLLOWED = 20  # Steps of the continuation of a steady state, and of Newton's method in each.
_STEP = 5e-3  # Of a simulation [s]: a twentieth of the fastest time constant of the textbook's Acrobot under its LQR.


def _findings(
    options: OffsetBound, bench: _Bench, bounds: Mapping[str, float], sets: Mapping[str, tuple[Ellipsoid, Certificate]]
) -> Findings:
    """Return the table, what it means, and its picture."""
    coordinate = bench.system.states[bench.first]
    meaning = {
        "certified, changing": "stays in a set whatever the offset does within +-",
        "certified, constant": "stays in a set under a constant offset of this sign",
        "posture": "steady posture loses stability beyond",
        "simulated, changing": "stays up from rest while the offset switches to push outwards",
        "simulated, constant": "stays up from rest under a constant offset",
        "linear": f"linear lean reaches {options.fall:.3g} {coordinate.unit}",
    }
    rows = [
        {"bound": name, f"offset [{coordinate.unit}]": value, "what it says": meaning[name],
         "cells": sets[name][1].cells if name in sets else 0}
        for name, value in bounds.items()
    ]  # fmt: skip
    words = [
        f"certified {bounds['certified, constant']:.3g} {coordinate.unit} constant and "
        f"{bounds['certified, changing']:.3g} {coordinate.unit} changing; simulated it stays up to "
        f"{bounds['simulated, constant']:.3g} and {bounds['simulated, changing']:.3g} {coordinate.unit}",
        "linear lean per offset: " + ", ".join(
            f"{bench.system.states[k].name} {bench.gains[k]:.1f}" for k in range(len(bench.system.coordinates))
        ),
    ]  # fmt: skip

    def draw() -> Any:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(12, 3.8), layout="constrained")
        ladder, lean, plane = figure.subplots(1, 3)
        names = list(bounds)
        ladder.barh(range(len(names)), [bounds[name] for name in names],
                    color=["C2" if name in sets else "C0" for name in names])  # fmt: skip
        ladder.set(yticks=range(len(names)), xlabel=f"offset [{coordinate.unit}]", title="bounds of the offset")
        ladder.set_yticklabels(names)
        ladder.invert_yaxis()
        grid = np.linspace(0.0, bounds["posture"], 40)
        postures = np.array([bench.steady(float(d))[0] for d in grid[:-1]])
        for k, one in enumerate(bench.system.coordinates):
            line = lean.plot(grid[:-1], postures[:, k], label=one.name)[0]
            lean.plot(grid, bench.gains[k] * grid, "--", color=line.get_color(), lw=1)
        lean.axvline(bounds["certified, constant"], color="C2", lw=1, label="certified, constant")
        lean.locator_params(axis="x", nbins=5)
        lean.set(xlabel=f"offset [{coordinate.unit}]", ylabel="steady posture", title="steady lean (dashed: linear)")
        lean.legend(fontsize=8)
        around = np.linspace(0, 2 * np.pi, 200)
        second = (bench.first + 1) % bench.loop.nx
        for (name, (one, proof)), colour in zip(sets.items(), ("C0", "C2"), strict=True):
            if not proof.holds:
                continue
            spread = np.linalg.inv(one.lower @ one.lower.T)[np.ix_([bench.first, second], [bench.first, second])]
            ring = np.linalg.cholesky(spread) @ np.vstack([np.cos(around), np.sin(around)])
            plane.plot(one.centre[bench.first] + ring[0], one.centre[second] + ring[1], color=colour, label=name)
            run = bench.simulated(one.high, one if one.low < 0 else None)[0]
            plane.plot(run[:, bench.first], run[:, second], color=colour, lw=0.8, ls=":")
        plane.plot(0, 0, "k+")
        plane.set(xlabel=f"{coordinate.name} [{coordinate.unit}]", ylabel=bench.system.states[second].name,
                  title="sets it cannot leave, runs (dotted)")  # fmt: skip
        plane.legend(fontsize=8)
        return figure

    shapes = {
        name: {"lower": one.lower.tolist(), "centre": one.centre.tolist(), "holds": proof.holds}
        for name, (one, proof) in sets.items()
    }
    details = {"bounds": dict(bounds), "gains": bench.gains, "sets": shapes}
    return Findings("bounds of a sensor offset", rows, words, details, draw)
