"""One table as a whole data set: its columns carry the names of the model's ports, or the caller names them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from harness.data.recipe.chosen import TIME, Chosen, Found
from harness.data.recipe.ports import Ports, located_model, ports_of, rate_unit
from harness.data.sections import Description, NominalSection, RunSection, SignalSection, TimeSection
from harness.data.tables.bags import is_bag_folder
from harness.data.tables.headers import REFERENCE
from harness.data.tables.merging import grid_of, one_clock
from harness.data.tables.table import FORMATS, WORKBOOKS, Table, open_table, suffix_of
from harness.data.trajectories import stored_spec
from harness.errors import InputError
from harness.signals import Channel


def describe_bare(
    path: Path,
    *,
    model: str | None,
    validation: str | Path | None,
    ports: tuple[Sequence[Channel], Sequence[Channel]] | None,
    notes: list[str],
    tables: dict[Path, Table],
    chosen: Chosen,
) -> tuple[Description, Ports | None]:
    """Return the description that a bare file amounts to, and the ports that name its columns.

    Raises InputError if neither a model nor the caller says which columns are meant, or a column is not there.

    - ``chosen``: what the caller says of the columns. The names are those of the model's ports where there is a model
      that has some, else those that the caller chose as inputs and outputs.
    """
    table = open_table(path, tables, chosen.sheet)
    known = _known_ports(table, model, ports, chosen)
    chosen = chosen.by_signal(table, known)
    if known is None or chosen.outputs is not None or chosen.inputs is not None:
        found, said = chosen.sections(table, known)
        notes += said
    else:
        found = _signals(table, known, path, notes, chosen)
    signals = dict(found.values())
    runs, second = _runs(path, table, validation, found, tables, chosen)
    notes += second
    if chosen.sample_time is not None:
        notes += _joined_records(table, found, chosen)
    described = Description(
        name=path.stem,
        signals=signals,
        runs=runs,
        nominal=NominalSection(model=model) if model is not None else None,
        time=_time(table, found, chosen),
        sample_time=chosen.sample_time,
        gaps=chosen.gaps,
    )
    return described, known


RECORDS = frozenset("run runs trial experiment episode session segment repetition versuch messung essai prova".split())
"""Titles of columns that number records, in small letters."""
LONGEST = 20  # Rows that a record has at least on average: what changes more often numbers something else.


def _joined_records(table: Table, found: Found, chosen: Chosen) -> list[str]:
    """Say that a column numbers records that follow each other where no clock parts them."""
    if TIME in chosen.columns or table.clock(found) is not None:
        return []
    notes = []
    for title in table.titles:
        if title in found or table.split(title)[0].strip().lower() not in RECORDS:
            continue
        try:
            changes = np.flatnonzero(np.diff(table.read(title)[0])) + 1
        except InputError:
            continue  # texts
        if 0 < changes.size <= len(table.read(title)[0]) / LONGEST:
            notes.append(
                f"{title!r} changes in {table.where(int(changes[0]))} ({changes.size}x), and no clock says that rows "
                "go on there: put each record into a file of its own (--run), or name a time column"
            )
    return notes


def _known_ports(
    table: Table, model: str | None, ports: tuple[Sequence[Channel], Sequence[Channel]] | None, chosen: Chosen
) -> Ports | None:
    """Return the ports that name the columns of a file; None where only the caller can."""
    if ports is not None:
        return Ports(tuple(ports[0]), tuple(ports[1]), model or "the model", rates=False)
    if model is not None and (found := ports_of(located_model(model, Path.cwd()), {})) is not None:
        return found
    said = chosen.inputs is not None or chosen.outputs is not None  # which outranks what was written with the table
    stored = None if said else stored_spec(table.path, table.titles)
    return None if stored is None else Ports(stored.inputs, stored.outputs, table.path.name, rates=False)


def _time(table: Table, found: Found, chosen: Chosen) -> TimeSection | None:
    """Return what the caller says of the clock; None where the titles are to say it."""
    column, unit = chosen.columns.get(TIME), chosen.units.get(TIME)
    if column is None and unit is None:
        return None
    return TimeSection(column=column if column is not None else table.clock(found) or TIME, unit=unit)


def _signals(table: Table, ports: Ports, path: Path, notes: list[str], chosen: Chosen) -> Found:
    """Return by title the name and signal of every column that carries the name of a port or rate, or is said to."""
    inputs = {channel.name: channel.unit for channel in ports.inputs}
    outputs = {channel.name: (channel, 0) for channel in ports.outputs}
    for channel in ports.outputs if ports.rates else ():
        outputs.setdefault(Ports.channel_name(channel.name, 1), (channel, 1))
    units = {name: rate_unit(channel.unit, derivative) for name, (channel, derivative) in outputs.items()} | inputs
    said = chosen.placed(table, units)
    titles = _titles(table, units, said)
    signals: Found = {}
    for title in (*table.titles, *(one for one in said if isinstance(one, int))):
        if isinstance(title, str) and title.startswith(REFERENCE):
            signals[title] = table.split(title)[0], SignalSection(role="reference")
        elif title in titles:
            name, port = titles[title]
            unit = chosen.units.get(port)
            if unit is None and units[port] == "1" and table.read(title, "1")[1] is None:
                unit = "1"  # a port that is a plain number asks for no unit
            # a column that was not said is found by its name: the unit in its title may be another in the next file
            column = title if title in said else None
            if port in inputs:
                section = SignalSection(role="input", port=port, unit=unit, column=column)
            else:
                channel, derivative = outputs[port]
                section = SignalSection(
                    role="output", port=channel.name, derivative=derivative, unit=unit, column=column
                )
            signals[title] = name, section
    _refuse_no_output(table, ports, path, signals)
    clock = next((title for title, name in said.items() if name == TIME), table.clock(signals))
    ignored = [title for title in table.titles if title and title not in signals and title != clock]
    if ignored:
        notes.append(f"columns that are no ports of {ports.model} are ignored: {', '.join(ignored[:8])}")
    return signals


def _refuse_no_output(table: Table, ports: Ports, path: Path, signals: Found) -> None:
    """Refuse a table of which no column is an output of the model."""
    if not any(signal.role == "output" for _, signal in signals.values()):
        raise InputError(
            f"no column is an output of {ports.model}",
            expected=f"a column named {' or '.join(map(str, ports.outputs[:6]))}",
            got=", ".join(table.titles[:12]),
            remedy=f"say which column it is (--column {ports.outputs[0].name}=TITLE), choose another --model, "
            "or write a dataset.toml",
            file=path,
        )


def _titles(table: Table, units: dict[str, str], said: dict[str | int, str]) -> dict[str | int, tuple[str, str]]:
    """Return by title the name of a signal and its port: as said, by its name, by its name and a unit behind it."""
    plain = {name.replace("_", ""): name for name in units}  # tau_1 is as good as tau1
    found = {title: (name, name) for title, name in said.items() if name != TIME}
    elsewhere = set(said.values())
    free = [title for title in table.titles if title not in said and not title.startswith(REFERENCE)]
    for title in free:
        name = table.split(title)[0]
        port = name if name in units else plain.get(name.replace("_", ""))
        if port is not None and port not in elsewhere:
            found[title] = name, port
    taken = {port for _, port in found.values()}
    for title in free:
        for port, unit in units.items() if title not in found else ():
            if port not in taken and (parts := table.stated(title, unit)) is not None and parts[0] == port:
                found[title] = port, port
    return found


def _runs(
    path: Path,
    table: Table,
    validation: str | Path | None,
    found: Found,
    tables: dict[Path, Table],
    chosen: Chosen,
) -> tuple[tuple[RunSection, ...], list[str]]:
    """Return the runs: the file and those beside it; two thirds and one third of it where none validates."""
    own = RunSection(file=path.name, sheet=chosen.sheet, use="estimation")
    beside = [(use, Path(file)) for use, file in chosen.runs]
    beside += [] if validation is None else [("validation", Path(validation))]
    files = [(use, file if file in tables else _table_file(file, use)) for use, file in beside]
    runs = [
        RunSection(file=str(file), sheet=chosen.sheet if suffix_of(file) in WORKBOOKS else None, use=use)
        for use, file in files
    ]
    if chosen.whole or any(run.use == "validation" for run in runs):
        return (own, *runs), []
    clocks = table.clocks(list(found)) if chosen.sample_time is not None else None
    if chosen.sample_time is None or clocks is None or one_clock(clocks[0]):
        n = len(table.read(next(iter(found)))[0])
    else:
        n = grid_of(clocks[0], [signal.role == "input" for _, signal in found.values()], chosen.sample_time)[1]
    cut = 2 * n // 3
    if cut < 1:
        return (own, *runs), []
    note = f"no validation file: rows {cut} to {n} of {path.name}, its last third, validate"
    return (
        msgspec.structs.replace(own, rows=(0, cut)),
        msgspec.structs.replace(own, use="validation", rows=(cut, n)),
        *runs,
    ), [note]


def _table_file(file: Path, use: str) -> Path:
    """Return the whole path of a further file; refuse one that is no table."""
    if suffix_of(file) not in FORMATS and not is_bag_folder(file):
        raise InputError(
            f"{use} file",
            expected=f"a file that ends in {' or '.join(FORMATS)}",
            got=file.name,
            remedy="give a file with the same columns",
            file=file,
        )
    return file.resolve()
