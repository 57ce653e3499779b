"""Everything about an FMU in one go: read it, run it, and stop where there is nothing more to learn."""

from __future__ import annotations

import logging
import platform
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from datetime import date
from pathlib import Path
from typing import Any

from harness.errors import HarnessError, InputError
from harness.parts.files import describe_fmu
from harness.vetting.described import NUMBERS, described
from harness.vetting.findings import Finding, Vetting
from harness.vetting.runs import FEWEST, SAMPLES, FmuSubject, excited, ran

STEPS = 500  # Samples of a default experiment that suggests no step.
STEP = 0.01  # Sample time [s] where nothing is suggested at all.
SHOWN = 50  # States, or local variables, that are looked at where an FMU declares no outputs.


def vet(
    path: str | Path,
    *,
    options: Mapping[str, Any] | None = None,
    limit: float = 10.0,
    progress: Callable[[float, str], None] | None = None,
) -> Vetting:
    """Say what there is to know about an FMU before it is handed on.

    Parameters
    ----------
    path : path
        The FMU.
    options : mapping, optional
        Of the plant: ``sample_time``, ``parameters``, ``kind``, ...
    limit : float
        Longest time [s] for one call of the FMU. One that crashes or hangs costs one line and ends the checks.
    progress : callable, optional
        Called as ``progress(share, what)``.

    Raises
    ------
    InputError
        If there is no such file, or an option does not fit.

    Examples
    --------
    >>> from plants.mockups import mockup
    >>> found = vet(mockup("mass_spring"), options={"parameters": {"m": -1.0}})  # what the FMU refuses
    >>> found.passed, [one.name for one in found.findings if one.passed is False]
    (False, ['runs'])
    """
    path = Path(path)
    tell = progress or (lambda share, what: None)
    if not path.is_file():
        raise InputError("no such FMU", expected="an FMU file", got="no file", remedy="check the path", file=path)
    if not limit > 0:
        raise InputError("limit", expected="a positive number of seconds", got=str(limit), remedy="correct it")
    try:
        content = describe_fmu(path)
    except HarnessError as error:
        name = "interface" if "nothing to run" in str(error) else "model description"
        return Vetting(path, path.name, (Finding(name, False, "the file read as an FMU", str(error)),))
    title = f"{path.name}: {content['model']}, FMI {content['fmi']}, {content['tool'] or 'tool not told'}"
    found = described(path, content)
    tell(0.1, "runs")
    with _unheard():
        return _run(path, title, content, found, options or {}, limit, tell)


@contextmanager
def _unheard() -> Iterator[None]:
    """Keep what plants log out of the terminal: the findings say it."""
    logger = logging.getLogger("plants")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)


def _run(
    path: Path,
    title: str,
    content: Mapping[str, Any],
    found: list[Finding],
    options: Mapping[str, Any],
    limit: float,
    tell: Callable[[float, str], None],
) -> Vetting:
    """Run what can be run, and return all findings."""
    asked = bool(options)
    options = {"path": str(path), **_chosen(content), **options}
    subject = FmuSubject(path, content, options, limit, samples_of(content, float(options["sample_time"])))
    found.append(_setting(subject))
    try:
        first, record = excited(subject)
    except InputError as error:
        if asked:
            raise
        first, record = [Finding("runs", False, "the FMU loaded and run", str(error))], None
    found += first
    if record is not None:
        tell(0.3, "runs again")
        found += ran(subject, record)
    return Vetting(path, title, tuple(found), record)


def _setting(subject: FmuSubject) -> Finding:
    """Say how, by what and where the FMU is run: a page is read long after it was made."""
    from harness import __version__

    kinds = {"cs": "co-simulation", "me": "model exchange"}
    kind = kinds.get(str(subject.options.get("kind")), next(iter(subject.content["kinds"])))
    step, start = float(subject.options["sample_time"]), float(subject.options["start_time"])
    given = {key: value for key, value in subject.options.items() if key in ("parameters", "start", "tolerance")}
    came = f"{kind}, {step:g} s a sample from {start:g} s" + "".join(f", {k} {v}" for k, v in given.items() if v)
    came += f"; sysid-harness {__version__} on {platform.system()} {platform.machine()}, {date.today().isoformat()}"
    return Finding("setting", None, "how it is run, by what and where", came, step)


def samples_of(content: Mapping[str, Any], step: float) -> int:
    """Return the samples of a run: none beyond the end of the FMU's own experiment."""
    start, stop = content["experiment"]["startTime"] or 0.0, content["experiment"]["stopTime"]
    own = SAMPLES if stop is None or not start < stop < SAMPLES * step + start else int((stop - start) / step + 1e-9)
    return max(FEWEST, own)


def _chosen(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options that suit an FMU: its own step, its outputs or, without any, its states."""
    experiment = content["experiment"]
    start, stop, step = experiment["startTime"] or 0.0, experiment["stopTime"], experiment["stepSize"]
    if step is None or not 0 < step < float("inf"):
        ends = stop is not None and start < stop < float("inf")
        step = float(f"{(stop - start) / STEPS:.6g}") if ends else STEP
        inner = next((kind.get("fixed internal step") for kind in content["kinds"].values()), None)
        step = inner * max(1, round(step / inner)) if inner else step
    chosen: dict[str, Any] = {"sample_time": step, "start_time": start}
    if not any(row["causality"] == "output" for row in content["variables"]):
        rows = [row for row in content["variables"] if row["type"] in NUMBERS and row["variability"] == "continuous"]
        states = {row["derivative_of"] for row in rows}
        moving = [row["name"] for row in rows if row["name"] in states]  # what tools add for themselves is no result
        moving = moving or [row["name"] for row in rows if row["causality"] == "local"]
        chosen["outputs"] = moving[:SHOWN]
    return chosen
