"""One loaded instance of an FMU: instantiated through fmpy, initialised, reset, freed, its temporary folder removed."""

from __future__ import annotations

import ctypes
import logging
import os
import threading
import weakref
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from harness.errors import InputError, PlantError
from plants.fmu.archive import FmuFile, Kind
from plants.fmu.snapshot import Snapshot
from plants.temporary import release

log = logging.getLogger("plants.fmu.plant")
_loading = threading.Lock()  # fmpy changes the working directory of the process while it loads
_alive: Counter[tuple[str, str]] = Counter()  # instances by (token, identifier), for "only once per process"
LEVELS = ("ok", "warning", "discard", "error", "fatal", "pending")


class Instance:
    """An FMU in memory.

    Raises InputError if it has no binary for this system, cannot be loaded, or may exist only once in a process and
    does already.

    - ``file``: what to load
    - ``kind``: co-simulation or model exchange
    - ``event_mode, early_return``: FMI 3.0 co-simulation: handle events here instead of inside the FMU; let a step end
      early
    - ``debug``: ask the FMU for its debug messages (they go to the logger ``plants.fmu.plant``)
    """

    def __init__(
        self,
        file: FmuFile,
        kind: Kind,
        *,
        event_mode: bool = False,
        early_return: bool = False,
        debug: bool = False,
    ) -> None:
        self.file, self.kind, self.version = file, kind, file.version
        self.event_mode, self.early_return, self.debug = event_mode, early_return, debug
        self.interface = file.interface(kind)
        self.messages: deque[str] = deque(maxlen=50)
        self.resets = not (self.version == 1 and kind == "me")  # there is a reset, and it brings the FMU back
        self.pristine = False  # instantiated or reset, and not yet initialised
        self.next_event: float | None = None  # [s], announced by an FMI 3.0 FMU in event mode
        self.dead = False  # after a fatal error no function may be called any more
        self.states: weakref.WeakSet[Snapshot] = weakref.WeakSet()
        self.fmu: Any = None
        self._key = (str(file.description.guid), str(self.interface.modelIdentifier))
        self._folder: Path | None = file.unpack()
        try:
            self._load()
        except BaseException:
            self._remove_folder()
            raise

    @property
    def component(self) -> int:
        """Address of the instance."""
        address = self.fmu.component
        return int(getattr(address, "value", address) or 0)

    def pointer(self, name: str) -> int:
        """Return the address of one of the FMU's functions by fmpy's name (``fmi2DoStep``, ``fmi1GetReal``)."""
        return int(ctypes.cast(self.fmu._functions[name], ctypes.c_void_p).value or 0)

    def _load(self) -> None:
        """Load the library and instantiate."""
        if self.interface.canBeInstantiatedOnlyOncePerProcess and _alive[self._key]:
            raise InputError(
                "the FMU can exist only once in a process",
                expected="no other instance",
                got="one that is not closed",
                remedy="close the other one, or run this one isolated",
                file=self.file.path,
            )
        from fmpy.fmi1 import FMU1Model, FMU1Slave
        from fmpy.fmi2 import FMU2Model, FMU2Slave
        from fmpy.fmi3 import FMU3Model, FMU3Slave

        classes = {
            (1, "cs"): FMU1Slave,
            (1, "me"): FMU1Model,
            (2, "cs"): FMU2Slave,
            (2, "me"): FMU2Model,
            (3, "cs"): FMU3Slave,
            (3, "me"): FMU3Model,
        }
        with _loading:
            before = os.getcwd()
            try:
                self.fmu = classes[self.version, self.kind](
                    guid=self.file.description.guid,
                    unzipDirectory=str(self._folder),
                    modelIdentifier=self.interface.modelIdentifier,
                    instanceName=self.file.description.modelName or self.interface.modelIdentifier,
                )
            except Exception as error:
                raise InputError(
                    "the FMU's library cannot be loaded",
                    expected=f"a shared library with the functions of FMI {self.version}",
                    got=" ".join(f"{type(error).__name__}: {error}".split())[:300].replace(str(self._folder), "..."),
                    remedy="export it again for this system",
                    file=self.file.path,
                ) from error
            finally:
                os.chdir(before)
        if self.version == 1:
            for function in self.fmu._functions.values():  # some are declared to return text where they return a status
                if function.restype is ctypes.c_char_p and not function.__name__.endswith(("Version", "Platform")):
                    function.restype = ctypes.c_int
        self._instantiate()

    def _instantiate(self) -> None:
        """Make the instance."""
        try:
            if self.version == 3:
                options: dict[str, Any] = {"loggingOn": self.debug, "logMessage": self._message3()}
                if self.kind == "cs":
                    options.update(eventModeUsed=self.event_mode, earlyReturnAllowed=self.early_return)
                self.fmu.instantiate(**options)
            elif self.version == 2:
                self.fmu.instantiate(callbacks=self._callbacks(), loggingOn=self.debug)
            else:
                self.fmu.instantiate(functions=self._callbacks(), loggingOn=self.debug)
            if not self.component:
                raise PlantError("no instance was returned")
        except Exception as error:
            self.fmu.component = None
            raise InputError(
                "the FMU refuses to be instantiated",
                expected="an instance",
                got=self._told(error),
                remedy="check its licence, its resources and the system it was exported for",
                file=self.file.path,
            ) from error
        _alive[self._key] += 1
        self.pristine = True

    def _message3(self) -> Any:
        """Return the logger for FMI 3.0; it must not keep this object alive."""
        hear = weakref.WeakMethod(self._hear)

        def message(_environment: Any, status: int, _category: bytes | None, text: bytes | None) -> None:
            if (call := hear()) is not None:
                call(int(status), text)

        return message

    def _callbacks(self) -> Any:
        """Return the callbacks for FMI 1.0 and 2.0."""
        from ctypes import byref

        from fmpy import calloc, fmi1, fmi2, free
        from fmpy.logging import addLoggerProxy

        hear = weakref.WeakMethod(self._hear)

        def logger(_e: Any, _name: bytes | None, status: int, _category: bytes | None, text: bytes | None) -> None:
            if (call := hear()) is not None:
                call(int(status), text)

        m, prefix = (fmi1, "fmi1") if self.version == 1 else (fmi2, "fmi2")
        made = getattr(m, f"{prefix}CallbackFunctions")()
        made.logger = getattr(m, f"{prefix}CallbackLoggerTYPE")(logger)
        made.allocateMemory = getattr(m, f"{prefix}CallbackAllocateMemoryTYPE")(calloc)
        made.freeMemory = getattr(m, f"{prefix}CallbackFreeMemoryTYPE")(free)
        addLoggerProxy(byref(made))
        return made

    def _hear(self, status: int, text: bytes | None) -> None:
        """Keep a message of the FMU and pass it to the log."""
        words = " ".join((text or b"").decode("utf-8", "replace").split())[:500]
        level = LEVELS[status] if 0 <= status < len(LEVELS) else str(status)
        log.log(logging.DEBUG if status == 0 else logging.WARNING, "%s: %s: %s", self.file.path.name, level, words)
        if status != 0 and words:
            self.messages.append(words)

    def _told(self, error: BaseException) -> str:
        """Return what went wrong, with what the FMU said about it."""
        said = f" ({self.messages[-1]})" if self.messages else ""
        return f"{error}{said}"

    def failure(self, what: str, error: BaseException | None = None, *, status: str = "crashed") -> PlantError:
        """Return the error for a call that failed; after a fatal one the instance is never touched again."""
        code = getattr(error, "status", None)
        if code == 4:
            self.dead = True
        said = f": {self.messages[-1]}" if self.messages else ""
        reason = "" if error is None else f": {error}"
        return PlantError(f"{self.file.path.name}: {what}{reason}{said}", status=status)

    def enter(self, values: Mapping[str, Any], t0: float, tolerance: float | None) -> None:
        """Reset if needed, set start values and begin to initialise; FMI 1.0 ends it too.

        - ``values``: values by variable name, as the FMU's own types and units (lists for arrays)
        - ``t0``: start time [s]
        - ``tolerance``: relative tolerance for solvers inside the FMU
        """
        if self.dead:
            raise self.failure("not usable after a fatal error; start a new process")
        self.messages.clear()
        if not self.pristine:
            self._reset()
        self.pristine = False
        try:
            self._enter(values, t0, tolerance)
        except (InputError, PlantError):
            raise
        except Exception as error:
            raise self.failure("the initialisation failed", error) from error

    def _reset(self) -> None:
        """Bring the instance back; where it cannot (FMI 1.0 model exchange, a failing reset), make a new one."""
        if self.resets:
            try:
                self.fmu.reset()
                return
            except Exception as error:
                if getattr(error, "status", None) == 4:
                    raise self.failure("fatal error at reset", error) from error
        self.renew()

    def renew(self) -> None:
        """Put a fresh instance in the place of this one."""
        self._free_instance()
        self._instantiate()

    def _enter(self, values: Mapping[str, Any], t0: float, tolerance: float | None) -> None:
        variables = self.file.variables
        fmu, early, late = self.fmu, {}, {}
        for name, value in values.items():
            v = variables[name]
            constant = v.variability == "constant"
            if v.causality == "structuralParameter":
                early[name] = value
            elif v.causality == "input" or (not constant and (v.initial in ("exact", "approx") or self.version == 1)):
                early[name] = value
            else:
                late[name] = value
        if self.version == 1:
            if self.kind == "me":
                fmu.setTime(t0)
            self._set(early, variables)
            if self.kind == "cs":
                status = fmu.initialize(tStart=t0, stopTime=None)
                if status > 1:
                    raise self.failure(f"the initialisation failed with status {LEVELS[status]}")
            return
        if self.version == 2:
            fmu.setupExperiment(tolerance=tolerance, startTime=t0)
            self._set(early, variables)
            fmu.enterInitializationMode()
        else:
            structural = {n: x for n, x in early.items() if variables[n].causality == "structuralParameter"}
            if structural:
                fmu.enterConfigurationMode()
                self._set(structural, variables)
                fmu.exitConfigurationMode()
            self._set({n: x for n, x in early.items() if n not in structural}, variables)
            fmu.enterInitializationMode(tolerance=tolerance, startTime=t0)
        self._set(late, variables)

    def leave(self) -> None:
        """End the initialisation."""
        try:
            if self.version > 1:
                self.fmu.exitInitializationMode()
            if self.version == 3 and self.kind == "cs" and self.event_mode:
                self.handle_events()
        except (InputError, PlantError):
            raise
        except Exception as error:
            raise self.failure("the initialisation failed", error) from error

    def enter_events(self) -> None:
        """FMI 3.0 co-simulation: an event was met; handle it."""
        self.fmu.enterEventMode()
        self.handle_events()

    def handle_events(self) -> None:
        """FMI 3.0 co-simulation in event mode: update discrete states until they settle, go back to step mode."""
        for _ in range(1000):
            again, terminate, _nominals, _values, defined, when = self.fmu.updateDiscreteStates()
            self.next_event = float(when) if defined else None
            if terminate:
                raise self.failure("the FMU ends the simulation at an event", status="terminated")
            if not again:
                self.fmu.enterStepMode()
                return
        raise self.failure("1000 event iterations without an end", status="timeout")

    def _set(self, values: Mapping[str, Any], variables: Mapping[str, Any]) -> None:
        """Set values through fmpy's typed setters; real ones that follow each other in one call, for every run asks it.

        Where a call for several fails, each is set by itself: what is refused is named.
        """
        for kind, group in groupby(values.items(), key=lambda item: self._kind(variables[item[0]])):
            together = list(group)
            if kind in ("Real", "Float64") and len(together) > 1:
                try:
                    self._call_setter(kind, together, variables)
                    continue
                except Exception as error:
                    if getattr(error, "status", None) == 4:
                        names = ", ".join(repr(name) for name, _ in together)
                        raise self.failure(f"{names} cannot be set", error) from error
            for name, value in together:
                try:
                    self._call_setter(kind, [(name, value)], variables)
                except Exception as error:
                    raise self.failure(f"{name!r} cannot be set to {value!r}", error) from error

    def _kind(self, variable: Any) -> str:
        """Return the type of a variable as fmpy's setters call it."""
        kind: str = variable.type
        return kind if kind != "Enumeration" else "Int64" if self.version == 3 else "Integer"

    def _call_setter(self, kind: str, values: Sequence[tuple[str, Any]], variables: Mapping[str, Any]) -> None:
        """Set variables of one type in one call; arrays follow each other."""
        listed = [part for _, one in values for part in (one if isinstance(one, list | tuple) else [one])]
        getattr(self.fmu, f"set{kind}")([variables[name].valueReference for name, _ in values], listed)

    def set_now(self, name: str, value: Any) -> None:
        """Set one variable while the simulation runs (a tunable parameter)."""
        self._set({name: value}, {v.name: v for v in self.file.description.modelVariables if v.name == name})

    def take(self) -> Snapshot:
        """Return the present state of the FMU."""
        pointer = ctypes.c_void_p()
        try:
            getattr(self.fmu, f"fmi{self.version}{'GetFMUstate' if self.version == 2 else 'GetFMUState'}")(
                self.fmu.component, ctypes.byref(pointer)
            )
        except Exception as error:
            raise self.failure("the state cannot be taken", error) from error
        return self.kept(pointer)

    def kept(self, pointer: ctypes.c_void_p) -> Snapshot:
        """Return a state of the FMU as one that is freed with this instance."""
        made = Snapshot(self, pointer)
        made.next_event = self.next_event
        self.states.add(made)
        return made

    def put(self, state: Snapshot) -> None:
        """Go back to a state."""
        if state.pointer is None or state.owner() is not self:
            raise InputError(
                "a state of another instance",
                expected="a state that this plant returned and that is still alive",
                got="one of a closed, replaced or other instance",
                remedy="take it from this plant after its last reset",
            )
        try:
            self.fmu.setFMUState(state.pointer)
        except Exception as error:
            raise self.failure("the state cannot be set", error) from error
        self.next_event = state.next_event

    def _free_instance(self) -> None:
        """Free the instance and the states it keeps, but not the library."""
        for state in list(self.states):
            state.free()
        if self.fmu is None or not self.component:
            return
        if not self.dead:
            names = {(1, "cs"): "fmi1FreeSlaveInstance", (1, "me"): "fmi1FreeModelInstance"}
            getattr(self.fmu, names.get((self.version, self.kind), f"fmi{self.version}FreeInstance"))(
                self.fmu.component
            )
        self.fmu.component = None
        _alive[self._key] -= 1

    def close(self) -> None:
        """Free the instance, unload the library, remove the temporary folder; harmless when called again."""
        try:
            if self.fmu is not None:
                self._free_instance()
                if not self.dead:
                    self.fmu.freeLibrary()
                self.fmu = None
        finally:
            self._remove_folder()

    def _remove_folder(self) -> None:
        if self._folder is not None:
            release(self._folder)
            self._folder = None
