"""Foreign code kept in its place: any plant in a child process, with a time limit on every call.

A segmentation fault, an abort, an exit, a hang or chatter on standard output ends (or disturbs) the child and never
the caller. Whole chunks of input travel at once, so an open-loop rollout costs little more than a direct one.
"""

from __future__ import annotations

import logging
import os
import pickle
import signal
import socket
import subprocess
import sys
import time
import weakref
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import msgspec
import numpy as np

from harness.errors import HarnessError, InputError, PlantError
from harness.protocols import Ability, Plant
from harness.signals import FloatArray, PlantSpec
from harness.supervision.patience import LOADING, LONGEST, Patience
from harness.supervision.whereabouts import was_at_time, was_at_work_on
from plants.checking import checked_inputs, refuse_input
from plants.isolation import frames
from plants.isolation.child import registered
from plants.temporary import release, temporary_folder

log = logging.getLogger("plants.isolation.isolated")

FIRST_CHUNK, LAST_CHUNK = 128, 8192  # rows of input in one message
SLACK = 16 << 20  # bytes of an answer beyond its numbers: descriptions and texts


class IsolatedPlant:
    """A plant that lives in a child process.

    Parameters
    ----------
    factory : str or callable
        Id of a registered plant (``"pendulum-fmu"``), ``"module:attribute"``, or a callable that can be pickled.
    options : mapping, optional
        Keyword arguments of the factory.
    timeout : float
        Longest time [s] for one call; a rollout is cut into chunks that stay far below it. A call that takes longer
        ends the child and raises PlantError with the status ``timeout``, as does a step that takes much longer than
        those before it (:class:`harness.supervision.patience.Patience`).
    start_timeout : float, optional
        Longest time [s] for starting the child and making the plant, by default
        :data:`harness.supervision.patience.LOADING`, or ``timeout`` where that is more.
    recycle : int
        Resets after which a fresh child is started (some FMUs leak or fail after about 1000 instances).
    show_output : bool
        Let what the plant prints reach standard error; otherwise it is dropped.

    Raises
    ------
    InputError
        If the factory refuses its options.
    PlantError
        If the child does not survive making the plant.

    Notes
    -----
    After a crash or timeout the next ``reset`` starts a new child; snapshots of the old one are gone. The child works
    in a temporary folder of its own, which is removed with it, and what it sends is read as numbers and text only. It
    is no sandbox: what runs in it may do whatever you may. Needs a POSIX system.

    Examples
    --------
    >>> with IsolatedPlant("pendulum-fmu", {"sample_time": 0.02}, timeout=5.0) as plant:
    ...     y = plant.reset(rng=np.random.default_rng(0), x0={"theta": 0.1})
    ...     print(plant.spec, plant.rollout(np.zeros((100, 1))).shape)
    u [N m] -> theta [rad] every 0.02 s (100, 1)
    """

    spec: PlantSpec
    abilities: frozenset[Ability]
    snapshot_tolerance: float
    input_starts: tuple[float, ...]
    beyond: tuple[str, ...]
    drives: bool  # Whether :meth:`enter`, :meth:`drive` and :meth:`leave` are to be had.

    def __init__(
        self,
        factory: str | Callable[..., Plant],
        options: Mapping[str, Any] | None = None,
        *,
        timeout: float = LONGEST,
        start_timeout: float | None = None,
        recycle: int = 500,
        show_output: bool = False,
    ) -> None:
        start_timeout = max(LOADING, timeout) if start_timeout is None else start_timeout
        for name, value in (("timeout", timeout), ("start_timeout", start_timeout), ("recycle", recycle)):
            if not value > 0:
                raise InputError(name, expected="a positive number", got=repr(value), remedy="give one")
        try:
            self._order = pickle.dumps((factory, {k: _from_here(k, v) for k, v in (options or {}).items()}))
        except Exception as error:
            raise InputError(
                "a factory that cannot travel to another process",
                expected="an id, 'module:attribute', or a function and options that can be pickled",
                got=f"{type(error).__name__}: {error}",
                remedy="define the function at the top of a module",
            ) from error
        self._name = factory if isinstance(factory, str) else getattr(factory, "__qualname__", repr(factory))
        if "path" in (options or {}):
            self._name = Path((options or {})["path"]).name
        self._timeout, self._start_timeout = float(timeout), float(start_timeout)
        self._patience = Patience(timeout)
        self._recycle, self._show = int(recycle), show_output
        self._child: _Child | None = None
        self._closed = False
        self._resets = 0
        self._doubtful = False
        self._truth = np.zeros(0)
        self._values: dict[str, Any] = {}
        self._told = True
        self.warnings: tuple[str, ...] = ()
        self._start()

    def reset(self, *, rng: np.random.Generator, x0: Mapping[str, float] | None = None) -> FloatArray:
        """Start anew, in a new child if the last one died; returns ``y[0]`` (ny,)."""
        return self._output(self._begun("reset", rng, x0), (self.spec.ny,))

    def enter(self, *, rng: np.random.Generator, x0: Mapping[str, float] | None = None) -> None:
        """Begin a :meth:`reset`, which :meth:`leave` ends, where the plant inside ``drives``."""
        self._begun("enter", rng, x0)

    def drive(self, u: FloatArray) -> FloatArray:
        """Set inputs (nu,) while the plant inside initialises; returns the outputs (ny,) that follow."""
        return self._output(self._call("drive", self._fitting(u)), (self.spec.ny,))

    def leave(self) -> FloatArray:
        """End what :meth:`enter` began; returns ``y[0]`` (ny,)."""
        return self._output(self._call("leave"), (self.spec.ny,))

    def _begun(self, order: str, rng: np.random.Generator, x0: Mapping[str, float] | None) -> frames.Reply:
        """Give the order that begins a run, again in a new child where only that brings the plant back."""
        self._resets += 1
        if self._child is None or self._doubtful or self._resets > self._recycle:
            self._start()
        self._tell_values()
        start = None if x0 is None else dict(x0)
        try:
            answer = self._call(order, rng, start)
            again = answer.renew  # neither its reset nor a fresh instance brings the plant back
        except PlantError:
            again = self._child is None and self._resets > 1  # the end of the run before, which did not come, or broke
            if not again:
                raise
            self._say(f"a run after another does not begin ({order}): every run gets a process of its own")
        if again:
            self._recycle = 1
            self._start()
            self._resets = 1
            self._tell_values()
            answer = self._call(order, rng, start)
        return answer

    def preset(self, values: Mapping[str, Any]) -> None:
        """Set parameters and start values for the resets to come, where the plant inside has ``preset``."""
        self._values.update(values)
        self._told = False

    def _tell_values(self) -> None:
        """Give a child the values that were preset, if it does not have them yet."""
        if not self._told and self._values:
            self._call("preset", dict(self._values))
        self._told = True

    def step(self, u: FloatArray) -> FloatArray:
        """Hold ``u`` (nu,) for one sample time; returns the next output (ny,)."""
        return self._output(self._stepped("step", self._fitting(u), 1, self.spec.ny), (self.spec.ny,))

    def output(self, u: FloatArray) -> FloatArray:
        """Return the output (ny,) with ``u`` applied, where the plant declares feedthrough."""
        return self._output(self._call("output", self._fitting(u)), (self.spec.ny,))

    def rollout(self, inputs: FloatArray) -> FloatArray:
        """Apply ``inputs`` (N, nu) in chunks; returns (N, ny), equal to stepping."""
        return self._rolled("rollout", inputs)[0]

    def rollout_truth(self, inputs: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the outputs (N, ny) of ``rollout``, and the true states (N, nx), where they are declared."""
        return self._rolled("rollout_truth", inputs)

    def rollout_partials(self, inputs: FloatArray, unknowns: Sequence[str], knowns: Sequence[str]) -> FloatArray:
        """Return partial derivatives (N, 2, len(unknowns), len(knowns)), where the plant inside tells any."""
        rows, names, width = (
            checked_inputs(inputs, self.spec),
            (list(unknowns), list(knowns)),
            len(unknowns) * len(knowns),
        )
        found = [np.empty((0, 2 * width))]
        for first in range(0, len(rows), FIRST_CHUNK):
            chunk = rows[first : first + FIRST_CHUNK]
            answer = self._call("rollout_partials", chunk, *names, size=2 * len(chunk) * width)
            found.append(self._output(answer, (len(chunk), 2 * width)))
        return np.concatenate(found).reshape(-1, 2, len(unknowns), len(knowns))

    def _rolled(self, order: str, inputs: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Apply inputs in chunks; the true states are filled in only where the order brings them."""
        rows = checked_inputs(inputs, self.spec)
        ny, nx = self.spec.ny, len(self.spec.states) if order == "rollout_truth" else 0
        both = np.empty((rows.shape[0], ny + nx))
        done, size = 0, FIRST_CHUNK
        while done < rows.shape[0]:
            chunk = rows[done : done + size]
            started = time.perf_counter()
            answer = self._stepped(order, chunk, len(chunk), len(chunk) * (ny + nx))
            both[done : done + len(chunk)] = self._output(answer, (len(chunk), ny + nx))
            spent = time.perf_counter() - started
            done += len(chunk)
            # a chunk shall take about a fiftieth of the limit
            size = int(np.clip(size * 0.02 * self._timeout / max(spent, 1e-6), 1, min(4 * size, LAST_CHUNK)))
        return both[:, :ny], both[:, ny:]

    def _stepped(self, order: str, inputs: FloatArray, steps: int, size: int) -> frames.Reply:
        """Have the child do so many steps, within the time that they may take by those before them."""
        started = time.perf_counter()
        answer = self._call(order, inputs, limit=self._patience.limit(steps), size=size)
        self._patience.took(steps, time.perf_counter() - started)
        return answer

    def truth(self) -> FloatArray:
        """Return the present true state (nx,); it comes with every output."""
        return self._truth.copy()

    def get_state(self) -> _Ticket:
        """Return a ticket for a state that the child keeps."""
        child = self._living()
        ticket = _Ticket(child, self._call("get_state").number)
        weakref.finalize(ticket, child.dropped.append, ticket.number)
        return ticket

    def set_state(self, state: _Ticket) -> None:
        """Go back to a state of this same child."""
        if state.child() is not self._living():
            raise InputError(
                "a state of another process",
                expected="a state taken since this plant's child was started",
                got="one of a child that is gone",
                remedy="replay the inputs from reset",
            )
        self._output(self._call("set_state", state.number), (0,))

    def close(self) -> None:
        """End the child; harmless when called twice."""
        self._closed = True
        if self._child is not None:
            self._child.end(polite=True)
            self._child = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _start(self) -> None:
        """Start a child and make the plant in it."""
        if self._closed:
            raise InputError("a closed plant", expected="an open one", got="a closed one", remedy="make a new one")
        if self._child is not None:
            self._child.end(polite=True)
        self._child = _Child(self._show)
        self._resets, self._doubtful, self._told = 0, False, not self._values
        made = self._call("make", self._order, limit=self._start_timeout).made
        if made is None:
            raise self._nonsense("make")
        self.spec, self.abilities = made.spec, frozenset(made.abilities) | {"batch"}
        self.input_starts, self.drives = made.input_starts, made.drives
        self.beyond = tuple(frames.plain(text) for text in made.beyond)
        if "truth" in self.abilities:
            self.abilities |= {"batch-truth"}
        if made.snapshot_tolerance is not None:  # only where the plant inside declares one
            self.snapshot_tolerance = made.snapshot_tolerance

    def _living(self) -> _Child:
        if self._child is None:
            raise InputError(
                "a plant without a process",
                expected="a living child",
                got="one that is closed or died",
                remedy="call reset first, or make a new plant if it is closed",
            )
        return self._child

    def _call(self, name: str, *arguments: Any, limit: float | None = None, size: int = 0) -> frames.Reply:
        """Have the child do something, within the time limit; ``size`` is the count of numbers in the answer."""
        child = self._living()
        try:
            answer = child.call(name, arguments, self._timeout if limit is None else limit, SLACK + 8 * size)
            for note in answer.notes:
                if name == "make" and note in self.warnings:  # of the process before this one
                    continue
                self._say(note)
            if answer.trouble is not None:
                raise frames.raised(answer.trouble)
            return answer
        except _Gone as gone:
            self._child = None
            longer = " (for longer: the option timeout, -O timeout=SECONDS)" if gone.status == "timeout" else ""
            raise PlantError(f"{self._name}: {gone}{longer}", status=gone.status) from None
        except BaseException as error:
            self._doubtful = isinstance(error, PlantError) and error.status == "crashed"  # better a fresh child
            if name == "make" or not isinstance(error, HarnessError):  # interrupted: the answer may still come
                child.end(polite=False)
                self._child = None
            raise

    def _say(self, note: str) -> None:
        """Say something that the plant has to say beside its answers."""
        self.warnings += (note,)
        log.warning("%s: %s", self._name, note)

    def _output(self, answer: frames.Reply, shape: tuple[int, ...]) -> FloatArray:
        """Return the outputs of an answer, keep the truth that came with them; NaN is divergence."""
        try:
            outputs = frames.array_of(answer.values, shape)
            truth = frames.array_of(answer.truth, (len(self.spec.states),) if answer.truth else (0,))
        except ValueError:
            raise self._nonsense("a step") from None
        self._truth = truth
        if not np.isfinite(outputs).all():
            raise PlantError(f"{self._name}: an output is not finite", status="diverged")
        return outputs

    def _nonsense(self, order: str) -> PlantError:
        """End a child that answers what no plant does, and return the error."""
        if self._child is not None:
            self._child.end(polite=False)
            self._child = None
        return PlantError(f"{self._name}: the child's answer to {order} is no answer", status="crashed")

    def _fitting(self, u: FloatArray) -> FloatArray:
        array = np.asarray(u, dtype=np.float64)
        if array.shape != (self.spec.nu,) or not np.isfinite(array).all():
            refuse_input(array, self.spec)
        return array


def isolated(plant: str, *, timeout: float = LONGEST, **options: Any) -> IsolatedPlant:
    """Any registered plant in a child process with a time limit.

    Parameters
    ----------
    plant : str
        Id of a registered plant: a file may name this one, and what is no id would be imported.
    timeout : float
        Longest time [s] for one call.
    **options
        Options of the plant.

    Raises
    ------
    InputError
        If no plant of this id is registered.
    """
    registered(plant)
    return IsolatedPlant(plant, options, timeout=timeout)


_DECODER = msgspec.msgpack.Decoder(frames.Reply)


class _Gone(Exception):
    """The child did not survive, or had to be ended."""

    def __init__(self, text: str, status: str) -> None:
        super().__init__(text)
        self.status = status


class _Ticket:
    """Stands for a state that a child keeps."""

    def __init__(self, child: _Child, number: int) -> None:
        self.child, self.number = weakref.ref(child), number


class _Child:
    """The child process as the caller sees it."""

    def __init__(self, show_output: bool) -> None:
        if os.name != "posix":
            raise InputError(
                "a plant in a process of its own",
                expected="a system whose processes inherit sockets (Linux, macOS)",
                got=os.name,
                remedy="isolated = false: the plant then runs in this process, and a crash of it ends both",
            )
        self.dropped: list[int] = []  # numbers of states that nobody holds any more
        self.folder = temporary_folder("sysid-isolated-")
        self.pipe, theirs = socket.socketpair()
        environment = {
            **os.environ,
            "TMPDIR": str(self.folder),
            "PYTHONPATH": os.pathsep.join(dict.fromkeys(os.path.abspath(path) for path in sys.path)),
        }
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-c", "from plants.isolation.child import serve; serve()", str(theirs.fileno())],
            pass_fds=[theirs.fileno()],
            cwd=self.folder,
            stdin=subprocess.DEVNULL,
            stdout=2 if show_output else subprocess.DEVNULL,
            stderr=None if show_output else subprocess.DEVNULL,
            env=environment,
            start_new_session=True,  # an interrupt from the keyboard is the caller's to handle
        )
        theirs.close()
        self._finalizer = weakref.finalize(self, _end, self.process, self.pipe, self.folder)

    def call(self, name: str, arguments: tuple[Any, ...], limit: float, largest: int) -> frames.Reply:
        """Send an order and wait for the answer, which has at most so many bytes."""
        dropped, self.dropped[:] = self.dropped.copy(), []
        try:
            frames.send(self.pipe, pickle.dumps((name, arguments, dropped), protocol=5), limit=limit)
            return _DECODER.decode(frames.receive(self.pipe, largest=largest, limit=limit))
        except TimeoutError:
            part, t = self._part(), was_at_time(self.folder)
            self.end(polite=False)
            missed = "is not loaded" if name == "make" else f"no answer to {name}"
            if name in ("step", "rollout", "rollout_truth") and t is not None:
                missed = f"the step from t = {t:.6g} s does not end"
            raise _Gone(f"{part}{missed} within {limit:.3g} s", "timeout") from None
        except (msgspec.DecodeError, HarnessError):  # no frame of ours, or a spec that makes no sense
            self.end(polite=False)
            raise _Gone(f"the child's answer to {name} is no answer", "crashed") from None
        except (EOFError, OSError):
            part = self._part()
            raise _Gone(f"{part}{self._obituary()} during {'loading' if name == 'make' else name}", "crashed") from None

    def _part(self) -> str:
        """Return which part of a coupled system the process is or was at work on, as the beginning of a message."""
        name = frames.plain(was_at_work_on(self.folder))
        return f"part {name!r}: " if name else ""

    def _obituary(self) -> str:
        """Return how the process ended."""
        try:
            code = self.process.wait(5.0)
        except subprocess.TimeoutExpired:
            code = None
        self.end(polite=False)
        if code is None:
            return "closed its pipe"
        if code < 0:
            try:
                return f"killed by {signal.Signals(-code).name}"
            except ValueError:
                return f"killed by signal {-code}"
        return f"exited with status {code}"

    def end(self, *, polite: bool) -> None:
        """End the process and remove its folder."""
        if polite:
            try:
                self.pipe.close()
                self.process.wait(2.0)
            except (OSError, subprocess.TimeoutExpired):
                polite = False
        self._finalizer()


def _from_here(name: str, value: Any) -> Any:
    """Return an option with the path of a file made absolute: the child works in another folder."""
    if isinstance(value, Path):
        return value.absolute()
    if isinstance(value, str) and (name == "path" or ("." in value and os.path.exists(value))):
        return os.path.abspath(value)
    return value


def _end(process: subprocess.Popen[bytes], pipe: socket.socket, folder: Path) -> None:
    """Kill the process with all it started, and remove what it left in its temporary folder."""
    pipe.close()
    if hasattr(os, "killpg"):
        try:
            os.killpg(process.pid, signal.SIGKILL)
        except (ProcessLookupError, PermissionError):
            process.kill()
    else:  # no groups of processes: what it started itself ends when its pipes close
        process.kill()
    process.wait()
    release(folder)
