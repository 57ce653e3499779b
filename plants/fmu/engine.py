"""The hot loop of co-simulation: the FMU's functions called with preallocated buffers, from C where gcc is at hand."""

from __future__ import annotations

import ctypes
import functools
import logging
import math
from collections.abc import Callable, Sequence
from ctypes import c_double, c_int32, c_int64, c_uint, c_uint8, c_void_p
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from harness.errors import PlantError
from harness.signals import FloatArray
from plants.fmu.instance import Instance
from plants.fmu.variables import FmuPort

log = logging.getLogger("plants.fmu.plant")
FINE, SET_FAILED, STEP_FAILED, GET_FAILED, OUTPUT_NOT_FINITE, INPUT_NOT_FINITE, STEP_INTERRUPTED = range(7)
# code in the C loop and ctypes type of a variable's type, by FMI version (12: 1.0 and 2.0)
CODES: dict[str, tuple[int, Any]] = {
    "Real": (0, c_double),
    "Float64": (0, c_double),
    "Float32": (1, ctypes.c_float),
    "Int8": (2, ctypes.c_int8),
    "UInt8": (3, c_uint8),
    "Int16": (4, ctypes.c_int16),
    "UInt16": (5, ctypes.c_uint16),
    "Int32": (6, c_int32),
    "Integer": (6, c_int32),
    "UInt32": (7, ctypes.c_uint32),
    "Int64": (8, c_int64),
    "UInt64": (9, ctypes.c_uint64),
}
BOOL8, BOOL32 = (10, c_uint8), (11, c_int32)


class _Group(ctypes.Structure):
    """Variables of one type, next to each other; mirrors Group of fmu_loop.c."""

    _fields_ = (
        ("call", c_void_p),
        ("vr", c_void_p),
        ("scale", c_void_p),
        ("offset", c_void_p),
        ("buffer", c_void_p),
        ("n_vr", c_int64),
        ("n", c_int64),
        ("first", c_int64),
        ("type", c_int32),
    )


class _Loop(ctypes.Structure):
    """Everything about one plant's stepping; mirrors Loop of fmu_loop.c."""

    _fields_ = (
        ("component", c_void_p),
        ("do_step", c_void_p),
        ("inputs", c_void_p),
        ("outputs", c_void_p),
        ("u", c_void_p),
        ("y", c_void_p),
        ("t0", c_double),
        ("h", c_double),
        ("n_in", c_int64),
        ("n_out", c_int64),
        ("nu", c_int64),
        ("ny", c_int64),
        ("substeps", c_int64),
        ("k", c_int64),
        ("done", c_int64),
        ("sub", c_int64),
        ("warnings", c_int64),
        ("version", c_int32),
        ("rollback", c_int32),
        ("status", c_int32),
        ("what", c_int32),
        ("event", c_uint8),
        ("terminate", c_uint8),
        ("early", c_uint8),
        ("last", c_double),
    )


@functools.cache
def native_library() -> Any:
    """Return the compiled loop, or None where there is no C compiler (then the loop runs in Python, slower)."""
    from harness.fmi import build
    from harness.fmi.compiled import library_of
    from plants.mockups import FOLDER

    carried = FOLDER / "built" / f"fmu_loop{build.library_suffix()}"
    try:
        path = carried if carried.is_file() else library_of(Path(__file__).with_name("fmu_loop.c"))
        library = ctypes.CDLL(str(path))
    except (build.BuildError, OSError) as error:
        log.info("FMUs are stepped from Python: %s", error)
        return None
    for name in ("one", "look", "peek"):
        getattr(library, name).argtypes = [c_void_p]
    library.run.argtypes = [c_void_p, c_void_p, c_void_p, c_int64]
    return library


class Timing(NamedTuple):
    """Start time [s], sample time [s], and communication steps in a sample."""

    t0: float
    sample_time: float
    substeps: int


class NativeStep(NamedTuple):
    """One step as C sees it: ``int call(void *loop)`` takes the row ``u``, leaves the row ``y``; 0 if it did."""

    call: int
    loop: int
    u: FloatArray
    y: FloatArray


