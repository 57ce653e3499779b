"""Frequency responses in CSV files: frequency, then real and imaginary part, or magnitude and phase, of each pair."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from harness.errors import InputError, refuse_unknown, unread
from harness.frequency.data import FrequencyResponse
from harness.signals import Channel, FloatArray

_NAMES = {
    "real": ("real", "re"),
    "imaginary": ("imaginary", "imag", "im"),
    "magnitude": ("magnitude", "mag", "gain", "amplitude", "abs"),
    "phase": ("phase", "angle", "arg"),
    "variance": ("variance", "var"),
    "deviation": ("deviation", "std", "sigma"),
    "coherence": ("coherence", "coh"),
}
_FREQUENCY = {"frequency": "hz", "freq": "hz", "f": "hz", "omega": "rad/s", "w": "rad/s", "angular frequency": "rad/s"}
_TO_HZ = {"hz": 1.0, "khz": 1e3, "mhz": 1e6, "ghz": 1e9, "rad/s": 0.5 / np.pi, "1/s": 1.0, "rpm": 1 / 60}
_TITLE = re.compile(r"^\s*(?P<name>[^\[\(]*?)\s*(?:[\[\(](?P<unit>[^\]\)]*)[\]\)])?\s*$")
_REMEDY = (
    "title the columns 'frequency [Hz]' and 'real', 'imag' or 'magnitude [dB]', 'phase [deg]', and 'variance' or "
    "'deviation' if you know it; of several pairs 'y/u real', ..."
)


def is_response(path: str | Path) -> bool:
    """Return True for a CSV file whose first column is a frequency and which has no column of time."""
    path = Path(path)
    if path.suffix.lower() not in (".csv", ".txt", ".tsv", ".dat") or not path.is_file():
        return False
    try:
        with path.open(encoding="utf-8-sig") as stream:
            first = stream.readline()
    except (OSError, UnicodeDecodeError):
        return False
    titles = [_split(title) for title in next(csv.reader([first], delimiter=_delimiter(first)), [])]
    return bool(titles) and titles[0][0].lower() in _FREQUENCY and len(titles) > 1


def read_response(
    path: str | Path, *, units: Mapping[str, str] | None = None, low: float = 0.0, high: float = np.inf
) -> FrequencyResponse:
    """Return the frequency response that a CSV file holds.

    The first row has titles: ``frequency [Hz]`` (or ``omega [rad/s]``), then ``real`` and ``imag``, or ``magnitude``
    (or ``magnitude [dB]``) and ``phase [deg]`` (or ``[rad]``), and if known ``variance`` (of the complex number, both
    parts together) or ``deviation`` (its square root). Of several pairs the titles begin with ``output/input``.

    Parameters
    ----------
    path : path
    units : mapping, optional
        Units of inputs and outputs by name.
    low, high : float
        [Hz]; the rest is left out.

    Raises
    ------
    InputError
        If a column is missing or unknown, or a number is none; names file and row.
    """
    path = Path(path)
    titles, rows = _table(path)
    parsed = [_split(title) for title in titles]
    key = parsed[0][0].lower()
    if key not in _FREQUENCY:
        raise InputError("first column", expected="frequency", got=repr(titles[0]), remedy=_REMEDY, file=path)
    unit = (parsed[0][1] or _FREQUENCY[key]).lower()
    refuse_unknown("unit of the frequency", unit, _TO_HZ, remedy="correct it", file=path)
    pairs: dict[tuple[str, str], dict[str, FloatArray]] = {}
    for column, (name, own) in enumerate(parsed[1:], 1):
        pair, part = _part(name, path)
        if part != "coherence":
            pairs.setdefault(pair, {})[part] = _converted(rows[:, column], part, own, titles[column], path)
    inputs, outputs, response, variance = _filled(pairs, len(rows), path)
    known = not np.isnan(variance).any()
    of = units or {}
    try:
        found = FrequencyResponse(
            rows[:, 0] * _TO_HZ[unit],
            response,
            variance if known else None,
            tuple(Channel(name, of.get(name, "1")) for name in inputs),
            tuple(Channel(name, of.get(name, "1")) for name in outputs),
        )
        return found.between(low, high) if low > 0 or np.isfinite(high) else found
    except InputError as error:
        raise error.located(file=path) from error


def _filled(
    pairs: Mapping[tuple[str, str], Mapping[str, FloatArray]], count: int, path: Path
) -> tuple[list[str], list[str], npt.NDArray[np.complex128], FloatArray]:
    """Return names of inputs and outputs, and responses and variances (F, ny, nu) of all pairs; NaN where unknown."""
    inputs, outputs = (list(dict.fromkeys(pair[side] for pair in pairs)) for side in (1, 0))
    missing = [f"{o}/{i}" for o in outputs for i in inputs if (o, i) not in pairs]
    if missing or not pairs:
        raise InputError(
            "pairs of a frequency response",
            expected="every output with every input",
            got=f"no {', '.join(missing) or 'response'}",
            remedy=_REMEDY,
            file=path,
        )
    response = np.empty((count, len(outputs), len(inputs)), dtype=np.complex128)
    variance = np.full(response.shape, np.nan)
    for (output, given), parts in pairs.items():
        place = (slice(None), outputs.index(output), inputs.index(given))
        response[place] = _complex(parts, f"{output}/{given}", path)
        if "variance" in parts:
            variance[place] = parts["variance"]
        elif "deviation" in parts:
            variance[place] = parts["deviation"] ** 2
    return inputs, outputs, response, variance


def write_response(found: FrequencyResponse, path: str | Path) -> Path:
    """Write a frequency response as :func:`read_response` reads it; returns the path."""
    path = Path(path)
    titles, columns = ["frequency [Hz]"], [found.frequency]
    for row, output in enumerate(found.outputs):
        for column, given in enumerate(found.inputs):
            one = found.response[:, row, column]
            titles += [f"{output.name}/{given.name} {part}" for part in ("real", "imag")]
            columns += [one.real, one.imag]
            if found.variance is not None:
                titles.append(f"{output.name}/{given.name} variance")
                columns.append(found.variance[:, row, column])
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(titles)
        writer.writerows([repr(float(value)) for value in line] for line in zip(*columns, strict=True))
    return path


def _table(path: Path) -> tuple[list[str], FloatArray]:
    """Return titles and numbers of a CSV file."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            "frequency response", expected="a CSV file", got=unread(path, error), remedy="give a file", file=path
        ) from error
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if len(lines) < 2:
        raise InputError("frequency response", expected="titles and rows", got="an empty table", remedy=_REMEDY,
                         file=path)  # fmt: skip
    table = list(csv.reader(lines, delimiter=_delimiter(lines[0])))
    titles = [title.strip() for title in table[0]]
    numbers = np.empty((len(table) - 1, len(titles)))
    for row, cells in enumerate(table[1:]):
        try:
            numbers[row] = [float(cell) for cell in cells]
        except ValueError as error:
            raise InputError(
                f"row {row + 2} of a frequency response",
                expected=f"{len(titles)} numbers",
                got=f"{len(cells)} cells: {', '.join(cells)[:80]}",
                remedy="correct the row",
                file=path,
            ) from error
    return titles, numbers


