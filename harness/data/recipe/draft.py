"""A dataset.toml drafted from files of data: what they state is written down, what they do not state is asked."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import takewhile
from pathlib import Path

from harness.data.conditioning.timebase import SHORTEST
from harness.data.recipe.chosen import NOTHING
from harness.data.recipe.contents import ChannelContent, Contents, contents_of
from harness.data.recipe.description import OPEN
from harness.data.recipe.ports import Ports, located_model, ports_of, rate_unit
from harness.data.tables.headers import stated_unit
from harness.data.trajectories import stored_spec
from harness.errors import InputError
from harness.signals import Channel, stated_categories
from harness.units import fits

_CURRENT = ", as REP 103 has it; some drivers write a current"
_JOINT = re.compile(r"\.(?P<list>position|velocity|effort)\[(?P<joint>[^\]]+)\]$")


def draft_dataset(
    files: Sequence[str | Path],
    *,
    model: str | None = None,
    folder: Path | None = None,
    sheet: str | None = None,
    inputs: Sequence[str] = (),
    outputs: Sequence[str] = (),
) -> str:
    r"""Return the text of a dataset.toml for files of data, with a question as a comment where something is open.

    Parameters
    ----------
    files : sequence of path
        One for each run; the first one's channels count.
    model : str, optional
        Nominal model: columns that carry the names of its ports get them.
    folder : Path, optional
        Where the text will stand; files are named from there.
    sheet : str, optional
        Of the workbooks.
    inputs, outputs : sequence of str
        Names or columns of channels whose titles are no ports of the model; it is then asked which port each is. What
        is neither said nor a port becomes a comment.

    Raises
    ------
    InputError
        If a file cannot be read, holds no such channel, or one is said to be the input that is the model's output.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     log = Path(folder) / "log.csv"
    ...     _ = log.write_text("time [s],u [V],y\n0,1,2\n1,2,3\n")
    ...     text = draft_dataset([log])
    >>> [line for line in text.splitlines() if line.startswith("[")]
    ['[time]', '[signals."u"]', '[signals."y"]', '[[runs]]']
    """
    paths = [Path(file) for file in files]
    found = [contents_of(path, sheet) for path in paths]
    first = found[0]
    ports = None if model is None else ports_of(located_model(model, Path.cwd()), {})
    alike = {} if ports is None else _alike(first, ports)
    if ports is not None and alike:
        ports = replace(ports, joints={one: ports.joints[own] for one, own in alike.items()})
    known = stored_spec(paths[0], [one.column for one in first.channels])
    if known is not None and not (inputs or outputs):
        inputs, outputs = [one.name for one in known.inputs], [one.name for one in known.outputs]
    roles = _roles(first, ports, inputs, outputs)
    lines = [f"name = {_quoted(paths[0].stem)}", *_clock(first, ports), ""]
    if alike:
        lines += ["# joints are those of the model but for a prefix: {} is {}, and so on".format(*alike.popitem()), ""]
    lines += [] if model is None else ["[nominal]", f"model = {_quoted(model)}", ""]
    lines += [] if model is not None else ['# [nominal] model = "..."  # your model of the machine, if any', ""]
    lines += _signals(first, ports, roles)
    if ports is not None:
        lines += _lacking(first, ports, roles)
    for number, path in enumerate(paths):
        name = path if folder is None else _from(path, folder)
        lines += _runs(number, str(name), found, ports, sheet)
    return "\n".join(lines)


def _roles(first: Contents, ports: Ports | None, inputs: Sequence[str], outputs: Sequence[str]) -> dict[str, str]:
    """Return by column the role that was said.

    Raises InputError if there is no such channel, it is said twice, or has the name of a port of the other role.
    """
    roles: dict[str, str] = {}
    for role, names in (("input", inputs), ("output", outputs)):
        for name in names if list(names) != [NOTHING] else ():
            found = [one for one in first.channels if name == one.column]
            found = found or [one for one in first.channels if name == one.name]
            if len(found) != 1 or found[0].column in roles:
                raise InputError(
                    f"no column {name!r}" if not found else f"{name!r} means two columns or is said twice",
                    expected=f"one of {', '.join(repr(one.column) for one in first.channels[:12])}, each once",
                    got=repr(name),
                    remedy="correct the name",
                    place=f"--{role}",
                )
            match = None if ports is None else _port(found[0], ports)
            if match is not None and match[1] != role:
                raise InputError(
                    f"{name!r} as an {role}", expected=f"{match[1]}, as the model has it", got=role,
                    remedy="leave it out, or rename the column", place=f"--{role}",
                )  # fmt: skip
            roles[found[0].column] = role
    return roles


def _signals(first: Contents, ports: Ports | None, roles: Mapping[str, str]) -> list[str]:
    """Return the tables of all channels; of those that share a name the first, the others as comments."""
    lines: list[str] = []
    named: set[str] = set()
    for channel in first.channels:
        table = _signal(channel, ports, roles)
        if channel.name in named and not table[0].startswith("# "):
            said = f"# another column is called {channel.name} too: to use it, give its signal a name of its own"
            table = [said, *(f"# {line}" if line else "" for line in table)]
        named.add(channel.name)
        lines += table
    return lines


def _runs(number: int, name: str, found: Sequence[Contents], ports: Ports | None, sheet: str | None) -> list[str]:
    """Return the runs of a file: one alone is divided where it is long enough."""
    first, own = found[0], found[number]
    rows = _grid_rows(first, ports) if first.clock is None and first.length is not None else first.rows
    cut = 2 * rows // 3
    divided = len(found) == 1 and rows - cut >= SHORTEST
    uses = ("estimation", "validation") if divided else ("estimation" if number == 0 else "validation",)
    lines = ["# one record only: its last third is kept for validation (a second record is better)"] if divided else []
    for use in uses:
        lines += ["[[runs]]", f"file = {_quoted(name)}", f'use = "{use}"']
        if own.sheet is not None:
            asked = "" if sheet is not None else "  # first sheet with numbers; or another?"
            lines.append(f"sheet = {_quoted(own.sheet)}{asked}")
        if divided:
            lines.append(f"rows = {[0, cut] if use == uses[0] else [cut, rows]}")
        notes = own.notes if use == uses[0] and own.clock is not None else ()
        lines += [f"# {note}" for note in notes] + [""]
    return lines


def _used(found: Contents, ports: Ports | None) -> list[tuple[ChannelContent, str]]:
    """Return the channels that the model has a port for, with their roles; all, as outputs, where it has none."""
    matches = [] if ports is None else [(channel, _port(channel, ports)) for channel in found.channels]
    used = [(channel, match[1]) for channel, match in matches if match is not None]
    return used or [(channel, "output") for channel in found.channels]


def _grid_rows(found: Contents, ports: Ports | None) -> int:
    """Return how many samples the drafted grid has: from the last channel to begin to the first output to end."""
    used = _used(found, ports)
    if _one_topic(used):  # its messages are rows
        return used[0][0].rows
    ends = [channel.end or 0.0 for channel, role in used if role == "output"] or [used[0][0].end or 0.0]
    shared = min(ends) - max(channel.begin or 0.0 for channel, _ in used)
    return int(shared / _slowest(found, ports) + 1e-6) + 1 if shared > 0.0 else 0


def _one_topic(used: Sequence[tuple[ChannelContent, str]]) -> bool:
    """Return True for channels that share one clock."""
    return len({(channel.begin, channel.end, channel.rows) for channel, _ in used}) == 1


def _slowest(found: Contents, ports: Ports | None) -> float:
    """Return the usual step [s] of the slowest channel with a clock of its own that is used."""
    return float(f"{max(channel.every or 0.0 for channel, _ in _used(found, ports)):.4g}")


def _clock(found: Contents, ports: Ports | None) -> list[str]:
    """Return the lines about time."""
    if found.clock is None and found.length is not None:
        step = _slowest(found, ports)
        if _one_topic(_used(found, ports)):
            return [f"# steps of {step:.4g} s; [resample] sample_time is for stamps that are no clock's"]
        return [
            "",
            "[resample]  # each channel has its own time stamps: hold inputs, interpolate outputs",
            f"sample_time = {step:.4g}  # [s] step of the slowest channel; or another?",
            'method = "linear"  # or "cubic"',
        ]
    if found.clock is None:
        return [f'sample_time = "{OPEN}"  # [s] no time column found: enter it, or name the column under [time]']
    rate = "" if found.sample_time is None else f"  # steps of {found.sample_time:.6g} s over {found.length:.6g} s"
    lines = []
    slow = [channel for channel in found.channels if 2 * channel.empty >= channel.rows > channel.empty]
    if found.rough:
        lines += [f"# sample_time = {found.sample_time:.6g}  # [s] time stamps jitter: was this the fixed rate?"]
    if (found.holes or found.back) and not slow:
        what = f"{found.holes} holes" if found.holes else ""
        what += f"{' and ' if what else ''}{found.back} rows where time runs back" if found.back else ""
        lines += [f'# gaps = "split"  # {what}: start a new run there?']
    if stands := found.unsteady - found.back:
        lines += [f'# duplicates = "first"  # {stands} rows have the time of the row before: keep first, last or mean?']
    if slow:
        every = max(channel.every or 0.0 for channel in slow)
        names = ", ".join(channel.name for channel in slow[:4])
        lines += [
            '# intersample = "zoh"  # inputs constant between samples?',
            "",
            f"# [resample]  # {names} logged less often: resample all to one rate?",
            f"# sample_time = {every:.4g}  # [s]",
        ]
    lines += ["", "[time]", f"column = {_quoted(found.clock)}{rate}"]
    if found.unlikely:
        lines.append(f'unit = "{OPEN}"  # no unit in the title, seconds unlikely: s, ms, us, ns or d?')
    elif not found.clock_stated:
        lines.append('unit = "s"  # no unit in the title: s, ms, us or ns?')
    return lines


def _signal(channel: ChannelContent, ports: Ports | None, roles: Mapping[str, str]) -> list[str]:
    """Return the table of one channel; as a comment where it holds no numbers, or nobody has asked for it."""
    head = f"[signals.{_quoted(channel.name)}]"
    if channel.note and channel.minimum is None:
        return [f"# {' '.join(channel.column.split())}: {channel.note}", ""]
    sizes = _sizes(channel)
    match = None if ports is None else _port(channel, ports)
    said = roles.get(channel.column)
    if ports is not None and match is None and not roles:
        near = _fitting(channel, ports)
        lines = [head, f'role = "{OPEN}"{sizes}', f"column = {_quoted(channel.column)}"]
        lines.append(f"# which input or output of {ports.model}? unit fits: {near}; delete this if none")
        return [*("# " + line if not line.startswith("# ") else line for line in lines), ""]
    if match is not None and ports is not None:
        port, role, derivative = match
        lines = [head, f'role = "{role}"{sizes}', f"column = {_quoted(channel.column)}"]
        lines += [f"port = {_quoted(port.name)}"] if port.name != channel.name else []
        lines += [f"derivative = {derivative}"] if derivative else []
    elif said is not None:
        lines = [head, f'role = "{said}"{sizes}', f"column = {_quoted(channel.column)}"]
        if ports is not None:
            near = _fitting(channel, ports, said)
            lines.append(f'port = "{OPEN}"  # which {said} of {ports.model}? unit fits: {near}')
    elif roles:
        return [f"# {channel.column}: not used{sizes}", ""]
    else:
        lines = [head, f'role = "{OPEN}"  # "input", "output" or "reference"?{sizes.replace("  #", "")}']
        lines.append(f"column = {_quoted(channel.column)}")
    lines += _names(channel) if ports is None else []
    lines += _unit(channel, match)
    return [*lines, ""]


def _unit(channel: ChannelContent, match: tuple[Channel, str, int] | None) -> list[str]:
    """Return what says in which unit a channel is whose title states none, or asks for it."""
    own = "" if match is None else rate_unit(match[0].unit, match[2])
    if channel.unit or (match is not None and stated_unit(channel.column, own)):
        return []
    joint = None if match is None else _JOINT.search(channel.name)
    if joint and joint["list"] != "effort":
        return [f'unit = "{own}"  # as REP 103 has it']
    wanted = f" (model: {own}{_CURRENT if joint else ''})" if own else ""
    return [f'unit = "{OPEN}"  # no unit in the title: which one{wanted}?']


def _sizes(channel: ChannelContent) -> str:
    """Return the remark on what the numbers of a channel are."""
    unit = channel.unit if stated_categories(channel.unit) is None else ""
    sizes = "" if channel.minimum is None else f"  # {channel.minimum:.4g} to {channel.maximum:.4g} {unit}".rstrip()
    return sizes + (f"{',' if sizes else '  #'} {channel.empty} rows empty" if channel.empty else "")


def _names(channel: ChannelContent) -> list[str]:
    """Return what says that the numbers of a channel are names, or asks whether they are."""
    count = stated_categories(channel.unit)
    if count is not None:
        return [f"categories = {count}  # numbers that are names, as the title says"]
    if not channel.names or channel.unit not in ("", "1"):
        return []
    last = channel.maximum or 0.0
    return [f'# categories = {last + 1:.0f}  # whole numbers 0 to {last:.0f}: codes of states (unit = "1")?']


def _port(channel: ChannelContent, ports: Ports) -> tuple[Channel, str, int] | None:
    """Return the port whose name a channel carries, with role and derivative."""
    joint = _JOINT.search(channel.name)
    if joint is not None and joint["joint"] in ports.joints:  # what ROS calls the three lists of a JointState
        drive, angle = ports.joints[joint["joint"]]
        if joint["list"] == "effort":
            return ports.find(drive, "input"), "input", 0
        return ports.find(angle, "output"), "output", int(joint["list"] == "velocity")
    for role, group in (("input", ports.inputs), ("output", ports.outputs)):
        for port in group:
            for derivative in (0, 1, 2) if role == "output" else (0,):
                name = Ports.channel_name(port.name, derivative)
                loose = stated_unit(channel.column, rate_unit(port.unit, derivative))
                if channel.name in (name, name.replace("_", "")) or (loose is not None and loose[0] == name):
                    return port, role, derivative
    return None


def _alike(first: Contents, ports: Ports) -> dict[str, str]:
    """Return the joints of a model by those of a log where they differ by one prefix only; nothing if others may."""
    logged = dict.fromkeys(found["joint"] for one in first.channels if (found := _JOINT.search(one.name)))
    if set(logged) & set(ports.joints):
        return {}
    ways: list[dict[str, str]] = []
    for one in logged:
        for own in ports.joints:
            shared = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(one[::-1], own[::-1], strict=False)))
            prefix, other = one[: len(one) - shared], own[: len(own) - shared]
            pairs = {name: other + name.removeprefix(prefix) for name in logged if name.startswith(prefix)}
            pairs = {name: joint for name, joint in pairs.items() if joint in ports.joints}
            if len(pairs) == len(ports.joints) and pairs not in ways:
                ways.append(pairs)
    return ways[0] if len(ways) == 1 else {}


def _fitting(channel: ChannelContent, ports: Ports, role: str | None = None) -> str:
    """Return the ports, of this role, whose unit a channel's fits, or none."""
    near = []
    for port in (*(ports.inputs if role != "output" else ()), *(ports.outputs if role != "input" else ())):
        for derivative in (0, 1, 2) if port in ports.outputs else (0,):
            try:
                if channel.unit and fits(channel.unit, rate_unit(port.unit, derivative)):
                    near.append(str(port) if derivative == 0 else f"{port.name} with derivative = {derivative}")
            except InputError:
                continue
    return ", ".join(near) or "none"


def _lacking(found: Contents, ports: Ports, roles: Mapping[str, str]) -> list[str]:
    """Return a question for each input of the model that no channel gives; none where as many are said to be inputs."""
    matches = {channel.column: _port(channel, ports) for channel in found.channels}
    given = {match[0].name for match in matches.values() if match is not None}
    lacking = [port for port in ports.inputs if port.name not in given]
    said = [column for column, role in roles.items() if role == "input" and matches[column] is None]
    return [
        f"# which column is {port}, an input of {ports.model}? If it was zero all the time: undriven = "
        f"[{_quoted(port.name)}] above the first table"
        for port in (lacking if len(said) < len(lacking) else ())
    ] + [""]


def _from(path: Path, folder: Path) -> Path:
    """Return a path as it is named from a folder."""
    try:
        return path.resolve().relative_to(folder.resolve())
    except ValueError:
        return path.resolve()


def _quoted(text: str) -> str:
    """Return a text as TOML writes it."""
    return json.dumps(text, ensure_ascii=False)
