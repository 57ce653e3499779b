"""Grey boxes: physical models with parameters fitted by output error, and the model that all of them become."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from harness.errors import FitError, InputError
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.filters import stationary_gain
from identifiers.records import moving, usable

if TYPE_CHECKING:
    from harness.physics import System

__all__ = ["GreyBoxModel", "OutputError", "system_for"]


def system_for(model: str, spec: PlantSpec, what: str) -> System:
    """Return the physical model for records of a plant, its outputs in the order of the records.

    Parameters
    ----------
    model : str
        Name of a built-in model, or ``FILE.py:NAME``.
    spec : PlantSpec
        Of the records; every input of the model must be there, and every output a port of the model.
    what : str
        For messages.

    Raises
    ------
    FitError
        If the signals are not those of the model.
    """
    from harness.physics.models import load_model

    system = load_model(model)
    ports = {channel.name for channel in system.outputs}
    wanted = [channel.name for channel in spec.outputs]
    inputs = [channel.name for channel in spec.inputs]
    missing = [name for name in wanted if name not in ports]
    if missing or inputs != [channel.name for channel in system.inputs]:
        raise FitError(
            f"{what}: signals of the records are not those of model {model!r}",
            expected=str(system),
            got=str(spec),
            remedy="rename the signals to the model's ports, or choose another model",
        )
    if wanted == [channel.name for channel in system.outputs]:
        return system
    return system.with_outputs([(name, 0) for name in wanted])


@dataclass(frozen=True, eq=False)
class GreyBoxModel:
    """A physical model with its parameters, discretized: what lumped and output-error identification return.

    Parameters
    ----------
    spec : PlantSpec
    model : str
        Name of the nominal model, or ``FILE.py:NAME``.
    parameters : dict
        Values by name, in SI units; effect parameters are called ``effect@port.name``.
    effects : tuple of (name, port)
        Effects built into the nominal model.
    covariance : dict
        Standard deviation by parameter name, where the identifier knows it.
    """

    spec: PlantSpec
    model: str
    parameters: dict[str, float]
    effects: tuple[tuple[str, str], ...] = ()
    deviations: dict[str, float] = field(default_factory=dict)
    intersample: Literal["zoh", "foh"] = "zoh"
    notes: dict[str, Any] = field(default_factory=dict)

    @property
    def burn_in(self) -> int:
        """No samples: the initial state is fitted."""
        return 0

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if not name.startswith("_")}

    def system(self) -> System:
        """Return the physical model with its effects."""
        if "_system" not in self.__dict__:
            system = system_for(self.model, self.spec, "grey box")
            if self.effects:
                from harness.effects import Placed, compose, find

                system = compose(system, [Placed(find(name), at) for name, at in self.effects])
            simulator = system.simulator(self.spec.sample_time, intersample=self.intersample)
            self.__dict__.update(_system=system, _simulator=simulator, _p=system.vector(self.parameters))
        kept: System = self.__dict__["_system"]
        return kept

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the state (nx,) whose free run fits the record best, parameters held."""
        from harness.physics.levenberg import minimise_states
        from harness.physics.windows import Windows, data_states

        self.system()
        simulator, p = self.__dict__["_simulator"], self.__dict__["_p"]
        record = Trajectory(data.t, data.u, data.y, simulator.spec)
        scale = np.maximum(np.std(data.y, axis=0), 1e-12)
        states, _ = data_states(simulator, record, p), None
        windows = Windows(simulator, [record], None, scale)
        start = windows.starts_from([states[0]])
        return np.array(minimise_states(windows, p, start)[0])

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the output (..., ny)."""
        return self._one(x, u, 1)[1][..., 0, :]

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next state (..., nx); delays of effects are not in a single step."""
        return self._one(x, u, 2)[0][..., 1, :]

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the state (..., nx) moved towards the output seen."""
        miss = y - self.output(x, u)
        moved: FloatArray = x + miss @ self._gain().T
        return moved

    def free_run(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the outputs (M, N, ny) from states x (M, nx) under inputs u (M, N, nu)."""
        self.system()
        simulated: FloatArray = self.__dict__["_simulator"].rollout(self.__dict__["_p"], x, u)
        return simulated

    def _one(self, x: FloatArray, u: FloatArray, samples: int) -> tuple[FloatArray, FloatArray]:
        """Return states and outputs over so many samples with the input held."""
        self.system()
        simulator, p = self.__dict__["_simulator"], self.__dict__["_p"]
        states = np.asarray(x, dtype=float)
        lead = states.shape[:-1]
        flat = states.reshape(-1, states.shape[-1])
        held = np.broadcast_to(u, (*lead, self.spec.nu)).reshape(-1, 1, self.spec.nu)
        inputs = np.repeat(held, samples, axis=1)
        wide = np.broadcast_to(p, (flat.shape[0], p.size)).copy()
        found, outputs, _ = simulator.windows(
            wide, np.ascontiguousarray(flat), inputs, None, np.zeros(flat.shape[0]), sensitivities=False
        )
        return found.reshape(*lead, samples, -1), outputs.reshape(*lead, samples, -1)

    def _gain(self) -> FloatArray:
        """Return the filter gain (nx, ny).

        A measured coordinate moves half way to its measurement, and its rate by 0.15 of the miss in a sample (an
        alpha-beta filter): the same wherever the plant stands, upright or hanging. Models without coordinates have
        the gain of a stationary Kalman filter at rest with equal noise on states and outputs.
        """
        if "_filter" in self.__dict__:
            kept: FloatArray = self.__dict__["_filter"]
            return kept
        system = self.system()
        nx, ny = system.nx, self.spec.ny
        rest, still = np.zeros(nx), np.zeros(self.spec.nu)
        a, c = np.empty((nx, nx)), np.empty((ny, nx))
        for j in range(nx):
            nudge = np.zeros(nx)
            nudge[j] = 1e-6
            a[:, j] = (self.step(rest + nudge, still) - self.step(rest - nudge, still)) / 2e-6
            c[:, j] = (self.output(rest + nudge, still) - self.output(rest - nudge, still)) / 2e-6
        if system.coordinates:
            back = np.linalg.pinv(c)
            gain: FloatArray = 0.5 * back
            for one in system.coordinates:
                if not np.any(c[:, one.v]):
                    gain[one.v] = 0.15 / self.spec.sample_time * back[one.q]
        else:
            gain = stationary_gain(a, c)
        self.__dict__["_filter"] = gain
        return gain

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description."""
        from harness.specs import spec_to_dict

        return {
            "kind": "grey-box",
            "spec": spec_to_dict(self.spec),
            "model": self.model,
            "parameters": self.parameters,
            "effects": [list(pair) for pair in self.effects],
            "deviations": self.deviations,
            "intersample": self.intersample,
            "notes": self.notes,
        }

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> GreyBoxModel:
        """Return the model of a description.

        Raises
        ------
        InputError
            If a key is missing.
        """
        from harness.specs import spec_from_dict

        try:
            return cls(
                spec_from_dict(content["spec"]),
                str(content["model"]),
                {str(name): float(value) for name, value in content["parameters"].items()},
                tuple((str(name), str(at)) for name, at in content.get("effects", [])),
                dict(content.get("deviations", {})),
                content.get("intersample", "zoh"),
                dict(content.get("notes", {})),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                "description of a grey-box model",
                expected="model, parameters, spec as written by to_dict()",
                got=f"{type(error).__name__}: {error}",
                remedy="write the model anew",
            ) from error


@dataclass(frozen=True)
class OutputError:
    """Physical parameters by minimising the simulation error (prediction-error method, output-error structure).

    Parameters
    ----------
    model : str
        Name of a built-in model (``sysid list models``), or ``FILE.py:NAME``.
    horizon : float, optional
        Length of the windows [s] whose initial states are free; whole records without it. Give it for unstable or
        integrating plants.
    starts : int
        Number of starts; 2 or more also say whether they agree.
    parameters : mapping, optional
        Start values by name.
    fixed : tuple of str
        Parameters that are known.
    """

    model: str
    horizon: float | None = None
    starts: int = 1
    parameters: Mapping[str, float] | None = None
    fixed: tuple[str, ...] = ()

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> GreyBoxModel:
        """Return the calibrated model."""
        from harness.physics.output_error import fit_output_error

        what = "output-error"
        records, spec = usable(trajectories, samples=5, what=what)
        moving(records, what, inputs=False)
        system = system_for(self.model, spec, what)
        own = PlantSpec(system.inputs, system.outputs, spec.sample_time)
        found = fit_output_error(
            system,
            [Trajectory(one.t, one.u, one.y, own) for one in records],
            start=dict(self.parameters or {}),
            fixed=tuple(self.fixed),
            horizon=self.horizon,
            starts=self.starts,
            rng=rng,
        )
        deviations = dict(zip(found.names, np.sqrt(np.diag(found.covariance)).tolist(), strict=True))
        notes = {"converged": found.converged, "message": found.message, "chi2": float(found.chi2)}
        return GreyBoxModel(spec, self.model, dict(found.parameters), deviations=deviations, notes=notes)
