"""Every run of a description, read from its files: columns, clocks, units, pieces without gaps."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from harness.data.conditioning.clock import TimeRules
from harness.data.conditioning.timebase import RecordPiece, pieces_of
from harness.data.conditioning.trends import conditioned
from harness.data.conditioning.unstated import refuse_unlikely_seconds
from harness.data.recipe.beside import BesideFile
from harness.data.recipe.in_memory import examined_data
from harness.data.recipe.loaded import LoadedDataset
from harness.data.recipe.plan import Plan
from harness.data.recipe.ports import nearest
from harness.data.recipe.sanity import check_run, check_runs
from harness.data.recipe.second_clock import refuse_other_pace
from harness.data.sections import BesideSection, Description, RunSection
from harness.data.tables.bags import is_bag_folder
from harness.data.tables.merging import in_turn, merged, one_clock
from harness.data.tables.table import Table, open_table
from harness.errors import InputError
from harness.resolution import resolution
from harness.signals import Dataset, FloatArray, PlantSpec, Run, Trajectory, stated_categories
from harness.units import convert, fits

DATA_FOLDER = "SYSID_HARNESS_DATA"  # Environment variable that names the folder of recordings.


class Reader:
    """One call of :func:`load_dataset`; the model and its ports are for the :class:`Plan`."""

    def __init__(
        self,
        path: Path,
        description: Description,
        notes: list[str],
        tables: dict[Path, Table],
        **named: Any,
    ) -> None:
        self.path, self.description = path, description
        self.tables = tables
        self._joined: dict[int, Table] = {}
        self.plan = Plan(path, description, header_unit=self._header_unit, **named)
        self.notes = [*notes, *self.plan.notes]
        self.steps: dict[str, list[float]] = {}
        self.recorded: dict[str, str] = {}
        self.rules = TimeRules(
            description.sample_time,
            description.gaps,
            description.resample,
            description.intersample,
            description.duplicates,
        )

    def load(self, *, fitted: bool) -> LoadedDataset:
        """Read every run; to learn from it, or only to predict what follows."""
        plan, spec = self.plan, None
        runs: list[Run] = []
        references: list[dict[str, FloatArray]] = []
        names: list[str] = []
        records: list[int] = []
        self._refuse_unrecorded()
        self._refuse_conditioning()
        measured = tuple((plan.port(name), plan.signal(name).derivative) for name in plan.outputs)
        self._check_files()
        arm = False
        if plan.nominal is not None:
            from harness.physics.arms.arm import is_arm

            arm = is_arm(plan.nominal.model)
        for number, section in enumerate(self.description.runs):
            file = self._file(number, section)
            place, name = self._place(number, section, file)
            try:
                pieces, notes = self._pieces(section, self._table(number), None if spec is None else spec.sample_time)
                longest = max((len(piece.values) for piece in pieces), default=0)
                for order, piece in enumerate(pieces):
                    spec = spec or self._spec(piece.sample_time)
                    trajectory, extra = self._trajectory(piece, spec)
                    whole = len(piece.values) == longest
                    notes += check_run(
                        trajectory, measured, recorded=self.recorded, inverse_dynamics=arm, fitted=fitted, whole=whole,
                        of=self._divided(section),
                    )  # fmt: skip
                    label = section.label + (f"/{order}" if len(pieces) > 1 else "")
                    runs.append(Run(trajectory, section.use, label.lstrip("/")))
                    references.append(extra)
                    records.append(number)
                    names.append(name + (f", piece {order}" if len(pieces) > 1 else ""))
            except InputError as error:
                raise error.located(file=file, place=place) from error
            self.notes += [f"{name}: {note}" for note in dict.fromkeys(notes)]
        for table in (*self.tables.values(), *self._joined.values()):
            self.notes += [f"{table.path.name}: {note}" for note in table.notes]
        self.notes += check_runs(runs, records)
        self._check_overlap()
        if not any(run.use == "validation" for run in runs):
            self.notes.append("no validation run: nothing chooses between models on data that they have not seen")
        between = self.description.intersample or "zoh"
        # readings that are brought onto another clock no longer lie on the grid on which they were read
        steps = {name: min(found) for name, found in self.steps.items() if min(found) > 0.0}
        found = Dataset(
            self.description.name, tuple(runs), between, plan.noise(), tuple(dict.fromkeys(self.notes)), steps
        )
        dataset = examined_data(replace(found, recorded=self.recorded), names)
        dataset = replace(
            dataset,
            runs=tuple(
                replace(run, trajectory=conditioned(run.trajectory, self.description.detrend, self.description.filter))
                for run in dataset
            ),
        )
        return LoadedDataset(dataset, plan.nominal, measured, tuple(references), self.path, self.description.source)

    def _place(self, number: int, section: RunSection, file: Path) -> tuple[str | None, str]:
        """Return what a run is called in its file, and everywhere: of a bare table nobody has numbered the runs."""
        if self.path.suffix == ".toml":
            return f"runs[{number}]", f"runs[{number}] ({file.name})"
        if section.rows is None:
            return None, file.name
        part = f"rows {section.rows[0]} to {section.rows[1]}"
        return part, f"{file.name}, {part}"

    def _divided(self, section: RunSection) -> int | None:
        """Return the rows of a table of which nobody said that the last third validates; None where rows are said."""
        if self.path.suffix == ".toml" or section.rows is None:
            return None
        return max(run.rows[1] for run in self.description.runs if run.rows is not None)

    def _refuse_conditioning(self) -> None:
        """Refuse trends and bands taken from signals that a nonlinear model is to explain."""
        declared = ["detrend"] * (self.description.detrend != "none") + ["[filter]"] * bool(self.description.filter)
        if not declared:
            return
        nominal = self.plan.nominal
        if nominal is not None and nominal.model != "linear":
            raise InputError(
                " and ".join(declared),
                expected="the nominal model linear, or none: other models know where they are only from whole signals",
                got=f"the model {nominal.model}",
                remedy="leave it out here, or leave out [nominal]",
                place=declared[0].strip("[]"),
            )
        steps = [] if self.description.detrend == "none" else [f"without their {self.description.detrend} trend"]
        steps += [] if self.description.filter is None else ["filtered"]
        self.notes.append(f"all signals are {' and '.join(steps)}, as declared: scores are those of what is left")

    def _refuse_unrecorded(self) -> None:
        """Refuse inputs of the model that no column gives: taken as 0 they would pass for something that is missing."""
        if not self.plan.unrecorded:
            return
        channel, ports = self.plan.unrecorded[0], self.plan.ports
        section, table = self.description.runs[0], self._table(0)
        signals = self.description.signals
        used = {self._title(name, table, section) for name in signals if signals[name].role != "reference"}
        clock = self._clock(section, table, used)
        time = None if clock is None else table.find(clock)
        free = [title for title in table.titles if title not in used and title != time]
        raise InputError(
            f"no column gives the input {channel} of {ports.model if ports is not None else 'the model'}",
            expected=f"a column {str(channel)!r}, or undriven = [{channel.name!r}] where nothing drove it",
            got=f"columns that serve nothing: {', '.join(nearest(channel, free)) or 'none'}",
            remedy=f"name the column after the input, or give a signal role = 'input' and port = {channel.name!r}; "
            f"only if the input was 0 all along, declare undriven (sysid: --undriven {channel.name})",
            place="undriven",
        )

    # ---- files ----------------------------------------------------------------------------------------------------

    def _table(self, number: int) -> Table:
        """Return the table of a run: of its file, and of those that other loggers wrote beside."""
        section = self.description.runs[number]
        file = self._file(number, section)
        table = open_table(file, self.tables, section.sheet)
        if not section.beside:
            return table
        if number not in self._joined:
            others = [(open_table(self._file(number, one), self.tables, one.sheet), one) for one in section.beside]
            self._joined[number] = Table(file, BesideFile(table, lambda: self._time(section, table, {}), others))
        return self._joined[number]

    def _file(self, number: int, section: RunSection | BesideSection) -> Path:
        """Return the file of a run: beside the description, or under the folder of recordings."""
        given = Path(section.file)
        if given in self.tables:
            return given
        places = [self.path.parent / given]
        folder = os.environ.get(DATA_FOLDER)
        if folder:
            places.append(Path(folder) / given)
        for place in places:
            if place.is_file() or is_bag_folder(place):
                return place
        source = self.description.source
        if source is None:
            # the table words the refusal: it looks for similar names
            return places[0]
        where = f"under ${DATA_FOLDER} ({folder})" if folder else f"as ${DATA_FOLDER} is not set"
        raise InputError(
            f"a file of the recording {self.description.name} is missing",
            expected=f"{section.file} under ${DATA_FOLDER} or beside the recipe",
            got=f"no such file {where}",
            remedy=f"download it from {source.download}"
            + (f" (or pip install {source.package})" if source.package else "")
            + f" and set ${DATA_FOLDER} to the folder that holds {given.parent if given.parent.name else 'it'}",
            file=given,
            place=f"runs[{number}].file",
        )

    def _check_files(self) -> None:
        """Say so if a file of a public recording is not the one that the recipe was written for."""
        source = self.description.source
        wanted = {listed.file: listed.sha256 for listed in source.files} if source is not None else {}
        for number, section in enumerate(self.description.runs):
            expected = wanted.pop(section.file, "")
            if expected and hashlib.sha256(self._file(number, section).read_bytes()).hexdigest() != expected:
                self.notes.append(f"{section.file} is not the file that this recipe was written for (SHA-256 differs)")

    def _header_unit(self, name: str, like: str | None) -> str | None:
        """Return the unit that the first run's file states for a signal."""
        section, table = self.description.runs[0], self._table(0)
        return table.read(self._column(name, section), like)[1]

    def _column(self, name: str, section: RunSection) -> str | int:
        """Return the column of a signal in one run."""
        if name in section.columns:
            return section.columns[name]
        column = self.description.signals[name].column
        return name if column is None else column

    def _title(self, name: str, table: Table, section: RunSection) -> str | None:
        """Return the title of a signal's column in one run; None where a selector finds it, or nothing does."""
        return table.find(self._column(name, section), self.plan.like(name))

    # ---- values ---------------------------------------------------------------------------------------------------

    def _pieces(self, section: RunSection, table: Table, common: float | None) -> tuple[list[RecordPiece], list[str]]:
        """Return the uninterrupted pieces of one run, in SI units."""
        from harness.data.oddities.numbers import ODD

        names = (*self.plan.inputs, *self.plan.outputs, *self.plan.references)
        columns: dict[str, FloatArray] = {}
        seen: dict[str | int, str] = {}
        for name in names:
            column = self._title(name, table, section) or self._column(name, section)
            if isinstance(self._column(name, section), int):  # two columns may have one title
                column = self._column(name, section)
            if column in seen:
                raise InputError(
                    "two signals from one column",
                    expected="a column of its own for each signal",
                    got=f"{seen[column]} and {name} from {column!r}",
                    remedy="correct the column of one",
                    place=f"signals.{name}.column",
                )
            seen[column] = name
            columns[name] = self._converted(name, table, column)
            if name in self.plan.outputs:
                sizes = columns[name][np.abs(columns[name]) <= ODD.beyond]
                self.steps.setdefault(name, []).append(resolution([sizes]))
        inputs = tuple(name in self.plan.inputs for name in names)
        own = table.clocks(list(seen))
        if own is not None:
            return self._merged(section, own, columns, inputs, common)
        time = self._time(section, table, seen)
        lengths = {name: len(values) for name, values in columns.items()}
        if time is not None:
            lengths["time"] = len(time)
        if len(set(lengths.values())) > 1:
            raise InputError(
                "columns of different length",
                expected="as many rows in each",
                got=", ".join(f"{name} {length}" for name, length in lengths.items()),
                remedy="correct the columns",
            )
        values = np.column_stack([columns[name] for name in names])
        chosen = self._rows(section, len(values))
        if time is not None and self.rules.resample and (turns := in_turn(time[chosen], values[chosen])) is not None:
            filled = dict(zip(names, turns[1], strict=True))
            return self._together((turns[0], "rows in which each signal is filled"), filled, inputs, common)
        return pieces_of(
            None if time is None else time[chosen],
            values[chosen],
            names=names,
            inputs=inputs,
            rules=self.rules,
            common=common,
            where=lambda row: table.where(row + (chosen.start or 0)),
        )

    def _merged(
        self,
        section: RunSection,
        own: tuple[list[FloatArray], str],
        columns: dict[str, FloatArray],
        inputs: tuple[bool, ...],
        common: float | None,
    ) -> tuple[list[RecordPiece], list[str]]:
        """Return the pieces of a run whose signals have clocks of their own, in SI units."""
        declared = section.columns.get(
            "time", "time" if self.description.time is None else self.description.time.column
        )
        if declared != "time" and not section.beside:
            raise InputError(
                "a time column where signals have clocks of their own",
                expected="none: each message has its stamp",
                got=repr(declared),
                remedy="remove [time]",
                place="time",
            )
        return self._together(own, columns, inputs, common, section)

    def _together(
        self,
        own: tuple[list[FloatArray], str],
        columns: dict[str, FloatArray],
        inputs: tuple[bool, ...],
        common: float | None,
        section: RunSection | None = None,
    ) -> tuple[list[RecordPiece], list[str]]:
        """Return the pieces of signals that have stamps of their own, cut to the rows of a run."""
        clocks, kind = own
        names, notes = tuple(columns), [f"time: {kind}"]
        if one_clock(clocks):
            time, values, rules = clocks[0], np.column_stack(list(columns.values())), self.rules
        else:
            time, values = merged(
                clocks, list(columns.values()), names=names, inputs=inputs, rules=self.rules, notes=notes
            )
            rules = replace(self.rules, resample=None, sample_time=None)
        chosen = slice(None) if section is None else self._rows(section, len(values))
        pieces, said = pieces_of(time[chosen], values[chosen], names=names, inputs=inputs, rules=rules, common=common)
        return pieces, notes + said

    def _converted(self, name: str, table: Table, column: str | int) -> FloatArray:
        """Return one signal in its SI unit: scale and offset first, then the unit."""
        signal = self.description.signals[name]
        raw, stated = table.read(column, self.plan.like(name))
        unit = stated if signal.unit is None and stated is not None else self.plan.units[name]
        if stated_categories(unit) is not None:
            unit = "1"
        elif stated is not None and signal.unit is not None and not _same_unit(stated, unit):
            self.notes.append(
                f"signals.{name}: the title seems to say {stated!r}; its numbers count as they are (declare unit = "
                f'"{stated}", or --unit {name}={stated}, if they are that)'
                if unit == "1"
                else f"signals.{name}: the title says {stated!r}; {unit!r}, as declared, counts"
            )
        self.recorded.setdefault(self.plan.channels[name].name, unit)
        scaled = raw if signal.scale == 1.0 and signal.offset == 0.0 else signal.scale * raw + signal.offset
        if np.isinf(scaled).any():
            row = int(np.argmax(np.isinf(scaled)))
            raise InputError(
                "an infinite value",
                expected="numbers",
                got=f"{raw[row]} in {table.where(row)}",
                remedy="cut or empty the cell",
                place=f"{table.where(row)}, signal {name}",
            )
        return convert(scaled, unit, self.plan.channels[name].unit)

    def _clock(self, section: RunSection, table: Table, used: Collection[str | int | None]) -> str | int | None:
        """Return the time column: the declared one, else what a title calls the time; None if there is none."""
        declared = self.description.time
        if "time" in section.columns or declared is not None:
            return section.columns.get("time", declared.column if declared is not None else "time")
        return table.clock([title for title in used if isinstance(title, str)])

    def _time(self, section: RunSection, table: Table, used: dict[str | int, str]) -> FloatArray | None:
        """Return the time stamps [s]; None where only a sample time is declared and the file has no time column."""
        titles = [column if (title := table.find(column)) is None else title for column in used]
        column = self._clock(section, table, titles)
        if column is None:
            if self.description.sample_time is None:
                raise InputError(
                    "no time",
                    expected="sample_time = ... (s), or a column time",
                    got=f"columns {', '.join(table.titles[:12])}",
                    remedy="declare sample_time, or [time] with the name of the column "
                    "(sysid: --sample-time, --column time=TITLE)",
                    place="sample_time",
                )
            return None
        declared = self.description.time
        try:
            time, stated = table.read_time(column, declared.unit if declared is not None else None)
        except InputError as error:
            raise error.located(file=self.path, place="time.unit") from error
        if not stated and self.description.sample_time is None:
            refuse_unlikely_seconds(time, str(column))
            span = float(np.nanmax(time) - np.nanmin(time)) if np.isfinite(time).any() else 0.0
            rate = f", {(len(time) - 1) / span:.4g} rows a second over {span:.4g} s" if span > 0.0 else ""
            note = f"{column}: no unit is stated: it is taken for seconds{rate} (else --unit time=UNIT)"
            self.notes += [note] if note not in self.notes else []
        asked_for = declared is not None or "time" in section.columns
        if not asked_for:
            refuse_other_pace(table, column, time, stated=stated, used=titles)
        if asked_for or not np.isnan(time[1:]).all():
            return time
        if self.description.sample_time is None:  # a "Ts" is no clock
            raise InputError(
                "no time",
                expected="sample_time = ... (s), or a time in every row",
                got=f"{'nothing in' if np.isnan(time[0]) else 'one number of'} {column!r}",
                remedy="declare sample_time"
                + ("" if np.isnan(time[0]) else f" = {time[0]:g} if that is it")
                + " (sysid: --sample-time)",
                place="sample_time",
            )
        return None

    def _rows(self, section: RunSection, n: int) -> slice:
        """Return the rows that a run uses."""
        start, stop = section.rows if section.rows is not None else (0, n)
        if stop > n:
            raise InputError(
                "rows beyond the end", expected=f"at most {n}", got=f"rows = [{start}, {stop}]", remedy="correct rows"
            )
        if start + section.discard >= stop:
            raise InputError(
                "nothing left of the run",
                expected=f"discard below {stop - start}",
                got=f"discard = {section.discard}",
                remedy="correct rows or discard",
            )
        return slice(start + section.discard, stop)

    def _spec(self, sample_time: float) -> PlantSpec:
        """Return what all runs share."""
        channels = self.plan.channels
        return PlantSpec(
            tuple(channels[name] for name in self.plan.inputs),
            tuple(channels[name] for name in self.plan.outputs),
            sample_time,
            feedthrough=self.description.feedthrough,
        )

    def _trajectory(self, piece: RecordPiece, spec: PlantSpec) -> tuple[Trajectory, dict[str, FloatArray]]:
        """Return one piece as a record, and its references."""
        n, nu, ny = len(piece.values), spec.nu, spec.ny
        t = piece.start + np.arange(n, dtype=np.float64) * spec.sample_time
        references = {name: piece.values[:, nu + ny + i].copy() for i, name in enumerate(self.plan.references)}
        outputs = slice(nu, nu + ny)
        missing = None if piece.between is None else piece.between[:, outputs]
        return Trajectory(t, piece.values[:, :nu], piece.values[:, outputs], spec, missing=missing), references

    def _check_overlap(self) -> None:
        """Refuse rows of one file that serve two uses."""
        runs = list(enumerate(self.description.runs))
        for a, first in runs:
            for b, second in runs[a + 1 :]:
                if (first.file, first.sheet, first.columns) != (
                    second.file,
                    second.sheet,
                    second.columns,
                ) or first.use == second.use:
                    continue
                low = [0 if run.rows is None else run.rows[0] for run in (first, second)]
                high = [np.inf if run.rows is None else run.rows[1] for run in (first, second)]
                if max(low) < min(high):
                    raise InputError(
                        f"runs {a} and {b} overlap",
                        expected=f"{second.use} data that are no {first.use} data",
                        got=f"rows {first.rows or 'all'} and {second.rows or 'all'} of {first.file}",
                        remedy="separate their rows",
                        file=self.path,
                        place=f"runs[{b}].rows",
                    )


def _same_unit(stated: str, declared: str) -> bool:
    """Return True if two unit texts mean the same; a text that is no unit says nothing."""
    if stated.strip() == declared.strip():  # the usual case needs no reading, which takes 0.3 s to load
        return True
    try:
        if not fits(stated, declared):
            return False
        return bool(np.allclose(convert(np.array([0.0, 1.0]), stated, declared), [0.0, 1.0], rtol=1e-9))
    except InputError:
        return True
