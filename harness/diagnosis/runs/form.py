"""Free runs over whole records or windows, each window with an initial state of its own that is fitted to it."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from harness.diagnosis.effort import EFFORT
from harness.diagnosis.runs.fitted import Fitted
from harness.diagnosis.runs.signs import signs_by_model
from harness.diagnosis.runs.states import carried_states, led_states, settled_states, state_bases
from harness.diagnosis.systems import AnySystem, by_equations
from harness.effects.compose import compose, moving, recommended_substeps
from harness.effects.effect import Placed
from harness.physics.compiled.simulator import Simulator, default_substeps
from harness.physics.compiled.system import System
from harness.physics.compiled.windows import Windows, data_states
from harness.physics.definition.model_equations import Equations
from harness.physics.fitting.levenberg import minimise_states
from harness.signals import Dataset, FloatArray, Trajectory


class FreeRunForm:
    """Simulates fitted models along the records.

    Parameters
    ----------
    nominal : System
        Measured as the data are.
    dataset : Dataset
        Estimation and validation runs.
    sizes : mapping
        Sizes of the data by port, for start values.
    horizon : float or None
        Window length [s]; None for whole records.
    weights : array (ny,)
        Residuals are divided by these.
    """

    decrease = 1e-7
    """Relative decrease of the cost at which a fit of what belongs to a record has converged."""

    def __init__(
        self,
        nominal: AnySystem,
        dataset: Dataset,
        *,
        sizes: Mapping[str, Mapping[str, float]],
        horizon: float | None,
        weights: FloatArray,
    ) -> None:
        self.nominal = nominal
        self.sizes = sizes
        self.horizon = horizon
        self.weights = np.asarray(weights, dtype=float)
        self.columns = tuple((channel.name, channel.unit) for channel in nominal.outputs)
        self.sample_time = dataset.spec.sample_time
        self.intersample = dataset.intersample
        self.records: dict[str, tuple[Trajectory, ...]] = {
            use: tuple(run.measured() for run in dataset.using(use)) for use in ("estimation", "validation", "test")
        }
        self._systems: dict[tuple[str, ...], AnySystem] = {}

    def system(self, effects: Sequence[Placed]) -> AnySystem:
        """Return the nominal system with effects, made once."""
        key = tuple(str(placed) for placed in effects)
        if key not in self._systems:
            assert by_equations(self.nominal)
            self._systems[key] = compose(self.nominal, effects, sizes=self.sizes) if effects else self.nominal
        return self._systems[key]

    def simulator(self, system: AnySystem, p: FloatArray, *, quick: bool = False) -> Simulator:
        """Return the simulator of a system with the substeps that these parameters need."""
        assert by_equations(system)
        values = dict(zip(system.parameter_names, p, strict=True))
        moved = recommended_substeps(system, values, self.sample_time, x=moving(system, self.sizes))
        steps = max(default_substeps(system, self.sample_time, p), moved)
        steps = int(2 ** np.ceil(np.log2(steps)))  # few different ones: each is compiled by itself
        return system.simulator(
            self.sample_time,
            intersample=self.intersample,
            substeps=min(steps, 32),
            backend="casadi" if quick else "auto",
        )

    def evaluate(self, effects: Sequence[Placed], record: Mapping[str, Any]) -> Fitted:
        """Return residuals and Jacobian of a record."""
        system = self.system(effects)
        p = system.vector(record["values"])
        free = tuple(parameter.name for parameter in system.parameters if not parameter.fixed)
        index = [system.parameter_names.index(name) for name in free]
        windows = self.windows(system, p, "estimation")
        x0 = np.array(record["x0"], dtype=float).reshape(len(windows), system.nx)
        result = windows.evaluate(p, x0, keep=True, jacobian=True)
        if result.jacobian is None:
            raise np.linalg.LinAlgError(f"the simulation of {system} diverges")
        inside, jacobian = windows.together(result.residuals), result.jacobian[:, index]
        cuts = np.cumsum([len(part) for part in inside])[:-1]
        q = system.vector({**record["values"], **record["refitted"]})
        outside: list[FloatArray] = []
        if self.records["validation"]:
            other = self.windows(system, q, "validation")
            y0 = np.array(record["x0_validation"], dtype=float).reshape(len(other), system.nx)
            outside = other.together(other.evaluate(q, y0, keep=True).residuals)
        unaided: list[FloatArray] = []
        if outside and system.hidden_count:
            z0 = carried_states(self, system, q, other, y0)
            unaided = other.together(other.evaluate(q, z0, keep=True).residuals)
        ny = len(self.weights)
        return Fitted.of(
            effects,
            system,
            p,
            record,
            estimation=tuple(part / self.weights for part in inside),
            validation=tuple(part / self.weights for part in outside),
            unaided=tuple(part / self.weights for part in unaided),
            jacobian=tuple(np.split(jacobian.reshape(len(jacobian) // ny, ny, len(free)), cuts)),
            refitted=dict(record["refitted"]),
            starts=tuple(result.starts),
        )

    def clean(self, base: Fitted, parts: Sequence[FloatArray]) -> tuple[FloatArray, ...]:
        """Take out of columns (N_i, ny, k) of the estimation runs what the initial states can do."""
        return self.without_states(base, parts, "estimation")

    def without_states(self, base: Fitted, parts: Sequence[FloatArray], use: str) -> tuple[FloatArray, ...]:
        """Take out of columns (N_i, ny, k) what the initial states of the windows of a use can do."""
        lefts, places = state_bases(self, base, use)
        cleaned = [np.array(part, dtype=float) for part in parts]
        for left, (record, first, last) in zip(lefts, places, strict=True):
            block = cleaned[record][first:last]
            flat = block.reshape(-1, block.shape[2])
            cleaned[record][first:last] = (flat - left @ (left.T @ flat)).reshape(block.shape)
        return tuple(cleaned)

    def simulated(
        self, fitted: Fitted, use: str, horizon: float | None, *, start: str = "estimated"
    ) -> tuple[list[FloatArray], list[FloatArray], list[FloatArray]]:
        """Return errors (N_i, ny), states (N_i, nx) and initial states of free runs at another horizon or use.

        Parameters
        ----------
        fitted : Fitted
        use : str
            ``estimation``, ``validation`` or ``test``.
        horizon : float or None
        start : {"estimated", "data"}
            Initial states fitted to each window, or read off the smoothed measurement, those of effects where the
            measured motion up to there left them.
        """
        system = fitted.system
        p = system.vector({**fitted.values, **(fitted.refitted if use != "estimation" else {})})
        windows = self.windows(system, p, use, horizon, always=True)
        states = [self.from_data(windows.simulator, run, p)[0] for run in self.records[use]]
        if start == "estimated":
            x0 = settled_states(self, system, p, use, windows, windows.starts_from(states))
        else:
            runs = zip(self.records[use], states, strict=True)
            x0 = windows.starts_from([led_states(windows.simulator, run, p, x) for run, x in runs])
        result = windows.evaluate(p, x0, keep=True)
        return windows.together(result.residuals), windows.together(result.states), list(x0)

    def shortened(self, fitted: Fitted, seconds: float | None) -> tuple[FreeRunForm, Fitted]:
        """Return a form of shorter windows and the same model seen in it, its initial states fitted.

        Over a short window a simulation has not yet lost track of the forces, whatever the motion magnifies later.
        """
        short = copy.copy(self)
        short.horizon = seconds
        p = fitted.system.vector(fitted.values)
        record = {**fitted.record}
        for use, key in (("estimation", "x0"), ("validation", "x0_validation")):
            q = p if use == "estimation" else fitted.system.vector({**fitted.values, **fitted.refitted})
            windows = short.windows(fitted.system, q, use)
            states = [self.from_data(windows.simulator, run, q)[0] for run in self.records[use]]
            record[key] = self.fit_states(windows, q, windows.starts_from(states), 25).tolist()
        return short, short.evaluate(fitted.effects, record)

    def driven_jacobian(self, fitted: Fitted, driven: Sequence[Trajectory]) -> tuple[FloatArray, ...]:
        """Return the sensitivities (N_i, ny, p) along other estimation records, initial states fitted to them."""
        other = copy.copy(self)
        other.records = {**self.records, "estimation": tuple(driven)}
        return other.shortened(fitted, self.horizon)[1].jacobian

    def lengths(self, fitted: Fitted, records: Sequence[Trajectory]) -> list[int]:
        """Return the samples of each window."""
        p = fitted.system.vector(fitted.values)
        windows = self.cut(self.simulator(fitted.system, p), list(records), self.horizon)
        return [last - first for _, first, last in windows.places]

    # ---- the work ------------------------------------------------------------------------------------------------

    def windows(
        self, system: AnySystem, p: FloatArray, use: str, horizon: float | None = None, *, always: bool = False
    ) -> Windows:
        """Return the windows of a use, at the form's horizon unless another is asked for."""
        length = horizon if always else self.horizon
        return self.cut(self.simulator(system, p), list(self.records[use]), length)

    def from_data(self, simulator: Simulator, record: Trajectory, p: FloatArray) -> tuple[FloatArray, list[bool]]:
        """Return what a record tells about the states (N, nx), and which of them it tells."""
        hidden = signs_by_model(self, simulator, record, p)
        if hidden is not None:
            return hidden, [True] * hidden.shape[1]
        return data_states(simulator, record, p)

    def cut(self, simulator: Simulator, records: list[Trajectory], horizon: float | None) -> Windows:
        """Return the windows of records."""
        return Windows(simulator, records, horizon, self.weights)

    def fit_states(self, windows: Windows, p: FloatArray, x0: FloatArray, most: int) -> FloatArray:
        """Return initial states (W, nx) fitted with the parameters held.

        Where a force changes its sign sooner than a step of the solver, derivatives by initial states tell nothing of
        longer steps: they are looked for with a wider change too, and what comes nearer is kept.
        """
        ends, wide = minimise_states(windows, p, x0, most), self._with_wide_signs(windows.simulator.system, p)
        if wide is None:
            return ends
        other = minimise_states(windows, p, minimise_states(windows, wide, x0, most), most)
        costs = [np.nan_to_num(windows.trial(p, each).costs, nan=np.inf) for each in (ends, other)]
        return np.where((costs[1] < costs[0])[:, None], other, ends)

    def _with_wide_signs(self, system: Equations, p: FloatArray) -> FloatArray | None:
        """Return parameters with which forces change their sign over a share of the largest speeds; None if they do."""
        if not isinstance(system, System) or not system.switches:
            return None
        wide, speeds = p.copy(), EFFORT.wide * moving(system, self.sizes)
        for state, name in system.switches:
            k = system.parameter_names.index(name)
            wide[k] = max(p[k], speeds[state])
        return wide if (wide > p).any() else None
