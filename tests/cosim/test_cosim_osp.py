"""Groups of variables, sums of vectors and proxies in structures of OSP; steps of their own."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import pytest

from harness import api
from harness.cosim import own_steps
from harness.cosim.structure import opened
from harness.cosim.structure.flat import FlatSystem, named
from harness.cosim.structure.flatten import flatten
from harness.cosim.structure.package import on_this_machine
from harness.errors import InputError
from plants.mockups import mockup

HEAD = '<OspSystemStructure xmlns="http://opensimulationplatform.com/MSMI/OSPSystemStructure" version="0.1">'
GROUPS = """<OspModelDescription xmlns="https://open-simulation-platform.com/OspModelDescription/1.0.1" version="1.0">
<UnitDefinitions><Unit name="m"/></UnitDefinitions>
<VariableGroups>
 <Generic name="motion">
  <LinearDisplacement name="place"><Variable ref="y[1]" unit="m"/><Variable ref="y[2]"/></LinearDisplacement>
  <AngularDisplacement name="turn"><Variable ref="phi"/></AngularDisplacement>
 </Generic>
 <Generic name="command">
  <Force name="push"><Variable ref="u[1]"/><Variable ref="u[2]"/></Force>
  <Torque name="twist"><Variable ref="m"/></Torque>
 </Generic>
 <Force name="single"><Variable ref="u[1]"/></Force>
