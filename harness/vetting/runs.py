"""What an FMU does when it runs: each check in a process of its own, so that none can end another."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from harness import registry
from harness.conformance.excitation import inputs_for
from harness.cosim.convergence import halved
from harness.errors import HarnessError, InputError, PlantError
from harness.signals import FloatArray, Trajectory
from harness.supervision.guarded import guarded
from harness.supervision.processes import APART
from harness.vetting import inside
from harness.vetting.findings import Finding
from harness.vetting.tubes import Tube

SAMPLES, FEWEST = 200, 10
"""Samples of a run: the most, and the fewest of an FMU whose own experiment is shorter or that ends a simulation."""
HALVINGS = 3  # Halvings of the step: two ratios of changes show whether an order is one.
CHANGES = 1e-2  # Share of an output's range that half the step may change (as plants.fmu.probe has it).
LEAK = 32.0  # KiB that an instance may leave behind: the allocator's own unrest is below a third of it.
INSTANCES = 60  # Instances that are made and freed one after the other.
RETURNS = 1e-3  # Relative error of a directional derivative: differences are sure to about 1e-6.


@dataclass(frozen=True)
class FmuSubject:
    """An FMU under test: ``options`` of the plant, ``limit`` [s] for a call, ``slow`` lets it take its time."""

    path: Path
    content: Mapping[str, Any]
    options: Mapping[str, Any]
    limit: float
    samples: int = SAMPLES

    def plant(self, **more: Any) -> Any:
        """Return the FMU in a process of its own; in this one where the system gives it none."""
        options = {**self.options, **more}
        if APART:
            return registry.create("plants", "isolated", plant="fmu", timeout=self.limit, **options)
        return registry.create("plants", "fmu", **options)

    def inside(self, work: Callable[..., Any], *arguments: Any, **more: Any) -> Any:
        """Return the findings of a function of :mod:`harness.vetting.inside`, called in a child."""
        options = {**self.options, **more}
        return guarded(work, options, *arguments, what=self.path.name, silence=self.limit)

    @property
    def abilities(self) -> Mapping[str, Any]:
        """What the interface in use offers."""
        kinds = self.content["kinds"]
        chosen = {"cs": "co-simulation", "me": "model exchange"}.get(str(self.options.get("kind")))
        found: Mapping[str, Any] = kinds[chosen] if chosen in kinds else next(iter(kinds.values()))
        return found


def excited(subject: FmuSubject) -> tuple[list[Finding], Trajectory | None]:
    """Return the findings of the first run, and the run; None if there is nothing more to try."""
    tried = f"{subject.samples} samples under changing inputs"
    try:
        with subject.plant() as plant:
            record = _run(plant, inputs_for(plant.spec, subject.samples))
            said = list(dict.fromkeys(plant.warnings))
    except PlantError as error:
        if error.status != "terminated":
            return [Finding("runs", False, tried, f"{error.status}: {error}")], None
        # an FMU may end a simulation: that is no fault, and what comes before it can be tried
        ends = [Finding("ends", None, tried, str(error))]
        if subject.samples < 2 * FEWEST:
            return ends, None
        found, shorter = excited(replace(subject, samples=subject.samples // 2))
        return (found if found[0].name == "ends" else ends + found), shorter
    found = [Finding("runs", True, tried, f"outputs up to {np.abs(record.y).max(initial=0.0):.3g}, all finite")]
    if not np.ptp(record.y, axis=0).any() and record.spec.ny:
        found.append(Finding("moves", None, tried, "no output changes: checks that compare runs say little"))
    said = [text for text in said if text not in subject.content["problems"]]
    if said:
        found.append(Finding("warnings", None, "what the FMU plant remarks", "; ".join(said)))
    return found, record


def ran(subject: FmuSubject, record: Trajectory) -> list[Finding]:
    """Return the findings of all other runs."""
    subject = replace(subject, samples=len(record))
    found: list[Finding] = []
    for name, check in CHECKS.items():
        try:
            found += check(subject, record)
        except HarnessError as error:
            found.append(Finding(name, False, "a further run", f"{error.status}: {error}"))
    return found


def _run(plant: Any, u: FloatArray) -> Trajectory:
    """Return the record of a run."""
    y = [plant.reset(rng=np.random.default_rng(0))]
    rows = np.vstack([y[0], plant.rollout(u[:-1])])
    return Trajectory(np.arange(len(u)) * plant.spec.sample_time, u, rows, plant.spec)


def _difference(one: FloatArray, other: FloatArray) -> float:
    return float(np.abs(one - other).max(initial=0.0)) if one.shape == other.shape else float("inf")


def _own_experiment(subject: FmuSubject, record: Trajectory) -> list[Finding]:
    """Run the default experiment to its end."""
    tried = "its default experiment, inputs at their start values"
    if not any(value is not None for value in subject.content["experiment"].values()):
        tried = "inputs at their start values (it has no default experiment)"
    more = {key: value for key, value in subject.options.items() if key not in ("path", "sample_time", "start_time")}
    tolerance = more.pop("tolerance", None)
    run = registry.load("tools", "fmu-as-is")(
        subject.path, timeout=subject.limit, tolerance=tolerance, isolated=APART, **more
    )
    if run.ended is not None:
        whole = run.ended.status == "terminated"
        return [Finding("own experiment", None if whole else False, tried, f"{run.ended.status}: {run.ended}")]
    said = [text for text in run.notes if "tolerance" in text]
    came = f"{len(run.trajectory)} samples to t = {run.trajectory.t[-1]:g} s" + "".join(f"; {text}" for text in said)
    passed = True if not said else None if run.moved < CHANGES else False
    return [Finding("own experiment", passed, tried, came, run.moved)]


def _again(subject: FmuSubject, record: Trajectory) -> list[Finding]:
    """Run once more in another process."""
    with subject.plant() as plant:
        off = _difference(_run(plant, record.u).y, record.y)
    came = "bit for bit the same" if off == 0.0 else f"differs by {off:.3g}"
    return [
        Finding("determinism", off == 0.0, f"the same run in a fresh {'process' if APART else 'instance'}", came, off)
    ]


def _probed(subject: FmuSubject, record: Trajectory) -> list[Finding]:
    """Return what the probe of benchmarks finds about reset and states."""
    result = subject.inside(inside.probed, subject.samples)
    tried = {
        "reset": "a second run after reset",
        "restore": "the state taken half way, a run on, the state set back, the run on again",
        "tolerance": "a tolerance 100 times smaller",
    }
    names = {"restore": "get and set state"}
    return [
        Finding(names.get(one["check"], one["check"]), one["passed"], tried[one["check"]], one["note"], one["figure"])
        for one in result
        if one["check"] in tried
    ]


def _parameters(subject: FmuSubject, record: Trajectory) -> list[Finding]:
    """Set every parameter to the value that it has."""
    from harness.calibration.variables import contents_of

    variables = contents_of(subject.path).variables.values()
    own = {one.key: one.start for one in variables if one.parameter and one.settable and one.start is not None}
    tried = f"{len(own)} real parameters set to their own start values"
    if not own:
        return [Finding("parameters", None, "real parameters (but for arrays) with start values", "there are none")]
    try:
        with subject.plant() as plant:
            plant.preset(own)
            off = _difference(_run(plant, record.u).y, record.y)
    except PlantError as error:
        return [Finding("parameters", False, tried, f"{error.status}: {error}")]
    size = max(float(np.ptp(record.y, axis=0).max(initial=0.0)), 1e-300)
    # a description holds decimal numbers, the binary those that it computed: the last digits may differ
    passed = off <= 1e-6 * size
    return [
        Finding("parameters", passed, tried, "the same run" if off == 0.0 else f"the run differs by {off:.3g}", off)
    ]


def _halving(subject: FmuSubject, record: Trajectory) -> list[Finding]:
    """Halve the communication step three times."""
    dt = record.spec.sample_time
    if subject.abilities.get("fixed internal step"):
        came = "the FMU has a fixed internal step, which no host can halve"
        return [Finding("step halving", None, "half the step", came)]
    if "variable step" not in subject.abilities:
        return []  # model exchange: the solver chooses

    def run(h: float | None) -> Trajectory:
        times = round(dt / (h or dt))
        with subject.plant(sample_time=dt / times) as plant:
            return _run(plant, np.repeat(record.u, times, axis=0)[: (len(record) - 1) * times + 1])

    found = halved(run, HALVINGS, dt)
    shares = found.shares.max(axis=1, initial=0.0)
    worst = int(np.argmax(found.shares[0])) if found.shares.size else 0
    orders = found.orders[:, worst] if found.orders.size else np.zeros(0)
    known = orders[np.isfinite(orders)]
    came = f"the first half changes {found.outputs[worst]} by {100 * shares[0]:.2g} % of its range"
    if shares[0] <= 1e-9:
        came = "nothing changes: the FMU steps inside as it likes"
    elif len(known) and not (np.diff(shares) < 0).all():
        came += f", then by {100 * shares[1]:.2g} % and {100 * shares[2]:.2g} %: it is not the step that errs"
    elif len(known):
        came += f", then by {100 * shares[1]:.2g} % and {100 * shares[2]:.2g} %: order {np.median(known):.1f}"
    return [
        Finding(
            "step halving",
            bool(shares[0] < CHANGES),
            f"steps of {dt:g} s, a half, a quarter, an eighth",
            came,
            float(shares[0]),
        )
    ]


def _binary(subject: FmuSubject, record: Trajectory) -> list[Finding]:
    """Look at the library that was loaded."""
    tried = "the functions that the standard demands, and what the library loads from this system"
    lacks, loaded, glibc = subject.inside(inside.binary)
    came = f"lacks {', '.join(lacks)}" if lacks else "complete"
    came += f"; loads {', '.join(loaded)}" if loaded else "; loads nothing more than Python does"
    came += f"; glibc {glibc} or later" if glibc else ""
    return [Finding("binary", not lacks, tried, came, float(len(lacks)))]


def _kinds(subject: FmuSubject, record: Trajectory) -> list[Finding]:
    """Run the other interface under the same inputs."""
    tried = "the same run by co-simulation and by model exchange with a solver of ours"
    if len(subject.content["kinds"]) < 2 or not record.spec.ny:
        return []
    other = "cs" if subject.options.get("kind") == "me" else "me"
    with subject.plant(kind=other) as plant:
        y = _run(plant, record.u).y
    near = Tube(time=record.spec.sample_time)  # a jump may come a sample later
    shares = []
    for k in range(record.spec.ny):
        low, high = near.limits(record.t, record.y[:, k], record.t)
        outside = float(np.maximum(y[:, k] - high, low - y[:, k]).max(initial=0.0))
        shares.append(outside / max(float(np.ptp(record.y[:, k])), 1e-9 * float(np.abs(record.y[:, k]).max()), 1e-300))
    worst = int(np.argmax(shares))
    came = f"they differ in {record.spec.outputs[worst].name} by {100 * shares[worst]:.2g} % of its range"
    came = came if shares[worst] > 1e-9 else "the same"
    passed = True if shares[worst] < CHANGES else None if subject.content["event_indicators"] else False
    came += "" if passed is not None else ": instants of events, which the two find otherwise, add up"
    return [Finding("both interfaces", passed, tried, came, shares[worst])]


def _beside(subject: FmuSubject, record: Trajectory) -> list[Finding]:
    """Run two instances in one process."""
    tried = "two instances of one loaded library, stepped in turn under different inputs"
    if "variable step" not in subject.abilities or str(subject.content["fmi"]).startswith("1"):
        return [Finding("two at once", None, tried, "tried for co-simulation of FMI 2.0 and 3.0 only")]
    if subject.abilities.get("once per process"):
        return [Finding("two at once", None, tried, "the FMU declares that there may be only one")]
    off = subject.inside(inside.apart, subject.samples // 2)
    came = "each as if it were alone" if off == 0.0 else f"the second changes the first by {off:.3g}"
    return [Finding("two at once", off == 0.0, tried, came, off)]


def _direct(subject: FmuSubject, record: Trajectory) -> list[Finding]:
    """Change the inputs while no time passes."""
    if not record.spec.nu:
        return []
    declared, told, moved = subject.inside(inside.direct)
    tried = "the inputs changed while no time passes"
    if moved and not told:  # FMI 3.0.2 sec. 2.4.9: without dependencies an output may depend on everything
        came = f"{', '.join(moved)} change at once; the outputs do not tell what they depend on"
        return [Finding("dependencies", None, tried, came)]
    if moved and not declared:
        return [Finding("dependencies", False, tried, f"{', '.join(moved)} change at once, which is not declared")]
    came = f"{', '.join(moved)} change at once, as declared" if moved else "no output changes"
    return [Finding("dependencies", True if moved or not declared else None, tried, came)]


def _slopes(subject: FmuSubject, record: Trajectory) -> list[Finding]:
    """Compare directional derivatives with differences."""
    tried = "d outputs / d inputs against differences"
    reals = [any(channel.kind == "real" for channel in group) for group in (record.spec.inputs, record.spec.outputs)]
    found = []
    if not subject.abilities.get("directional derivatives"):
        found.append(Finding("derivatives", None, tried, "the FMU offers none"))
    elif not all(reals):
        found.append(Finding("derivatives", None, tried, "no real inputs and outputs to compare"))
    else:
        off, follows = subject.inside(inside.slopes)
        silent = "outputs do not follow the inputs before a step: nothing to compare"
        came = f"off by {off:.2g} of the largest" if follows else silent
        found.append(Finding("derivatives", off < RETURNS if follows else None, tried, came, off if follows else None))
    exchange = subject.content["kinds"].get("model exchange") or {}
    if exchange.get("directional derivatives") and not str(subject.content["fmi"]).startswith("1"):
        tried = "d derivatives / d states against differences (model exchange)"
        off = subject.inside(inside.state_slopes)
        came = "no real states to compare" if off is None else f"off by {off:.2g} of the largest"
        found.append(Finding("state derivatives", None if off is None else off < RETURNS, tried, came, off))
    return found


def _serialised(subject: FmuSubject, record: Trajectory) -> list[Finding]:
    """Write the state as bytes and read it."""
    tried = "the state written as bytes half way, read back, the run on"
    if not (subject.abilities.get("serialise state") and subject.abilities.get("get and set state")):
        return [Finding("serialised state", None, tried, "the FMU offers none")]
    try:
        size, off = subject.inside(inside.serialised, subject.samples)
    except InputError as error:
        return [Finding("serialised state", False, tried, error.got)]
    came = f"{size} bytes, " + ("the same run" if off == 0.0 else f"the run differs by {off:.3g}")
    return [Finding("serialised state", off == 0.0, tried, came, off)]


def _events(subject: FmuSubject, record: Trajectory) -> list[Finding]:
    """Handle events outside, where the FMU lets us."""
    count = subject.content["event_indicators"] or 0
    if not subject.abilities.get("event mode"):
        return [Finding("events", None, "what the description says", f"{count} event indicators, no event mode")]
    with subject.plant(event_mode=True) as plant:
        off = _difference(_run(plant, record.u).y, record.y)
    size = max(float(np.ptp(record.y, axis=0).max(initial=0.0)), 1e-300)
    came = "the same run" if off == 0.0 else f"the run differs by {off:.3g}"
    return [Finding("events", off <= 1e-3 * size, "events handled outside (event mode) and inside", came, off)]


def _speed(subject: FmuSubject, record: Trajectory) -> list[Finding]:
    """Take the time."""
    found = subject.inside(inside.speed, subject.samples)
    times = found["sample_time"] / max(found["sample"], 1e-9)
    came = (
        f"{1e3 * found['make']:.0f} ms to load and instantiate, {1e3 * found['initialise']:.1f} ms to initialise, "
        f"{1e6 * found['sample']:.1f} us a sample: {times:.3g} times real time; "
        f"{found['threads']:.0f} threads of its own"
    )
    said, tried = found["said"], "what it prints, and writes into the working folder, by itself"
    told = [f"{said:.0f} bytes printed over {subject.samples} samples: a host cannot turn that off"] if said else []
    told += [f"files: {', '.join(found['written'])}"] if found["written"] else []
    return [
        Finding("timing", None, f"{subject.samples} samples in one call", came, found["sample"]),
        Finding("output", None if told else True, tried, "; ".join(told) or "nothing", said),
    ]


def _leaks(subject: FmuSubject, record: Trajectory) -> list[Finding]:
    """Make and free many instances."""
    tried = f"{INSTANCES} instances made, run and freed one after the other"
    if subject.abilities.get("once per process"):
        return [Finding("leaks", None, tried, "the FMU declares that there may be only one")]
    found = subject.inside(inside.instances, INSTANCES)
    left = [f"{found['memory']:.1f} KiB"] if found["memory"] > LEAK else []
    left += [f"{found[what]:.2g} {what}" for what in ("files", "threads") if found[what] > 0.1]
    came = (
        f"each leaves {' and '.join(left)}" if left else f"nothing is left ({max(found['memory'], 0.0):.1f} KiB each)"
    )
    if not found["known"]:
        return [Finding("leaks", None, tried, "the system does not tell the memory of a process")]
    return [Finding("leaks", not left, tried, came, found["memory"])]


CHECKS: Mapping[str, Callable[[FmuSubject, Trajectory], list[Finding]]] = {
    "own experiment": _own_experiment,
    "binary": _binary,
    "determinism": _again,
    "reset": _probed,
    "parameters": _parameters,
    "step halving": _halving,
    "both interfaces": _kinds,
    "two at once": _beside,
    "dependencies": _direct,
    "derivatives": _slopes,
    "serialised state": _serialised,
    "events": _events,
    "timing": _speed,
    "leaks": _leaks,
}
"""What is tried after the first run, in this order."""
