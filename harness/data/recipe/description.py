"""dataset.toml, read into frozen records; every mistake is named with its place."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec

from harness.data.sections import (
    Description,
    FilterSection,
    NominalParameter,
    NominalSection,
    ResampleSection,
    RunSection,
    SignalSection,
    SourceSection,
    TimeSection,
)
from harness.errors import InputError, refuse_unknown

OPEN = "?"
"""What a draft writes where something has to be decided: no value of any key, so that nothing is taken before it is."""


def read_description(path: str | Path) -> Description:
    """Read a dataset.toml.

    Raises
    ------
    InputError
        If the file is missing or no TOML, a key is unknown, a value has the wrong type or makes no sense. The message
        names the file and the place.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(
            "no such data set",
            expected="a dataset.toml, or a CSV or Parquet file",
            got="a folder" if path.is_dir() else "no file",
            remedy=f"give the file in it, e.g. {path / 'dataset.toml'}" if path.is_dir() else "check the path",
            file=path,
        )
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise InputError(
            "not a text file", expected="TOML in UTF-8", got=str(error), remedy="save it as UTF-8", file=path
        ) from error
    return parse_description(text, file=path)


def parse_description(text: str, *, file: str | Path | None = None) -> Description:
    r"""Read the text of a dataset.toml; see :func:`read_description`.

    Examples
    --------
    >>> from harness.errors import InputError
    >>> try:
    ...     parse_description('name = "a"\nsampel_time = 0.1')
    ... except InputError as error:
    ...     print(error)
    sampel_time: unknown key: expected one of name, signals, runs, nominal, sample_time, time, intersample, gaps,
    duplicates, resample, detrend, filter, undriven, feedthrough, source, description, got 'sampel_time'; remedy: did
    you mean sample_time?
    """
    try:
        content = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError("not TOML", expected="TOML", got=str(error), remedy="repair that line", file=file) from error
    _refuse_unknown(content, file)
    _refuse_open(content, "", file)
    try:
        read = msgspec.convert(content, Description)
    except msgspec.ValidationError as error:
        raise _explained(error, file) from error
    try:
        _check(read)
    except InputError as error:
        raise error.located(file=file) from error
    return read


def _refuse_open(content: Any, place: str, file: str | Path | None) -> None:
    """Refuse a question of a draft that nobody has answered yet."""
    if content == OPEN:
        raise InputError(
            "an open question",
            expected="an answer, as the comment behind it asks",
            got=repr(OPEN),
            remedy="replace it",
            file=file,
            place=place,
        )
    items: Iterable[tuple[Any, Any]] = ()
    if isinstance(content, dict):
        items = ((f"{place}.{key}".lstrip("."), value) for key, value in content.items())
    elif isinstance(content, list):
        items = ((f"{place}[{number}]", value) for number, value in enumerate(content))
    for where, value in items:
        _refuse_open(value, where, file)


_TABLES: dict[str, type[msgspec.Struct]] = {
    "nominal": NominalSection,
    "time": TimeSection,
    "resample": ResampleSection,
    "filter": FilterSection,
    "source": SourceSection,
}


def _refuse_unknown(content: dict[str, Any], file: str | Path | None) -> None:
    """Refuse keys that mean nothing, with the nearest that does (msgspec would not say which are allowed)."""
    todo: list[tuple[str, Any, type[msgspec.Struct]]] = [("", content, Description)]
    todo += [(key, content[key], kind) for key, kind in _TABLES.items() if key in content]
    signals, runs = content.get("signals"), content.get("runs")
    if isinstance(signals, dict):
        todo += [(f"signals.{name}", table, SignalSection) for name, table in signals.items()]
    if isinstance(runs, list):
        todo += [(f"runs[{number}]", table, RunSection) for number, table in enumerate(runs)]
    nominal = content.get("nominal")
    if isinstance(nominal, dict) and isinstance(nominal.get("parameters"), dict):
        todo += [
            (f"nominal.parameters.{name}", table, NominalParameter) for name, table in nominal["parameters"].items()
        ]
    for place, table, kind in todo:
        known = kind.__struct_fields__
        for key in table if isinstance(table, dict) else ():
            remedy = _remedy(key, known)
            refuse_unknown("unknown key", key, known, remedy=remedy, file=file, place=f"{place}.{key}".lstrip("."))


def _remedy(key: str, known: tuple[str, ...]) -> str:
    """Return what to do with a key that its table does not know: it may belong to another one."""
    if key in Description.__struct_fields__:
        return f"write {key} above the first table"
    homes = [f"[{name}]" for name, kind in _TABLES.items() if key in kind.__struct_fields__ and key not in known]
    return f"write it under {', or '.join(homes)}" if homes else "remove it"


