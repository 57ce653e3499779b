"""Texts and bytes between the parts of a coupling; wires of text in structures of other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness.cosim import Connection, Coupled
from harness.cosim.structure import opened
from harness.cosim.structure.conversion import Chain
from harness.cosim.structure.flat import FlatSystem, FlatWire
from harness.cosim.structure.flatten import flatten
from harness.errors import InputError
from harness.protocols import Ability
from harness.signals import Channel, FloatArray, PlantSpec


class Teller:
    """Counts its steps, tells the count as a text, and puts out the length of the text that it hears."""

    abilities: frozenset[Ability] = frozenset()

    def __init__(self, kind: str = "String") -> None:
        self.spec = PlantSpec((), (Channel("length"),), 0.1)
        self.text_inputs, self.text_outputs = {"ear": kind}, {"mouth": kind}
        self.count, self.heard, self.history = 0, "", list[str]()

    def reset(self, *, rng: np.random.Generator, x0: Any = None) -> FloatArray:
        self.count, self.heard = 0, ""
        return np.zeros(1)

    def step(self, u: FloatArray) -> FloatArray:
        self.history.append(self.heard)
        self.count += 1
        return np.array([float(len(self.heard))])

    def texts(self, names: Any) -> list[str | bytes]:
        assert list(names) == ["mouth"]
        return ["x" * self.count]

    def put_texts(self, values: Any) -> None:
        self.heard = values["ear"]

    def close(self) -> None: ...


@pytest.mark.parametrize("order", ["jacobi", "gauss-seidel"])
def test_texts_cross_at_communication_instants_under_both_orders(order: Any) -> None:
    a, b = Teller(), Teller()
    wires = [("a.mouth", "b.ear"), ("b.mouth", "a.ear")]
    with Coupled({"a": a, "b": b}, wires, outputs=["b.length"], order=order) as pair:
        pair.reset(rng=np.random.default_rng(0))
        lengths = [float(pair.step(np.zeros(0))[0]) for _ in range(4)]
    assert lengths == [0.0, 1.0, 2.0, 3.0]
    assert a.history == b.history == ["", "x", "xx", "xxx"]


@pytest.mark.parametrize(
    ("wires", "words"),
    [
        ([Connection("a.mouth", "b.ear", gain=2.0)], "a text is carried as it is"),
        ([("a.length", "b.ear")], "got a number to String"),
        ([("a.mouth", "b.ear"), ("b.mouth", "b.ear")], "input driven twice"),
    ],
)
def test_what_is_no_text_or_changes_one_is_refused(wires: Any, words: str) -> None:
    with pytest.raises(InputError, match=words):
        Coupled({"a": Teller(), "b": Teller()}, wires, outputs=["b.length"])
    with pytest.raises(InputError, match="got String to Binary"):
        Coupled({"a": Teller(), "b": Teller("Binary")}, [("a.mouth", "b.ear")], outputs=["b.length"])


ROWS = [
    {"name": name, "causality": causality, "type": type, "unit": None, "scale": None, "offset": None, "si_unit": None,
     "shape": [], "start": None, "items": None, "alias": False}
    for name, causality, type in (
        ("said", "output", "String"), ("heard", "input", "String"), ("bytes", "input", "Binary"),
        ("tick", "output", "Clock"), ("tock", "input", "Clock"), ("y", "output", "Integer"),
    )
]  # fmt: skip
ABOUT = {"fmi": "3.0", "tool": "", "platforms": [], "experiment": {"stepSize": 0.1}, "variables": ROWS}


def flat(place: Path, wires: str, connectors: str = "", values: str = "") -> FlatSystem:
    space = "http://ssp-standard.org/SSP1/SystemStructure"
    names = " ".join(
        f'xmlns:{key}="{space}{word}"'
        for key, word in (("ssd", "Description"), ("ssc", "Common"), ("ssv", "ParameterValues"))
    )
    boxes = "".join(f'<ssd:Component name="{name}" source="x.fmu"/>' for name in "ab")
    (place / "x.fmu").write_bytes(b"")
    (place / "SystemStructure.ssd").write_text(
        f'<ssd:SystemStructureDescription {names} version="1.0" name="t"><ssd:System name="s">'
        f"<ssd:Connectors>{connectors}</ssd:Connectors>{values}<ssd:Elements>{boxes}</ssd:Elements>"
        f"<ssd:Connections>{wires}</ssd:Connections></ssd:System></ssd:SystemStructureDescription>"
    )
    with opened(place) as found:
        return flatten(found.description, lambda _: ABOUT)


def test_a_wire_of_text_is_flattened_and_no_channel(tmp_path: Path) -> None:
    system = flat(
        tmp_path,
        '<ssd:Connection startElement="a" startConnector="said" endElement="b" endConnector="heard"/>'
        '<ssd:Connection startElement="b" startConnector="said" endConnector="out"/>'
        '<ssd:Connection startElement="b" startConnector="y" endConnector="number"/>',
        '<ssd:Connector name="out" kind="output"><ssc:String/></ssd:Connector>'
        '<ssd:Connector name="number" kind="output"><ssc:Integer/></ssd:Connector>',
    )
    assert system.wires == [FlatWire("a.said", "b.heard", Chain())]
    assert [one.inputs for one in system.components] == [[], []]
    assert [one.name for one in system.outputs] == ["number"]
    assert "texts and bytes are carried but not recorded: out" in system.notes


def test_a_text_from_outside_is_the_start_value_of_what_it_reaches(tmp_path: Path) -> None:
    values = (
        '<ssd:ParameterBindings><ssd:ParameterBinding><ssd:ParameterValues><ssv:ParameterSet version="1.0" name="v">'
        '<ssv:Parameters><ssv:Parameter name="word"><ssv:String value="go"/></ssv:Parameter></ssv:Parameters>'
        "</ssv:ParameterSet></ssd:ParameterValues></ssd:ParameterBinding></ssd:ParameterBindings>"
    )
    system = flat(
        tmp_path,
        '<ssd:Connection startConnector="word" endElement="b" endConnector="heard"/>',
        '<ssd:Connector name="word" kind="input"><ssc:String/></ssd:Connector>',
        values,
    )
    assert system.components[1].start == {"heard": "go"}
    assert system.inputs == []


@pytest.mark.parametrize(
    ("start", "end", "words"),
    [("said", "bytes", "a text or bytes at both ends"), ("tick", "tock", "no clocks"), ("y", "heard", "at both ends")],
)
def test_clocks_and_texts_that_become_another_type_are_refused(
    tmp_path: Path, start: str, end: str, words: str
) -> None:
    with pytest.raises(InputError, match=words):
        flat(
            tmp_path, f'<ssd:Connection startElement="a" startConnector="{start}" endElement="b" endConnector="{end}"/>'
        )
