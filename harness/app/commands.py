"""From what was chosen on the page to the words of a command line: what is run, and what a person may copy."""

from __future__ import annotations

import os
import shlex
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec

from harness.app.reach import SessionFiles
from harness.errors import InputError
from harness.trust import names_fmu

LINEAR = "linear"
"""What a closed loop starts from where no physical model is chosen."""


class LogColumn(msgspec.Struct, forbid_unknown_fields=True):
    """What a column of the log is."""

    title: str
    use: Literal["", "time", "input", "output"] = ""
    port: str = ""
    """Name of the model's port; empty without a model that has ports."""
    unit: str = ""
    """Where the title states none, or another is meant."""


class Choice(msgspec.Struct, forbid_unknown_fields=True):
    """What was chosen on the page."""

    task: Literal["close-loop", "identify", "check-data"]
    log: str
    columns: list[LogColumn] = msgspec.field(default_factory=list)
    sample_time: float | None = None
    validation: str = ""
    model: str = ""
    trusted: bool = False
    undriven: list[str] = msgspec.field(default_factory=list)
    identifier: str = ""
    options: list[str] = msgspec.field(default_factory=list)


def read_choice(text: bytes) -> Choice:
    """Return what the page sent.

    Raises
    ------
    InputError
        If it is no choice.
    """
    try:
        return msgspec.json.decode(text, type=Choice)
    except (msgspec.ValidationError, msgspec.DecodeError) as error:
        raise InputError(
            "what was chosen", expected="a choice as the page makes it", got=str(error), remedy="reload the page"
        ) from error


def words(choice: Choice, reach: SessionFiles, *, shown: bool = False) -> list[str]:
    """Return the words of the command, without ``sysid`` and ``--out``.

    Parameters
    ----------
    choice : Choice
    reach : Reach
        Every file is looked up there.
    shown : bool
        True for a person: an FMU need not be trusted yet, paths are as short as the working folder allows, and an
        uploaded file that goes with the session is called by its name, to be run where it came from.

    Raises
    ------
    InputError
        If a file is out of reach, no log or output is chosen, or an FMU is not trusted.
    """
    log = reach.path(choice.log)

    def place(path: Path) -> str:
        if not shown:
            return _whole(path)
        uploaded = path.is_relative_to(reach.work) and not reach.stays
        return _no_option(path.name) if uploaded else _shortened(path)

    found = [choice.task, place(log)]
    if log.suffix == ".toml":
        reach.runs_within(log)
    model = choice.model or (LINEAR if choice.task == "close-loop" and log.suffix != ".toml" else "")
    is_file = model != "" and not _registered(model)
    if is_file:
        path = reach.path(model)
        model = place(path)
    if model:
        found += _flag("--model", model)
    if log.suffix != ".toml":
        found += _columns(choice, None if model in ("", LINEAR) else matched(log, _whole(path) if is_file else model))
        if choice.validation:
            found += _flag("--validation", place(reach.path(choice.validation)))
    for name in choice.undriven:
        found += _flag("--undriven", name)
    if choice.task == "identify":
        _refuse_code(choice, log)
        found += _flag("--identifier", choice.identifier) if choice.identifier else []
        for option in choice.options:
            found += _flag("--option", option)
    if is_file and names_fmu(model) and choice.task != "check-data":
        if not choice.trusted and not shown:
            raise InputError(
                "an FMU is machine code",
                expected="a model that you trust, as --trust on the command line says",
                got=f"{Path(model).name}, which is not trusted yet",
                remedy="tick 'I trust this FMU' if you know where it comes from",
            )
        found += _flag("--trust", model)
    return found


def _refuse_code(choice: Choice, log: Path) -> None:
    """Refuse options that name code or a file out of the log's folder: there is no question of trust for these.

    Raises
    ------
    InputError
        With the option.
    """
    from harness.trust import registered_only

    for option in choice.options:
        registered_only(option.partition("=")[2], file=log, place=f"--option {option}", options=True)


def spoken(given: Sequence[str]) -> str:
    """Return a command line as it is typed in the shell of this system.

    Examples
    --------
    >>> spoken(["identify", "my log.csv", "--input", "u"]) if os.name == "posix" else "sysid identify 'my log.csv' --input u"
    "sysid identify 'my log.csv' --input u"
    """  # noqa: E501
    join = shlex.join if os.name == "posix" else subprocess.list2cmdline
    return join(["sysid", *given])


def ports_told(model: str, reach: SessionFiles) -> dict[str, Any]:
    """Return the ports of a model for the page: nothing of an FMU is loaded for it but its description.

    Raises
    ------
    InputError
        If the model is unknown, out of reach, or cannot be read.
    """
    from harness.data.recipe.ports import ports_of

    found = ports_of(model if _registered(model) else _whole(reach.path(model)), {}) if model else None
    if found is None:
        return {"ports": [], "fixed": False}
    ports = [{"name": one.name, "unit": one.unit, "use": "input"} for one in found.inputs]
    ports += [{"name": one.name, "unit": one.unit, "use": "output"} for one in found.outputs]
    return {"ports": ports, "fixed": True}