def _explained(error: msgspec.ValidationError, file: str | Path | None) -> InputError:
    """Return msgspec's refusal (``what - at `$.place` ``) in our words."""
    what, _, place = str(error).partition(" - at ")
    place = place.strip("`").removeprefix("$").lstrip(".")
    if "missing required field" in what:
        key = what.rpartition("field ")[2].strip("`")
        return InputError(
            "missing key",
            expected=f"the key {key}",
            got="none",
            remedy="add a table [signals.NAME] with role and column for each; sysid new dataset FILE drafts them"
            if key == "signals"
            else f"add {key} = ...",
            file=file,
            place=f"{place}.{key}".lstrip("."),
        )
    return InputError(
        "value of the wrong type",
        expected="the type that fits",
        got=what[:1].lower() + what[1:],
        remedy="correct it",
        file=file,
        place=place or None,
    )


def _check(read: Description) -> None:
    """Refuse values that have the right type and make no sense."""
    positive: list[tuple[str, float | None]] = [("sample_time", read.sample_time)]
    if read.resample is not None:
        positive += [
            ("resample.sample_time", read.resample.sample_time),
            ("resample.max_gap", read.resample.max_gap),
        ]
    if read.filter is not None:
        positive += [("filter.low", read.filter.low), ("filter.high", read.filter.high)]
        if not 1 <= read.filter.order <= 12:
            raise InputError(
                "order of a filter",
                expected="1 to 12",
                got=str(read.filter.order),
                remedy="4 is usual",
                place="filter.order",
            )
    positive += [(f"signals.{name}.noise", signal.noise) for name, signal in read.signals.items()]
    for place, value in positive:
        if value is not None and not (value > 0 and math.isfinite(value)):
            raise InputError(
                place.rpartition(".")[2],
                expected="a positive number",
                got=f"{value:g}",
                remedy="correct it",
                place=place,
            )
    if not read.runs:
        raise InputError("no runs", expected="at least one [[runs]]", got="none", remedy="add one", place="runs")
    if not any(run.use == "estimation" for run in read.runs):
        raise InputError(
            "no estimation run", expected='a run with use = "estimation"', got="none", remedy="add one", place="runs"
        )
    if not any(signal.role == "output" for signal in read.signals.values()):
        raise InputError(
            "no output", expected='a signal with role = "output"', got="none", remedy="declare one", place="signals"
        )
    for name, signal in read.signals.items():
        _check_signal(f"signals.{name}", signal)
    for number, run in enumerate(read.runs):
        _check_run(f"runs[{number}]", run, (*read.signals, "time"))
    for name, given in (read.nominal.parameters if read.nominal is not None else {}).items():
        _check_parameter(f"nominal.parameters.{name}", given)


def _check_signal(place: str, signal: SignalSection) -> None:
    """Refuse a scale of 0, a derivative of an input, numbers that are not finite."""
    if not (math.isfinite(signal.scale) and signal.scale != 0.0 and math.isfinite(signal.offset)):
        raise InputError(
            "scale or offset",
            expected="finite numbers, the scale not 0",
            got=f"scale = {signal.scale:g}, offset = {signal.offset:g}",
            remedy="correct it",
            place=place,
        )
    if signal.derivative not in (0, 1, 2) or (signal.derivative and signal.role != "output"):
        raise InputError(
            "derivative",
            expected="0, 1 (the rate of a port) or 2 (its acceleration), of an output",
            got=f"{signal.derivative} of an {signal.role}",
            remedy="correct it",
            place=f"{place}.derivative",
        )


def _check_run(place: str, run: RunSection, known: Iterable[str]) -> None:
    """Refuse rows, a discard or a column override that cannot be meant."""
    if run.rows is not None and not 0 <= run.rows[0] < run.rows[1]:
        raise InputError(
            "rows",
            expected="[start, stop] with 0 <= start < stop (stop is not included)",
            got=str(list(run.rows)),
            remedy="correct it",
            place=f"{place}.rows",
        )
    if run.discard < 0:
        raise InputError(
            "discard", expected="0 or more", got=str(run.discard), remedy="correct it", place=f"{place}.discard"
        )
    for name in run.columns:
        refuse_unknown(
            "column of an unknown signal", name, known, remedy="declare the signal", place=f"{place}.columns.{name}"
        )


def _check_parameter(place: str, given: NominalParameter | float) -> None:
    """Refuse a parameter that is both known and fitted, or starts outside its bounds."""
    if not isinstance(given, NominalParameter):
        return
    low = -math.inf if given.minimum is None else given.minimum
    high = math.inf if given.maximum is None else given.maximum
    chosen = given.value if given.value is not None else given.start
    if given.value is not None and given.start is not None:
        raise InputError(
            "parameter both known and fitted",
            expected="value (known) or start (fitted)",
            got="both",
            remedy="remove one",
            place=place,
        )
    if not low <= high or (chosen is not None and not low <= chosen <= high):
        raise InputError(
            "bounds of a parameter",
            expected="minimum <= value or start <= maximum",
            got=f"{chosen} in [{low:g}, {high:g}]",
            remedy="correct them",
            place=place,
        )
