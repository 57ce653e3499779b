"""What is done with an FMU inside a process of its own, by :func:`harness.supervision.guarded.guarded`.

Each function is called by its name with the plant's options, and returns plain numbers.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import re
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from harness.conformance.excitation import inputs_for
from harness.parts.files import describe_fmu
from harness.signals import FloatArray
from harness.supervision.guarded import alive

REPEATS = 3  # Runs whose time is taken; the shortest counts.
WARM = 10  # Instances before anything is counted: libraries and caches fill up.
NUDGE = 1e-4  # Step of differences, relative to the input or [1].


def _made(options: Mapping[str, Any]) -> Any:
    from harness import registry

    _quiet()
    alive()
    return registry.create("plants", "fmu", **options)


_SAID: list[Path] = []  # Where this process writes what the FMU prints, once that is caught.


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


def speed(options: Mapping[str, Any], samples: int, *, progress: Callable[..., None]) -> dict[str, Any]:
    """Return the times [s] of instantiating, initialising and a sample, and what the FMU prints, writes and starts."""
    path = str(Path(options["path"]).absolute())
    os.chdir(tempfile.mkdtemp(prefix="sysid-working-"))  # where what is written is seen, and is nobody's
    options, idle = {**options, "path": path}, _threads()
    begun = time.perf_counter()
    with _made(options) as plant:
        made = time.perf_counter() - begun
        begun = time.perf_counter()
        _begun(plant)
        initialised = time.perf_counter() - begun
        u = inputs_for(plant.spec, samples)
        plant.rollout(u[: max(1, samples // 10)])
        wall = np.inf
        for _ in range(REPEATS):  # the first run of few samples is mostly what comes once
            _begun(plant)
            begun = time.perf_counter()
            plant.rollout(u)
            wall = min(wall, time.perf_counter() - begun)
        threads = _threads() - idle
    return {
        "make": made,
        "initialise": initialised,
        "sample": wall / samples,
        "threads": float(max(threads, 0)),
        "sample_time": plant.spec.sample_time,
        "said": float(_quiet().stat().st_size),
        "written": sorted(os.listdir()),
    }


def _threads() -> int:
    """Return the threads of this process; 0 where the system does not tell."""
    return len(os.listdir("/proc/self/task")) if Path("/proc/self/task").is_dir() else 0


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


def _own_units(path: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters and start values of the options in the units of the FMU."""
    rows = {row["name"]: row for row in describe_fmu(path)["variables"]}
    return {
        name: (value - (rows[name]["offset"] or 0.0)) / (rows[name]["scale"] or 1.0)
        if isinstance(value, int | float) and not isinstance(value, bool) and rows[name]["scale"] is not None
        else value
        for name, value in {**(options.get("parameters") or {}), **(options.get("start") or {})}.items()
    }


class _Twin:
    """Instances of one loaded library."""

    def __init__(self, path: str, folder: str, options: Mapping[str, Any]) -> None:
        import fmpy

        self._folder = folder
        self._description = fmpy.read_model_description(path, validate=False)
        self._three = str(self._description.fmiVersion).startswith("3")
        self._dt, self._t0 = float(options["sample_time"]), float(options.get("start_time") or 0.0)
        self._given = _own_units(path, options)
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
        above, below = ([k for k, channel in enumerate(group) if channel.kind == "real"]
                        for group in (plant.spec.outputs, plant.spec.inputs))  # fmt: skip
        names = [plant.spec.outputs[k].name for k in above], [plant.spec.inputs[k].name for k in below]
        own = np.asarray(plant.directional_derivative(*names))
        found = np.empty_like(own)
        for at, column in enumerate(below):
            h = NUDGE * max(1.0, abs(u[column]))
            up, down = u.copy(), u.copy()
            up[column] += h
            down[column] -= h
            found[:, at] = ((np.array(plant.output(up)) - np.array(plant.output(down))) / (2 * h))[above]
        size = float(np.abs(found).max(initial=0.0))
        follows = size > 1e-12 or not np.abs(own).max(initial=0.0) > 1e-12
        return float(np.abs(own - found).max(initial=0.0) / max(size, 1e-12)), follows


