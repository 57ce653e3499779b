"""What the description of an FMU says, held against the standard and against itself; nothing runs."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from harness.vetting.findings import Finding

LISTED = 5  # Names that a line lists.
NUMBERS = ("Real", "Float64", "Float32")
NEEDS = {
    "once per process": ("any number of instances in a process", "one instance in a process"),
    "needs its tool": ("runs by itself", "needs its tool"),
}
"""What is no ability, and how it is said where it does not hold and where it does."""
PORTS = ("input", "output", "parameter")
_LINE = re.compile(r"^ERROR \(line (\d+), column \d+\): ")


def described(path: Path, content: Mapping[str, Any]) -> list[Finding]:
    """Return the findings about a description.

    - ``path``: the FMU
    - ``content``: as :func:`harness.parts.files.describe_fmu` returns it
    """
    return [
        _archive(path, content),
        _standard(content),
        *_abilities(content),
        _experiment(content),
        _units(content),
        _starts(content),
        _texts(path, content),
    ]


def _listed(names: Sequence[str]) -> str:
    """Return the first names."""
    return ", ".join(names[:LISTED]) + (f" and {len(names) - LISTED} more" if len(names) > LISTED else "")


def _gathered(texts: Sequence[str]) -> list[str]:
    """Return complaints that differ by their line only as one, with the lines."""
    kinds: dict[str, list[str]] = {}
    for text in texts:
        match = _LINE.match(text)
        kinds.setdefault(text[match.end() :] if match else text, []).extend(match.groups() if match else ())
    return [
        text + (f" (line{'s' if len(lines) > 1 else ''} {_listed(lines)})" if lines else "")
        for text, lines in kinds.items()
    ]


def _archive(path: Path, content: Mapping[str, Any]) -> Finding:
    """Say what is in the file."""
    with zipfile.ZipFile(path) as archive:
        damaged = archive.testzip()
        count = len(archive.infolist())
    came = (
        f"{path.stat().st_size / 1024:.0f} KiB, {count} entries, for {', '.join(content['platforms']) or 'no system'}"
    )
    if damaged is not None:
        return Finding("archive", False, "every entry read and its checksum compared", f"{damaged!r} is damaged")
    return Finding("archive", bool(content["platforms"]), "every entry read and its checksum compared", came)


def _standard(content: Mapping[str, Any]) -> Finding:
    """Say where the description breaks the standard."""
    units = {text for text in content["problems"] if _is_unit(text, content)}
    found = [text for text in content["problems"] if text not in units]
    tried = f"modelDescription.xml held against FMI {content['fmi']}"
    return Finding(
        "model description", not found, tried, "; ".join(_gathered(found)[:LISTED]) or "sound", float(len(found))
    )


def _is_unit(text: str, content: Mapping[str, Any]) -> bool:
    """Return True for a complaint about the unit of a variable."""
    return any(text.startswith(f"{row['name']}: ") for row in content["variables"])


def _abilities(content: Mapping[str, Any]) -> list[Finding]:
    """Say what the FMU offers."""
    found = []
    for kind, abilities in content["kinds"].items():
        offers = {name: has for name, has in abilities.items() if isinstance(has, bool) and name not in NEEDS}
        can = [name for name, has in offers.items() if has]
        lacks = [name for name, has in offers.items() if not has]
        step = abilities.get("fixed internal step")
        needs = [words[abilities[name]] for name, words in NEEDS.items()] + ([f"steps of {step:g} s"] if step else [])
        came = f"{', '.join(can) or 'nothing optional'}; not: {', '.join(lacks) or 'nothing'}; {', '.join(needs)}"
        found.append(Finding(kind, None, "the attributes of the interface", came))
    return found


def _experiment(content: Mapping[str, Any]) -> Finding:
    """Say whether there is a default experiment that can be run."""
    given = {name: value for name, value in content["experiment"].items() if value is not None}
    start, stop = given.get("startTime", 0.0), given.get("stopTime")
    sound = stop is None or stop > start
    step = given.get("stepSize")
    sound = sound and (step is None or (0 < step < np.inf and (stop is None or step <= stop - start)))
    came = ", ".join(f"{name} {value:g}" for name, value in given.items()) or "none"
    wanting = [name for name in ("stopTime", "stepSize") if name not in given]
    came += f"; without {' and '.join(wanting)}" if wanting and given else ""
    return Finding("default experiment", sound if given else None, "whether a run of its own is described", came)


def _units(content: Mapping[str, Any]) -> Finding:
    """Say which units cannot be read, and how many numbers have none."""
    rows = [row for row in content["variables"] if row["type"] in NUMBERS and row["causality"] in PORTS]
    bare = [row["name"] for row in rows if not row["unit"]]
    wrong = [text for text in content["problems"] if _is_unit(text, content)]
    came = "; ".join(wrong[:LISTED]) if wrong else f"{len(rows) - len(bare)} of {len(rows)} with a unit that is known"
    came += f"; without: {_listed(bare)}" if bare and not wrong else ""
    passed = False if wrong else (None if bare else True)
    return Finding(
        "units", passed, "units of real inputs, outputs and parameters brought to SI", came, float(len(bare))
    )


def _starts(content: Mapping[str, Any]) -> Finding:
    """Say which start values lie outside their own limits."""
    outside, count = [], 0
    for row in content["variables"]:
        if row["type"] not in NUMBERS or row["start"] is None:
            continue
        try:
            given = np.array(str(row["start"]).split() if row["shape"] else [row["start"]], dtype=float)
        except ValueError:
            outside.append(f"{row['name']} starts at {row['start']!r}")
            continue
        count += 1
        values = given * (row["scale"] or 1.0) + (row["offset"] or 0.0)
        low, high = (
            np.inf * sign if row[side] is None else row[side] for side, sign in (("minimum", -1), ("maximum", 1))
        )
        slack = 1e-9 * np.maximum(np.abs(values), 1e-300)
        wrong = ~(np.isfinite(values) & (low - slack <= values) & (values <= high + slack))
        if wrong.any():
            outside.append(f"{row['name']} = {values[wrong][0]:g} outside [{low:g}, {high:g}]")
    came = "; ".join(outside[:LISTED]) if outside else f"{count} inside"
    return Finding(
        "start values", not outside, "real start values held against their min and max", came, float(len(outside))
    )


def _texts(path: Path, content: Mapping[str, Any]) -> Finding:
    """Say what a reader is told."""
    rows = [row for row in content["variables"] if row["causality"] in PORTS]
    silent = [row["name"] for row in rows if not row["description"]]
    with zipfile.ZipFile(path) as archive:
        names = [name.lower() for name in archive.namelist()]
    has = [
        what
        for what in ("documentation/", "documentation/licenses/", "sources/")
        if any(n.startswith(what) for n in names)
    ]
    came = f"{len(rows) - len(silent)} of {len(rows)} inputs, outputs and parameters are described"
    brought = ", ".join(one.rstrip("/") for one in has) or "no documentation"
    came += f"; tool: {content['tool'] or 'not told'}; with {brought}"
    return Finding("texts", None, "what a reader is told", came, float(len(silent)))
