"""Simulation: the loop on output errors of free runs, over whole records or windows.

Right where the sensor's noise is what limits the fit, and for every model that can be simulated. Each window has an
initial state of its own, fitted on estimation and on validation alike and taken out of every Jacobian and column.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from harness.diagnosis.descent import Bar, by_expense, first_ends, promise
from harness.diagnosis.forms import Fitted
from harness.diagnosis.per_record import carried_states, extended_states, on_validation, settled_states, state_bases
from harness.diagnosis.unfold import signs_by_model, unfolded_starts
from harness.effects.compose import compose
from harness.effects.effect import Placed
from harness.errors import FitError
from harness.physics.levenberg import Solution, minimise, minimise_states
from harness.physics.simulator import Simulator, default_substeps
from harness.physics.windows import Windows, data_states
from harness.signals import Dataset, FloatArray, Trajectory

__all__ = ["OutputForm"]

ITERATIONS = 50
SHORT = 250
"""Samples of a horizon that no shorter windows lead to."""


class OutputForm:
    """Compare free runs; see :class:`harness.diagnosis.forms.Form`.

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
    floors : sequence of float or None
        Noise floor of each output, in its unit.
    """

    decrease = 1e-7
    """Relative decrease of the cost at which a fit has converged."""
    many_starts = True
    """A simulation is cheap enough for many starts."""
    direct = False
    """Descend on the whole horizon at once too, not only by way of short windows."""

    def __init__(
        self,
        nominal: Any,
        dataset: Dataset,
        *,
        sizes: Mapping[str, Mapping[str, float]],
        horizon: float | None,
        weights: FloatArray,
        floors: Sequence[float | None],
    ) -> None:
        self.nominal = nominal
        self.sizes = sizes
        self.horizon = horizon
        self.weights = np.asarray(weights, dtype=float)
        self.floors = tuple(None if s is None else s / w for s, w in zip(floors, self.weights, strict=True))
        self.columns = tuple((channel.name, channel.unit) for channel in nominal.outputs)
        self.sample_time = dataset.spec.sample_time
        self.intersample = dataset.intersample
        self.records: dict[str, tuple[Trajectory, ...]] = {
            use: tuple(run.measured() for run in dataset.using(use)) for use in ("estimation", "validation", "test")
        }
        self._systems: dict[tuple[str, ...], Any] = {}
        self._before: dict[Any, Solution | None] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_systems": {}, "_before": {}}

    def judges(self, placed: Placed) -> bool:
        """Return True: everything can be simulated."""
        return True

    def system(self, effects: Sequence[Placed]) -> Any:
        """Return the nominal system with effects, made once."""
        key = tuple(str(one) for one in effects)
        if key not in self._systems:
            self._systems[key] = compose(self.nominal, effects, sizes=self.sizes) if effects else self.nominal
        return self._systems[key]

    def simulator(self, system: Any, p: FloatArray, *, quick: bool = False) -> Simulator:
        """Return the simulator of a system with the substeps that these parameters need."""
        steps = max(default_substeps(system, self.sample_time, p), 1)
        steps = int(2 ** np.ceil(np.log2(steps)))  # few different ones: each is compiled by itself
        backend = "casadi" if quick else "auto"
        found: Simulator = system.simulator(
            self.sample_time, intersample=self.intersample, substeps=min(steps, 32), backend=backend
        )
        return found

    def solve(
        self,
        effects: Sequence[Placed],
        starts: Sequence[Mapping[str, float]],
        *,
        seed: int,
        bar: Bar | None = None,
    ) -> dict[str, Any]:
        """Fit over short windows first, then over the horizon, from each start; the best end counts.

        A model that does not come up to the bar over short windows is given up; see :class:`Bar`.
        """
        del seed
        system = self.system(effects)
        free = np.array([not one.fixed for one in system.parameters], dtype=bool)
        ends: list[Any] = []
        for some in by_expense(self, system, starts or ({},)):
            ends = first_ends(self, system, some, free, self._path()[0], bar)
            if ends:
                break
        best: dict[str, Any] | None = None
        for end in ends:
            if best is not None and best["converged"]:
                break
            found = self._descend(system, end, free, bar if end is ends[0] else None)
            if found is not None and (best is None or found["cost"] < best["cost"]):
                best = found
        vectors = [system.vector(one["values"]) for one in unfolded_starts(self, effects, starts)]
        if self.direct and len(self._path()) > 1:
            vectors += [system.vector({k: v for k, v in one.items() if k in system.parameter_names}) for one in starts]
        straight = [self._stage(system, p, None, free, self.horizon) for p in vectors]
        more = [self._ended(system, one) for one in straight if one is not None]
        best = min([*more, *([] if best is None else [best])], key=lambda one: float(one["cost"]), default=None)
        if best is None:
            raise FitError(
                f"refit of {system}",
                expected="a start from which the simulation stays finite",
                got="none",
                remedy="give start values nearer to the plant",
            )
        best.update(on_validation(self, system, best))
        return best

    def evaluate(self, effects: Sequence[Placed], record: Mapping[str, Any]) -> Fitted:
        """Return residuals and Jacobian of a record."""
        system = self.system(effects)
        p = system.vector(record["values"])
        free = tuple(one.name for one in system.parameters if not one.fixed)
        index = [system.parameter_names.index(name) for name in free]
        windows = self._windows(system, p, "estimation")
        x0 = np.array(record["x0"], dtype=float).reshape(len(windows), system.nx)
        result = windows.evaluate(p, x0, keep=True, jacobian=True)
        if result.jacobian is None:
            raise np.linalg.LinAlgError(f"the simulation of {system} diverges")
        inside, jacobian = windows.together(result.residuals), result.jacobian[:, index]
        cuts = np.cumsum([len(one) for one in inside])[:-1]
        q = system.vector({**record["values"], **record["refitted"]})
        outside: list[FloatArray] = []
        if self.records["validation"]:
            other = self._windows(system, q, "validation")
            y0 = np.array(record["x0_validation"], dtype=float).reshape(len(other), system.nx)
            outside = other.together(other.evaluate(q, y0, keep=True).residuals)
        unaided: list[FloatArray] = []
        hidden = int(getattr(system, "hidden_count", 0))
        if outside and hidden:
            z0 = carried_states(self, system, q, other, y0)
            unaided = other.together(other.evaluate(q, z0, keep=True).residuals)
        ny = len(self.weights)
        return Fitted(
            effects=tuple(effects),
            system=system,
            values=dict(zip(system.parameter_names, map(float, p), strict=True)),
            free=free,
            converged=bool(record["converged"]),
            message=str(record["message"]),
            estimation=tuple(one / self.weights for one in inside),
            validation=tuple(one / self.weights for one in outside),
            unaided=tuple(one / self.weights for one in unaided),
            jacobian=tuple(np.split(jacobian.reshape(len(jacobian) // ny, ny, len(free)), cuts)),
            refitted=dict(record["refitted"]),
            record=dict(record),
            starts=tuple(result.starts),
        )

    def responses(self, base: Fitted, placed: Placed, values: Mapping[str, float]) -> tuple[FloatArray, ...] | None:
        """Return difference and derivatives of the simulated outputs; see the protocol."""
        system = self.system((*base.effects, placed))
        named = {placed.name(key): value for key, value in values.items()}
        p = system.vector({**base.values, **named})
        windows = self._windows(system, p, "estimation")
        x0 = extended_states(self, base, system, p, windows)
        try:
            with np.errstate(all="ignore"):
                result = windows.evaluate(p, x0, keep=True, jacobian=True)
        except np.linalg.LinAlgError:
            return None
        if result.jacobian is None:
            return None
        after = windows.together([r / self.weights for r in result.residuals])
        names = [placed.name(one.name) for one in placed.effect.parameters if not one.fixed]
        index = [system.parameter_names.index(name) for name in names]
        slopes = result.jacobian[:, index]
        cuts = np.cumsum([len(one) for one in after])[:-1]
        ny = len(self.weights)
        parts = [
            np.concatenate([(r - new)[:, :, None], slope], axis=2)
            for r, new, slope in zip(
                base.estimation, after, np.split(slopes.reshape(len(slopes) // ny, ny, len(index)), cuts), strict=True
            )
        ]
        return self.clean(base, parts)

    def clean(self, base: Fitted, parts: Sequence[FloatArray]) -> tuple[FloatArray, ...]:
        """Take out of columns (N_i, ny, k) of the estimation runs what the initial states can do."""
        return self.without_states(base, parts, "estimation")

    def seams(self, base: Fitted, use: str = "estimation") -> list[tuple[int, int, int]]:
        """Return the windows of the runs of a use as (run, first, last)."""
        return state_bases(self, base, use)[1]

    def without_states(self, base: Fitted, parts: Sequence[FloatArray], use: str) -> tuple[FloatArray, ...]:
        """Take out of columns (N_i, ny, k) what the initial states of the windows of a use can do."""
        lefts, places = state_bases(self, base, use)
        cleaned = [np.array(one, dtype=float) for one in parts]
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
            Initial states fitted to each window, or read off the smoothed measurement.
        """
        system = fitted.system
        p = system.vector({**fitted.values, **(fitted.refitted if use != "estimation" else {})})
        windows = self._windows(system, p, use, horizon, always=True)
        x0 = windows.starts_from([self._from_data(windows.simulator, one, p)[0] for one in self.records[use]])
        if start == "estimated":
            x0 = settled_states(self, system, p, use, windows, x0)
        result = windows.evaluate(p, x0, keep=True)
        return windows.together(result.residuals), windows.together(result.states), list(x0)

    def shortened(self, fitted: Fitted, seconds: float | None) -> tuple[OutputForm, Fitted]:
        """Return a form of shorter windows and the same model seen in it, its initial states fitted.

        Over a short window a simulation has not yet lost track of the forces, whatever the motion magnifies later.
        """
        short = copy.copy(self)
        short.horizon = seconds
        p = fitted.system.vector(fitted.values)
        record = {**fitted.record}
        for use, key in (("estimation", "x0"), ("validation", "x0_validation")):
            q = p if use == "estimation" else fitted.system.vector({**fitted.values, **fitted.refitted})
            windows = short._windows(fitted.system, q, use)
            states = [self._from_data(windows.simulator, one, q)[0] for one in self.records[use]]
            record[key] = self._fit_states(windows, q, windows.starts_from(states), 25).tolist()
        return short, short.evaluate(fitted.effects, record)

    def refined(self, fitted: Fitted) -> dict[str, float] | None:
        """Return the parameters of a model fitted once more on this form's records; None if that diverges."""
        system = fitted.system
        free = np.array([not one.fixed for one in system.parameters], dtype=bool)
        solution = self._stage(system, system.vector(fitted.values), None, free, self.horizon)
        if solution is None:
            return None
        return dict(zip(system.parameter_names, map(float, solution.p), strict=True))

    def settled(self, fitted: Fitted, values: Mapping[str, float]) -> dict[str, Any]:
        """Return the record of a model at other parameters, only its initial states fitted to this form's records."""
        system = fitted.system
        p = system.vector(values)
        windows = self._windows(system, p, "estimation")
        states = [self._from_data(windows.simulator, one, p)[0] for one in self.records["estimation"]]
        x0 = settled_states(self, system, p, "estimation", windows, windows.starts_from(states))
        record = {**fitted.record, "values": dict(values), "x0": x0.tolist()}
        record["cost"] = 2 * float(windows.evaluate(p, x0).cost)
        return {**record, **on_validation(self, system, record)}

    # ---- the work ------------------------------------------------------------------------------------------------

    def _windows(
        self, system: Any, p: FloatArray, use: str, horizon: float | None = None, *, always: bool = False
    ) -> Windows:
        """Return the windows of a use, at the form's horizon unless another is asked for."""
        length = horizon if always else self.horizon
        return self._cut(self.simulator(system, p), list(self.records[use]), length)

    def _from_data(self, simulator: Any, record: Trajectory, p: FloatArray) -> tuple[FloatArray, list[bool]]:
        """Return what a record tells about the states (N, nx), and which of them it tells."""
        hidden = signs_by_model(self, simulator, record, p)
        if hidden is not None:
            return hidden, [True] * hidden.shape[1]
        return data_states(simulator, record, p)

    def _iterations(self, horizon: float | None) -> int:
        """Return how many iterations a fit at a horizon may take."""
        return ITERATIONS

    def _cut(self, simulator: Any, records: list[Trajectory], horizon: float | None) -> Windows:
        """Return the windows of records."""
        return Windows(simulator, records, horizon, self.weights)

    def _fit_states(self, windows: Windows, p: FloatArray, x0: FloatArray, most: int) -> FloatArray:
        """Return initial states (W, nx) fitted with the parameters held."""
        return minimise_states(windows, p, x0, most)

    def _path(self) -> list[float | None]:
        """Return the horizons of a fit in their order."""
        longest = max(len(one) for one in self.records["estimation"]) * self.sample_time
        target = longest if self.horizon is None else self.horizon
        if target <= SHORT * self.sample_time:
            return [self.horizon]
        steps = [max(part * target, 50 * self.sample_time) for part in (0.1, 0.3)]
        return [*(one for one in dict.fromkeys(steps) if one < 0.6 * target), self.horizon]

    def cost_of(self, bar: Bar, horizon: float | None) -> Solution | None:
        """Return the fit of the model before at a horizon; found once."""
        key = (tuple(map(str, bar.effects)), tuple(sorted(bar.values.items())), horizon)
        if key not in self._before:
            system = self.system(bar.effects)
            free = np.array([not one.fixed for one in system.parameters], dtype=bool)
            self._before[key] = self._stage(system, system.vector(bar.values), None, free, horizon)
        return self._before[key]

    def _stage(
        self,
        system: Any,
        p: FloatArray,
        states: list[FloatArray] | None,
        free: Any,
        horizon: float | None,
        iterations: int | None = None,
    ) -> Solution | None:
        """Fit at one horizon; None if the simulation diverges."""
        records = list(self.records["estimation"])
        simulator = self.simulator(system, p)
        if states is None:
            states = [self._from_data(simulator, one, p)[0] for one in records]
        windows = self._cut(simulator, records, horizon)
        x0 = self._fit_states(windows, p, windows.starts_from(states), 8)
        most = self._iterations(horizon) if iterations is None else iterations
        solution = minimise(windows, p, x0, free, most, decrease=self.decrease)
        if not np.isfinite(solution.evaluation.cost):
            return None
        solution.states = windows.together(solution.evaluation.states)  # type: ignore[attr-defined]
        return solution

    def directly(self, starts: Sequence[Mapping[str, float]]) -> list[dict[str, Any]]:
        """Return the nominal ends of starts that descend on the form's horizon at once; those that diverge are out."""
        free = np.array([not one.fixed for one in self.nominal.parameters], dtype=bool)
        ends = [self._stage(self.nominal, self.nominal.vector(one), None, free, self.horizon) for one in starts]
        found = [self._ended(self.nominal, one) for one in ends if one is not None]
        return [{**one, **on_validation(self, self.nominal, one)} for one in found]

    def _descend(self, system: Any, solution: Any, free: Any, bar: Bar | None = None) -> dict[str, Any] | None:
        """Return the end of one start, from its first stage on.

        Raises
        ------
        GivenUp
            If it does not come up to the bar.
        """
        path = self._path()
        for before, horizon in pairwise(path):
            promise(self, bar, system, solution, before)
            solution = self._stage(system, solution.p, solution.states, free, horizon)
            if solution is None:
                return None
        return self._ended(system, solution)

    def _ended(self, system: Any, solution: Any) -> dict[str, Any]:
        """Return a solution as plain numbers."""
        return {
            "values": dict(zip(system.parameter_names, map(float, solution.p), strict=True)),
            "cost": 2 * float(solution.evaluation.cost),
            "converged": bool(solution.converged),
            "message": solution.message,
            "x0": solution.x0.tolist(),
        }
