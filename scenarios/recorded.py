"""An input that was recorded before, played back at the times at which it was recorded."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from harness.data.conditioning.unstated import refuse_unlikely_seconds
from harness.data.tables.headers import clock_of
from harness.data.tables.table import Table
from harness.errors import InputError
from harness.protocols import Experiment
from harness.rng import Streams
from harness.signals import Channel, FloatArray, PlantSpec
from harness.units import convert
from scenarios.conditions import Conditions

ON_GRID = 1e-3
"""Part of a sample by which a stamp may miss an instant: what is lost by writing it rounded, and moves no row."""


@dataclass(frozen=True, kw_only=True)
class ReplayedInput(Conditions):
    """An input that was recorded before: columns of a file named after the inputs, at the times of its time column.

    The run begins at the first stamp and ends at the last; ``samples`` or ``duration`` cut it. Stamps may lie at any
    distance, twice the same stamp is a jump, and titles may carry a unit (``time [ms]``, ``Zeit (ms)``, ``u [kN]``,
    ``u_kN``); times without a unit are seconds, where they are less than 1 apart. A file that holds nothing but the
    inputs has no times: its rows are samples of the plant.

    Parameters
    ----------
    file : path
        CSV, Parquet or another table, with one row of titles.
    interpolation : {"hold", "linear"}
        What the input does between two stamps: keep the value of the first, or go straight to the second. Plants hold
        their input over a sample, so a straight line arrives as a staircase of the values at the sample instants.
    off_grid : {"refuse", "next"}
        What to do where a held input changes between two sample instants: refuse it, or let it change at the next one.
    time : str, optional
        Title of the time column; default the one whose title says so.
    """

    file: str | Path
    interpolation: Literal["hold", "linear"] = "hold"
    off_grid: Literal["refuse", "next"] = "refuse"
    time: str | None = None

    def prepare(self, spec: PlantSpec, *, streams: Streams, role: str) -> Experiment:
        """Return the experiment of one role."""
        for name, known in (("interpolation", ("hold", "linear")), ("off_grid", ("refuse", "next"))):
            if getattr(self, name) not in known:
                got = repr(getattr(self, name))
                raise InputError(
                    f"option {name}", expected=" or ".join(known), got=got, remedy="choose one", place=name
                )
        table = Table(Path(self.file))
        values = np.column_stack([_column(table, channel) for channel in spec.inputs] or [np.zeros((0, 0))])
        if not values.size:
            raise InputError(
                "a replayed input",
                expected="a plant with inputs, and rows to play",
                got="no inputs" if not spec.inputs else "no rows",
                remedy="leave the scenario out" if not spec.inputs else "check the file",
                file=self.file,
            )
        if len(values) < 2:
            raise InputError(
                "a replayed input",
                expected="two rows or more",
                got="one row, which says nothing of its time",
                remedy="check the file; a constant is two rows, at its beginning and its end",
                file=self.file,
            )
        title = self._clock(table, spec)
        excitation = values if title is None else self._played(_seconds(table, title), values, spec, table)
        if self.samples is not None or self.duration is not None:
            n = self.length(spec)
            if n > excitation.shape[0]:
                raise InputError(
                    "length of a replayed input",
                    expected=f"at most {excitation.shape[0]} samples",
                    got=str(n),
                    remedy="lower samples or duration",
                    file=self.file,
                )
            excitation = excitation[:n]
        return self.experiment(spec, excitation, streams=streams, role=role)

    def _clock(self, table: Table, spec: PlantSpec) -> str | None:
        """Return the title of the time column; None where the file holds the inputs only."""
        if self.time is not None:
            found = table.find(self.time)
            if found is None:
                raise table.missing(self.time)
            return found
        inputs = {table.find(channel.name, channel.unit) for channel in spec.inputs}
        try:
            clock = clock_of(table.titles, [title for title in inputs if title is not None])
        except InputError as error:
            raise error.located(file=self.file) from error
        if clock is not None:
            return clock
        others = [title for title in table.titles if title not in inputs]
        if others:
            raise InputError(
                "no time column",
                expected="one whose title says time, with its unit as in 'time [ms]'",
                got=", ".join(others[:8]),
                remedy="name it with time = TITLE, or keep the inputs only: then a row is a sample",
                file=self.file,
            )
        return None

    def _played(self, time: FloatArray, values: FloatArray, spec: PlantSpec, table: Table) -> FloatArray:
        """Return the inputs (N, nu) at the sample instants."""
        bad = ~np.isfinite(time)
        bad[1:] |= np.diff(time) < 0
        if bad.any():
            row = int(np.argmax(bad))
            raise InputError(
                "time of a replayed input",
                expected="stamps that never go back",
                got=f"{time[row]:.9g} s after {time[row - 1]:.9g} s" if row else f"{time[row]:g} s",
                remedy="sort or repair the rows",
                file=self.file,
                place=table.where(row),
            )
        dt = spec.sample_time
        stamps = (time - time[0]) / dt  # in samples
        slack = max(ON_GRID, 2 * float(np.spacing(np.abs(time).max())) / dt)  # since 1970 a number holds 0.2 us
        instants = np.arange(int(np.floor(stamps[-1] + slack)) + 1, dtype=np.float64)
        before = np.searchsorted(stamps, instants + slack, side="right") - 1
        if self.interpolation == "linear":
            discrete = [channel.name for channel in spec.inputs if channel.kind != "real"]
            if discrete:
                raise InputError(
                    "interpolation",
                    expected="hold, for an input of whole numbers",
                    got=f"linear for {', '.join(discrete)}",
                    remedy="leave interpolation out",
                    place="interpolation",
                )
            after = np.minimum(before + 1, len(stamps) - 1)
            span = stamps[after] - stamps[before]
            share = np.clip((instants - stamps[before]) / np.where(span > 0, span, 1.0), 0.0, 1.0)[:, None]
            straight: FloatArray = (1.0 - share) * values[before] + share * values[after]
            return straight
        if self.off_grid == "refuse":
            self._refuse_between(time, stamps, values, dt, slack, table)
        held: FloatArray = values[before]
        return held

    def _refuse_between(
        self, time: FloatArray, stamps: FloatArray, values: FloatArray, dt: float, slack: float, table: Table
    ) -> None:
        """Refuse a change that falls between two sample instants: the plant could only see it late."""
        changes = np.zeros(len(stamps), dtype=bool)
        changes[1:] = np.any(values[1:] != values[:-1], axis=1)
        wrong = changes & (np.abs(stamps - np.rint(stamps)) > slack + 1e-9 * stamps)
        if wrong.any():
            row = int(np.argmax(wrong))
            raise InputError(
                "a replayed input that changes between samples",
                expected=f"changes at multiples of the plant's sample time, {dt:g} s, after the first stamp",
                got=f"one {time[row] - time[0]:.9g} s after it ({int(wrong.sum())} in all)",
                remedy="give the plant a sample time that divides the stamps (--option sample_time=...), "
                "interpolation=linear, or off_grid=next to let it change at the next sample",
                file=self.file,
                place=table.where(row),
            )


def _seconds(table: Table, title: str) -> FloatArray:
    """Return the stamps in seconds; whole numbers without a unit are asked for it, as milliseconds look so too."""
    time, stated = table.read_time(title)
    if not stated:
        try:
            refuse_unlikely_seconds(time, title)
        except InputError as error:
            remedy = f'title it "{title} [s]", "{title} [ms]" or as it is meant'
            raise InputError(
                error.what, expected=error.expected, got=error.got, remedy=remedy, file=table.path
            ) from error
    return time


def _column(table: Table, channel: Channel) -> FloatArray:
    """Return the column of an input in its unit (SI)."""
    if table.find(channel.name, channel.unit) is None:
        raise InputError(
            f"column of input {channel.name!r}",
            expected=f"a column {channel}",
            got=", ".join(table.titles),
            remedy="rename the column",
            file=table.path,
        )
    values, unit = table.read(channel.name, channel.unit)
    try:
        converted = values if unit is None else convert(values, unit, channel.unit)
    except InputError as error:
        raise InputError(
            f"column of input {channel.name!r}",
            expected=f"a unit that converts to {channel.unit!r}",
            got=repr(unit),
            remedy="correct the title",
            file=table.path,
        ) from error
    if not np.isfinite(converted).all():
        row = int(np.argmin(np.isfinite(converted)))
        raise InputError(
            f"column of input {channel.name!r}",
            expected="a number in every row",
            got="none",
            remedy="repair the row",
            file=table.path,
            place=table.where(row),
        )
    return converted
