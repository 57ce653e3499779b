"""One table as a whole data set: its columns carry the names of the model's ports, or the caller names them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec

from harness.data.chosen import Chosen
from harness.data.headers import split_header
from harness.data.ports import Ports, located_model, ports_of
from harness.data.sections import Description, NominalSection, RunSection, SignalSection, TimeSection
from harness.data.tables import FORMATS, REFERENCE, Table, open_table, suffix_of
from harness.data.trajectories import stored_spec
from harness.errors import InputError
from harness.signals import Channel

__all__ = ["describe_bare"]


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

    Parameters
    ----------
    chosen : Chosen
        What the caller says of the columns. The names are those of the model's ports where there is a model that has
        some, else those that the caller chose as inputs and outputs.

    Raises
    ------
    InputError
        If neither a model nor the caller says which columns are meant, or a column is not there.
    """
    table = open_table(path, tables)
    known = _known_ports(path, model, ports)
    if known is None or chosen.outputs is not None or chosen.inputs is not None:
        signals, said = chosen.sections(table, ported=known is not None)
        notes += said
    else:
        signals = _signals(table, known, path, notes, chosen)
    runs, second = _runs(path, table, validation, next(iter(signals)), tables, chosen)
    notes += second
    nominal = NominalSection(model=model) if model is not None else None
    names = [split_header(title)[0] for title in table.titles]
    clock = chosen.columns.get("time") or _clock(names)
    unit = chosen.units.get("time")
    time = TimeSection(column=clock, unit=unit) if unit or clock not in ("", "time", *signals) else None
    described = Description(
        name=path.stem, signals=signals, runs=runs, nominal=nominal, time=time, sample_time=chosen.sample_time
    )
    return described, known


def _known_ports(
    path: Path, model: str | None, ports: tuple[Sequence[Channel], Sequence[Channel]] | None
) -> Ports | None:
    """Return the ports that name the columns of a file; None where only the caller can."""
    if ports is not None:
        return Ports(tuple(ports[0]), tuple(ports[1]), model or "the model", rates=False)
    if model is not None and (found := ports_of(located_model(model, Path.cwd()), {})) is not None:
        return found
    stored = stored_spec(path)
    return None if stored is None else Ports(stored.inputs, stored.outputs, path.name, rates=False)


def _signals(table: Table, ports: Ports, path: Path, notes: list[str], chosen: Chosen) -> dict[str, SignalSection]:
    """Return a signal for every column that carries the name of a port or of its rate, or was said to be one."""
    signals: dict[str, SignalSection] = {}
    inputs = {channel.name: channel for channel in ports.inputs}
    outputs = {channel.name: (channel, 0) for channel in ports.outputs}
    for channel in ports.outputs if ports.rates else ():
        outputs.setdefault(Ports.channel_name(channel.name, 1), (channel, 1))
    chosen.refuse_unused((*inputs, *outputs, "time"))
    said: dict[str | None, str] = {}
    for name, given in chosen.columns.items():
        if (found := table.find(given)) is None:
            raise table.missing(given)
        said[found] = name
    # tau_1 is as good as tau1
    plain = {port.replace("_", ""): port for port in inputs}
    bare = {name.replace("_", ""): name for name in outputs}
    names = {split_header(title)[0]: title for title in table.titles}
    clock = names.get(_clock(list(names)), "")
    ignored = []
    for title in table.titles:
        name = said.get(title, split_header(title)[0])
        if title not in said and name in chosen.columns:
            name = ""  # another column was said to be this one
        # a unit in the title stays there: a validation file may state another one
        unit = chosen.units.get(name)
        column: str | None = title if title in said else None
        if name.startswith(REFERENCE):
            signals[name] = SignalSection(role="reference")
            continue
        flat = name.replace("_", "")
        port = name if name in inputs else "" if name in outputs else plain.get(flat, "")
        measured = "" if port else name if name in outputs else bare.get(flat, "")
        if port:
            unit = unit or _plain_number(inputs[port], split_header(title)[1])
            signals[name] = SignalSection(role="input", port=None if port == name else port, unit=unit, column=column)
        elif measured:
            channel, derivative = outputs[measured]
            unit = unit or (None if derivative else _plain_number(channel, split_header(title)[1]))
            signals[name] = SignalSection(
                role="output", port=channel.name, derivative=derivative, unit=unit, column=column
            )
        elif name != "time" and title != clock:
            ignored.append(title)
    if not any(signal.role == "output" for signal in signals.values()):
        raise InputError(
            f"no column is an output of {ports.model}",
            expected=f"a column named {' or '.join(map(str, ports.outputs[:6]))}",
            got=", ".join(table.titles[:12]),
            remedy=f"say which column it is (--column {ports.outputs[0].name}=TITLE), choose another --model, "
            "or write a dataset.toml",
            file=path,
        )
    if ignored:
        notes.append(f"columns that are no ports of {ports.model} are ignored: {', '.join(ignored[:8])}")
    return signals


def _plain_number(channel: Channel, stated: str | None) -> str | None:
    """Return the unit of a column whose title states none: that of a port that is a plain number, else unknown."""
    return "1" if stated is None and channel.unit == "1" else None


def _clock(names: Sequence[str]) -> str:
    """Return the name of the time column, empty if there is none: time or t, else the same with capitals."""
    for wanted in ("time", "t", "timestamp"):
        found = [name for name in names if name == wanted] or [name for name in names if name.lower() == wanted]
        if len(found) == 1 or wanted in found:
            return found[0]
    return ""


def _runs(
    path: Path,
    table: Table,
    validation: str | Path | None,
    first: str,
    tables: dict[Path, Table],
    chosen: Chosen,
) -> tuple[tuple[RunSection, ...], list[str]]:
    """Return the runs: the file and those beside it; two thirds and one third of it where none validates."""
    own = RunSection(file=path.name, use="estimation")
    beside = [(use, Path(file)) for use, file in chosen.runs]
    beside += [] if validation is None else [("validation", Path(validation))]
    runs = [RunSection(file=str(file if file in tables else _table_file(file, use)), use=use) for use, file in beside]
    if chosen.whole or any(run.use == "validation" for run in runs):
        return (own, *runs), []
    n = len(table.read(chosen.columns.get(first, first))[0])
    cut = 2 * n // 3
    if cut < 1:
        return (own, *runs), []
    note = f"no validation file: rows {cut} to {n} of {path.name}, its last third, validate"
    return (
        msgspec.structs.replace(own, rows=(0, cut)),
        RunSection(file=path.name, use="validation", rows=(cut, n)),
        *runs,
    ), [note]


def _table_file(file: Path, use: str) -> Path:
    """Return the whole path of a further file; refuse one that is no table."""
    if suffix_of(file) not in FORMATS:
        raise InputError(
            f"{use} file",
            expected=f"a file that ends in {' or '.join(FORMATS)}",
            got=file.name,
            remedy="give a file with the same columns",
            file=file,
        )
    return file.resolve()