class FmuEngine:
    """Steps one co-simulation instance; row buffers ``u`` and ``y`` are shared with the plant.

    ``loop.rollback`` tells the FMU that the run may go back to an earlier state (FMI 2.0.5 sec. 4.2.2,
    noSetFMUStatePriorToCurrentPoint): only while somebody holds one, because some FMUs then stand still.
    ``one``, ``look`` and ``peek`` return 0 or what stopped them: step with ``u``; read ``y``; apply ``u`` and read
    ``y`` while no time passes. Without a ``timing`` it only reads.
    """

    one: Callable[[], int]
    look: Callable[[], int]
    peek: Callable[[], int]

    def __init__(
        self,
        instance: Instance,
        inputs: Sequence[FmuPort],
        outputs: Sequence[FmuPort],
        timing: Timing | None,
    ) -> None:
        self.instance = instance
        self.error: PlantError | None = None  # what a step raised where it runs in Python
        t0, sample_time, substeps = (0.0, 1.0, 1) if timing is None else timing
        self.u = np.zeros(sum(p.size for p in inputs))
        self.y = np.zeros(sum(p.size for p in outputs))
        self._keep: list[Any] = []
        self.inputs = [self._group(g, "Set", first) for g, first in grouped(inputs, apart=instance.event_mode)]
        self.outputs = [self._group(g, "Get", first) for g, first in grouped(outputs)]
        v = instance.version
        self.loop = loop = _Loop(
            component=instance.component,
            t0=t0,
            h=sample_time / substeps,
            n_in=len(self.inputs),
            n_out=len(self.outputs),
            nu=len(self.u),
            ny=len(self.y),
            substeps=substeps,
            version=v,
            u=self.u.ctypes.data,
            y=self.y.ctypes.data,
        )
        if timing is not None and instance.kind == "cs":
            loop.do_step = instance.pointer(f"fmi{v}DoStep")
        for name, groups in (("inputs", self.inputs), ("outputs", self.outputs)):
            array = (_Group * max(1, len(groups)))(*groups)
            self._keep.append(array)
            setattr(loop, name, ctypes.addressof(array))
        library = native_library()
        self.native = library is not None
        if library is not None:
            address = ctypes.addressof(loop)
            self.one = functools.partial(library.one, address)
            self.look = functools.partial(library.look, address)
            self.peek = functools.partial(library.peek, address)
            self._run = functools.partial(library.run, address)
        else:
            self._slow = SlowLoop(self)
            self.one, self.look, self.peek = self._slow.one, self._slow.get, self._slow.peek
        self.initial = self.peek  # the same of all kinds while the FMU initialises

    def renew(self) -> None:
        """Take over the address of a new instance (the old one could not be reset)."""
        self.loop.component = self.instance.component

    def native_step(self) -> NativeStep | None:
        """Return the step for a loop in C; None where there is no compiled one."""
        library = native_library() if self.native else None
        if library is None or not self.loop.do_step:
            return None
        call = ctypes.cast(library.one, c_void_p).value or 0
        return NativeStep(call, ctypes.addressof(self.loop), self.u, self.y)

    def settle(self) -> None:
        """Take notice that the FMU's state was set from outside; co-simulation keeps nothing here."""

    def touched(self) -> None:
        """Take notice that the state was taken, or a parameter changed; co-simulation keeps nothing here."""

    def many(self, inputs: FloatArray) -> FloatArray:
        """Step through the rows of ``inputs`` (N, nu); returns the completed rows (done, ny), see ``loop.what``."""
        n = inputs.shape[0]
        outputs = np.empty((n, len(self.y)))
        if self.native:
            self._run(inputs.ctypes.data, outputs.ctypes.data, n)
            return outputs[: self.loop.done]
        for i in range(n):
            self.u[:] = inputs[i]
            if self.one():
                self.loop.done = i
                return outputs[:i]
            outputs[i] = self.y
        self.loop.done = n
        return outputs

    def step_once(self, t: float, h: float) -> int:
        """Call doStep from Python with any step size; returns the status, flags are in ``loop``."""
        return SlowLoop(self).do_step(t, h)

    def _group(self, ports: Sequence[FmuPort], verb: str, first: int) -> _Group:
        """Return the C view of variables of one type."""
        v = self.instance.version
        kind = ports[0].variable.type
        if kind == "Enumeration":
            kind = "Int64" if v == 3 else "Integer"
        code, ctype = (BOOL8 if v != 2 else BOOL32) if kind == "Boolean" else CODES[kind]
        size = sum(p.size for p in ports)
        references = (c_uint * len(ports))(*[p.variable.valueReference for p in ports])
        scale = (c_double * size)(*[p.scale for p in ports for _ in range(p.size)])
        offset = (c_double * size)(*[p.offset for p in ports for _ in range(p.size)])
        buffer = (ctype * size)()
        self._keep += [references, scale, offset, buffer]
        return _Group(
            call=self.instance.pointer(f"fmi{v}{verb}{kind}"),
            vr=ctypes.addressof(references),
            scale=ctypes.addressof(scale),
            offset=ctypes.addressof(offset),
            buffer=ctypes.addressof(buffer),
            n_vr=len(ports),
            n=size,
            first=first,
            type=code,
        )


def grouped(ports: Sequence[FmuPort], *, apart: bool = False) -> list[tuple[list[FmuPort], int]]:
    """Return runs of neighbouring variables of one type, with the first column of each; discrete ones may be apart."""

    def kind(one: FmuPort) -> tuple[str, bool]:
        return one.variable.type, apart and one.variable.variability == "discrete"

    groups: list[tuple[list[FmuPort], int]] = []
    column = 0
    for one in ports:
        if groups and kind(groups[-1][0][0]) == kind(one):
            groups[-1][0].append(one)
        else:
            groups.append(([one], column))
        column += one.size
    return groups