</VariableGroups></OspModelDescription>"""
NAMES = {"u[1]": "input", "u[2]": "input", "m": "input", "y[1]": "output", "y[2]": "output", "phi": "output"}
ROWS: list[dict[str, Any]] = [
    {"name": name, "causality": causality, "type": "Real", "unit": None, "scale": 1.0, "offset": 0.0, "si_unit": None,
     "shape": [], "start": None, "items": None, "alias": False}
    for name, causality in NAMES.items()
]  # fmt: skip
ABOUT = {"fmi": "2.0", "tool": "", "platforms": [], "experiment": {"stepSize": 0.1}, "variables": ROWS}


def folder(place: Path, connections: str, functions: str = "", source: str = "fmus/box.fmu", step: str = "") -> Path:
    """Write a structure of two boxes, their FMU, and what describes its groups."""
    (place / "fmus").mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(place / "fmus" / "box.fmu", "w") as archive:
        archive.writestr("modelDescription.xml", '<fmiModelDescription fmiVersion="2.0" modelName="Box" guid="g"/>')
    (place / "fmus" / "Box_OspModelDescription.xml").write_text(GROUPS)
    boxes = "".join(f'<Simulator name="{name}" source="{source}" {step}/>' for name in ("a", "b"))
    text = f"<Simulators>{boxes}</Simulators><Functions>{functions}</Functions><Connections>{connections}</Connections>"
    (place / "OspSystemStructure.xml").write_text(f"{HEAD}<BaseStepSize>0.1</BaseStepSize>{text}</OspSystemStructure>")
    return place


def flat(place: Path) -> FlatSystem:
    with opened(place) as found:
        return flatten(found.description, lambda _: ABOUT)


def wires(place: Path) -> set[tuple[str, str]]:
    return {(wire.source, wire.target) for wire in flat(place).wires}


def joined(first: str, second: str, kind: str = "VariableGroup") -> str:
    ends = []
    for text in (first, second):
        owner, name = text.split(":")
        word = "function" if owner == "sum" else "simulator"
        tag = kind.replace("Variable", "Signal") if owner == "sum" else kind
        ends.append(f'<{tag} {word}="{owner}" name="{name}"/>')
    whole = "SignalGroupConnection" if "sum:" in first + second else f"{kind}Connection"
    return f"<{whole}>{''.join(ends)}</{whole}>"


def test_groups_are_connected_group_by_group_and_variable_by_variable(tmp_path: Path) -> None:
    expected = {("a.y[1]", "b.u[1]"), ("a.y[2]", "b.u[2]"), ("a.phi", "b.m")}
    assert wires(folder(tmp_path, joined("a:motion", "b:command"))) == expected
    assert wires(folder(tmp_path, joined("b:command", "a:motion"))) == expected, "a connection has no direction"
    inner = wires(folder(tmp_path, joined("a:turn", "b:twist")))
    assert inner == {("a.phi", "b.m")}, "a group in a group has a name of its own"


def test_a_description_beside_the_structure_serves_as_well(tmp_path: Path) -> None:
    place = folder(tmp_path, joined("a:turn", "b:twist"))
    (place / "fmus" / "Box_OspModelDescription.xml").rename(place / "Box_OspModelDescription.xml")
    assert wires(place) == {("a.phi", "b.m")}
    (place / "Box_OspModelDescription.xml").unlink()
    with pytest.raises(InputError, match=r"groups of 'a'.*Box_OspModelDescription\.xml beside its FMU"):
        wires(place)


@pytest.mark.parametrize(
    ("connection", "words"),
    [
        (joined("a:motion", "b:single"), "2 groups and 0 variables.*0 groups and 1 variables"),
        (joined("a:speed", "b:command"), "group 'speed' of 'a': expected one of its groups.*'motion'"),
        (joined("a:motion", "c:command"), "group 'command': expected one of a simulator or a VectorSum"),
    ],
)
def test_groups_that_do_not_fit_are_refused(connection: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words):
        wires(folder(tmp_path, connection))


def test_vectors_are_added(tmp_path: Path) -> None:
    both = joined("a:place", "sum:in[0]") + joined("b:place", "sum:in[1]") + joined("sum:out", "b:push")
    place = folder(tmp_path, both, '<VectorSum name="sum" inputCount="2" dimension="2"/>')
    found = flat(place)
    assert {(w.source, w.target) for w in found.wires} == {
        (f"{box}.y[{k}]", f"b.u[{k}]") for box in "ab" for k in (1, 2)
    }
    assert [w.add for w in found.wires if w.target == "b.u[1]"] == [True, True]
    assert all(w.chain(2.5) == 2.5 for w in found.wires)
    for wrong in ('inputCount="0" dimension="2"', 'inputCount="9999" dimension="99"'):
        with pytest.raises(InputError, match="sum 'sum'"):
            wires(folder(tmp_path, both, f'<VectorSum name="sum" {wrong}/>'))


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1", "localhost:9090"])
def test_a_proxy_on_this_machine_is_its_file(host: str, tmp_path: Path) -> None:
    place = folder(tmp_path, joined("a:turn", "b:twist"), source=f"proxyfmu://{host}?file=fmus/box.fmu")
    found = flat(place)
    assert {one.path.name for one in found.components} == {"box.fmu"}
    assert [note for note in found.notes if "without it" in note]
    with pytest.raises(InputError, match="expected an FMU in a file"):
        wires(folder(tmp_path, "", source="proxyfmu://elsewhere?file=fmus/box.fmu"))
    assert on_this_machine("fmus/box.fmu") == "fmus/box.fmu"
    with pytest.raises(InputError, match="expected a file inside"):
        wires(folder(tmp_path, "", source=f"proxyfmu://{host}?file=../box.fmu"))


def test_parts_with_steps_of_their_own_are_said(tmp_path: Path) -> None:
    assert own_steps(folder(tmp_path / "osp", "", step='stepSize="0.2"')) == ["a", "b"]
    assert own_steps(folder(tmp_path / "none", "")) == []
    toml = tmp_path / "loop.toml"
    toml.write_text(
        'sample_time = 0.02\ninputs = {u = "drive.u"}\noutputs = ["arm.theta"]\n'
        '[parts.arm]\nplant = "pendulum-ode"\noptions = {sample_time = 0.02}\n'
        '[parts.drive]\nmockup = "drive"\n[[connections]]\nfrom = "drive.q"\nto = "arm.u"\ngain_unit = "N"\n'
        '[[connections]]\nfrom = "u"\nto = "drive.u"\n'
    )
    assert own_steps(toml) == ["arm"]
    said: list[str] = []
    api.halve(str(toml), times=1, note=said.append, stop=0.2)
    assert [text for text in said if text.endswith("only the exchange with the others does: arm")]
    quiet = toml.read_text().replace('plant = "pendulum-ode"\noptions = {sample_time = 0.02}', 'mockup = "pendulum"')
    toml.write_text(quiet)
    said.clear()
    api.halve(str(toml), times=1, note=said.append, stop=0.2)
    assert not [text for text in said if "steps of their own" in text]


def test_the_folder_of_within_is_that_of_the_caller(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "system").mkdir()
    (tmp_path / "arm.fmu").write_bytes(mockup("pendulum").read_bytes())
    (tmp_path / "system" / "OspSystemStructure.xml").write_text(
        f'{HEAD}<BaseStepSize>0.01</BaseStepSize><Simulators><Simulator name="arm" source="../arm.fmu"/></Simulators>'
        "</OspSystemStructure>"
    )
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=f"--option within={tmp_path}$"):
        api.simulate("system", stop=0.1)
    found = api.simulate("system", stop=0.1, options={"within": "."})
    assert [channel.name for channel in found.spec.outputs] == ["arm.theta", "arm.omega"]


def test_what_a_system_says_is_said_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "arm.fmu").write_bytes(mockup("pendulum").read_bytes())
    (tmp_path / "OspSystemStructure.xml").write_text(
        f'{HEAD}<Algorithm>ecco</Algorithm><Simulators><Simulator name="arm" source="arm.fmu"/></Simulators>'
        "</OspSystemStructure>"
    )
    said: list[str] = []
    api.simulate(str(tmp_path), stop=0.1, note=said.append)
    assert len([text for text in said if "'ecco' is not run" in text]) == 1
    assert not [one for one in caplog.records if "ecco" in one.getMessage()]


def test_the_remedy_for_an_fmu_in_a_package_names_no_unpacked_file(tmp_path: Path) -> None:
    package, unpacked = tmp_path / "loop.ssp", tmp_path / "gone" / "tank.fmu"
    package.write_bytes(b"")
    error = InputError("no binary", expected="one", got="none", remedy=f"fmpy compile {unpacked}")
    text = str(named(error, "tank", unpacked, package))
    assert str(unpacked) not in text
    assert "unzip loop.ssp" in text
    assert "fmpy compile tank.fmu" in text


@pytest.mark.parametrize(("name", "count"), [("Sum", "0"), ("Sum", "10001"), ("VectorSum", "0"), ("VectorSum", "-1")])
def test_a_sum_of_nothing_or_of_too_much_is_refused(name: str, count: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="sum 's'"):
        flat(folder(tmp_path, "", f'<{name} name="s" inputCount="{count}" dimension="1"/>'))
    flat(folder(tmp_path, "", f'<{name} name="s" inputCount="10000" dimension="1"/>'))
    flat(folder(tmp_path, "", f'<{name} name="s" inputCount="1" dimension="1"/>'))
