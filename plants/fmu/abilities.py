"""What an FMU plant can do beyond stepping, where the FMU offers it: states, derivatives, tunable parameters."""

from __future__ import annotations

import functools
import hashlib
import math
import struct
import weakref
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NoReturn

import numpy as np

from harness.errors import InputError
from harness.protocols import Ability
from harness.signals import FloatArray
from plants.fmu.archive import FmuFile, Kind
from plants.fmu.engine import FmuEngine
from plants.fmu.instance import Instance
from plants.fmu.options import encoded, refused
from plants.fmu.snapshot import Snapshot
from plants.fmu.trust import FirstRun, state_error
from plants.fmu.variables import FmuPort, port, unknown


def slopes(instance: Instance, unknowns: Sequence[str], knowns: Sequence[str], seed: FloatArray | None) -> FloatArray:
    """Return ``d unknowns / d knowns`` times the seed, or the whole matrix without one.

    Raises
    ------
    InputError
        If the FMU does not offer it, a name is unknown or no real scalar, or the seed does not fit.
    PlantError
        If the FMU fails to.
    """
    file = instance.file
    if not _offers(file, instance.kind):
        raise InputError(
            "directional derivatives",
            expected="an FMU with providesDirectionalDerivative",
            got="one without",
            remedy="differentiate by finite differences from snapshots",
            file=file.path,
        )
    above, below = _reals(file, tuple(unknowns)), _reals(file, tuple(knowns))
    if seed is None:
        columns = [_product(instance, above, below, row) for row in np.eye(len(below))]
        return np.column_stack(columns) if columns else np.zeros((len(above), 0))
    direction = np.asarray(seed, dtype=float)
    if direction.shape != (len(below),) or not np.isfinite(direction).all():
        raise InputError(
            "seed of a directional derivative",
            expected=f"{len(below)} finite numbers, one for each of {', '.join(knowns)}",
            got=f"shape {direction.shape}",
            remedy="correct it",
        )
    return _product(instance, above, below, direction)


@functools.lru_cache(maxsize=64)
def _offers(file: FmuFile, kind: Kind) -> bool:
    """Return whether the FMU offers them: for FMI 3.0 the archive is read for it."""
    return file.offers_slopes(kind)


@functools.lru_cache(maxsize=64)
def _reals(file: FmuFile, names: tuple[str, ...]) -> list[FmuPort]:
    """Return the variables of these names, which must be real scalars; asked again at every sample of a run."""
    variables = {v.name: v for v in file.description.modelVariables if v.type in ("Real", "Float64")}
    found = []
    for name in names:
        if name not in variables:
            raise unknown(file, "directional derivatives", name, list(variables))
        found.append(port(file, variables[name]))
        if found[-1].size != 1:
            raise InputError(
                "directional derivatives", expected="scalars", got=f"the array {name!r}", remedy="choose others"
            )
    return found


def _product(instance: Instance, above: Sequence[FmuPort], below: Sequence[FmuPort], seed: FloatArray) -> FloatArray:
    """Return the derivative in one direction, in SI."""
    try:
        raw = instance.fmu.getDirectionalDerivative(
            [one.variable.valueReference for one in above],
            [one.variable.valueReference for one in below],
            [value / one.scale for value, one in zip(seed.tolist(), below, strict=True)],
        )
    except Exception as error:
        raise instance.failure("the directional derivative cannot be had", error) from error
    return np.array([one.scale * value for one, value in zip(above, raw, strict=True)])


HEAD = struct.Struct("<8s16sqd")  # mark, digest of the FMU's token and kind, samples since reset, next event or NaN
MARK = b"sysidfmu"


def packed(instance: Instance, state: Snapshot) -> bytes:
    """Return a state as bytes that an instance of the same FMU takes back.

    Raises InputError if the FMU does not offer it. Raises PlantError if it fails to.
    """
    _need_offer(instance)
    try:
        body: bytes = instance.fmu.serializeFMUState(state.pointer)
    except Exception as error:
        raise instance.failure("the state cannot be serialised", error) from error
    event = math.nan if state.next_event is None else state.next_event
    return HEAD.pack(MARK, _digest(instance), state.k, event) + body


def unpacked(instance: Instance, data: bytes) -> Snapshot:
    """Return a state of this instance from the bytes of :func:`packed`.

    Raises InputError if the FMU does not offer it, or the bytes are not of this FMU. Raises PlantError if it fails to.
    """
    _need_offer(instance)
    mark, digest, k, event = HEAD.unpack_from(data) if len(data) >= HEAD.size else (b"", b"", 0, math.nan)
    if mark != MARK or digest != _digest(instance):
        raise InputError(
            "a serialised state",
            expected="bytes that serialize_state of a plant of this FMU returned",
            got="those of another FMU" if mark == MARK else f"{len(data)} other bytes",
            remedy="serialise a state of this FMU, of the same version and kind",
            file=instance.file.path,
        )
    try:
        pointer = instance.fmu.deserializeFMUState(data[HEAD.size :])
    except Exception as error:
        raise instance.failure("the state cannot be deserialised", error) from error
    made = instance.kept(pointer)
    made.k = k
    made.next_event = None if math.isnan(event) else event
    return made


def _digest(instance: Instance) -> bytes:
    """Return what tells one FMU from another."""
    text = f"{instance.file.description.guid} {instance.version} {instance.kind}"
    return hashlib.sha256(text.encode()).digest()[:16]


def _need_offer(instance: Instance) -> None:
    """Refuse FMUs that do not serialise states."""
    if instance.version == 1 or not instance.interface.canSerializeFMUstate:
        raise InputError(
            "serialised states",
            expected="an FMU with canSerializeFMUState",
            got="one without",
            remedy="use get_state and set_state, or replay the inputs from reset",
            file=instance.file.path,
        )


def idle() -> int:
    """Stand in for the step of a plant that does not run (a method of its own would keep the plant alive)."""
    return -1


class Beyond:
    """The part of :class:`plants.fmu.plant.FmuPlant` that is about the FMU's state, derivatives and parameters."""

    file: FmuFile
    kind: Kind
    abilities: frozenset[Ability]
    _instance: Instance
    _engine: FmuEngine
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
