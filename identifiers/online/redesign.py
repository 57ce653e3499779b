"""Identification and redesign in turns on a plant that need not be linear, from outputs measured with noise."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from harness.errors import FitError, InputError, PlantError
from harness.models.analysis import Findings, Takes
from harness.models.lqr import kalman_gain, lqr_gain
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.mechanics.grey_box import OutputError

__all__ = ["Redesign", "repeatable_coverage"]

_GONE = 10.0
"""A run has left the point when an output is so many times as far from it as the farthest one at the start, or as so
many deviations of the noise."""

_SMALL = 1e-5
"""Step of the differences by which a mechanism is linearised, in the unit of each state and input."""

_QUIET = 1e-9
"""Least sensor noise that a filter is designed for: without any it would differentiate."""

_FEWEST = 20
"""Samples of a run at least: a record to learn from."""

_TRIALS = 4
"""Runs from every start, each with its own noise, over which a cost is averaged."""

_REPEATS = 2
"""Runs under the same excitation in a round: what they share is no noise."""

_COSTLY = 1e3
"""Cost of a run that left, in those of a plant that never moves from its start: worse than any that stayed."""


def repeatable_coverage(first: FloatArray, second: FloatArray) -> float:
    """Return how well regressors cover all directions, by what two runs under the same excitation share.

    The least singular value of a table of regressors is above 0 as soon as there is noise in it. Noise of one run is
    not that of the other: the symmetric cross-Gram matrix of both holds only what the excitation moves. Each column is
    scaled to an rms of 1; 1 is white, 0 leaves a direction out.

    Parameters
    ----------
    first, second : array (n, p)
        Regressors of the same samples of both runs.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> moved = rng.normal(size=(4000, 1)) @ np.ones((1, 2))
    >>> noisy = [moved + 0.3 * rng.normal(size=moved.shape) for _ in range(2)]
    >>> bool(np.linalg.svd(noisy[0], compute_uv=False)[-1] / 4000**0.5 > 0.2), repeatable_coverage(*noisy) < 0.15
    (True, True)
    """
    size = np.sqrt(0.5 * (np.mean(first**2, axis=0) + np.mean(second**2, axis=0)))
    size = np.where(size > 0, size, 1.0)
    cross = (first / size).T @ (second / size) / len(first)
    return float(np.sqrt(max(float(np.linalg.eigvalsh(0.5 * (cross + cross.T))[0]), 0.0)))


@dataclass(frozen=True)
class Redesign:
    """Data under the controller so far, a new model, a new controller; again: what every round costs on the plant.

    A mechanism is to be held at a point, its outputs measured with noise. The first controller is designed with the
    parameters that are believed. In every round two runs under the same excitation are recorded; the parameters are
    fitted to all records so far by their free runs (``output-error``, which knows that the plant is not linear); a
    Kalman filter and an LQR designed on the mechanism linearised at the point are tried from the starts, and take over
    where they cost less than the ones before (with the same noise for all): so the cost never rises. It is that of the
    outputs without noise, ``sum (y - y*)' q (y - y*) + u' r u``, averaged over the starts. Identification for control
    in turns with design: Schrama 1992, *IEEE Trans. Autom. Control* 37:991.

    ``coverage`` is that of :func:`repeatable_coverage` for outputs, their differences and inputs; ``with noise`` is
    what the least singular value of one run says, which noise makes look well.

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
    samples: int = 60
    noise: float = 3e-3
    excitation: float = 0.1
    hold: int = 3
    q: float | Sequence[float] = 1.0
    r: float | Sequence[float] = 0.1

    def of(self, subject: Any, *, rng: np.random.Generator) -> Findings:
        """Return cost, coverage and what was done in every round."""
        if not self.believed or not self.starts or min(self.rounds, self.hold) < 1 or self.samples < _FEWEST:
            raise InputError(
                "redesign",
                expected=f"believed parameters, starts, rounds and hold of at least 1, samples of at least {_FEWEST}",
                got=f"believed={self.believed}, starts={list(self.starts)}, rounds={self.rounds}, hold={self.hold}, "
                f"samples={self.samples}",
                remedy="say what is believed and where to start, such as -O 'believed={mgl=0.7}' "
                "-O 'starts=[{theta=3.0}]'",
            )
        with subject() as plant:
            bench = _Bench(self, plant)
            seed = int(rng.integers(2**62))
            controller = bench.designed(self.believed)
            cost = bench.cost(controller, seed)
            rows = [self._row(0, cost, cost, 0.0, 0.0, "designed with what is believed", self.believed)]
            records: list[Trajectory] = []
            parameters: dict[str, float] = dict(self.believed)
            for number in range(1, self.rounds + 1):
                pair = bench.collected(controller, seed, number)
                coverage, naive = _coverages(pair)
                records += pair
                tried = float("inf")
                try:
                    identifier = OutputError(model=self.model, start=parameters)
                    fitted = dict(identifier.fit(records, rng=np.random.default_rng(number)).parameters)
                    new = bench.designed(fitted)
                except FitError as error:
                    said = f"refused: {error}"
                else:
                    tried = bench.cost(new, seed)
                    said = "takes over" if tried < cost else "costs more: the one before stays"
                    if tried < cost:
                        cost, controller, parameters = tried, new, fitted
                rows.append(self._row(number, cost, tried, coverage, naive, said, parameters))
            best = bench.cost(bench.designed(dict(plant.true_parameters)), seed)
        falls = sum(late["cost"] < early["cost"] for early, late in itertools.pairwise(rows))
        words = (
            f"cost {rows[0]['cost']:.6g} at first, {cost:.6g} after {self.rounds} rounds; it fell in {falls} of them "
            "and rose in none",
            f"a controller designed with the true parameters costs {best:.6g}",
        )
        return Findings("identification and redesign in turns", rows, words, {"best": best, "falls": falls})

    def _row(
        self, number: int, cost: float, tried: float, coverage: float, naive: float, said: str,
        parameters: Mapping[str, float],
    ) -> dict[str, Any]:  # fmt: skip
        return {"round": number, "cost": cost, "of the new controller": tried, "coverage": coverage,
                "with noise": naive, "what was done": said,
                **{name: parameters[name] for name in self.believed}}  # fmt: skip


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

    def collected(self, controller: _Controller, seed: int, number: int) -> list[Trajectory]:
        """Return two runs under the same excitation, each with its own noise."""
        rng, hold, n = np.random.default_rng([seed, 1, number]), self.options.hold, self.options.samples
        pushed = self.options.excitation * np.repeat(rng.normal(size=(-(-n // hold), self.spec.nu)), hold, axis=0)[:n]
        return [
            self._run(controller, self.options.starts[0], pushed, np.random.default_rng([seed, 2, number, k]))[0]
            for k in range(_REPEATS)
        ]

    def cost(self, controller: _Controller, seed: int) -> float:
        """Return the mean cost over the starts, without excitation, always with the same noise."""
        still = np.zeros((self.options.samples, self.spec.nu))
        every = [
            self._run(controller, start, still, np.random.default_rng([seed, 3, k, trial]))[1]
            for k, start in enumerate(self.options.starts)
            for trial in range(_TRIALS)
        ]
        return float(np.mean(every))

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
    return float(np.linalg.svd(rows / np.where(size > 0, size, 1.0), compute_uv=False)[-1] / np.sqrt(len(rows)))