def state_slopes(options: Mapping[str, Any], *, progress: Callable[..., None]) -> float | None:
    """Return by how much the FMU's own d derivatives / d states differ from differences, over the largest of these.

    By model exchange, with fmpy, at the start; None where the FMU does not say what its states are.
    """
    import fmpy
    from fmpy.simulation import apply_start_values, instantiate_fmu

    _quiet()
    alive()
    path = str(options["path"])
    description = fmpy.read_model_description(path, validate=False)
    three = str(description.fmiVersion).startswith("3")
    rates = [one.variable for one in description.derivatives]
    states = [rate.derivative for rate in rates]
    if not states or any(one is None or isinstance(one, str) or one.dimensions for one in states):
        return None
    knowns, unknowns = [one.valueReference for one in states], [one.valueReference for one in rates]
    count = len(states)
    with tempfile.TemporaryDirectory(prefix="sysid-slopes-") as folder:
        fmpy.extract(path, folder)
        fmu = instantiate_fmu(folder, description, "ModelExchange")
        start = float(options.get("start_time") or 0.0)
        if not three:
            fmu.setupExperiment(startTime=start)
        apply_start_values(fmu, description, _own_units(path, options))
        fmu.enterInitializationMode(**({"startTime": start} if three else {}))
        fmu.exitInitializationMode()
        more = True
        while more:
            alive()
            told = (fmu.updateDiscreteStates if three else fmu.newDiscreteStates)()
            more = bool(told[0])
        fmu.enterContinuousTimeMode()

        def rate_at(x: FloatArray) -> FloatArray:
            numbers = (ctypes.c_double * count)(*x)
            fmu.setContinuousStates(numbers, count)
            (fmu.getContinuousStateDerivatives if three else fmu.getDerivatives)(numbers, count)
            return np.array(numbers)

        held = (ctypes.c_double * count)()
        fmu.getContinuousStates(held, count)
        x = np.array(held) + 1e-2 * np.maximum(1.0, np.abs(np.array(held)))  # not where everything rests at 0
        found, own = np.empty((2, count, count))
        for k, h in enumerate(NUDGE * np.maximum(1.0, np.abs(x))):
            step = h * np.eye(count)[k]
            found[:, k] = (rate_at(x + step) - rate_at(x - step)) / (2 * h)
        rate_at(x)
        for k in range(count):
            own[:, k] = fmu.getDirectionalDerivative(unknowns, [knowns[k]], [1.0])
        fmu.terminate()
        fmu.freeInstance()
    return float(np.abs(own - found).max() / max(np.abs(found).max(), 1e-12))


def binary(options: Mapping[str, Any], *, progress: Callable[..., None]) -> tuple[list[str], list[str], str | None]:
    """Return the functions that the library lacks, what it loads from the system, and the glibc that it needs."""
    import fmpy
    from fmpy import platform, platform_tuple

    _quiet()
    alive()
    path = str(options["path"])
    description = fmpy.read_model_description(path, validate=False)
    version = int(str(description.fmiVersion)[0])
    interfaces = {"Co-Simulation": description.coSimulation, "Model Exchange": description.modelExchange}
    with tempfile.TemporaryDirectory(prefix="sysid-binary-") as folder:
        fmpy.extract(path, folder)
        name = next(one.modelIdentifier for one in interfaces.values() if one is not None)
        places = [Path(folder, "binaries", place, f"{name}.so") for place in (platform_tuple, platform)]
        place = next((one for one in places if one.is_file()), None)
        if place is None or version == 1:
            return [], [], None
        code = place.read_bytes()
        before = _mapped()
        library = ctypes.CDLL(str(place))
        loaded = sorted(_mapped() - before - {place.name})
        wanted = _functions(version, [name for name, one in interfaces.items() if one is not None])
        lacks = [name for name in wanted if not hasattr(library, name)]
    needs = [tuple(map(int, found)) for found in re.findall(rb"GLIBC_(\d+)\.(\d+)", code)]
    return lacks, loaded, ".".join(map(str, max(needs))) if needs else None


def _functions(version: int, interfaces: list[str]) -> list[str]:
    """Return the functions that the standard's header has for interfaces."""
    import fmpy

    found, section = [], ""
    for line in Path(fmpy.__file__).with_name("c-code").joinpath(f"fmi{version}Functions.h").read_text().splitlines():
        heading = re.match(r"(Common) Functions|Functions for (?:FMI2 for )?(.*)", line)
        section = (heading[1] or heading[2]) if heading else section
        name = re.match(r" *FMI\d_Export \w+TYPE +(\w+);", line)
        if name and section in ("Common", *interfaces):
            found.append(name[1])
    return found


def _mapped() -> set[str]:
    """Return the names of the libraries in this process."""
    maps = Path("/proc/self/maps")
    lines = maps.read_text(encoding="utf-8").splitlines() if maps.is_file() else []
    return {Path(line.split()[-1]).name for line in lines if ".so" in line}


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
            threads.append(_threads())
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
    return pages * mmap.PAGESIZE / 1024
