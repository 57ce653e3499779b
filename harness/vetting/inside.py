"""What is done with an FMU inside a process of its own, by :func:`harness.supervision.guarded.guarded`.

Each function is called by its name with the plant's options, and returns plain numbers.
"""

from __future__ import annotations

import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from harness.conformance.excitation import inputs_for
from harness.parts.files import describe_fmu
from harness.signals import FloatArray
from harness.supervision.guarded import alive

__all__ = ["apart", "direct", "instances", "probed", "serialised", "slopes", "speed"]

WARM = 10
"""Instances before anything is counted: libraries and caches fill up."""
NUDGE = 1e-4
"""Step of differences, relative to the input or [1]."""


def _made(options: Mapping[str, Any]) -> Any:
    from harness import registry

    _quiet()
    alive()
    return registry.create("plants", "fmu", **options)


_SAID: list[Path] = []
"""Where this process writes what the FMU prints, once that is caught."""


def _quiet() -> Path:
    """Send what is printed in this process, also by machine code, to a file of its own."""
    if not _SAID:
        descriptor, name = tempfile.mkstemp(prefix="sysid-said-")
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        for target in (1, 2):
            os.dup2(descriptor, target)
        os.close(descriptor)
        _SAID.append(Path(name))
    return _SAID[0]


def _begun(plant: Any) -> FloatArray:
    alive()
    return np.asarray(plant.reset(rng=np.random.default_rng(0)))


