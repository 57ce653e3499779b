"""Terminals of FMUs: one connection for what belongs together, by the matching rules of FMI 3.0."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from harness.cosim import couple
from harness.errors import InputError
from harness.fmi.terminals import ENTRY, Terminal, joined, read_terminals
from harness.parts.files import make_part
from harness.signals import FloatArray
from harness.trust import trusting
from plants.mockups import mockup

HEAD = (
    'sample_time = 0.02\ninputs = { set = "law.r" }\noutputs = ["arm.theta", "law.u"]\n'
    'initial = { "arm.theta" = 0.3 }\n'
    '[parts.arm]\nfmu = "arm.fmu"\n[parts.law]\nfmu = "law.fmu"\noptions = { parameters = { Kp = 0.8, Ki = 0.3 } }\n'
    '[[connections]]\nfrom = "set"\nto = "law.r"\n'
)
BY_HAND = (
    '[[connections]]\nfrom = "arm.theta"\nto = "law.y"\n'
    '[[connections]]\nfrom = "law.u"\nto = "arm.u"\ngain = {gain}\ngain_unit = "N m"\n'
)
JOINED = '[[connections]]\nfrom = "{source}"\nto = "{target}"\n'


def member(variable: str, name: str, kind: str = "signal") -> str:
    named = f'memberName="{name}" ' if name else ""
    return f'<TerminalMemberVariable variableName="{variable}" {named}variableKind="{kind}"/>'


def terminal(name: str, rule: str, *inside: str, kind: str = "") -> str:
    told = f' terminalKind="{kind}"' if kind else ""
    return f'<Terminal name="{name}" matchingRule="{rule}"{told}>{"".join(inside)}</Terminal>'


def with_terminals(model: str, path: Path, *terminals: str) -> None:
    """Write one of our FMUs with terminals."""
    with zipfile.ZipFile(mockup(model)) as old, zipfile.ZipFile(path, "w") as new:
        for entry in old.infolist():
            text = old.read(entry)
            if entry.filename == "modelDescription.xml":  # the law's numbers have no unit: nor has the torque
                text = text.replace(b'<Real unit="N m" start="0" />', b'<Real start="0" />')
            new.writestr(entry, text)
        content = f'<fmiTerminalsAndIcons fmiVersion="3.0"><Terminals>{"".join(terminals)}</Terminals>'
        new.writestr(ENTRY, f'<?xml version="1.0"?>{content}</fmiTerminalsAndIcons>')


Run = Callable[[str], FloatArray]


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """Return what runs a coupling of the pendulum under its law."""

    def made(wires: str) -> FloatArray:
        (tmp_path / "loop.toml").write_text(HEAD + wires)
        with trusting(tmp_path), couple(tmp_path / "loop.toml", make_part) as plant:
            first = plant.reset(rng=np.random.default_rng(0))
            return np.vstack([first, *(plant.step(np.ones(1)) for _ in range(40))])

    return made


@pytest.mark.parametrize(
    ("arm", "law", "gain"),
    [
        (
            terminal("shaft", "plug", member("theta", "phi"), member("u", "tau"), kind="a.shaft"),
            terminal("motor", "plug", member("u", "tau"), member("y", "phi"), kind="a.shaft"),
            1.0,
        ),
        (
            terminal("shaft", "bus", member("theta", "phi"), member("u", "tau"), member("omega", "w")),
            terminal("motor", "bus", member("u", "tau"), member("y", "phi")),
            1.0,
        ),
        (
            terminal("shaft", "sequence", member("theta", ""), member("u", "")),
            terminal("motor", "sequence", member("y", "other"), member("u", "")),
            1.0,
        ),
        (  # what flows into the one flows out of the other
            terminal("shaft", "plug", member("theta", "phi"), member("u", "tau", "inflow")),
            terminal("motor", "plug", member("y", "phi"), member("u", "tau", "inflow")),
            -1.0,
        ),
        (
            terminal("shaft", "plug", member("theta", "phi"), member("u", "tau", "inflow")),
            terminal("motor", "plug", member("y", "phi"), member("u", "tau", "outflow")),
            1.0,
        ),
        (  # terminals within terminals
            terminal("shaft", "plug", terminal("x", "plug", member("theta", "phi")), member("u", "tau")),
            terminal("motor", "plug", terminal("x", "plug", member("y", "phi")), member("u", "tau")),
            1.0,
        ),
    ],
    ids=["plug", "bus", "sequence", "flows", "out and in", "nested"],
)
def test_terminals_join_what_wires_by_hand_do(tmp_path: Path, run: Run, arm: str, law: str, gain: float) -> None:
    with_terminals("pendulum", tmp_path / "arm.fmu", arm)
    with_terminals("pi_controller", tmp_path / "law.fmu", law)
    expected = run(BY_HAND.format(gain=gain).replace('gain_unit = "N m"\n', ""))
    assert np.ptp(expected[:, 0]) > 0.05
    for source, target in (("arm.shaft", "law.motor"), ("law.motor", "arm.shaft")):
        assert np.array_equal(run(JOINED.format(source=source, target=target)), expected)


@pytest.mark.parametrize(
    ("arm", "law", "words"),
    [
        (
            terminal("shaft", "plug", member("theta", "phi"), member("u", "tau"), member("omega", "w")),
            terminal("motor", "plug", member("y", "phi"), member("u", "tau")),
            "the same members at both ends .*, got w at one only",
        ),
        (
            terminal("shaft", "plug", member("theta", "phi")),
            terminal("motor", "bus", member("y", "phi")),
            "one matching rule of plug, bus, sequence, got 'plug' and 'bus'",
        ),
        (
            terminal("shaft", "org.x", member("theta", "phi")),
            terminal("motor", "org.x", member("y", "phi")),
            "'org.x' and 'org.x'",
        ),
        (
            terminal("shaft", "plug", member("theta", "phi"), kind="a"),
            terminal("motor", "plug", member("y", "phi"), kind="b"),
            "one terminal kind, got 'a' and 'b'",
        ),
        (
            terminal("shaft", "sequence", member("theta", ""), member("u", "")),
            terminal("motor", "sequence", member("y", "")),
            "as many members at both ends, got 2 and 1",
        ),
        (
            terminal("shaft", "plug", member("theta", "phi")),
            terminal("motor", "plug", member("y", "phi", "inflow")),
            "two signals or two flows, got signal and inflow",
        ),
        (
            terminal("shaft", "plug", member("theta", "phi")),
            terminal("motor", "plug", member("u", "phi")),
            "an output at one end and an input at the other, got arm.theta and law.u",
        ),
        (terminal("shaft", "plug", member("theta", "phi")), terminal("other", "plug"), "a terminal at both ends"),
        (
            terminal("shaft", "bus", member("theta", "phi")),
            terminal("motor", "bus", member("y", "psi")),
            "a member that both ends have, got none",
        ),
        (terminal("shaft", "plug", member("theta", "x", "volume")), "", "a variableKind of signal, inflow, outflow"),
        (terminal("shaft", "plug", member("theta", "x"), member("u", "x")), "", "members of shaft with names of their"),
        (terminal("shaft", "plug") + terminal("shaft", "plug"), "", "two called 'shaft'"),
        ("<Terminal", "", "terminals of the FMU: expected XML"),
    ],
)
def test_terminals_that_do_not_fit_are_refused(tmp_path: Path, run: Run, arm: str, law: str, words: str) -> None:
    with_terminals("pendulum", tmp_path / "arm.fmu", arm)
    with_terminals("pi_controller", tmp_path / "law.fmu", law)
    with pytest.raises(InputError, match=words) as refused:
        run(JOINED.format(source="arm.shaft", target="law.motor"))
    assert "connect" in str(refused.value)


def test_a_stream_is_refused_by_name(tmp_path: Path) -> None:
    stream = (
        '<TerminalStreamMemberVariable inStreamMemberName="h" outStreamMemberName="g" '
        'inStreamVariableName="theta" outStreamVariableName="omega"/>'
    )
    with_terminals("pendulum", tmp_path / "arm.fmu", terminal("pipe", "plug", stream))
    (pipe,) = read_terminals(tmp_path / "arm.fmu").values()
    with pytest.raises(InputError, match=r"pipe\.h: .*got stream and stream"):
        joined(pipe, pipe)


def test_a_delay_holds_for_all_of_a_terminal_and_a_gain_for_none(tmp_path: Path, run: Run) -> None:
    plug = [("pendulum", "arm", "theta", "u"), ("pi_controller", "law", "y", "u")]
    for model, name, phi, tau in plug:
        ends = terminal("end", "plug", member(phi, "phi"), member(tau, "tau"))
        with_terminals(model, tmp_path / f"{name}.fmu", ends)
    wire = JOINED.format(source="arm.end", target="law.end")
    by_hand = BY_HAND.format(gain=1.0).replace('gain_unit = "N m"\n', "delay = 2\n").replace('y"\n', 'y"\ndelay = 2\n')
    assert np.array_equal(run(wire + "delay = 2\n"), run(by_hand))
    for option in ("gain = 2.0\n", "offset = 1.0\n", "add = true\n"):
        with pytest.raises(InputError, match="no gain, offset or add"):
            run(wire + option)


def test_members_keep_their_order() -> None:
    first = Terminal("a", "sequence", None, (("x", "x", "signal"), ("y", "y", "signal")))
    second = Terminal("b", "sequence", None, (("p", "p", "signal"), ("q", "q", "signal")))
    assert [(one.first, one.second) for one in joined(first, second)] == [("x", "p"), ("y", "q")]


@pytest.mark.parametrize("damage", ["content", "method", "encrypted", "cut"])
def test_an_entry_that_cannot_be_unpacked_is_refused_in_words(damage: str, tmp_path: Path) -> None:
    """zipfile raises another error for each of these; a stream whose bytes were changed was a fault of ours."""
    path = tmp_path / "theirs.fmu"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(ENTRY, "<a>" + "terminals and icons " * 200 + "</a>")
    content = bytearray(path.read_bytes())
    first, head = 30 + len(ENTRY), content.index(b"PK\x01\x02")
    if damage == "content":
        content[first : first + 20] = b"\xff" * 20
    elif damage == "method":
        content[8:10] = content[head + 10 : head + 12] = (99).to_bytes(2, "little")
    elif damage == "encrypted":
        content[6] |= 1
        content[head + 8] |= 1
    else:
        del content[first + 10 : first + 30]
    path.write_bytes(bytes(content))
    with pytest.raises(InputError, match=r"theirs\.fmu"):
        read_terminals(path)