def stated(titles: Sequence[str], ports: Sequence[Mapping[str, str]]) -> dict[str, dict[str, str]]:
    """Return by title and port the unit that a title states without brackets, where it fits the port.

    Examples
    --------
    >>> stated(["Winkel_deg", "Weg"], [{"name": "theta", "unit": "rad", "use": "output"}])
    {'Winkel_deg': {'theta': 'deg'}}
    """
    from harness.data.tables.headers import stated_unit

    found = {
        title: {one["name"]: parts[1] for one in ports if (parts := stated_unit(title, one["unit"])) is not None}
        for title in titles
    }
    return {title: units for title, units in found.items() if units}


def matched(log: Path, model: str) -> dict[str, tuple[str, str]]:
    """Return by title which columns the command line itself takes for a model's ports: (use, port).

    Empty where it finds no output, and the person has to say.
    """
    from harness.data.recipe.bare import describe_bare
    from harness.data.recipe.chosen import Chosen
    from harness.data.recipe.ports import Ports, ports_of
    from harness.data.tables.table import Table, open_table

    tables: dict[Path, Table] = {}
    ports = ports_of(model, {})
    if ports is None:
        return {}
    try:
        described, _ = describe_bare(
            log, model=model, validation=None, ports=None, notes=[], tables=tables, chosen=Chosen(whole=True)
        )
    except InputError:
        return {}
    table = open_table(log, tables)
    units = {channel.name: channel.unit for channel in (*ports.inputs, *ports.outputs)}
    found: dict[str, tuple[str, str]] = {}
    for name, signal in described.signals.items():
        title = table.find(name, units.get(signal.port or name))
        if title is not None and signal.role in ("input", "output"):
            found[title] = (signal.role, Ports.channel_name(signal.port or name, signal.derivative))
    return found


def _columns(choice: Choice, known: Mapping[str, tuple[str, str]] | None) -> list[str]:
    """Return what is said of the columns.

    ``known`` is what goes without saying: columns that carry the names of the model's ports.
    """
    found: list[str] = []
    used = [one for one in choice.columns if one.use in ("input", "output")]
    if not any(one.use == "output" for one in used):
        raise InputError(
            "which columns are outputs",
            expected="one at least",
            got="none",
            remedy="choose 'output' beside the column that was measured",
        )
    found += _channels(used, known)
    for one in used:
        if one.unit:
            found += _flag("--unit", f"{one.port or _name(one.title)}={one.unit}")
    for one in choice.columns:
        if one.use == "time":
            found += _flag("--column", f"time={one.title}") if one.port == "chosen" else []
            found += _flag("--unit", f"time={one.unit}") if one.unit else []
    if choice.sample_time is not None:
        found += _flag("--sample-time", f"{choice.sample_time:.12g}")
    return found


def _channels(used: Sequence[LogColumn], known: Mapping[str, tuple[str, str]] | None) -> list[str]:
    """Return what is said of inputs and outputs."""
    by_title = {one.title: (one.use, one.port) for one in used}
    if known is not None and all(by_title.get(title) == one for title, one in known.items()):
        return [word for one in used if one.title not in known for word in _flag("--column", f"{one.port}={one.title}")]
    found: list[str] = []
    for one in used:
        found += _flag(f"--{one.use}", one.port or one.title)
        if one.port and known is not None:
            found += _flag("--column", f"{one.port}={one.title}")
    return found if any(one.use == "input" for one in used) else [*found, "--input", "none"]


def _name(title: str) -> str:
    """Return the name that the command line gives a column."""
    from harness.data.tables.headers import split_header

    return split_header(title)[0]


def _registered(model: str) -> bool:
    """Return True for a model of the catalogue."""
    from harness import registry

    return any(entry.id == model for entry in registry.entries("models"))


def _flag(name: str, value: str) -> list[str]:
    """Return an option with its value, in one word where the value begins like an option."""
    return [f"{name}={value}"] if value.startswith("-") else [name, value]


def _whole(path: Path) -> str:
    """Return a path that means the same from any folder."""
    return str(path.absolute())


def _shortened(path: Path) -> str:
    """Return a path from the working folder, if it lies below it."""
    whole = path.absolute()
    if not whole.is_relative_to(Path.cwd()):
        return str(whole)
    return _no_option(str(whole.relative_to(Path.cwd())))


def _no_option(path: str) -> str:
    """Return a path that is not taken for an option."""
    return f".{os.sep}{path}" if path.startswith("-") else path
