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

from harness.diagnosis.descent import STIFFER, Bar, distinct, first_ends, promise
from harness.diagnosis.forms import Fitted
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
PER_RECORD = {"payload_step": ("t0",), "periodic_disturbance": ("phi",)}
"""Parameters that belong to a record, not to the plant: refitted on validation."""


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
        for some in self._by_expense(system, starts or ({},)):
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
        best.update(self._on_validation(system, best))
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
            z0 = self._hidden_carried(system, q, other, y0)
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
        x0 = self._extended(base, system, p, windows)
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
        return self._state_bases(base, use)[1]

    def without_states(self, base: Fitted, parts: Sequence[FloatArray], use: str) -> tuple[FloatArray, ...]:
        """Take out of columns (N_i, ny, k) what the initial states of the windows of a use can do."""
        lefts, places = self._state_bases(base, use)
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
            x0 = self._settled(system, p, use, windows, x0)
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
        x0 = self._settled(system, p, "estimation", windows, windows.starts_from(states))
        record = {**fitted.record, "values": dict(values), "x0": x0.tolist()}
        record["cost"] = 2 * float(windows.evaluate(p, x0).cost)
        return {**record, **self._on_validation(system, record)}

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

    def _by_expense(self, system: Any, starts: Sequence[Mapping[str, float]]) -> list[list[FloatArray]]:
        """Return distinct starts (np,): first those with the fewest steps in a sample, then the much stiffer ones.

        A start that is much stiffer than another one costs more than all the others, and is tried if these diverge.
        """
        known = [system.vector({k: v for k, v in one.items() if k in system.parameter_names}) for one in starts]
        vectors = distinct(known)
        steps = [getattr(self.simulator(system, p), "substeps", 1) for p in vectors]
        easy = [p for p, count in zip(vectors, steps, strict=True) if count <= STIFFER * min(steps)]
        stiff = [p for p, count in zip(vectors, steps, strict=True) if count > STIFFER * min(steps)]
        return [easy, stiff]

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
        return [{**one, **self._on_validation(self.nominal, one)} for one in found]

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

    def _on_validation(self, system: Any, record: Mapping[str, Any]) -> dict[str, Any]:
        """Return the initial states of the validation windows, and what belongs to the record refitted there."""
        if not self.records["validation"]:
            return {"x0_validation": [], "refitted": {}}
        p = system.vector(record["values"])
        windows = self._windows(system, p, "validation")
        x0 = windows.starts_from([self._from_data(windows.simulator, one, p)[0] for one in self.records["validation"]])
        x0 = self._settled(system, p, "validation", windows, x0)
        own = {one.name(name) for one in system.effects for name in PER_RECORD.get(one.effect.name, ())}
        own = {name for name in own if not system.parameter(name).fixed}
        refitted: dict[str, float] = {}
        if own:
            free = np.array([one.name in own for one in system.parameters], dtype=bool)
            best = None
            for start in self._own_starts(system, p, own, max(len(r) for r in self.records["validation"])):
                solution = minimise(windows, start, x0, free, 25, decrease=self.decrease)
                if best is None or solution.evaluation.cost < best.evaluation.cost:
                    best = solution
            if best is not None and np.isfinite(best.evaluation.cost):
                x0 = best.x0
                refitted = {name: float(best.p[system.parameter_names.index(name)]) for name in sorted(own)}
        return {"x0_validation": x0.tolist(), "refitted": refitted}

    def _own_starts(self, system: Any, p: FloatArray, own: set[str], samples: int) -> list[FloatArray]:
        """Return several starts for phases and instants of change."""
        starts = []
        for part in (0.0, 0.25, 0.5, 0.75):
            q = p.copy()
            for name in own:
                k = system.parameter_names.index(name)
                q[k] = 2 * np.pi * part if name.endswith("phi") else (part + 0.125) * samples * self.sample_time
            starts.append(q)
        return starts

    def _settled(self, system: Any, p: FloatArray, use: str, windows: Windows, x0: FloatArray) -> FloatArray:
        """Return fitted initial states, found over short windows first where the windows are long."""
        records = list(self.records[use])
        longest = max(last - first for _, first, last in windows.places) * self.sample_time
        short = max(longest / 8, 50 * self.sample_time)
        if short < 0.6 * longest:
            first = self._cut(windows.simulator, records, short)
            states = [self._from_data(windows.simulator, one, p)[0] for one in records]
            found = self._fit_states(first, p, first.starts_from(states), 8)
            kept = first.together(first.evaluate(p, found, keep=True).states)
            better = windows.starts_from(kept)
            x0 = np.where(np.isfinite(better), better, x0)
        return self._fit_states(windows, p, x0, 25)

    def _extended(self, base: Fitted, system: Any, p: FloatArray, windows: Windows) -> FloatArray:
        """Return the base model's initial states with those of the new hidden states."""
        old_names = [channel.name for channel in base.system.states]
        old = np.array(base.record["x0"], dtype=float).reshape(len(windows), len(old_names))
        x0 = np.zeros((len(windows), system.nx))
        fresh = []
        for k, channel in enumerate(system.states):
            if channel.name in old_names:
                x0[:, k] = old[:, old_names.index(channel.name)]
            else:
                fresh.append(k)
        if fresh:
            first = system.nx - system.hidden_count
            for row, (number, place, _) in enumerate(windows.places):
                u = self.records["estimation"][number].u[place]
                hidden = windows.simulator.hidden_start(x0[row], u, p)
                for k in fresh:
                    x0[row, k] = hidden[k - first]
        return x0

    def _hidden_carried(self, system: Any, p: FloatArray, windows: Windows, x0: FloatArray) -> FloatArray:
        """Return initial states of validation windows with the hidden ones handed on from window to window.

        They start where their effects say, and are carried over the seams by how far they are from there (a twist, a
        bent bristle); the other states are fitted to each window. So hidden states are what the motion made them.
        """
        result, first = x0.copy(), system.nx - system.hidden_count
        simulator, records = windows.simulator, self.records["validation"]
        away, before = np.zeros(system.hidden_count), -1
        for row, (number, place, last) in enumerate(windows.places):
            record = records[number][place:last]
            alone = Windows(simulator, [record], None, self.weights)
            away = away if number == before else np.zeros(system.hidden_count)
            before = number
            for _ in range(3):  # Gauss-Newton over the states of the nominal model
                result[row, first:] = simulator.hidden_start(result[row], record.u[0], p) + away
                rest = alone.evaluate(p, result[row : row + 1], keep=True).residuals[0]
                _, _, slope = simulator.sensitivities(p, result[row], record.u, t0=float(record.t[0]))
                known = (slope[..., :first] / self.weights[:, None]).reshape(-1, first)
                wanted = (rest / self.weights).reshape(-1)
                if not (np.isfinite(known).all() and np.isfinite(wanted).all()):
                    break
                result[row, :first] += np.linalg.lstsq(known, wanted, rcond=1e-10)[0]
            result[row, first:] = simulator.hidden_start(result[row], record.u[0], p) + away
            end = alone.evaluate(p, result[row : row + 1], keep=True).states[0][-1]
            if np.isfinite(end).all():
                away = end[first:] - simulator.hidden_start(end, record.u[-1], p)
        return result

    def _state_bases(self, base: Fitted, use: str) -> tuple[list[FloatArray], list[tuple[int, int, int]]]:
        """Return for each window an orthonormal basis of what its initial state can do."""
        cache: dict[str, Any] = base.__dict__.setdefault("_state_bases", {})
        if use not in cache:
            system = base.system
            p = system.vector({**base.values, **(base.refitted if use != "estimation" else {})})
            windows = self._windows(system, p, use)
            key = "x0" if use == "estimation" else "x0_validation"
            x0 = np.array(base.record[key], dtype=float).reshape(len(windows), system.nx)
            lefts = []
            for row, (number, first, last) in enumerate(windows.places):
                record = self.records[use][number]
                _, _, slope = windows.simulator.sensitivities(p, x0[row], record.u[first:last], t0=record.t[first])
                flat = (slope / self.weights[:, None]).reshape(-1, system.nx)
                left, sizes, _ = np.linalg.svd(flat, full_matrices=False)
                lefts.append(left[:, sizes > 1e-10 * max(sizes.max(initial=0.0), 1e-300)])
            cache[use] = (lefts, windows.places)
        found: tuple[list[FloatArray], list[tuple[int, int, int]]] = cache[use]
        return found