def speed(options: Mapping[str, Any], samples: int, *, progress: Callable[..., None]) -> dict[str, float]:
    """Return the times [s] of instantiating, initialising and a sample."""
    begun = time.perf_counter()
    with _made(options) as plant:
        made = time.perf_counter() - begun
        begun = time.perf_counter()
        _begun(plant)
        initialised = time.perf_counter() - begun
        u = inputs_for(plant.spec, samples)
        plant.rollout(u[: max(1, samples // 10)])
        begun, spent = time.perf_counter(), time.process_time()
        plant.rollout(u)
        wall, cpu = time.perf_counter() - begun, time.process_time() - spent
        threads = threading.active_count() - 1
        kernel = len(os.listdir("/proc/self/task")) if Path("/proc/self/task").is_dir() else 0
    return {
        "make": made,
        "initialise": initialised,
        "sample": wall / samples,
        "cpu": cpu / samples,
        "threads": float(max(kernel, threads)),
        "sample_time": plant.spec.sample_time,
        "said": float(_quiet().stat().st_size),
    }


def apart(options: Mapping[str, Any], samples: int, *, progress: Callable[..., None]) -> float:
    """Return by how much an instance moves otherwise while one of the same library runs beside it.

    The plants of this project load a copy of the library each, which would hide what instances share: so this is done
    with fmpy, for co-simulation of FMI 2.0 and 3.0.
    """
    import fmpy

    _quiet()
    alive()
    path = str(options["path"])
    with tempfile.TemporaryDirectory(prefix="sysid-beside-") as folder:
        fmpy.extract(path, folder)
        twin = _Twin(path, folder, options)
        alone = twin.moved([1], samples)
        beside = twin.moved([1, 2], samples)
    return float(np.abs(beside - alone).max(initial=0.0))


class _Twin:
    """Instances of one loaded library."""

    def __init__(self, path: str, folder: str, options: Mapping[str, Any]) -> None:
        import fmpy

        self._folder = folder
        self._description = fmpy.read_model_description(path, validate=False)
        self._three = str(self._description.fmiVersion).startswith("3")
        self._dt, self._t0 = float(options["sample_time"]), float(options.get("start_time") or 0.0)
        rows = {row["name"]: row for row in describe_fmu(path)["variables"]}
        self._given = {
            name: (value - (rows[name]["offset"] or 0.0)) / (rows[name]["scale"] or 1.0)
            if isinstance(value, int | float) and not isinstance(value, bool) and rows[name]["scale"] is not None
            else value
            for name, value in {**(options.get("parameters") or {}), **(options.get("start") or {})}.items()
        }
        reals = [v for v in self._description.modelVariables if v.type in ("Real", "Float64") and not v.dimensions]
        self._ins, self._outs = (
            [v.valueReference for v in reals if v.causality == kind] for kind in ("input", "output")
        )

    def moved(self, seeds: list[int], samples: int) -> FloatArray:
        """Return the outputs (samples, ny) of the first of some instances, each under inputs of its own."""
        made = [self._begun() for _ in seeds]
        inputs = [np.random.default_rng(seed).uniform(-0.1, 0.1, (samples, len(self._ins))) for seed in seeds]
        rows = []
        for k in range(samples):
            alive()
            for fmu, u in zip(reversed(made), reversed(inputs), strict=True):  # the first one last
                if self._ins:
                    (fmu.setFloat64 if self._three else fmu.setReal)(self._ins, u[k].tolist())
                fmu.doStep(currentCommunicationPoint=self._t0 + k * self._dt, communicationStepSize=self._dt)
            get = made[0].getFloat64 if self._three else made[0].getReal
            rows.append(list(get(self._outs)) if self._outs else [])
        for fmu in made:
            fmu.terminate()
            fmu.freeInstance()
        return np.array(rows, dtype=float).reshape(samples, len(self._outs))

    def _begun(self) -> Any:
        """Return an initialised instance."""
        from fmpy.simulation import apply_start_values, instantiate_fmu

        fmu = instantiate_fmu(self._folder, self._description, "CoSimulation")
        if not self._three:
            fmu.setupExperiment(startTime=self._t0)
        apply_start_values(fmu, self._description, self._given)
        fmu.enterInitializationMode(**({"startTime": self._t0} if self._three else {}))
        fmu.exitInitializationMode()
        return fmu


def direct(options: Mapping[str, Any], *, progress: Callable[..., None]) -> tuple[bool, bool, list[str]]:
    """Return whether feedthrough is declared, whether the outputs tell, and those that move while no time passes."""
    with _made(options) as plant:
        _begun(plant)
        pair = inputs_for(plant.spec, 9)[[0, -1]]
        plant.rollout(pair[:1])
        before, after = np.array(plant.output(pair[0])), np.array(plant.output(pair[1]))
        moved = np.abs(after - before) > 1e-9 * np.maximum(np.abs(before), 1e-6)
        names = [channel.name for channel, yes in zip(plant.spec.outputs, moved, strict=True) if yes]
        return bool(plant.spec.feedthrough), bool(plant.tells_feedthrough), names


def probed(options: Mapping[str, Any], samples: int, *, progress: Callable[..., None]) -> list[dict[str, Any]]:
    """Return the findings of the probe that benchmarks use."""
    from harness import registry

    _quiet()
    alive()
    rest = {key: value for key, value in options.items() if key != "path"}
    result = registry.load("tools", "fmu-probe")(options["path"], samples=samples, isolate=False, **rest)
    found: list[dict[str, Any]] = result.to_dict()["findings"]
    return found


def slopes(options: Mapping[str, Any], *, progress: Callable[..., None]) -> tuple[float, bool]:
    """Return the largest difference of d outputs / d inputs between the FMU's own and differences, over the largest.

    And whether differences tell anything: outputs that wait for the next step do not follow the inputs at once.
    """
    with _made(options) as plant:
        _begun(plant)
        u = inputs_for(plant.spec, 9)[-1]
        plant.rollout(u[None])
        plant.output(u)
        names = [[channel.name for channel in group] for group in (plant.spec.outputs, plant.spec.inputs)]
        own = np.asarray(plant.directional_derivative(*names))
        found = np.empty_like(own)
        for column in range(len(u)):
            h = NUDGE * max(1.0, abs(u[column]))
            up, down = u.copy(), u.copy()
            up[column] += h
            down[column] -= h
            found[:, column] = (np.array(plant.output(up)) - np.array(plant.output(down))) / (2 * h)
        size = float(np.abs(found).max(initial=0.0))
        follows = size > 1e-12 or not np.abs(own).max(initial=0.0) > 1e-12
        return float(np.abs(own - found).max(initial=0.0) / max(size, 1e-12)), follows


def serialised(options: Mapping[str, Any], samples: int, *, progress: Callable[..., None]) -> tuple[int, float]:
    """Return the bytes of a serialised state, and by how much the continuation from it differs."""
    with _made(options) as plant:
        u = inputs_for(plant.spec, samples)
        _begun(plant)
        plant.rollout(u[: samples // 2])
        kept = plant.serialize_state()
        plant.deserialize_state(kept)
        first = plant.rollout(u[samples // 2 :])
        plant.deserialize_state(kept)
        again = plant.rollout(u[samples // 2 :])
        return len(kept), float(np.abs(first - again).max(initial=0.0))


def instances(options: Mapping[str, Any], count: int, *, progress: Callable[..., None]) -> dict[str, float]:
    """Return the memory [KiB], descriptors and threads that an instance leaves behind, of so many made in turn."""
    memory, files, threads = [], [], []
    for number in range(WARM + count):
        with _made(options) as plant:
            _begun(plant)
            plant.rollout(inputs_for(plant.spec, 3))
        if number >= WARM:
            memory.append(_resident())
            files.append(len(os.listdir("/proc/self/fd")) if Path("/proc/self/fd").is_dir() else 0)
            threads.append(len(os.listdir("/proc/self/task")) if Path("/proc/self/task").is_dir() else 0)
    # the median of the increments: an arena that grows once is no leak
    half = len(memory) // 2
    late, early = float(np.median(memory[half:])), float(np.median(memory[:half]))
    return {
        "memory": (late - early) / max(1.0, len(memory) / 2),
        "files": (files[-1] - files[0]) / max(1, count - 1),
        "threads": (threads[-1] - threads[0]) / max(1, count - 1),
        "known": float(memory[0] > 0),
    }


def _resident() -> float:
    """Return the memory of this process [KiB]; 0 where the system does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except (OSError, ValueError, IndexError):
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 1024
