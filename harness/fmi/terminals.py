"""Terminals of FMUs (FMI 3.0, Terminals and Icons): groups of variables that are connected by one name."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.errors import InputError
from harness.fmi.archive import has_document_type
from harness.trust import UNZIPPING

ENTRY = "terminalsAndIcons/terminalsAndIcons.xml"
LARGEST, DEEPEST = 16 << 20, 32  # Bytes of the entry, and levels of terminals within terminals, that are read.
KINDS = ("signal", "inflow", "outflow")
RULES = ("plug", "bus", "sequence")  # Matching rules of the standard; any other one is its author's own.


@dataclass(frozen=True)
class Terminal:
    """A terminal of an FMU."""

    name: str
    rule: str
    """``plug`` (the members of both ends have the same names), ``bus`` (those that both have are connected),
    ``sequence`` (in their order), or a rule of its author's."""
    kind: str | None  # ``terminalKind``; ends of different kinds do not fit
    members: tuple[tuple[str, str, str], ...]
    """Tuple of (str, str, str): Names of the member and of its variable, and ``signal``, ``inflow`` or ``outflow``; a
    stream is ``stream``."""
    inner: tuple[Terminal, ...] = ()


@dataclass(frozen=True)
class Joined:
    """Two variables that a connection of terminals joins: the gain turns a flow out of one end into one into the other.

    ``place`` is the member's name, that of terminals around it before it.
    """

    first: str
    second: str
    gain: float
    place: str


def read_terminals(path: str | Path) -> dict[str, Terminal]:
    """Return the terminals of an FMU by name, those within others as ``outer.inner`` as well.

    Raises InputError if the entry is no XML of terminals.

    - ``path``: the FMU; one without terminals has none

    Examples
    --------
    >>> from plants.mockups import mockup
    >>> read_terminals(mockup("pendulum"))
    {}
    """
    try:
        with zipfile.ZipFile(path) as archive:
            if ENTRY not in archive.namelist():
                return {}
            size = archive.getinfo(ENTRY).file_size
            text = archive.read(ENTRY) if size <= LARGEST else b""
    except UNZIPPING as error:
        raise _refused(path, "an entry that can be unpacked", str(error)) from error
    if not text:
        raise _refused(path, f"at most {LARGEST >> 20} MiB, and something in it", f"{size} bytes")
    if has_document_type(text):
        raise _refused(path, "no document type", "a DOCTYPE")
    from lxml import etree

    try:
        parser = etree.XMLParser(resolve_entities=False, no_network=True, remove_comments=True, remove_pis=True)
        root = etree.fromstring(text, parser)
    except etree.XMLSyntaxError as error:
        raise _refused(path, "XML", str(error)) from error
    found: dict[str, Terminal] = {}
    for element in root.iterfind("./Terminals/Terminal"):
        for name, terminal in _all(_terminal(path, element, 0), ""):
            if name in found:
                raise _refused(path, "terminals with names of their own", f"two called {name!r}")
            found[name] = terminal
    return found