def _delimiter(line: str) -> str:
    """Return what separates the cells of a line."""
    return max(",;\t", key=line.count)


def _split(title: str) -> tuple[str, str]:
    """Return name and unit of a title."""
    found = _TITLE.match(title)
    return (found["name"].strip(), (found["unit"] or "").strip()) if found else (title.strip(), "")


def _part(name: str, path: Path) -> tuple[tuple[str, str], str]:
    """Return (output, input) and what a column holds of them."""
    words = name.rsplit(maxsplit=1)
    pair, last = (words[0], words[1]) if len(words) == 2 else ("y/u", name)
    for part, names in _NAMES.items():
        if last.lower() in names:
            output, _, given = pair.partition("/")
            return (output.strip() or "y", given.strip() or "u"), part
    known = ", ".join(names[0] for names in _NAMES.values())
    raise InputError("column", expected=f"one of {known}", got=repr(name), remedy=_REMEDY, file=path)


def _converted(values: FloatArray, part: str, unit: str, title: str, path: Path) -> FloatArray:
    """Return a column in linear gain or radians."""
    small = unit.lower()
    if part == "magnitude" and small == "db":
        return np.asarray(10.0 ** (values / 20.0), dtype=np.float64)
    if part == "phase":
        if small in ("deg", "degree", "degrees", "°"):
            return np.asarray(np.radians(values), dtype=np.float64)
        if small != "rad":
            raise InputError("unit of the phase", expected="[deg] or [rad]", got=repr(title),
                             remedy="write the unit in the title", file=path)  # fmt: skip
    return values


def _complex(parts: Mapping[str, FloatArray], pair: str, path: Path) -> npt.NDArray[np.complex128]:
    """Return the complex response of its two columns."""
    if {"real", "imaginary"} <= set(parts):
        return np.asarray(parts["real"] + 1j * parts["imaginary"])
    if {"magnitude", "phase"} <= set(parts):
        return np.asarray(parts["magnitude"] * np.exp(1j * parts["phase"]))
    raise InputError(
        f"response {pair}",
        expected="real and imag, or magnitude and phase",
        got=", ".join(parts) or "none",
        remedy=_REMEDY,
        file=path,
    )
