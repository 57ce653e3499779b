"""The child's side of an isolated plant: make it, obey orders, tell how they went."""

from __future__ import annotations

import importlib
import inspect
import os
import pickle
import shutil
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, cast

import msgspec
import numpy as np

from harness.errors import HarnessError, InputError, PlantError
from harness.options import instead, meant_options
from harness.protocols import Batch, BatchTruth, Feedthrough, Plant, Snapshots, Truth
from harness.signals import FloatArray
from harness.supervision.whereabouts import at_time, share
from plants.isolation import frames
from plants.isolation.frames import Made, Reply

if TYPE_CHECKING:
    import importlib.metadata

HELD = 90.0
"""Seconds for which a library may keep the interpreter to itself, as one that never ends its loading does: nothing here
can then notice that the caller has gone. More than a caller waits for a plant to be loaded."""


def serve() -> None:
    """Run in the child: obey orders until the caller closes the pipe."""
    pipe = socket.socket(fileno=int(sys.argv[1]))
    parent = os.getppid()
    plant: Plant | None = None

    def watch() -> None:
        # a hung plant must not outlive the caller
        while os.getppid() == parent:
            if hasattr(signal, "setitimer"):  # where this thread gets no turn, the alarm ends the process
                signal.setitimer(signal.ITIMER_REAL, HELD)
            if (now := getattr(plant, "now", None)) is not None:
                at_time(now)
            time.sleep(0.5)
        shutil.rmtree(os.environ["TMPDIR"], ignore_errors=True)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    if (folder := os.environ.get("TMPDIR")) is not None:  # of its own, made by who started it
        share(folder)
    states: dict[int, Any] = {}
    number, told = 0, 0
    while True:
        try:
            name, arguments, dropped = pickle.loads(frames.receive(pipe))
        except (EOFError, OSError):
            break
        for old in dropped:
            states.pop(old, None)
        try:
            if name == "make":
                plant = _made(*pickle.loads(arguments[0]))
                tolerance = getattr(plant, "snapshot_tolerance", None)
                abilities = tuple(sorted(plant.abilities))
                starts = tuple(map(float, getattr(plant, "input_starts", ())))
                beyond = tuple(map(str, getattr(plant, "beyond", ())))
                drives = bool(getattr(plant, "drives", False))
                tolerance = None if tolerance is None else float(tolerance)
                made = Made(plant.spec, abilities, tolerance, starts, beyond, drives)
                answer = Reply(made=made)
            elif plant is None:
                raise PlantError("no plant was made")
            elif name == "get_state":
                number += 1
                states[number] = cast(Snapshots, plant).get_state()
                answer = Reply(number=number)
            else:
                outputs = np.ascontiguousarray(_obey(plant, name, arguments, states), dtype=np.float64)
                knows = "truth" in plant.abilities and name not in ("preset", "enter", "drive")  # then it does not run
                truth = cast(Truth, plant).truth().tobytes() if knows else b""
                renew = name in ("reset", "enter") and bool(getattr(plant, "needs_process", False))
                answer = Reply(values=outputs.tobytes(), truth=truth, renew=renew)
        except HarnessError as error:
            answer = Reply(trouble=frames.trouble(error))
        except Exception as error:
            text = " ".join(f"raised {type(error).__name__}: {error}".split())
            answer = Reply(trouble=frames.trouble(PlantError(text[:500], status="crashed")))
        said = tuple(getattr(plant, "warnings", ()))
        if len(said) > told:
            answer, told = msgspec.structs.replace(answer, notes=said[told:]), len(said)
        frames.send(pipe, msgspec.msgpack.encode(answer))
    states.clear()
    if plant is not None:
        plant.close()


def _obey(plant: Plant, name: str, arguments: tuple[Any, ...], states: dict[int, Any]) -> FloatArray:
    """Carry out one order on the plant."""
    if name == "reset":
        return plant.reset(rng=arguments[0], x0=arguments[1])
    if name == "step":
        return plant.step(arguments[0])
    if name == "output":
        return cast(Feedthrough, plant).output(arguments[0])
    if name == "preset":
        cast(Any, plant).preset(arguments[0])
        return np.zeros(0)
    if name == "enter":
        cast(Any, plant).enter(rng=arguments[0], x0=arguments[1])
        return np.zeros(0)
    if name in ("drive", "leave"):
        outputs: FloatArray = getattr(plant, name)(*arguments)
        return outputs
    if name == "rollout_partials":
        found: FloatArray = cast(Any, plant).rollout_partials(*arguments)
        return found
    if name == "set_state":
        cast(Snapshots, plant).set_state(states[arguments[0]])
        return np.zeros(0)
    if name == "rollout_truth":  # outputs and states travel as one table
        if "batch-truth" in plant.abilities:
            return np.hstack(cast(BatchTruth, plant).rollout_truth(arguments[0]))
        width = plant.spec.ny + len(plant.spec.states)
        pairs = [np.concatenate([plant.step(row), cast(Truth, plant).truth()]) for row in arguments[0]]
        return np.array(pairs).reshape(len(arguments[0]), width)
    if "batch" in plant.abilities:
        return cast(Batch, plant).rollout(arguments[0])
    return np.array([plant.step(row) for row in arguments[0]]).reshape(len(arguments[0]), plant.spec.ny)


def _made(factory: str | Callable[..., Plant], options: dict[str, Any]) -> Plant:
    """Return the plant of an order."""
    maker = _maker(factory)
    try:
        inspect.signature(maker).bind(**options)
    except TypeError as error:
        known = inspect.signature(maker).parameters
        unknown = [name for name in options if name not in known]
        lacking = [name for name, one in known.items() if one.default is one.empty and name not in options]
        raise InputError(
            f"options of the plant {factory if isinstance(factory, str) else maker.__name__!r}",
            expected=f"options among ({', '.join(known)})",
            got=", ".join(f"{name}={value!r}" for name, value in options.items()) or "none",
            remedy=instead(unknown, known) if unknown else f"give {', '.join(lacking)}",
        ) from error
    options = meant_options(f"the plant {factory if isinstance(factory, str) else maker.__name__!r}", maker, options)
    return maker(**options)


def _maker(factory: str | Callable[..., Plant]) -> Callable[..., Plant]:
    """Return what makes the plant of an order."""
    if not isinstance(factory, str):
        return factory
    if ":" in factory:
        module, _, attribute = factory.partition(":")
        return cast(Callable[..., Plant], getattr(importlib.import_module(module), attribute))
    return cast(Callable[..., Plant], registered(factory).load())


def registered(id: str) -> importlib.metadata.EntryPoint:
    """Return the module and attribute of a registered plant.

    Raises InputError if no plant is registered under this id.
    """
    import importlib.metadata  # 10 ms that a child with a plant of its own file does not need

    points = importlib.metadata.entry_points(group="sysid_harness.plants")
    for point in points:
        if point.name == id:
            return point
    known = sorted({point.name for point in points})
    raise InputError("unknown plant", expected=f"one of {', '.join(known)}", got=repr(id), remedy="correct it")
