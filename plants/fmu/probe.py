"""Probe an FMU before it is trusted: repeatable, insensitive to step or tolerance, restorable, finite, units known.

Accuracy in co-simulation is the exporter's: an FMU with forward Euler inside returns nonsense with status OK.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from harness.errors import HarnessError, InputError
from harness.rng import stream
from harness.signals import FloatArray, PlantSpec
from plants.fmu.archive import Kind
from plants.fmu.plant import FmuPlant
from plants.isolation.isolated import IsolatedPlant

STEP_TOLERANCE = 1e-2  # of an output's spread: more means that the step or tolerance decides the result
Check = Literal["units", "description", "runs", "finite", "reset", "restore", "step", "tolerance"]
FINER: dict[Kind, tuple[Check, str]] = {
    "cs": ("step", "half the communication step"),
    "me": ("tolerance", "a tolerance 100 times smaller"),
}


@dataclass(frozen=True)
class ProbeFinding:
    """One check: its verdict, the figure behind it, and what it means.

    ``passed`` is None where the FMU does not offer what is checked.
    """

    check: Check
    passed: bool | None
    figure: float | None
    note: str


@dataclass(frozen=True)
class ProbeResult:
    """What a probe found; ``to_dict`` is kept with the scores of the FMU."""

    file: str
    sample_time: float
    findings: tuple[ProbeFinding, ...]

    @property
    def passed(self) -> bool:
        """True if no check failed."""
        return all(finding.passed is not False for finding in self.findings)

    def to_dict(self) -> dict[str, Any]:
        """Return the result for JSON."""
        return {
            "file": self.file,
            "sample_time": self.sample_time,
            "passed": self.passed,
            "findings": [asdict(finding) for finding in self.findings],
        }

    def __str__(self) -> str:
        words = {True: "ok", False: "FAILED", None: "-"}
        lines = [f"{self.file}, sample time {self.sample_time:g} s"]
        lines += [f"  {f.check:12s} {words[f.passed]:7s} {f.note}" for f in self.findings]
        return "\n".join(lines)


def probe(
    path: str | Path,
    *,
    sample_time: float | None = None,
    samples: int = 200,
    amplitude: float = 1.0,
    isolate: bool = True,
    timeout: float = 30.0,
    **options: Any,
) -> ProbeResult:
    """Run an FMU a few times and tell whether it can be trusted.

    Parameters
    ----------
    path : path
        The ``.fmu`` file.
    sample_time : float, optional
        Seconds; default: the step of the FMU's default experiment.
    samples : int
        Length of each run.
    amplitude : float
        Of the inputs, in SI, for those that start at 0; the others move by a fifth of their start value. All are cut
        to their declared range.
    isolate : bool
        Run it in a child process, where it can do no harm.
    timeout : float
        Longest time [s] for one call, if isolated.
    **options
        More options of :class:`plants.fmu.plant.FmuPlant`.

    Returns
    -------
    ProbeResult
        A crash or NaN is a finding, not an exception.

    Raises
    ------
    InputError
        If the file is no FMU or an option does not fit it.

    Examples
    --------
    >>> from plants.mockups import mockup
    >>> result = probe(mockup("mass_spring"), samples=50, isolate=False)
    >>> result.passed, [finding.check for finding in result.findings]
    (True, ['units', 'description', 'runs', 'finite', 'reset', 'restore', 'step'])
    """
    wanted = {"path": str(path), "sample_time": sample_time, **options}

    def made(**more: Any) -> FmuPlant | IsolatedPlant:
        if isolate:
            return IsolatedPlant("plants.fmu.plant:FmuPlant", {**wanted, **more}, timeout=timeout)
        return FmuPlant(**{**wanted, **more})

    with FmuPlant(**wanted) as described:  # loads, but does not run
        inputs = _excitation(described.spec, described.input_starts, samples, amplitude)
        odd_units, others = described.unit_complaints, described.warnings
        dt, kind, tolerance = described.spec.sample_time, described.kind, described.tolerance
        finer = {"step": dt / described.substeps / 2} if kind == "cs" else {"tolerance": 0.01 * tolerance}
    others = tuple(text for text in others if text not in odd_units)
    findings = [
        ProbeFinding("units", not odd_units, None, "; ".join(odd_units) or "known"),
        ProbeFinding("description", None if others else True, None, "; ".join(others) or "sound"),
    ]
    with made() as plant:
        first = _tried(lambda: _run(plant, inputs), findings)
        if first is not None:
            findings += _repeat(plant, inputs, first)
    if first is not None:
        findings.append(_refined(lambda: made(**finer), inputs, first, *FINER[kind]))
    return ProbeResult(str(path), dt, tuple(findings))


def _excitation(spec: PlantSpec, starts: FloatArray, samples: int, amplitude: float) -> FloatArray:
    """Return steps of random size around the start values, inside the declared ranges."""
    rng = stream("plants.fmu.probe", samples)
    levels = rng.uniform(-1, 1, size=(samples // 20 + 1, spec.nu))
    size = np.where(starts == 0.0, amplitude, 0.2 * np.abs(starts))
    rows: FloatArray = np.repeat(starts + size * levels, 20, axis=0)[:samples]
    for column, channel in enumerate(spec.inputs):
        rows[:, column] = np.clip(rows[:, column], channel.minimum, channel.maximum)
        if channel.kind != "real":
            rows[:, column] = np.rint(rows[:, column])
    return rows


def _run(plant: FmuPlant | IsolatedPlant, inputs: FloatArray) -> FloatArray:
    """Return outputs from reset on, one row more than inputs."""
    first = plant.reset(rng=stream("plants.fmu.probe"))
    return np.vstack([first, plant.rollout(inputs)])


def _tried(job: Callable[[], FloatArray], findings: list[ProbeFinding]) -> FloatArray | None:
    """Return the first run; record how it went."""
    try:
        outputs = job()
    except HarnessError as error:
        finite = error.status != "diverged"
        findings.append(ProbeFinding("runs" if finite else "finite", False, None, f"{error.status}: {error}"))
        return None
    findings.append(ProbeFinding("runs", True, None, f"{len(outputs)} samples"))
    findings.append(
        ProbeFinding("finite", True, float(np.abs(outputs).max()), f"outputs up to {np.abs(outputs).max():.3g}")
    )
    return outputs


def _repeat(plant: FmuPlant | IsolatedPlant, inputs: FloatArray, first: FloatArray) -> list[ProbeFinding]:
    """Compare a second run after reset, and a continuation after a restored state."""
    try:
        again = float(np.abs(_run(plant, inputs) - first).max())
        said = [text for text in plant.warnings if text.startswith("reset does not")]
        note = said[0] if said else f"second run differs by {again:.3g}"
        found = [ProbeFinding("reset", again == 0.0 and not said, again, note)]
    except HarnessError as error:
        return [ProbeFinding("reset", False, None, f"{error.status}: {error}")]
    if "snapshots" not in plant.abilities:
        return [*found, ProbeFinding("restore", None, None, "the FMU offers no get and set of its state")]
    try:
        plant.reset(rng=stream("plants.fmu.probe"))
        half = len(inputs) // 2
        plant.rollout(inputs[:half])
        state: Any = plant.get_state()  # a solver starts anew here, so the run before it is not what counts
        went_on = plant.rollout(inputs[half:])
        plant.set_state(state)
        again_on = plant.rollout(inputs[half:])
        miss = float(np.abs(again_on - went_on).max())
        return [*found, ProbeFinding("restore", miss == 0.0, miss, f"continuation differs by {miss:.3g}")]
    except HarnessError as error:
        note = error.got if isinstance(error, InputError) else f"{error.status}: {error}"  # not the plant's advice
        return [*found, ProbeFinding("restore", False, None, note)]


def _refined(
    make: Callable[[], FmuPlant | IsolatedPlant], inputs: FloatArray, first: FloatArray, check: Check, what: str
) -> ProbeFinding:
    """Compare with a run at a finer step or tolerance."""
    try:
        with make() as plant:
            finer = _run(plant, inputs)
    except HarnessError as error:
        return ProbeFinding(check, None, None, f"cannot run with {what}: {error.status}: {error}")
    spread = np.std(first, axis=0)
    scale = np.where(spread > 0, spread, np.maximum(np.abs(first).max(axis=0), 1e-12))
    change = float((np.sqrt(np.mean((finer - first) ** 2, axis=0)) / scale).max())
    return ProbeFinding(check, change < STEP_TOLERANCE, change, f"{what} changes the outputs by {100 * change:.3g} %")