class SlowLoop:
    """The same loop in Python, for systems without a C compiler and for the rest of an interrupted step."""

    def __init__(self, engine: FmuEngine) -> None:
        self.u, self.y, self.loop = engine.u, engine.y, engine.loop
        self.in_groups = [self.opened(g) for g in engine.inputs]
        self.out_groups = [self.opened(g) for g in engine.outputs]
        v = self.loop.version
        tail: dict[int, list[Any]] = {
            1: [ctypes.c_char],
            2: [ctypes.c_int],
            3: [ctypes.c_bool, c_void_p, c_void_p, c_void_p, c_void_p],
        }
        self._step = None
        if self.loop.do_step:
            prototype = ctypes.CFUNCTYPE(ctypes.c_int, c_void_p, c_double, c_double, *tail[v])
            self._step = prototype(self.loop.do_step)

    def opened(self, group: _Group) -> tuple[Any, ...]:
        """Return a group's function with its arguments, its buffer as an array, and its columns."""
        wide = self.loop.version == 3
        prototype = ctypes.CFUNCTYPE(
            ctypes.c_int, c_void_p, c_void_p, ctypes.c_size_t, c_void_p, *([ctypes.c_size_t] if wide else [])
        )
        arguments = (group.vr, group.n_vr, group.buffer, *([group.n] if wide else []))
        ctype = dict([*CODES.values(), BOOL8, BOOL32])[group.type]
        values = np.ctypeslib.as_array((ctype * group.n).from_address(group.buffer))
        scale = np.ctypeslib.as_array((c_double * group.n).from_address(group.scale))
        offset = np.ctypeslib.as_array((c_double * group.n).from_address(group.offset))
        columns = slice(int(group.first), int(group.first + group.n))
        return prototype(group.call), arguments, values, scale, offset, columns, int(group.type)

    def set(self, groups: Sequence[int] | None = None) -> int:
        """Set the inputs, or some groups of them."""
        loop = self.loop
        if not all(map(math.isfinite, self.u)):
            return self._stop(INPUT_NOT_FINITE)
        chosen = self.in_groups if groups is None else [self.in_groups[number] for number in groups]
        for call, arguments, values, scale, offset, columns, code in chosen:
            values[:] = self.raw(columns, scale, offset, code)
            loop.status = call(loop.component, *arguments)
            if loop.status > 1:
                return self._stop(SET_FAILED)
            loop.warnings += loop.status == 1
        return FINE

    def raw(self, columns: slice, scale: FloatArray, offset: FloatArray, code: int) -> FloatArray:
        """Return inputs as the FMU's own numbers."""
        raw: FloatArray = (self.u[columns] - offset) / scale
        return raw if code < 2 else (raw != 0 if code >= 10 else np.rint(raw))

    def get(self) -> int:
        """Read the outputs."""
        loop = self.loop
        loop.what = FINE
        for call, arguments, values, scale, offset, columns, _code in self.out_groups:
            loop.status = call(loop.component, *arguments)
            if loop.status > 1:
                return self._stop(GET_FAILED)
            loop.warnings += loop.status == 1
            self.y[columns] = scale * values + offset
        if not all(map(math.isfinite, self.y)):
            return self._stop(OUTPUT_NOT_FINITE)
        return FINE

    def peek(self) -> int:
        """Apply the inputs and read the outputs while no time passes."""
        self.loop.what = FINE
        return self.set() or self.get()

    def one(self) -> int:
        """Step one sample."""
        loop = self.loop
        loop.what = FINE
        if self.set():
            return int(loop.what)
        for sub in range(loop.substeps):
            loop.sub = sub
            loop.status = self.do_step(loop.t0 + (loop.k * loop.substeps + sub) * loop.h, loop.h)
            if loop.status > 1:
                return self._stop(STEP_FAILED)
            loop.warnings += loop.status == 1
            if loop.version == 3 and (loop.event or loop.terminate or loop.early):
                return self._stop(STEP_INTERRUPTED)
        if self.get():
            return int(loop.what)
        loop.k += 1
        return FINE

    def do_step(self, t: float, h: float) -> int:
        """Call doStep with any step size; returns the status, flags are in the loop."""
        loop = self.loop
        if self._step is None:
            raise PlantError("this instance cannot step")
        if loop.version == 1:
            return int(self._step(loop.component, t, h, b"\x01"))
        if loop.version == 2:
            return int(self._step(loop.component, t, h, int(not loop.rollback)))
        event, terminate, early = ctypes.c_bool(), ctypes.c_bool(), ctypes.c_bool()
        last = c_double(t + h)
        flags = [ctypes.addressof(x) for x in (event, terminate, early, last)]
        status = int(self._step(loop.component, t, h, not loop.rollback, *flags))
        loop.event, loop.terminate, loop.early = event.value, terminate.value, early.value
        loop.last = last.value
        return status

    def _stop(self, what: int) -> int:
        self.loop.what = what
        return what
