"""Identification and redesign in turns on a plant that need not be linear, from outputs measured with noise."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from harness.algebra import divisor
from harness.errors import FitError, InputError, PlantError
from harness.models.analysis import Findings, Takes
from harness.models.lqr import kalman_gain, lqr_gain
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.mechanics.grey_box import OutputError

_GONE = 10.0
"""A run has left the point when an output is so many times as far from it as the farthest one at the start, or as so
many deviations of the noise."""

_SMALL = 1e-5  # Step of the differences by which a mechanism is linearised, in the unit of each state and input.
_QUIET = 1e-9  # Least sensor noise that a filter is designed for: without any it would differentiate.
_FEWEST = 20  # Samples of a run at least: a record to learn from.

_TRIALS = (8, 16, 32, 64)
"""Noises under which two designs are compared from every start: more as long as nothing can be told."""

_LEVEL = 0.01  # Chance that a design which costs as much as the present one takes over, at each look at the trials.
_CHECKS = 64  # Noises, none of them used in a decision, under which the cost that is told is measured.

_NOTHING = 0.0
"""Coverage in a half of the runs up to which a fit is not tried. Where two runs share nothing but noise, the cross-Gram
matrix has as many negative eigenvalues as positive ones, and hardly ever none in both halves."""

_TRIED, _TOLD = 3, 4  # Streams of noise: of the trials that decide, and of those that are told.
_REPEATS = 2  # Runs under the same excitation in a round: what they share is no noise.

_COSTLY = 1e3
"""Cost of a run that left, in those of a plant that never moves from its start: worse than any that stayed."""


def repeatable_coverage(first: FloatArray, second: FloatArray) -> float:
    """Return how well regressors cover all directions, by what two runs under the same excitation share.

    The least singular value of a table of regressors is above 0 as soon as there is noise in it. Noise of one run is
    not that of the other: the symmetric cross-Gram matrix of both holds only what the excitation moves. Each column is
    scaled to an rms of 1; 1 is white, 0 leaves a direction out.

    - ``first, second`` (n, p): regressors of the same samples of both runs

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> moved = rng.normal(size=(4000, 1)) @ np.ones((1, 2))
    >>> noisy = [moved + 0.3 * rng.normal(size=moved.shape) for _ in range(2)]
    >>> bool(np.linalg.svd(noisy[0], compute_uv=False)[-1] / 4000**0.5 > 0.2), repeatable_coverage(*noisy) < 0.15
    (True, True)
    """
    size = divisor(np.sqrt(0.5 * (np.mean(first**2, axis=0) + np.mean(second**2, axis=0))))
    cross = (first / size).T @ (second / size) / len(first)
    return float(np.sqrt(max(float(np.linalg.eigvalsh(0.5 * (cross + cross.T))[0]), 0.0)))


@dataclass(frozen=True)
class Redesign:
    """Data under the controller so far, a new model, a new controller; again: what every round costs on the plant.

    A mechanism is to be held at a point, its outputs measured with noise. The first controller is designed with the
    parameters that are believed. In every round two runs under the same excitation are recorded; the parameters are
    fitted to all records so far by their free runs (``output-error``, which knows that the plant is not linear), and a
    Kalman filter and an LQR are designed on the mechanism linearised at the point. The new controller takes over where
    it is shown to cost less than the present one: both are run from the same starts under the same noise, 8 to 64
    times, and a one-sided t-test of the differences (a sign test where one of them leaves the point) has to say so at
    1 %. Where it does not, the round goes on with two more runs, up to ``batches`` times; then the turns end, as what
    is left to gain is smaller than what trials can tell. So the cost falls in every round but that last one. It is
    that of the outputs without noise, ``sum (y - y*)' q (y - y*) + u' r u``, averaged over the starts; what is told is
    measured under noise that no decision has seen, as the least of many measured costs is always too low.
    Identification for control in turns with design: Schrama 1992, *IEEE Trans. Autom. Control* 37:991.

    ``coverage`` is that of :func:`repeatable_coverage` for outputs, their differences and inputs; ``with noise`` is
    what the least singular value of one run says, which noise makes look well. Where the first is 0 in one half of the
    runs nothing is fitted.

    Parameters
    ----------
    model : str
        Name of the mechanism that is fitted, with the outputs of the plant; the fit starts from what is believed.
    believed : mapping
        Parameters that are believed; needed. Those of the model by default.
    target : mapping
        State at the point to be held, by name; 0 for the others. It holds there without an input.
    starts : sequence of mapping
        Initial states from which a controller is tried, by name; the first one also begins the records.
    rounds : int
        At most.
    batches : int
        Times that a round records two runs before it gives up.
    samples : int
        Of a run.
    noise : float
        Standard deviation of the sensor noise, in the unit of each output.
    excitation : float
        Standard deviation of the steps added to each input, in its unit.
    hold : int
        Samples that a step lasts.
    q, r : float or sequence
        Weights of outputs and inputs: one number, or one each.
    """

    takes: ClassVar[Takes] = "maker"
    model: str = "pendulum"
    believed: dict[str, float] = field(default_factory=dict)
    target: dict[str, float] = field(default_factory=dict)
    starts: Sequence[Mapping[str, float]] = ()
    rounds: int = 5
    batches: int = 4
    samples: int = 60
    noise: float = 3e-3
    excitation: float = 0.1
    hold: int = 3
    q: float | Sequence[float] = 1.0
    r: float | Sequence[float] = 0.1

    def of(self, subject: Any, *, rng: np.random.Generator) -> Findings:
        """Return cost, coverage and what was done in every round."""
        few = min(self.rounds, self.hold, self.batches) < 1 or self.samples < _FEWEST
        if not self.believed or not self.starts or few:
            raise InputError(
                "redesign",
                expected="believed parameters, starts, rounds, batches and hold of at least 1, samples of at least "
                f"{_FEWEST}",
                got=f"believed={self.believed}, starts={list(self.starts)}, rounds={self.rounds}, hold={self.hold}, "
                f"batches={self.batches}, samples={self.samples}",
                remedy="say what is believed and where to start, such as -O 'believed={mgl=0.7}' "
                "-O 'starts=[{theta=3.0}]'",
            )
        with subject() as plant:
            bench = _Bench(self, plant)
            seed = int(rng.integers(2**62))
            parameters: dict[str, float] = dict(self.believed)
            controller = bench.designed(parameters)
            costs = bench.costs(controller, [seed, _TOLD], range(_CHECKS))
            rows = [_row(0, costs, costs, 0, (0.0, 0.0), "designed with what is believed", parameters, self.believed)]
            records: list[Trajectory] = []
            for number in range(1, self.rounds + 1):
                done = self._round(bench, controller, parameters, records, seed, number)
                last = costs
                if done.better:
                    controller, parameters = done.controller, done.parameters
                    costs = bench.costs(controller, [seed, _TOLD], range(_CHECKS))
                rows.append(
                    _row(number, costs, last, len(records), done.coverages, done.said, parameters, self.believed)
                )
                if not done.better:
                    break
            best = bench.costs(bench.designed(dict(plant.true_parameters)), [seed, _TOLD], range(_CHECKS))
        falls = sum(row["change"] < 0 for row in rows[1:])
        taken = len(rows) - 1 - (not done.better)
        end = "as many as asked" if done.better else f"then no more: {done.said}"
        gap, error = _paired(costs, best)
        words = (
            f"cost {rows[0]['cost']:.6g} at first, {rows[-1]['cost']:.6g} at the end; it fell in {falls} of {taken} "
            f"rounds, {end}",
            f"a controller designed with the true parameters costs {best.mean():.6g}: the last one "
            f"{100 * gap / best.mean():+.2g} % (standard error {100 * error / best.mean():.1g} %)",
        )
        details = {"best": float(best.mean()), "falls": falls, "rounds": taken}
        return Findings("identification and redesign in turns", rows, words, details)

    def _round(
        self,
        bench: _Bench,
        controller: _Controller,
        parameters: Mapping[str, float],
        records: list[Trajectory],
        seed: int,
        number: int,
    ) -> _Round:
        """Record, fit and try until a design is shown to cost less, or the batches are used up; adds to the records."""
        said, coverages = "", (0.0, 0.0)
        fitted = dict(parameters)
        for batch in range(self.batches):
            pair = bench.collected(controller, [seed, number, batch])
            middle = min(map(len, pair)) // 2
            records += pair
            coverages = _coverages(pair)
            halves = [[record[:middle] for record in pair], [record[middle:] for record in pair]]
            if min(_coverages(part)[0] for part in halves) <= _NOTHING:
                said = "not fitted: in one direction both runs share next to nothing but noise"
                continue
            try:
                identifier = OutputError(model=self.model, start=fitted)
                fitted = dict(identifier.fit(records, rng=np.random.default_rng(number)).parameters)
                new = bench.designed(fitted)
            except FitError as error:
                said, fitted = f"refused: {error}", dict(parameters)
                continue
            better, said = bench.compared(new, controller, [seed, _TRIED, number, batch])
            if better:
                return _Round(True, new, fitted, coverages, said)
        said = f"no better one after {_REPEATS * self.batches} more runs; the last: {said}"
        return _Round(False, controller, dict(parameters), coverages, said)


@dataclass(frozen=True, eq=False)
class _Round:
    """How a round ended."""

    better: bool
    controller: _Controller
    parameters: dict[str, float]
    coverages: tuple[float, float]
    said: str


def _row(
    number: int, costs: FloatArray, before: FloatArray, records: int, coverages: tuple[float, float], said: str,
    parameters: Mapping[str, float], names: Iterable[str],
) -> dict[str, Any]:  # fmt: skip
    change, error = _paired(costs, before)
    return {"round": number, "cost": float(costs.mean()), "change": change, "error of it": error, "records": records,
            "coverage": coverages[0], "with noise": coverages[1], "what was done": said,
            **{name: parameters[name] for name in names}}  # fmt: skip


def _paired(new: FloatArray, old: FloatArray) -> tuple[float, float]:
    """Return the mean difference of costs (n,) under the same noise, and its standard error."""
    difference = new - old
    return float(difference.mean()), float(difference.std(ddof=1) / np.sqrt(len(difference)))


@dataclass(frozen=True, eq=False)
class _Controller:
    """``u = -K x`` with ``x+ = A x + B u + L (y - C x)``, in deviations from the point."""

    a: FloatArray
    b: FloatArray
    c: FloatArray
    gain: FloatArray
    filter: FloatArray


class _Bench:
    """The plant, and the mechanism that is believed of it."""

    def __init__(self, options: Redesign, plant: Any) -> None:
        from harness.physics.models.catalogue import load_model

        self.options, self.plant, self.spec = options, plant, plant.spec
        self.system = load_model(options.model)
        names = [channel.name for channel in self.system.states]
        unknown = sorted(set(options.target) - set(names))
        outputs, own = ([channel.name for channel in side] for side in (self.spec.outputs, self.system.outputs))
        if unknown or outputs != own:
            raise InputError(
                "redesign: model and plant",
                expected=f"target among {', '.join(names)}, outputs {', '.join(own)}",
                got=f"target {', '.join(options.target)}, outputs {', '.join(outputs)}",
                remedy="give the model of this plant",
            )
        self.simulator = self.system.simulator(self.spec.sample_time)
        self.state = np.array([float(options.target.get(name, 0.0)) for name in names])
        self.point = self._output(self.system.vector(), self.state)
        self.q = np.diag(np.broadcast_to(np.asarray(options.q, dtype=float), (self.spec.ny,)))
        self.r = np.diag(np.broadcast_to(np.asarray(options.r, dtype=float), (self.spec.nu,)))
        self.low = np.array([channel.minimum for channel in self.spec.inputs])
        self.high = np.array([channel.maximum for channel in self.spec.inputs])

    def designed(self, parameters: Mapping[str, float]) -> _Controller:
        """Return Kalman filter and LQR of the mechanism with these parameters, linearised at the point."""
        values = self.system.vector(dict(parameters))
        nx, nu = len(self.state), self.spec.nu
        steps = _SMALL * np.vstack([np.eye(nx + nu), -np.eye(nx + nu)])
        ahead = np.array([self._stepped(values, self.state + one[:nx], one[nx:]) for one in steps])
        seen = np.array([self._output(values, self.state + one[:nx]) for one in steps])
        moved, looked = ((side[: nx + nu] - side[nx + nu :]).T / (2 * _SMALL) for side in (ahead, seen))
        a, b, c = moved[:, :nx], moved[:, nx:], looked[:, :nx]
        gain = lqr_gain(a, b, c.T @ self.q @ c, self.r)
        # What moves the state unseen is taken for as large as the excitation: so the filter follows what it missed.
        pushed = self.options.excitation**2 * b @ b.T
        filtered = kalman_gain(a, c, pushed, max(self.options.noise, _QUIET) ** 2 * np.eye(self.spec.ny))
        if gain is None or filtered is None:
            raise FitError("no design", expected="a model that can be stabilised", got="none", remedy="record more")
        return _Controller(a, b, c, gain, filtered)

    def collected(self, controller: _Controller, key: Sequence[int]) -> list[Trajectory]:
        """Return two runs under the same excitation, each with its own noise."""
        rng, hold, n = np.random.default_rng([*key, 1]), self.options.hold, self.options.samples
        pushed = self.options.excitation * np.repeat(rng.normal(size=(-(-n // hold), self.spec.nu)), hold, axis=0)[:n]
        return [
            self._run(controller, self.options.starts[0], pushed, np.random.default_rng([*key, 2, k]))[0]
            for k in range(_REPEATS)
        ]

    def costs(self, controller: _Controller, key: Sequence[int], trials: range) -> FloatArray:
        """Return the costs (n,), means over the starts, without excitation, under the noise of each trial."""
        still = np.zeros((self.options.samples, self.spec.nu))
        every = [
            [
                self._run(controller, start, still, np.random.default_rng([*key, trial, k]))[1]
                for k, start in enumerate(self.options.starts)
            ]
            for trial in trials
        ]
        return np.asarray(np.mean(every, axis=1), dtype=np.float64)

    def compared(self, new: _Controller, old: _Controller, key: Sequence[int]) -> tuple[bool, str]:
        """Return whether a controller is shown to cost less than another, and what the trials say."""
        from scipy.special import bdtrc, stdtr

        mine, other = np.zeros(0), np.zeros(0)
        for count in _TRIALS:
            more = range(len(mine), count)
            mine, other = (
                np.append(have, self.costs(controller, key, more)) for have, controller in ((mine, new), (other, old))
            )
            change, error = _paired(mine, other)
            if max(mine.max(), other.max()) > _COSTLY * min(mine.min(), other.min()):
                wins = int(np.sum(mine < other))  # one of them leaves: means say nothing
                chances = float(bdtrc(wins - 1, count, 0.5)), float(bdtrc(int(np.sum(mine > other)) - 1, count, 0.5))
            else:
                t = change / max(error, 1e-300)
                chances = float(stdtr(count - 1, t)), float(stdtr(count - 1, -t))
            if min(chances) < _LEVEL:
                break
        share, scatter = 100 * change / other.mean(), 100 * error / other.mean()
        shown = f"{share:+.2g} % (standard error {scatter:.1g} %) in {count} trials"
        if chances[0] < _LEVEL:
            return True, f"takes over: {shown}"
        return False, f"costs more, {shown}" if chances[1] < _LEVEL else f"nothing to tell it by, {shown}"

    def _stepped(self, values: FloatArray, x: FloatArray, u: FloatArray) -> FloatArray:
        return np.asarray(self.simulator.states(values, x, np.tile(u, (2, 1)))[1], dtype=float)

    def _output(self, values: FloatArray, x: FloatArray) -> FloatArray:
        return np.asarray(self.simulator.rollout(values, x, np.zeros((1, self.spec.nu)))[0], dtype=float)

    def _run(
        self, controller: _Controller, start: Mapping[str, float], pushed: FloatArray, rng: np.random.Generator
    ) -> tuple[Trajectory, float]:
        """Return the record, up to where it leaves, and the cost of the whole run."""
        c = controller
        y = np.asarray(self.plant.reset(rng=rng, x0=dict(start)), dtype=float)
        limit = _GONE * max(float(np.abs(y - self.point).max()), _GONE * self.options.noise)
        x: FloatArray = np.zeros(len(c.a))
        rows, inputs, cost = [], [], 0.0
        for k in range(len(pushed)):
            seen = y + self.options.noise * rng.normal(size=y.shape)
            if k == 0:
                x = np.asarray(np.linalg.lstsq(c.c, seen - self.point, rcond=1e-10)[0], dtype=np.float64)
            u = np.clip(pushed[k] - c.gain @ x, self.low, self.high)
            moved = c.a @ x + c.b @ u + c.filter @ (seen - self.point - c.c @ x)
            x = np.asarray(moved, dtype=np.float64)
            rows.append(seen)
            inputs.append(u)
            away = y - self.point
            cost += float(away @ self.q @ away + u @ self.r @ u)
            try:
                y = np.asarray(self.plant.step(u), dtype=float)
            except PlantError:
                y = np.full(self.spec.ny, np.inf)
            if not np.abs(y - self.point).max() <= limit:
                away = rows[0] - self.point
                cost = _COSTLY * len(pushed) * float(away @ self.q @ away)
                break
        times = np.arange(len(rows)) * self.spec.sample_time
        spec = PlantSpec(self.spec.inputs, self.spec.outputs, self.spec.sample_time)
        return Trajectory(times, np.array(inputs), np.array(rows), spec), cost


def _coverages(pair: Sequence[Trajectory]) -> tuple[float, float]:
    """Return the coverage that two runs share, and what the first says with its noise."""
    length = min(map(len, pair))
    if length < _FEWEST // 2:
        return 0.0, 0.0  # it fell at once
    tables = []
    for record in pair:
        y = record.y[:length] - record.y[:length].mean(axis=0)
        tables.append(np.hstack([y[1:], np.diff(y, axis=0), record.u[1:length]]))
    return repeatable_coverage(tables[0], tables[1]), _naive(tables[0])


def _naive(rows: FloatArray) -> float:
    """Return the least singular value of regressors, each scaled to an rms of 1."""
    size = np.sqrt(np.mean(rows**2, axis=0))
    return float(np.linalg.svd(rows / divisor(size), compute_uv=False)[-1] / np.sqrt(len(rows)))
