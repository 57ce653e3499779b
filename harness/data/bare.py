"""One CSV or Parquet file as a whole data set: its columns carry the names of the model's ports."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec

from harness.data.headers import clock_of, split_header
from harness.data.ports import Ports, located_model, ports_of, rate_unit
from harness.data.sections import Description, NominalSection, RunSection, SignalSection
from harness.data.tables import BARE, REFERENCE, Table, open_table, suffix_of
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
) -> tuple[Description, Ports]:
    """Return the description that a bare file amounts to, and the ports that name its columns.

    Raises
    ------
    InputError
        If no model names the ports, or no column carries the name of one.
    """
    table = open_table(path, tables)
    stored = stored_spec(path)
    if model is None and ports is None and stored is None:
        raise InputError(
            "a bare file without a model",
            expected="--model NAME, whose ports name the columns",
            got="none",
            remedy="add --model, or write a dataset.toml",
            file=path,
        )
    if ports is not None:
        known = Ports(tuple(ports[0]), tuple(ports[1]), model or "the model")
    elif model is not None and (found := ports_of(located_model(model, Path.cwd()), {})) is not None:
        known = found
    elif stored is not None:
        known = Ports(stored.inputs, stored.outputs, path.name)
    else:
        raise InputError(
            f"the model {model} takes any ports",
            expected="a dataset.toml that says which columns are inputs",
            got="a bare table",
            remedy="write a dataset.toml, or use a Parquet file of sysid simulate, which knows",
            file=path,
        )
    signals = _signals(table, known, path, notes)
    name, first = next(iter(signals.items()))
    like = None if first.port is None else known.find(first.port, first.role).unit
    like = None if like is None else rate_unit(like, first.derivative)
    runs, second = _runs(path, table, validation, table.find(name, like) or name, tables)
    notes += second
    nominal = NominalSection(model=model) if model is not None else None
    return Description(name=path.stem, signals=signals, runs=runs, nominal=nominal), known


def _signals(table: Table, ports: Ports, path: Path, notes: list[str]) -> dict[str, SignalSection]:
    """Return a signal for every column that carries the name of a port or of its rate."""
    signals: dict[str, SignalSection] = {}
    units = {channel.name: channel.unit for channel in ports.inputs}
    outputs: dict[str, tuple[str, int]] = {channel.name: (channel.name, 0) for channel in ports.outputs}
    units |= {channel.name: channel.unit for channel in ports.outputs}
    for channel in ports.outputs:
        rate = Ports.channel_name(channel.name, 1)
        outputs.setdefault(rate, (channel.name, 1))
        units.setdefault(rate, rate_unit(channel.unit, 1))
    inputs = {channel.name for channel in ports.inputs}
    # tau_1 is as good as tau1
    plain = {name.replace("_", ""): name for name in units}
    found: dict[str, str] = {}
    for title in table.titles:
        # the unit stays with the title: a validation file may state another one
        name = split_header(title)[0]
        if name in units or name.replace("_", "") in plain:
            found[title] = name
    taken = {plain[name.replace("_", "")] for name in found.values()}
    for title in table.titles:
        if title in found or title.startswith(REFERENCE):
            continue
        for name, unit in units.items():
            if name not in taken and (parts := table.stated(title, unit)) is not None and parts[0] == name:
                found[title] = name
    clock = clock_of(table.titles, found)
    ignored = [
        title
        for title in table.titles
        if title and title not in found and title != clock and not title.startswith(REFERENCE)
    ]
    for title in table.titles:
        if title.startswith(REFERENCE):
            signals[split_header(title)[0]] = SignalSection(role="reference")
        elif title in found:
            name = found[title]
            port = name if name in units else plain[name.replace("_", "")]
            if port in inputs:
                signals[name] = SignalSection(role="input", port=port)
            else:
                signals[name] = SignalSection(role="output", port=outputs[port][0], derivative=outputs[port][1])
    if not any(signal.role == "output" for signal in signals.values()):
        raise InputError(
            f"no column is an output of {ports.model}",
            expected=f"a column named {' or '.join(map(str, ports.outputs[:6]))}",
            got=", ".join(table.titles[:12]),
            remedy="rename the columns, choose another --model, or write a dataset.toml",
            file=path,
        )
    if ignored:
        notes.append(f"columns that are no ports of {ports.model} are ignored: {', '.join(ignored[:8])}")
    return signals


def _runs(
    path: Path, table: Table, validation: str | Path | None, first: str, tables: dict[Path, Table]
) -> tuple[tuple[RunSection, ...], list[str]]:
    """Return the estimation and validation run: two files, or two thirds and one third of one."""
    own = RunSection(file=path.name, use="estimation")
    if validation is not None and Path(validation) in tables:
        return (own, RunSection(file=str(validation), use="validation")), []
    if validation is not None:
        other = Path(validation)
        if suffix_of(other) not in BARE:
            raise InputError(
                "validation file",
                expected=f"a file that ends in {' or '.join(BARE)}",
                got=other.name,
                remedy="give a CSV or Parquet file",
                file=other,
            )
        return (own, RunSection(file=str(other.resolve()), use="validation")), []
    n = len(table.read(first)[0])
    cut = 2 * n // 3
    if cut < 1:
        return (own,), []
    note = f"no validation file: rows {cut} to {n} of {path.name}, its last third, validate"
    return (
        msgspec.structs.replace(own, rows=(0, cut)),
        RunSection(file=path.name, use="validation", rows=(cut, n)),
    ), [note]