def joined(first: Terminal, second: Terminal, place: str = "") -> list[Joined]:
    """Return which variables a connection of two terminals joins, by the matching rule that both have (FMI 3.0).

    Raises InputError if their rules or kinds differ, the rule is its author's own, the members do not match, or one is
    a stream.

    Examples
    --------
    >>> flange = Terminal("flange", "plug", None, (("phi", "angle", "signal"), ("tau", "torque", "inflow")))
    >>> shaft = Terminal("shaft", "plug", None, (("tau", "load", "inflow"), ("phi", "turned", "signal")))
    >>> [(one.first, one.second, one.gain) for one in joined(flange, shaft)]
    [('angle', 'turned', 1.0), ('torque', 'load', -1.0)]
    """
    where = f"{place}.{first.name}".strip(".")
    if first.rule != second.rule or first.rule not in RULES:
        raise _unfit(where, f"one matching rule of {', '.join(RULES)}", f"{first.rule!r} and {second.rule!r}")
    if first.kind != second.kind and None not in (first.kind, second.kind):
        raise _unfit(where, "one terminal kind", f"{first.kind!r} and {second.kind!r}")
    pairs = _paired([name for name, _, _ in first.members], [name for name, _, _ in second.members], first.rule, where)
    found = []
    for a, b in pairs:
        (name, one, kind), (_, other, others) = first.members[a], second.members[b]
        if "stream" in (kind, others) or (kind == "signal") != (others == "signal"):
            raise _unfit(f"{where}.{name}", "two signals or two flows", f"{kind} and {others}")
        # what flows into one end flows out of the other: the sum of all flows into a connection is 0
        found.append(Joined(one, other, -1.0 if kind == others != "signal" else 1.0, f"{where}.{name}"))
    for a, b in _paired([t.name for t in first.inner], [t.name for t in second.inner], first.rule, where):
        found += joined(first.inner[a], second.inner[b], where)
    return found


def _paired(first: Sequence[str], second: Sequence[str], rule: str, where: str) -> Iterator[tuple[int, int]]:
    """Yield the places of members of two ends that belong together."""
    if rule == "sequence":
        if len(first) != len(second):
            raise _unfit(where, "as many members at both ends", f"{len(first)} and {len(second)}")
        yield from enumerate(range(len(first)))
        return
    alone = sorted(set(first) ^ set(second))
    if rule == "plug" and alone:
        raise _unfit(where, "the same members at both ends (matching rule 'plug')", f"{', '.join(alone)} at one only")
    yield from ((a, second.index(name)) for a, name in enumerate(first) if name in second)


def _terminal(path: str | Path, element: Any, depth: int) -> Terminal:
    """Return one terminal of the XML."""
    if depth > DEEPEST:
        raise _refused(path, f"at most {DEEPEST} terminals within each other", "more")
    name, inner = element.get("name"), []
    members: list[tuple[str, str, str]] = []
    for child in element:
        if child.tag == "TerminalMemberVariable":
            kind = child.get("variableKind") or "signal"
            if kind not in KINDS:
                raise _refused(path, f"a variableKind of {', '.join(KINDS)} at {name}", repr(kind))
            # without a name of its own (matching rule 'sequence') a member is called by its variable
            variable = child.get("variableName") or ""
            members.append((child.get("memberName") or variable, variable, kind))
        elif child.tag == "TerminalStreamMemberVariable":
            variable = child.get("inStreamVariableName") or ""
            members.append((child.get("inStreamMemberName") or variable, variable, "stream"))
        elif child.tag == "Terminal":
            inner.append(_terminal(path, child, depth + 1))
    if not name or any(not text for member in members for text in member):
        raise _refused(path, "a name of each terminal and a variable of each member", f"none at {name or 'one'}")
    rule = element.get("matchingRule") or "none"
    names = [member for member, _, _ in members]
    if len(set(names)) < len(names) and rule != "sequence":
        raise _refused(path, f"members of {name} with names of their own", f"{', '.join(names)}"[:80])
    return Terminal(name, rule, element.get("terminalKind"), tuple(members), tuple(inner))


def _all(terminal: Terminal, before: str) -> Iterator[tuple[str, Terminal]]:
    """Yield a terminal and those within it by their whole names."""
    name = f"{before}{terminal.name}"
    yield name, terminal
    for one in terminal.inner:
        yield from _all(one, f"{name}.")


def _refused(path: str | Path, expected: str, got: str) -> InputError:
    remedy = "connect the variables one by one, or export it again"
    return InputError("terminals of the FMU", expected=expected, got=got, remedy=remedy, file=path, place=ENTRY)


def _unfit(where: str, expected: str, got: str) -> InputError:
    remedy = "connect the variables one by one"
    return InputError("terminals that do not fit", expected=expected, got=got, remedy=remedy, place=where)
