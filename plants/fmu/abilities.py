"""What an FMU plant can do beyond stepping, where the FMU offers it: states, derivatives, tunable parameters."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NoReturn

import numpy as np

from harness.protocols import Ability
from harness.signals import FloatArray
from plants.fmu.archive import FmuFile, Kind
from plants.fmu.engine import Engine
from plants.fmu.instance import Instance
from plants.fmu.options import encoded, refused
from plants.fmu.slopes import slopes
from plants.fmu.snapshot import Snapshot
from plants.fmu.states import packed, unpacked
from plants.fmu.trust import FirstRun, state_error


def idle() -> int:
    """Stand in for the step of a plant that does not run (a method of its own would keep the plant alive)."""
    return -1


class Beyond:
    """The part of :class:`plants.fmu.plant.FmuPlant` that is about the FMU's state, derivatives and parameters."""

    file: FmuFile
    kind: Kind
    abilities: frozenset[Ability]
    _instance: Instance
    _engine: Engine
    _start: dict[str, Any]
    _one: Callable[[], int]
    _finalizer: weakref.finalize[Any, Any]
    _first: FirstRun | None
    _states_kept = False
    input_starts: Any
    output: Callable[[FloatArray], FloatArray]
    step: Callable[[FloatArray], FloatArray]

    @property
    def text_inputs(self) -> dict[str, str]:
        """Types (String, Binary) of the inputs that are no numbers, by name; of co-simulation, arrays left out."""
        return self._texts_of("input")

    @property
    def text_outputs(self) -> dict[str, str]:
        """The same of outputs and local variables."""
        return {**self._texts_of("local"), **self._texts_of("output")}

    def _texts_of(self, causality: str) -> dict[str, str]:
        if self.kind != "cs" or self._instance.event_mode:
            return {}
        found = [v for v in self.file.description.modelVariables if v.causality == causality and not v.shape]
        return {v.name: v.type for v in found if v.type in ("String", "Binary")}

    def texts(self, names: Sequence[str]) -> list[str | bytes]:
        """Return the present values of variables that are texts or bytes.

        Raises
        ------
        PlantError
            If the FMU does not tell.
        """
        found: list[str | bytes] = []
        for name in names:
            variable = self.file.variables[name]
            try:
                value = getattr(self._instance.fmu, f"get{variable.type}")([variable.valueReference])[0]
            except Exception as error:
                raise self._instance.failure(f"{name!r} cannot be read", error) from error
            if variable.type == "Binary":
                found.append(bytes(value or b""))
            else:
                found.append(value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value or ""))
        return found

    def put_texts(self, values: Mapping[str, str | bytes]) -> None:
        """Set inputs that are texts or bytes for the step to come.

        Raises
        ------
        PlantError
            If the FMU refuses one.
        """
        for name, value in values.items():
            self._instance.set_now(name, value)
            self._leave_record()

    def get_state(self) -> Snapshot:
        """Return a state of the FMU that stays valid until the plant is closed."""
        if "snapshots" not in self.abilities or self._one is idle:
            self._not_ready("a snapshot")
        if not self._states_kept:
            self._try_state()
        return self._taken()

    def _taken(self) -> Snapshot:
        """Return the present state of the FMU, and where the plant is in its run."""
        taken = self._instance.take()
        taken.k = self._engine.loop.k
        self._engine.loop.rollback = True
        self._engine.touched()
        return taken

    def _set_back(self, state: Snapshot) -> None:
        """Go back to a state."""
        self._instance.put(state)
        self._engine.loop.rollback = True
        self._engine.loop.k = state.k
        self._engine.settle()

    def _leave_record(self) -> None:
        """End the record of the first run: what comes next is no plain step."""
        if self._first is not None:
            self._first.close()

    def _try_state(self) -> None:
        """Try once whether the FMU keeps the states that it declares; where it does not, there are none."""
        self._leave_record()
        held = self._engine.u if self._engine.loop.k else self.input_starts
        difference = state_error(self._engine, self._taken, self._set_back, held)
        self._states_kept = difference == 0.0
        if difference is None or self._states_kept:
            return
        self.abilities -= {"snapshots"}
        self._one = idle
        raise refused(
            self.file,
            "a snapshot",
            "a state that the FMU keeps, as its description declares",
            f"another continuation from it (off by {100 * difference:.3g} % of the signal)",
            "reset, and replay the inputs; this plant gives no more states",
        )

    def set_state(self, state: Snapshot) -> None:
        """Go back to a state that :meth:`get_state` of this plant returned."""
        if "snapshots" not in self.abilities or self._one is idle:
            self._not_ready("a snapshot")
        self._leave_record()
        self._set_back(state)

    def serialize_state(self) -> bytes:
        """Return the present state as bytes, for a plant of the same FMU in this process or, if it allows, another.

        Raises
        ------
        InputError
            If the FMU does not serialise states.
        """
        if self._one is idle:
            self._not_ready("a snapshot")
        if "snapshots" not in self.abilities:
            raise refused(self.file, "a serialised state", "an FMU that gives its state", "one that does not", "replay")
        return packed(self._instance, self.get_state())

    def deserialize_state(self, data: bytes) -> None:
        """Go back to a state that :meth:`serialize_state` returned; the plant must have been reset once.

        Raises
        ------
        InputError
            If the FMU does not serialise states, or the bytes are of another one.
        """
        if self._one is idle:
            self._not_ready("a snapshot")
        self.set_state(unpacked(self._instance, data))

    def directional_derivative(
        self, unknowns: Sequence[str], knowns: Sequence[str], seed: FloatArray | None = None
    ) -> FloatArray:
        """Return partial derivatives at the present state and input as the FMU computes them, in SI.

        Parameters
        ----------
        unknowns : sequence of str
            Outputs and derivatives (FMI 2.0.5 sec. 2.1.9).
        knowns : sequence of str
            Inputs and continuous states.
        seed : array (len(knowns),), optional
            Direction; without it the whole matrix is returned.

        Returns
        -------
        array (len(unknowns),), or (len(unknowns), len(knowns)) without a seed

        Raises
        ------
        InputError
            If the FMU does not offer it, or a name is unknown or not a real scalar.
        PlantError
            If the FMU fails to.
        """
        if self._one is idle:
            self._not_ready("a derivative")
        return slopes(self._instance, unknowns, knowns, seed)

    def rollout_partials(self, inputs: FloatArray, unknowns: Sequence[str], knowns: Sequence[str]) -> FloatArray:
        """Step through inputs (N, nu) and return partial derivatives (N, 2, len(unknowns), len(knowns)), in SI.

        For every sample those at its beginning and at its end, both under its input; names and errors are those of
        :meth:`directional_derivative`.
        """
        found = np.empty((len(inputs), 2, len(unknowns), len(knowns)))
        for k, u in enumerate(inputs):
            self.output(u)
            found[k, 0] = self.directional_derivative(unknowns, knowns)
            self.step(u)
            found[k, 1] = self.directional_derivative(unknowns, knowns)
        return found

    def set_parameter(self, name: str, value: Any) -> None:
        """Set a tunable parameter (SI) while the plant runs; it is kept for later resets.

        Raises
        ------
        InputError
            If the FMU has no such parameter, or it is fixed and the plant runs (use ``parameters`` instead).
        """
        self._check_open()
        as_fmu = encoded(self.file, {name: value}, "parameters", ("parameter",))
        variability = self.file.variables[name].variability
        self._leave_record()
        if self._one is not idle:
            if variability != "tunable":
                raise refused(self.file, "a fixed parameter", "a tunable one", repr(name), "reset first", name)
            self._instance.set_now(name, as_fmu[name])
            self._engine.touched()
        self._start.update(as_fmu)

    def preset(self, values: Mapping[str, Any]) -> None:
        """Set parameters and start values (SI), fixed ones too, for the resets to come; a run that is under way ends.

        Raises
        ------
        InputError
            If the FMU has no such variable, or it has no start value.
        """
        self._check_open()
        self._leave_record()
        fixed = {n: x for n, x in values.items() if _is_parameter(self.file, n)}
        given = encoded(self.file, fixed, "parameters", ("parameter", "structuralParameter"))
        given.update(encoded(self.file, {n: x for n, x in values.items() if n not in fixed}, "start", None))
        self._one = idle
        self._start.update(given)

    def _not_ready(self, what: str = "a step") -> NoReturn:
        self._check_open()
        raise refused(self.file, f"{what} of a plant that does not run", "a reset before", "none", "call reset first")

    def _check_open(self) -> None:
        if not self._finalizer.alive:
            raise refused(self.file, "a closed plant", "an open one", "a closed one", "make a new one")


def _is_parameter(file: FmuFile, name: str) -> bool:
    """Return True for a parameter of the FMU."""
    variable = file.variables.get(name)
    return variable is not None and variable.causality in ("parameter", "structuralParameter")
