"""Rules of SSP 1.0 and 2.0 and of OSP, one small structure each; what the FMUs hold is told by a table here."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.cosim.structure import opened
from harness.cosim.structure.conversion import Chain, IntegerConversion, LinearConversion, change_of_unit, unit_of
from harness.cosim.structure.flat import FlatSystem
from harness.cosim.structure.flatten import flatten
from harness.cosim.structure.package import PROXIED
from harness.errors import InputError
from plants.mockups import mockup

HEAD = (
    '<ssd:SystemStructureDescription xmlns:ssd="http://ssp-standard.org/SSP1/SystemStructureDescription"'
    ' xmlns:ssc="http://ssp-standard.org/SSP1/SystemStructureCommon"'
    ' xmlns:ssb="http://ssp-standard.org/SSP1/SystemStructureSignalDictionary"'
    ' xmlns:ssm="http://ssp-standard.org/SSP1/SystemStructureParameterMapping"'
    ' xmlns:ssv="http://ssp-standard.org/SSP1/SystemStructureParameterValues" version="1.0" name="t">'
)
UNITS = (
    '<ssd:Units><ssc:Unit name="m"><ssc:BaseUnit m="1"/></ssc:Unit>'
    '<ssc:Unit name="mm"><ssc:BaseUnit m="1" factor="1e-3"/></ssc:Unit>'
    '<ssc:Unit name="K"><ssc:BaseUnit K="1"/></ssc:Unit>'
    '<ssc:Unit name="degC"><ssc:BaseUnit K="1" offset="273.15"/></ssc:Unit></ssd:Units>'
)


def row(name: str, causality: str, type: str = "Real", unit: str | None = None, scale: float = 1.0, **more: Any) -> Any:
    known = {"shape": [], "start": None, "items": None, "alias": False, "offset": 0.0, "si_unit": unit}
    return {"name": name, "causality": causality, "type": type, "unit": unit, "scale": scale, **known, **more}


BOX = [
    *(row(name, "input") for name in "uv"),
    *(row(name, "output") for name in "yz"),
    *(row(name, "parameter") for name in "kp"),
    row("i", "input", "Integer"),
    row("j", "output", "Integer"),
    row("b", "input", "Boolean"),
    row("c", "output", "Boolean"),
    row("e", "input", "Enumeration", items={"off": 1, "on": 2}),
    row("f", "output", "Enumeration", items={"red": 5, "green": 7}),
    row("a", "input", "Float64", shape=[3]),
    row("d", "output", "Float64", shape=[3]),
    row("deg_in", "input", unit="deg", scale=math.pi / 180, si_unit="rad"),
    row("angle", "parameter", unit="deg", scale=math.pi / 180, si_unit="rad"),
    row("text", "output", "String"),
]
FMU = {"fmi": "2.0", "tool": "", "platforms": [], "experiment": {"stepSize": 0.1}, "variables": BOX}


def connector(name: str, kind: str, unit: str = "", type: str = "Real") -> str:
    shown = f' unit="{unit}"' if unit else ""
    return f'<ssd:Connector name="{name}" kind="{kind}"><ssc:{type}{shown}/></ssd:Connector>'


def part(name: str, connectors: str = "", bindings: str = "") -> str:
    inside = f"<ssd:Connectors>{connectors}</ssd:Connectors>" + bound(bindings)
    return f'<ssd:Component name="{name}" source="x.fmu">{inside}</ssd:Component>'


def bound(bindings: str) -> str:
    return f"<ssd:ParameterBindings>{bindings}</ssd:ParameterBindings>" if bindings else ""


def values(more: str = "", prefix: str = "", **given: float) -> str:
    rows = "".join(f'<ssv:Parameter name="{n}"><ssv:Real value="{v}"/></ssv:Parameter>' for n, v in given.items())
    return binding(rows, more, prefix)


def binding(rows: str, more: str = "", prefix: str = "") -> str:
    return (
        f'<ssd:ParameterBinding prefix="{prefix}"><ssd:ParameterValues><ssv:ParameterSet version="1.0" name="v">'
        f"<ssv:Parameters>{rows}</ssv:Parameters>"
        f"{UNITS.replace('ssd:', 'ssv:')}</ssv:ParameterSet></ssd:ParameterValues>{more}</ssd:ParameterBinding>"
    )


def wire(start: str, end: str, change: str = "", more: str = "") -> str:
    ends = []
    for side, place in (("start", start), ("end", end)):
        element, _, name = place.rpartition(".")
        ends.append((f'{side}Element="{element}" ' if element else "") + f'{side}Connector="{name}"')
    return f"<ssd:Connection {' '.join(ends)} {more}>{change}</ssd:Connection>"


def system(elements: str, wires: str = "", connectors: str = "", bindings: str = "", name: str = "s") -> str:
    return (
        f'<ssd:System name="{name}"><ssd:Connectors>{connectors}</ssd:Connectors>{bound(bindings)}'
        f"<ssd:Elements>{elements}</ssd:Elements><ssd:Connections>{wires}</ssd:Connections></ssd:System>"
    )


def read(tmp_path: Path, text: str, **parameters: Any) -> FlatSystem:
    (tmp_path / "x.fmu").write_text("")
    (tmp_path / "SystemStructure.ssd").write_text(f"{HEAD}{text}{UNITS}</ssd:SystemStructureDescription>")
    with opened(tmp_path) as found:
        return flatten(found.description, lambda path: FMU, parameters=parameters)


def only(flat: FlatSystem) -> Chain:
    assert len(flat.wires) == 1
    return flat.wires[0].chain


LINEAR = '<ssc:LinearTransformation factor="3" offset="1"/>'


def mapped(kind: str, *pairs: tuple[object, object]) -> str:
    entries = "".join(f'<ssc:MapEntry source="{a}" target="{b}"/>' for a, b in pairs)
    return f"<ssc:{kind}MappingTransformation>{entries}</ssc:{kind}MappingTransformation>"


def mapping(source: str, target: str, change: str = "") -> str:
    entry = f'<ssm:MappingEntry source="{source}" target="{target}">{change}</ssm:MappingEntry>'
    inner = f'<ssm:ParameterMapping version="1.0">{entry}</ssm:ParameterMapping>'
    return f"<ssd:ParameterMapping>{inner}</ssd:ParameterMapping>"


@pytest.mark.parametrize(
    ("own", "outer", "expected"),
    [
        (values(k=2) + values(k=3), "", {"k": 3}),  # of two at one level the later
        (values(k=2), values(**{"d.k": 5}), {"k": 5}),  # of two levels the higher
        ("", values(**{"d.k": 5, "d.p": 1}) + values(k=4, prefix="d."), {"k": 4, "p": 1}),
        ("", values(foo=3, bar=9, more=mapping("foo", "d.k", LINEAR)), {"k": 10}),  # inline; bar is not mapped
        ("", values(foo=3, more=mapping("x.foo", "d.k"), prefix="x."), {"k": 3}),  # the prefix is before the mapping
        (
            binding(
                '<ssv:Parameter name="i"><ssv:Integer value="1"/></ssv:Parameter>',
                mapping("i", "i", mapped("Integer", (1, 7))),
            ),
            "",
            {"i": 7},
        ),
        (binding('<ssv:Parameter name="angle"><ssv:Real value="180"/></ssv:Parameter>'), "", {"angle": math.pi}),
    ],
)  # fmt: skip
def test_values_land_where_the_standard_says(tmp_path: Path, own: str, outer: str, expected: dict[str, float]) -> None:
    found = read(tmp_path, system(part("d", bindings=own), bindings=outer)).components[0]
    assert {**found.parameters, **found.start} == pytest.approx(expected)


def test_a_value_reaches_parameters_through_connectors_of_systems(tmp_path: Path) -> None:
    inner = system(
        part("d", connector("k", "parameter", "mm") + connector("u", "input")),
        wire("K", "d.k", LINEAR) + wire("K", "d.u"),
        connector("K", "parameter", "m"),
        name="box",
    )
    outer = system(inner, wire("L", "box.K"), connector("L", "parameter"), values(L=2))
    found = read(tmp_path, outer).components[0]
    assert found.parameters == {"k": 3 * 2000 + 1}  # m to mm first, then the transformation
    assert found.start == {"u": 2}
    assert read(tmp_path, outer, L=4.0).components[0].start == {"u": 4}


def test_a_value_with_a_unit_is_converted_and_a_wrong_one_is_refused(tmp_path: Path) -> None:
    metres = '<ssv:Parameter name="k"><ssv:Real value="2" unit="{}"/></ssv:Parameter>'
    declared = connector("k", "parameter", "mm")
    found = read(tmp_path, system(part("d", declared, binding(metres.format("m")))))
    assert found.components[0].parameters == {"k": 2000}
    with pytest.raises(InputError, match=r"unit of parameter 'k'.*converts to mm.*got K"):
        read(tmp_path, system(part("d", declared, binding(metres.format("K")))))


def test_values_that_name_nothing_are_passed_over_and_said(tmp_path: Path) -> None:
    flat = read(tmp_path, system(part("d", bindings=values(nothing=1, k=2))))
    assert flat.components[0].parameters == {"k": 2}
    assert any("passed over" in note and "d.nothing" in note for note in flat.notes)
    with pytest.raises(InputError, match="parameter 'nothing'"):
        read(tmp_path, system(part("d")), nothing=1.0)


def pair(source: str, target: str, change: str = "", more: str = "", types: tuple[str, str] = ("", "")) -> str:
    out = part("one", connector(source, "output", types[0]) if types[0] else "")
    into = part("two", connector(target, "input", types[1]) if types[1] else "")
    return system(out + into, wire(f"one.{source}", f"two.{target}", change, more))


@pytest.mark.parametrize(
    ("text", "given", "expected"),
    [
        (pair("y", "u", types=("m", "mm")), 1.0, 1000.0),
        (pair("y", "u", types=("degC", "K")), 1.0, 274.15),
        (pair("y", "u", types=("K", "degC")), 274.15, 1.0),
        (pair("y", "u", LINEAR, types=("m", "mm")), 1.0, 3001.0),
        (pair("y", "u", LINEAR, 'suppressUnitConversion="true"', ("m", "mm")), 1.0, 4.0),
        (pair("y", "u", types=("m", "")), 1.0, 1.0),  # an end without a unit takes the number
        (pair("y", "deg_in"), 180.0, math.pi),  # the plant's channel is in SI
        (pair("y", "deg_in", '<ssc:LinearTransformation offset="90"/>'), 90.0, math.pi),
        (pair("j", "i", mapped("Integer", (1, 7))), 1.0, 7.0),
        (pair("j", "i", mapped("Integer", (1, 7))), 2.0, 2.0),
        (pair("c", "b", mapped("Boolean", ("true", "false"), ("false", "true"))), 1.0, 0.0),
        (pair("f", "e", mapped("Enumeration", ("red", "off"), ("green", "on"))), 7.0, 2.0),
        (pair("y", "u", LINEAR).replace("one.y", "one.y"), 2.0, 7.0),
    ],
)
def test_what_a_connection_does_to_a_number(tmp_path: Path, text: str, given: float, expected: float) -> None:
    assert only(read(tmp_path, text))(given) == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (pair("y", "u", types=("m", "K")), r"units of a connection.*converts to K.*got m"),
        (pair("j", "i", LINEAR), r"LinearTransformation.*real numbers.*'j': Integer"),
        (pair("y", "u", mapped("Integer", (1, 7))), r"IntegerMappingTransformation.*'y': Real"),
        (pair("f", "e", mapped("Enumeration", ("blue", "off"))), r"red, green.*'blue'"),
        (pair("text", "u"), r"a text or bytes at both ends.*'text' of String"),
        (system(part("one") + part("two"), wire("one.y", "two.u") + wire("one.z", "two.u")), "driven twice"),
        (system(part("one") + part("two"), wire("one.u", "two.u")), "one source and one sink"),
        (system(part("one") + part("two"), wire("one.y", "two.k")), r"parameter 'two.k'.*known at the start"),
        (system(part("one"), wire("one.d", "one.u")), r"1 values.*3 of one\.d"),
        (system(part("one"), wire("one.y", "one.u", more='startIndices="1"')), "whole arrays"),
        (system(part("one").replace("x.fmu", "x.mo")), "component 'one'"),
        (system(part("one") + part("one")), "different names"),
    ],
)
def test_what_breaks_the_standard_is_refused_in_one_line(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        read(tmp_path, text)
    assert "\n" not in str(caught.value)


def test_units_pass_through_a_system_that_says_none(tmp_path: Path) -> None:
    box = system(part("d", connector("u", "input", "mm")), wire("in", "d.u"), connector("in", "input"), name="box")
    flat = read(tmp_path, system(part("one", connector("y", "output", "m")) + box, wire("one.y", "box.in")))
    assert only(flat)(1.0) == pytest.approx(1000.0)
    assert flat.wires[0].target == "box/d.u"


def test_the_outermost_connectors_are_in_si(tmp_path: Path) -> None:
    ends = connector("T", "input", "degC") + connector("y", "output", "mm") + connector("w", "input")
    wires = wire("T", "d.u", LINEAR) + wire("d.y", "y", LINEAR) + wire("w", "d.v")
    flat = read(tmp_path, system(part("d", connector("v", "input", "mm")), wires, ends, values(T=20)))
    by_name = {one.name: one for one in flat.inputs}
    assert (by_name["T"].unit, by_name["T"].start) == ("K", pytest.approx(293.15))
    assert by_name["w"].unit == "m"  # what it is wired to says so
    chains = {wire.target: wire.chain for wire in flat.wires}
    assert chains["d.u"](293.15) == pytest.approx(61.0)
    assert chains["d.v"](2e-3) == pytest.approx(2.0)
    assert flat.outputs[0].unit == "m"
    assert flat.outputs[0].chain(1.0) == pytest.approx(4e-3)


def test_signals_go_through_a_dictionary_at_any_depth(tmp_path: Path) -> None:
    bus = connector("speed", "inout", "mm")
    reference = (
        '<ssd:SignalDictionaryReference name="{}" dictionary="bus"><ssd:Connectors>{}</ssd:Connectors>'
        "</ssd:SignalDictionaryReference>"
    )
    box = system(part("d") + reference.format("r", bus), wire("r.speed", "d.u"), name="box")
    text = system(
        part("one", connector("y", "output", "m")) + reference.format("q", bus) + box, wire("one.y", "q.speed")
    )
    entry = (
        '<ssd:SignalDictionaries><ssd:SignalDictionary name="bus"><ssb:SignalDictionary version="1.0">'
        '<ssb:DictionaryEntry name="speed"><ssc:Real unit="m"/></ssb:DictionaryEntry>'
        "</ssb:SignalDictionary></ssd:SignalDictionary></ssd:SignalDictionaries></ssd:System>"
    )
    flat = read(tmp_path, entry.join(text.rsplit("</ssd:System>", 1)))
    assert (flat.wires[0].source, flat.wires[0].target) == ("one.y", "box/d.u")
    assert only(flat)(1.0) == pytest.approx(1000.0)


def test_arrays_are_wired_element_by_element(tmp_path: Path) -> None:
    flat = read(tmp_path, system(part("one") + part("two"), wire("one.d", "two.a")))
    assert [(one.source, one.target) for one in flat.wires] == [(f"one.d[{k}]", f"two.a[{k}]") for k in (1, 2, 3)]


def test_a_system_is_used_twice_by_its_id(tmp_path: Path) -> None:
    box = system(part("d"), connectors=connector("K", "parameter"), wires=wire("K", "d.k"), name="box")
    box = box.replace('name="box"', 'name="box" id="it"')
    text = system(box + '<ssd:Component name="again" source="#it"/>', bindings=values(**{"box.K": 1, "again.K": 2}))
    assert [(one.label, one.parameters) for one in read(tmp_path, text).components] == [
        ("again.d", {"k": 2.0}),
        ("box.d", {"k": 1.0}),
    ]


def test_a_system_that_shows_nothing_shows_the_outputs_of_all_its_parts(tmp_path: Path) -> None:
    flat = read(tmp_path, system(part("one") + part("two"), wire("one.y", "two.u")))
    shown = [one.name for one in flat.outputs]
    assert {"one.y", "one.z", "two.y", "two.z", "two.d[3]"} <= set(shown)
    assert len(shown) == len(set(shown))
    for component in flat.components:  # what is shown is also what the FMU is asked for
        assert sorted(component.outputs) == ["c", "d", "f", "j", "y", "z"]


def test_only_of_what_a_proxy_of_this_machine_runs_is_it_said(tmp_path: Path) -> None:
    assert PROXIED not in read(tmp_path, system(part("d"))).notes
    proxied = part("d").replace("x.fmu", "proxyfmu://localhost?file=x.fmu")
    assert list(read(tmp_path, system(proxied + proxied.replace('"d"', '"e"'))).notes).count(PROXIED) == 1


def osp(tmp_path: Path, connections: str, more: str = "") -> Path:
    path = tmp_path / "OspSystemStructure.xml"
    (tmp_path / "x.fmu").write_text("")
    simulators = "".join(f'<Simulator name="{n}" source="x.fmu">{more}</Simulator>' for n in ("one", "two"))
    path.write_text(
        '<OspSystemStructure xmlns="http://opensimulationplatform.com/MSMI/OSPSystemStructure" version="0.1">'
        f"<StartTime>1</StartTime><BaseStepSize>0.1</BaseStepSize><Algorithm>ecco</Algorithm>"
        f"<Simulators>{simulators}</Simulators>"
        '<Functions><LinearTransformation name="lin" factor="2" offset="1"/>'
        '<Sum name="sum" inputCount="2"/></Functions>'
        f"<Connections>{connections}</Connections></OspSystemStructure>"
    )
    return path


def test_functions_of_an_osp_structure(tmp_path: Path) -> None:
    def joined(function: str, name: str, simulator: str, variable: str, *, out: bool = False) -> str:
        ends = [
            f'<Variable simulator="{simulator}" name="{variable}"/>',
            f'<Signal function="{function}" name="{name}"/>',
        ]
        return f"<SignalConnection>{''.join(ends[::-1] if out else ends)}</SignalConnection>"

    initial = '<InitialValues><InitialValue variable="k"><Real value="4"/></InitialValue></InitialValues>'
    plain = '<VariableConnection><Variable simulator="two" name="v"/><Variable simulator="one" name="z"/>'
    connections = [
        joined("sum", "in[0]", "one", "y"),
        joined("sum", "in[1]", "one", "z"),
        joined("sum", "out", "two", "u", out=True),
        joined("lin", "in", "one", "y"),
        joined("lin", "out", "two", "deg_in", out=True),
        f"{plain}</VariableConnection>",
    ]
    path = osp(tmp_path, "".join(connections), initial)
    with opened(path) as found:
        assert (found.description.start, found.description.step, found.description.exchange) == (1.0, 0.1, "jacobi")
        flat = flatten(found.description, lambda path: FMU)
    assert flat.components[0].parameters == {"k": 4.0}
    assert {(w.source, w.target, w.add) for w in flat.wires} == {
        ("one.y", "two.u", True),
        ("one.z", "two.u", True),
        ("one.y", "two.deg_in", False),
        ("one.z", "two.v", False),
    }
    angle = next(w for w in flat.wires if w.target == "two.deg_in")
    assert angle.chain(1.0) == pytest.approx(math.radians(3.0))
    assert any("'ecco' is not run" in note for note in flat.notes)


def test_files_outside_the_folder_are_opened_only_when_they_are_allowed(tmp_path: Path) -> None:
    inner = tmp_path / "system"
    inner.mkdir()
    path = osp(inner, "")
    path.write_text(path.read_text().replace("x.fmu", "../x.fmu"))
    (tmp_path / "x.fmu").write_text("")
    with pytest.raises(InputError, match=f"--option within={tmp_path}$"), opened(path):
        pass
    with opened(path, within=tmp_path) as found:
        assert len(list(found.files())) == 2


numbers = st.floats(-1e3, 1e3).filter(lambda x: abs(x) > 1e-3)


@given(steps=st.lists(st.tuples(numbers, numbers), max_size=5), x=numbers, at=st.integers(0, 5))
def test_a_chain_is_its_steps_one_after_another(steps: list[tuple[float, float]], x: float, at: int) -> None:
    chain, expected = Chain(), x
    for place, (factor, offset) in enumerate(steps):
        if place == at:
            chain = chain.then(IntegerConversion(((1.0, 2.0),)))
            expected = 2.0 if expected == 1.0 else expected
        chain = chain.then(LinearConversion(factor, offset))
        expected = factor * expected + offset
    size = abs(x) + 1e3
    for factor, _ in steps:
        size *= abs(factor)
        size += 1e3
    assert chain(x) == pytest.approx(expected, rel=1e-9, abs=1e-12 * size)


@given(factor=numbers, offset=numbers, x=numbers)
def test_a_unit_and_back_is_nothing(factor: float, offset: float, x: float) -> None:
    odd, kelvin = unit_of("odd", {"K": 1}, factor, offset), unit_of("K", {"K": 1}, 1.0, 0.0)
    there, back = change_of_unit(odd, kelvin), change_of_unit(kelvin, odd)
    assert there is not None
    assert back is not None
    assert there(x) == pytest.approx(factor * x + offset)
    assert back(there(x)) == pytest.approx(x, rel=1e-6, abs=1e-6)
    assert change_of_unit(odd, odd) == LinearConversion()
    assert change_of_unit(odd, unit_of("m", {"m": 1}, 1.0, 0.0)) is None


def test_a_folder_runs_and_is_listed_as_it_is(tmp_path: Path, sysid: Callable[..., Any]) -> None:
    arm = part("arm", bindings=values(b=0.1)).replace("x.fmu", "arm.fmu")
    law = part("law").replace("x.fmu", "law.fmu")
    wires = wire("arm.theta", "law.y") + wire("law.u", "arm.u") + wire("wish", "law.r") + wire("arm.theta", "angle")
    ends = connector("wish", "input") + connector("angle", "output")
    text = system(arm + law, wires, ends, values(wish=0.4))
    (tmp_path / "SystemStructure.ssd").write_text(
        f'{HEAD}{text}{UNITS}<ssd:DefaultExperiment startTime="2" stopTime="3"/></ssd:SystemStructureDescription>'
    )
    (tmp_path / "arm.fmu").write_bytes(mockup("pendulum").read_bytes())
    (tmp_path / "law.fmu").write_bytes(mockup("pi_controller").read_bytes())
    rows = {}
    for exchange in ("jacobi", "gauss-seidel"):
        out = tmp_path / f"{exchange}.csv"
        chosen = ["--exchange", exchange, "--step", "0.01", "-o", str(out)]
        sysid("simulate", tmp_path, *chosen)
        rows[exchange] = out.read_text().splitlines()
    assert rows["jacobi"][0] == "time [s],wish [1],angle [rad]"
    assert rows["jacobi"][1].startswith("2.0,0.4,")
    assert rows["jacobi"][-1].startswith("3.0,0.4,")
    assert len(rows["jacobi"]) == 102
    assert rows["jacobi"] != rows["gauss-seidel"]
    listed = sysid("list", tmp_path).out
    assert "arm.theta" in listed
    assert "stopTime 3 s" in listed
