"""What is inside a file of data: its channels with units, sizes and holes, and the clock that they were taken by."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from harness.data.conditioning.clock import ROUGH, sample_time_of
from harness.data.conditioning.unstated import refuse_unlikely_seconds
from harness.data.tables.merging import one_clock
from harness.data.tables.table import WORKBOOKS, Table, open_table, suffix_of
from harness.errors import InputError
from harness.signals import FloatArray

_OFTEN = 10.0
"""Rows for each whole number up to the largest from which on it is asked whether they are names, and no counter."""


@dataclass(frozen=True)
class ChannelContent:
    """One channel of a file."""

    column: str  # What ``column = ...`` in a dataset.toml calls it
    name: str  # Its title without the unit
    unit: str = ""  # The unit that the file states; empty where it states none
    # Rows, and how many of them hold no number
    rows: int = 0
    empty: int = 0
    # Of its numbers, in its unit
    minimum: float | None = None
    maximum: float | None = None
    mean: float | None = None
    deviation: float | None = None
    every: float | None = None
    """Usual step [s] of a channel that has a clock of its own, or is filled in some rows only."""
    note: str = ""  # Why it cannot be read as numbers
    # First and last stamp [s] of a channel that has a clock of its own
    begin: float | None = None
    end: float | None = None
    names: bool = False  # True where its numbers may be names: whole, from 0 on, each in ten rows or more on average


@dataclass(frozen=True)
class Contents:
    """What is inside a file of data."""

    path: str
    channels: tuple[ChannelContent, ...]  # But for the time column
    rows: int
    clock: str | None = None  # The time column
    clock_stated: bool = False  # False if the file does not say in what unit the time is
    # Of the clock [s]
    start: float | None = None
    length: float | None = None
    sample_time: float | None = None
    # Steps longer than one and a half sample times; steps that are not forward
    holes: int = 0
    unsteady: int = 0
    notes: tuple[str, ...] = ()  # What was noticed
    back: int = 0  # Of the unsteady steps those that run back
    # True where the time states no unit and is hardly seconds; where its steps vary
    unlikely: bool = False
    rough: bool = False
    sheet: str | None = None  # Of a workbook, where one of several had to be chosen

    def facts(self) -> list[str]:
        """Return lines for a person."""
        lines = [f"{self.path}: {self.rows} rows, {len(self.channels)} channels"]
        if self.clock is None and self.length is not None:
            lines.append(f"time: {self.length:.6g} s in all")
        elif self.clock is None:
            lines.append("no time column: sample_time has to be declared")
        elif self.sample_time is None:
            lines.append(f"time: {self.clock}, which does not run")
        else:
            unit = "" if self.clock_stated else " (no unit stated: seconds?)"
            unit = " (no unit stated, and hardly seconds: say which)" if self.unlikely else unit
            lines.append(
                f"time: {self.clock}{unit}, {self.length:.6g} s from {self.start:.6g} s, "
                f"every {self.sample_time:.6g} s ({1 / self.sample_time:.6g} Hz)"
            )
            lines += [f"{self.holes} holes"] if self.holes else []
            lines += [f"{self.unsteady} steps that stand still or run back"] if self.unsteady else []
        return lines + list(self.notes)

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return asdict(self)


def contents_of(path: str | Path, sheet: str | None = None, tables: dict[Path, Table] | None = None) -> Contents:
    r"""Return the columns, units, sampling and notes of a file of data.

    Parameters
    ----------
    path : path
        Any format of :data:`harness.data.tables.table.FORMATS`; nothing in it has to be declared.
    sheet : str, optional
        Of an Excel workbook.
    tables : dict, optional
        Tables that were opened before, by their path, which are not read again.

    Raises
    ------
    InputError
        If there is no such file, or it is none of these formats.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     log = Path(folder) / "log.csv"
    ...     _ = log.write_text("time [ms],u [V]\n0,1\n10,3\n20,5\n")
    ...     found = contents_of(log)
    >>> found.sample_time, found.channels[0].unit, found.channels[0].mean
    (0.01, 'V', 3.0)
    """
    path = Path(path)
    sheet, notes = (sheet, []) if sheet is not None else _sheet(path)
    table = open_table(path, {} if tables is None else tables, sheet)
    columns = [(title, selector) for title in table.titles for selector in _selectors(table, title)]
    try:
        clock = table.clock()
    except InputError as error:
        clock, notes = None, [f"time: {error.what}: {error.got}"]
    channels = tuple(_channel(table, title, selector) for title, selector in columns if clock not in (title, selector))
    rows = max((channel.rows for channel in channels), default=0)
    if table.clocks([title for title in table.titles if title][:1]) is not None and clock in (None, "time"):
        clocks, kind = table.clocks([channel.column for channel in channels]) or ([], "")
        notes.append(
            f"channels have one clock ({kind})"
            if one_clock(clocks)
            else f"channels have clocks of their own ({kind}): [resample] sample_time puts them on one grid"
        )
        start, end = min(one[0] for one in clocks), max(one[-1] for one in clocks)
        return Contents(path.name, channels, rows, None, True, float(start), float(end - start), None, 0, 0,
                        (*table.notes, *notes))  # fmt: skip
    if clock is None:
        return Contents(path.name, channels, rows, notes=(*table.notes, *notes), sheet=sheet)
    try:
        time, stated = table.read_time(clock)
    except InputError as error:
        return Contents(path.name, channels, rows, clock, notes=(*table.notes, f"time: {error}"), sheet=sheet)
    steps = np.diff(time[np.isfinite(time)])
    forward = steps[steps > 0]
    notes += [*table.notes] + [f"{int((~np.isfinite(time)).sum())} rows without a time"] * (not np.isfinite(time).all())
    if not forward.size:
        return Contents(path.name, channels, max(rows, len(time)), clock, stated, notes=tuple(notes), sheet=sheet)
    dt = sample_time_of(np.concatenate(([0.0], np.cumsum(forward))))
    channels = tuple(_timed(table, channel, time) for channel in channels)
    notes += [note for note in table.notes if note not in notes]  # what reading the time has shown
    return Contents(
        path.name,
        channels,
        max(rows, len(time)),
        clock,
        stated,
        float(np.nanmin(time)),
        float(np.nanmax(time) - np.nanmin(time)),
        dt,
        int((steps > 1.5 * dt).sum()),
        int((steps <= 0).sum()),
        tuple(notes),
        int((steps < 0).sum()),
        not stated and _hardly_seconds(time),
        rough=float(np.std(forward[np.abs(forward - dt) < 0.5 * dt])) > ROUGH * dt,
        sheet=sheet,
    )


def _timed(table: Table, channel: ChannelContent, time: FloatArray) -> ChannelContent:
    """Return a channel that is filled in some rows only with its own usual step [s]."""
    if not 0 < channel.empty < channel.rows - 1 or channel.rows != len(time):
        return channel
    filled = np.isfinite(table.read(channel.column)[0]) & np.isfinite(time)
    steps = np.diff(time[filled])
    return replace(channel, every=float(np.median(steps))) if steps.size else channel


def _sheet(path: Path) -> tuple[str | None, list[str]]:
    """Return the sheet of a workbook that is shown where several hold numbers and the first does not, and its note."""
    if suffix_of(path) not in WORKBOOKS or not path.is_file():
        return None, []
    from harness.data.tables.excel import sheets_of

    sheets = sheets_of(path)
    if len(sheets) < 2:
        return None, []
    return sheets[0], [f"sheets with rows of numbers: {', '.join(map(repr, sheets[:8]))}; {sheets[0]!r} is shown"]


def _hardly_seconds(time: FloatArray) -> bool:
    """Return True if stamps without a unit would be refused as seconds."""
    try:
        refuse_unlikely_seconds(time, "time")
    except InputError:
        return True
    return False


def _selectors(table: Table, title: str) -> list[str]:
    """Return the columns that a variable holds: itself, or those of its matrices, cells and fields, by their names."""
    inside = table.inside(title)
    names = {way: name for name, (way, _) in table.called.items()}
    return [title] if inside is None else [names.get(one, one) for one in inside]


def _channel(table: Table, title: str, selector: str) -> ChannelContent:
    """Return one channel with what its numbers are."""
    name = table.split(title)[0] if selector == title else selector
    try:
        values, unit = table.read(selector)
    except InputError as error:
        where = f" in {error.place.partition(',')[0]}" if error.place else ""
        return ChannelContent(selector, name, note=f"{error.what}: {error.got[:60]}{where}")
    own = table.clocks([selector])
    steps = np.zeros(0) if own is None else np.diff(own[0][0])
    every = float(np.median(steps)) if steps.size else None
    holes = int((steps > 5 * every).sum()) if every is not None else 0
    note = f"{holes} holes" if holes else ""
    empty = int((~np.isfinite(values)).sum())
    begin, end = (None, None) if own is None or not len(own[0][0]) else (float(own[0][0][0]), float(own[0][0][-1]))
    return replace(
        ChannelContent(selector, name, unit or "", len(values), empty, every=every, note=note, begin=begin, end=end),
        **_sizes(values),
    )


def _sizes(values: FloatArray) -> dict[str, Any]:
    """Return minimum, maximum, mean and standard deviation of what is finite, and whether it may be names."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return {}
    with np.errstate(over="ignore"):  # a damaged row may hold numbers whose squares are none
        mean, deviation = float(finite.mean()), float(finite.std())
    low, high = float(finite.min()), float(finite.max())
    names = low >= 0.0 and 1.0 <= high < finite.size / _OFTEN and not np.any(finite % 1.0)
    return {"minimum": low, "maximum": high, "mean": mean, "deviation": deviation, "names": bool(names)}
