"""Simulation of an FMU against records: the output-error form of the loop where there are no equations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from harness.diagnosis.fmu_runner import Runner
from harness.diagnosis.fmu_simulator import FmuSimulator
from harness.diagnosis.fmu_system import FmuSystem, fits_fmu
from harness.diagnosis.output_form import OutputForm
from harness.effects.effect import Placed
from harness.physics.levenberg import minimise_states
from harness.physics.smoothing import smooth
from harness.physics.windows import Evaluation, Windows
from harness.signals import Dataset, FloatArray, Trajectory

__all__ = ["FmuForm"]


class _Lazy(Evaluation):
    """An evaluation whose normal equations are computed when they are asked for: a step that is rejected needs none."""

    def __init__(self, plain: Evaluation, windows: _FmuWindows, p: FloatArray, x0: FloatArray) -> None:
        self.__dict__.update({k: v for k, v in plain.__dict__.items() if k not in ("gram", "slope")})
        self._ask = windows, p.copy(), x0.copy()
        self._full: Evaluation | None = None

    def __getattr__(self, name: str) -> Any:
        if name not in ("gram", "slope"):
            raise AttributeError(name)
        if self._full is None:
            windows, p, x0 = self._ask
            self._full = windows.complete(p, x0)
        return getattr(self._full, name)


class _FmuWindows(Windows):
    """Windows of an FMU: simulated once for the cost, once for every column of the Jacobian."""

    def evaluate(self, p: FloatArray, x0: FloatArray, *, keep: bool = False, jacobian: bool = False) -> Evaluation:
        """Simulate all windows; the normal equations follow on demand."""
        simulator: Any = self.simulator
        if simulator.wanted != "all" or jacobian:
            return super().evaluate(p, x0, keep=keep, jacobian=jacobian)
        simulator.wanted = "none"
        try:
            plain = super().evaluate(p, x0, keep=keep)
        finally:
            simulator.wanted = "all"
        return _Lazy(plain, self, p, x0)

    def complete(self, p: FloatArray, x0: FloatArray) -> Evaluation:
        """Simulate with all derivatives."""
        return super().evaluate(p, x0)


class FmuForm(OutputForm):
    """Compare free runs of an FMU with effects around it; see :class:`harness.diagnosis.output_form.OutputForm`.

    Parameters are those of :class:`OutputForm`, with a :class:`FmuSystem` as the nominal model.
    """

    decrease = 1e-5
    """Finite differences see no more; over 10 000 samples the BIC then misses 0.1."""
    many_starts = False

    def __init__(
        self,
        nominal: FmuSystem,
        dataset: Dataset,
        *,
        sizes: Mapping[str, Mapping[str, float]],
        horizon: float | None,
        weights: FloatArray,
        floors: Sequence[float | None],
        runner: Runner | None = None,
    ) -> None:
        super().__init__(nominal, dataset, sizes=sizes, horizon=horizon, weights=weights, floors=floors)
        self.runner = Runner(nominal, self.sample_time) if runner is None else runner
        self._simulators: dict[int, tuple[Any, FmuSimulator]] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_simulators": {}}

    def judges(self, placed: Placed) -> bool:
        """Return True for an effect that can be put around an FMU."""
        return fits_fmu(placed.effect)

    def system(self, effects: Sequence[Placed]) -> Any:
        """Return the FMU with effects around it, made once."""
        key = tuple(str(one) for one in effects)
        if key not in self._systems:
            self._systems[key] = self.nominal.with_effects(effects, self.sizes) if effects else self.nominal
        return self._systems[key]

    def simulator(self, system: Any, p: FloatArray, *, quick: bool = False) -> Any:
        """Return the simulator of a system, made once."""
        if id(system) not in self._simulators:
            self._simulators[id(system)] = (system, FmuSimulator(system, self.runner))
        return self._simulators[id(system)][1]

    @staticmethod
    def first_state(system: FmuSystem, simulator: FmuSimulator, run: Trajectory) -> FloatArray:
        """Return what a record tells about the first state (nx,)."""
        return np.asarray(_states_from(system, simulator, run, system.vector())[0][0])

    def started(self, values: Mapping[str, float]) -> dict[str, Any]:
        """Return a record of the nominal model at these parameters, its initial states fitted."""
        p = self.nominal.vector(values)
        found: dict[str, Any] = {
            "values": self.nominal.values(values),
            "converged": True,
            "message": "",
            "refitted": {},
        }
        for use, key in (("estimation", "x0"), ("validation", "x0_validation")):
            windows = self._windows(self.nominal, p, use)
            states = [self._from_data(windows.simulator, one, p)[0] for one in self.records[use]]
            found[key] = self._fit_states(windows, p, windows.starts_from(states), 10).tolist()
        return found

    def pushed(self, fitted: Any, use: str, basis: Mapping[int, Sequence[FloatArray]]) -> dict[int, list[FloatArray]]:
        """Return what small functions added to the FMU's inputs do to the weighted outputs.

        Parameters
        ----------
        fitted : Fitted
        use : str
        basis : mapping of int to sequence of array (N_i, K)
            By row of the input: functions on every record.

        Returns
        -------
        dict of int to list of array (N_i, ny, K)
            Derivatives, by finite differences of 1e-3 of the input's size.
        """
        system = fitted.system
        p = system.vector({**fitted.values, **(fitted.refitted if use != "estimation" else {})})
        windows = self._windows(system, p, use)
        key = "x0" if use == "estimation" else "x0_validation"
        x0 = np.array(fitted.record[key], dtype=float).reshape(len(windows), system.nx)
        simulator: Any = windows.simulator
        inputs = []
        for record in self.records[use]:
            inputs.append(simulator.sampled.inputs(record.u[None], p[None], False)[0][0])
        ny = len(self.weights)
        result = {row: [np.zeros((len(one), ny, one.shape[1])) for one in parts] for row, parts in basis.items()}
        for begun, (number, first, last) in zip(x0, windows.places, strict=True):
            u, t0 = inputs[number][first:last], float(self.records[use][number].t[first])
            before = self._read(simulator, p, simulator.run(p, begun, u, t0)[1])
            for row, parts in basis.items():
                size = 1e-3 * max(float(np.sqrt(np.mean(u[:, row] ** 2))), 1e-9)
                for k in range(parts[number].shape[1]):
                    extra = np.zeros_like(u)
                    extra[:, row] = size * parts[number][first:last, k]
                    after = self._read(simulator, p, simulator.run(p, begun, u, t0, extra)[1])
                    result[row][number][first:last, :, k] = (after - before) / size / self.weights
        return result

    def motion(self, fitted: Any, use: str) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
        """Return simulated positions (N_i, n), rates (N_i, n) and outputs (N_i, ny) of every record of a use."""
        system = fitted.system
        p = system.vector({**fitted.values, **(fitted.refitted if use != "estimation" else {})})
        windows = self._windows(system, p, use)
        key = "x0" if use == "estimation" else "x0_validation"
        x0 = np.array(fitted.record[key], dtype=float).reshape(len(windows), system.nx)
        simulator: Any = windows.simulator
        parts: list[list[FloatArray]] = [[], [], []]
        for begun, (number, first, last) in zip(x0, windows.places, strict=True):
            record = self.records[use][number]
            u = simulator.sampled.inputs(record.u[None], p[None], False)[0][0, first:last]
            q, v, y = simulator.motion(p, begun, u, float(record.t[first]))
            for part, one in zip(parts, (q, v, self._read(simulator, p, y)), strict=True):
                part.append(one)
        return list(zip(*(windows.together(part) for part in parts), strict=True))

    def _path(self) -> list[float | None]:
        """Return the horizons of a fit: a fifth first, which leaves one minimum where the whole has many."""
        longest = max(len(one) for one in self.records["estimation"]) * self.sample_time
        target = longest if self.horizon is None else self.horizon
        first = max(0.2 * target, 50 * self.sample_time)
        return [first, self.horizon] if first < 0.6 * target else [self.horizon]

    def _iterations(self, horizon: float | None) -> int:
        """Return how many iterations a fit at a horizon may take: on the way there few are enough."""
        return 60 if horizon == self.horizon else 10

    def _cut(self, simulator: Any, records: list[Trajectory], horizon: float | None) -> Windows:
        """Return the windows of records."""
        return _FmuWindows(simulator, records, horizon, self.weights)

    def _fit_states(self, windows: Windows, p: FloatArray, x0: FloatArray, most: int) -> FloatArray:
        """Return fitted initial states (W, nx); no derivative by a parameter is needed for that."""
        simulator: Any = windows.simulator
        simulator.wanted = "states"
        try:
            return minimise_states(windows, p, x0, most)
        finally:
            simulator.wanted = "all"

    def _read(self, simulator: FmuSimulator, p: FloatArray, y: FloatArray) -> FloatArray:
        """Return outputs (N, ny) as delayed and rounded by the sensors."""
        return np.asarray(simulator.sampled.outputs(y[None], None, p[None])[0][0])

    def _from_data(self, simulator: Any, record: Trajectory, p: FloatArray) -> tuple[FloatArray, list[bool]]:
        """Return smoothed measurements for states that are outputs, their derivatives for rates, else 0."""
        return _states_from(simulator.system, simulator, record, p)


def _states_from(system: FmuSystem, simulator: Any, record: Trajectory, p: FloatArray) -> tuple[FloatArray, list[bool]]:
    """Return states (N, nx) along a record, and which of them it tells."""
    names = [one.name for one in system.outputs]
    states = [one.name for one in system.inner_states]
    x, known = np.zeros((len(record), system.nx)), [False] * system.nx
    rates = {one.position: one.rate for one in system.coordinates}
    names = [system.shown.get(name, name) for name in names]
    for row, name in enumerate(names):
        if name not in states and rates.get(name) not in states:
            continue
        found = smooth(record.y[:, row], simulator.dt, period=record.spec.outputs[row].period)
        if name in states:
            x[:, states.index(name)], known[states.index(name)] = found.value, True
        rate = rates.get(name)
        if rate in states and rate not in names:
            x[:, states.index(rate)], known[states.index(rate)] = found.rate, True
    if system.hidden_count:
        x[:, len(states) :] = simulator.hidden_starts(x, record.u, p)
    return x, known
