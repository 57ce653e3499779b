"""A system laid flat in memory: values, start values, steps and refusals, each against what the standard says."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from lxml import etree

from harness.cosim.ssp import _coupled, _own_step, _step
from harness.cosim.structure.conversion import LinearConversion, Unit
from harness.cosim.structure.flat import FlatComponent, FlatSystem
from harness.cosim.structure.flatten import flatten
from harness.cosim.structure.model import (
    Component,
    Connector,
    ElementWire,
    Mapped,
    SystemDescription,
    SystemElement,
    Value,
)
from harness.cosim.structure.osp import _simulator, _typed, _vector_sum
from harness.cosim.structure.values import _value
from harness.errors import InputError
from harness.signals import Channel, FloatArray, PlantSpec

MM = Unit("mm", "m", 1e-3, 0.0, (("m", 1.0),))
CELSIUS = Unit("degC", "K", 1.0, 273.15, (("K", 1.0),))


def row(name: str, causality: str, type: str = "Real", **more: Any) -> dict[str, Any]:
    own = {"shape": [], "start": None, "items": None, "alias": False, "offset": 0.0, "si_unit": None, "unit": None}
    return {"name": name, "causality": causality, "type": type, "scale": None, **own, **more}


ROWS = [
    row("u", "input", start="4.0"), row("v", "input", start="2.5", unit="mm", si_unit="m", scale=1e-3),
    row("n", "input", "Integer", start="3"), row("b", "input", "Boolean", start="true"), row("y", "output"),
    row("k", "parameter"), row("i", "parameter", "Integer"), row("t", "parameter", unit="degC", si_unit="K", scale=1.0,
    offset=273.15),
]  # fmt: skip


def flat(
    connectors: list[Connector], wires: list[ElementWire], *, parts: tuple[str, ...] = ("p",), **more: Any
) -> FlatSystem:
    inside = [Component(name, {}, more.pop(f"bindings_{name}", []), Path("x.fmu")) for name in parts]
    top = SystemElement("", {one.name: one for one in connectors}, more.pop("bindings", []), list(inside), wires)
    about = {"variables": ROWS, "experiment": {"stepSize": None}, "fmi": "2.0", "tool": "", "platforms": []}
    return flatten(
        SystemDescription(Path("s.ssd"), "s", top), lambda path: about, parameters=more.pop("parameters", None)
    )


@pytest.mark.parametrize(
    ("target", "unit", "change", "start", "si"),
    [
        ("u", None, None, 4.0, "1"),
        ("u", None, LinearConversion(2.0, 1.0), 1.5, "1"),  # 2 x + 1 = 4
        ("u", MM, None, 4e-3, "m"),
        ("v", None, None, 2.5e-3, "m"),
        ("v", MM, LinearConversion(0.5, 1.0), 3e-3, "m"),  # 0.5 x + 1 mm = 2.5 mm
        ("n", None, None, 3.0, "1"),
        ("b", None, None, 1.0, "1"),
    ],
)
def test_an_input_starts_where_what_it_drives_starts(
    target: str, unit: Any, change: Any, start: float, si: str
) -> None:
    made = flat([Connector("w", "input", "Real", unit)], [ElementWire((None, "w"), ("p", target), change)])
    (one,) = made.inputs
    assert (one.name, one.unit) == ("w", si)
    assert one.start == pytest.approx(start)
    (wire,) = made.wires
    row_of = next(own for own in ROWS if own["name"] == target)
    own = 4.0 if row_of["start"] == "true" else float(row_of["start"])
    arrives = wire.chain(one.start)  # from SI to SI
    assert arrives == pytest.approx(1.0 if target == "b" else own * (row_of["scale"] or 1.0))


def test_a_value_goes_to_every_variable_of_its_name_outer_ones_last() -> None:
    inner = [(Value("k", 1.0), Value("i", 2.0), Value("t", 20.0, CELSIUS))]
    made = flat([], [], bindings_p=inner, bindings=[(Value("p.k", 5.0),), (Value("p.k", 6.0), Value("gone", 1.0))])
    assert made.components[0].parameters == {"k": 6.0, "i": 2, "t": pytest.approx(293.15)}
    assert isinstance(made.components[0].parameters["i"], int)
    assert made.notes == ["values that name nothing in the system, passed over as the standard says: gone"]
    asked = flat([], [], bindings_p=inner, parameters={"p.k": 9.0, "p.t": 300.0})
    assert asked.components[0].parameters == {"k": 9.0, "i": 2, "t": 300.0}  # in SI as they are given
    with pytest.raises(InputError, match=r"parameter 'p\.q'"):
        flat([], [], parameters={"p.q": 1.0})
    led = [Connector("size", "parameter", "Real", MM)]
    wires = [ElementWire((None, "size"), ("p", "k"), LinearConversion(3.0))]
    through = flat(led, wires, bindings=[(Value("size", 2.0, None),)])
    assert through.components[0].parameters["k"] == pytest.approx(6.0)
    assert flat(led, wires, parameters={"size": 2.0}).components[0].parameters["k"] == pytest.approx(6000.0)
    mapped = [
        (Value("i", 2, None, Mapped("Integer", (("2", "7"),))), Value("k", 2.0, None, LinearConversion(4.0, 1.0)))
    ]
    assert flat([], [], bindings_p=mapped).components[0].parameters == {"i": 7, "k": 9.0}
    many = [tuple(Value(f"x{k}", 1.0) for k in range(9))]
    assert flat([], [], bindings=many).notes[0].endswith("x6, x7, ...")


def test_outputs_that_nothing_drives_are_said_and_others_are_shown() -> None:
    shown = [
        Connector("out", "output"),
        Connector("silent", "output"),
        Connector("in", "input"),
        Connector("fixed", "output"),
    ]
    made = flat(shown, [ElementWire(("p", "y"), (None, "out"), LinearConversion(2.0))])
    assert [(one.name, one.source, one.chain(3.0)) for one in made.outputs] == [("out", "p.y", 6.0)]
    assert made.notes == ["outputs of the system that nothing drives: silent, fixed"]
    assert made.components[0].outputs == ["y"]
    everything = flat([], [], parts=("p", "q"))
    assert [(one.name, one.source) for one in everything.outputs] == [("p.y", "p.y"), ("q.y", "q.y")]
    chain = flat([], [ElementWire(("p", "y"), ("q", "u"))], parts=("p", "q"))
    assert [(one.source, one.target) for one in chain.wires] == [("p.y", "q.u")]
    assert (chain.components[1].inputs, chain.inputs) == (["u"], [])
    for start, end in ((("p", "u"), ("q", "u")), (("p", "y"), ("q", "y"))):
        with pytest.raises(InputError, match="one source and one sink"):
            flat([], [ElementWire(start, end)], parts=("p", "q"))
    with pytest.raises(InputError, match="input driven twice"):
        flat([], [ElementWire(("p", "y"), ("q", "u")), ElementWire(("q", "y"), ("q", "u"))], parts=("p", "q"))


def component(step: float | None, suggested: float | None = None) -> FlatComponent:
    return FlatComponent("p", "p", Path("x.fmu"), {"experiment": {"stepSize": suggested}}, {}, None, step)


@pytest.mark.parametrize(
    ("own", "found", "said"),
    [(None, 0.1, False), (0.3, 0.3, False), (0.26, 0.3, True), (0.04, 0.1, True), (0.1, 0.1, False), (0.34, 0.3, True)],
)
def test_a_component_steps_in_multiples_of_the_communication_step(own: float | None, found: float, said: bool) -> None:
    notes: list[str] = []
    assert _own_step(component(own), 0.1, notes) == pytest.approx(found)
    assert notes == ([f"'p' steps every {found:g} s: its step of {own:g} s is no multiple of 0.1 s"] if said else [])


@pytest.mark.parametrize(
    ("asked", "stated", "suggested", "stop", "start", "step", "notes"),
    [
        (0.2, 0.3, (0.1,), None, None, 0.2, 0), (None, 0.3, (0.1,), None, None, 0.3, 0),
        (None, None, (0.4, None, 0.1), None, None, 0.1, 0), (None, None, (None, 0.0), 3.0, 1.0, 2.0 / 500, 1),
        (None, None, (), None, None, 1.0 / 500, 1),
    ],
)  # fmt: skip
def test_the_communication_step_is_that_of_who_says_one(
    asked: Any, stated: Any, suggested: Any, stop: Any, start: Any, step: float, notes: int
) -> None:
    description = SystemDescription(Path("s"), "s", SystemElement("", {}, []), start, stop, stated)
    made = FlatSystem([component(None, one) for one in suggested], [], [], [], [])
    found, said = _step(description, made, asked)
    assert found == pytest.approx(step)
    assert len(said) == notes


class Still:
    """A plant with two inputs of its own channels and an output."""

    abilities: frozenset[str] = frozenset()
    spec = PlantSpec((Channel("u", "1", -1.0, 1.0), Channel("v", "m", -2.0, 2.0)), (Channel("y"),), 0.1)

    def step(self, u: FloatArray) -> FloatArray:
        return u[:1]

    def close(self) -> None:
        pass


def test_an_input_of_the_whole_has_the_channel_of_what_it_drives_unchanged() -> None:
    made = flat(
        [Connector("a", "input"), Connector("b", "input", "Real", MM), Connector("out", "output")],
        [
            ElementWire((None, "a"), ("p", "u")),
            ElementWire((None, "b"), ("p", "v")),
            ElementWire(("p", "y"), (None, "out")),
        ],
    )
    coupled = _coupled(made, {"p": Still()}, {"sample_time": 0.1})  # type: ignore[dict-item]
    first, second = coupled.spec.inputs
    assert (first.name, first.minimum, first.maximum) == ("a", -1.0, 1.0)
    assert (second.name, second.unit, second.minimum) == ("b", "m", -2.0)
    assert [one.name for one in coupled.spec.outputs] == ["out"]


def xml(text: str) -> Any:
    return etree.fromstring(text)


READER: Any = SimpleNamespace(
    refused=lambda what, expected, got: InputError(what, expected=expected, got=got, remedy="x")
)


@pytest.mark.parametrize(
    ("text", "array", "value"),
    [
        ('<Real value="1.5"/>', False, 1.5),
        ('<Real value="1.5 2"/>', False, [1.5, 2.0]),
        ('<Real value="1"/>', True, [1.0]),
        ('<Integer value="3"/>', False, 3),
        ('<Boolean value="true"/>', False, True),
        ('<Boolean value="0"/>', False, False),
        ('<String value="a b"/>', False, "a b"),
        ('<String value="a"/>', True, ["a"]),
        ('<Binary value="0aff"/>', False, b"\n\xff"),
        ("<String><Value>a</Value></String>", False, "a"),
        ('<String><Value value="b"/></String>', False, "b"),
        ("<String><Value>a</Value><Value/></String>", False, ["a", ""]),
        ("<String><Value>a</Value></String>", True, ["a"]),
        ('<Real value=""/>', False, None),
        ('<Integer value="1.5"/>', False, None),
        ('<Boolean value="yes"/>', False, None),
    ],
)
def test_a_value_is_read_in_its_type(text: str, array: bool, value: Any) -> None:
    if value is None:
        with pytest.raises(InputError, match="value of parameter 'q'"):
            _value(READER, "q", xml(text), array)
    else:
        found = _value(READER, "q", xml(text), array)
        assert found == value
        assert type(found) is type(value)


def test_what_an_osp_file_leaves_out_is_refused(tmp_path: Path) -> None:
    package: Any = SimpleNamespace(path=tmp_path, named=lambda source, *rest: source, file=lambda name: tmp_path / name)
    for attributes in ('name="a"', 'source="a.fmu"', ""):
        with pytest.raises(InputError, match="a name and a source"):
            _simulator(package, "s", xml(f"<Simulator {attributes}/>"), [])
    with pytest.raises(InputError, match="an FMU in a file"):
        _simulator(package, "s", xml('<Simulator name="a" source="a.txt"/>'), [])
    values = "".join(
        f'<InitialValue variable="{name}"><{kind} value="{text}"/></InitialValue>'
        for name, kind, text in (
            ("r", "Real", "1.5"),
            ("i", "Integer", "2"),
            ("b", "Boolean", "true"),
            ("s", "String", "x"),
        )
    )
    made = _simulator(
        package, "s", xml(f'<S name="a" source="a.fmu" stepSize="0.5"><InitialValues>{values}</InitialValues></S>'), []
    )
    assert (made.name, made.step, made.kind) == ("a", 0.5, "cs")
    assert [(one.name, one.value) for one in made.bindings[0]] == [("r", 1.5), ("i", 2), ("b", True), ("s", "x")]
    for kind, text in (("Real", "x"), ("Integer", "1.5")):
        with pytest.raises(InputError, match=f"of type {kind}"):
            _typed(package, xml(f'<{kind} value="{text}"/>'))
    system, groups = _vector_sum(package, xml('<VectorSum name="v" inputCount="2" dimension="3"/>'))
    assert [(one.name, len(one.variables)) for one in groups] == [("in[0]", 3), ("in[1]", 3), ("out", 3)]
    assert len(system.wires) == 6
    assert system.sums == {"out[0]", "out[1]", "out[2]"}
    assert [(wire.start[1], wire.end[1]) for wire in system.wires][3] == ("in[1][0]", "out[0]")
    for counts in ('inputCount="0" dimension="3"', 'inputCount="2"', 'inputCount="100000" dimension="100000"'):
        with pytest.raises(InputError, match="sum 'v'"):
            _vector_sum(package, xml(f'<VectorSum name="v" {counts}/>'))
    assert np.isfinite(made.step or np.nan)
