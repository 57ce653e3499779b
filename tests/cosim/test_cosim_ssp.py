"""SSP packages, built here from our own FMUs: coupled as in Python, refused where unsafe or not understood."""

from __future__ import annotations

import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness import api, registry
from harness.cosim import Connection, Coupled, couple_ssp
from harness.cosim.structure import opened
from harness.cosim.structure.flat import FlatSystem
from harness.cosim.structure.flatten import flatten
from harness.errors import InputError
from harness.parts.files import describe_fmu
from harness.protocols import Plant
from plants.fmu.plant import FmuPlant
from plants.mockups import mockup

RNG = np.random.default_rng(0)
DT = 0.02
HEAD = """<?xml version="1.0" encoding="UTF-8"?>
<ssd:SystemStructureDescription xmlns:ssd="http://ssp-standard.org/SSP1/SystemStructureDescription"
 xmlns:ssc="http://ssp-standard.org/SSP1/SystemStructureCommon"
 xmlns:ssv="http://ssp-standard.org/SSP1/SystemStructureParameterValues" version="1.0" name="loop">"""
ARM = """<ssd:Component name="arm" source="resources/pendulum.fmu">
 <ssd:Connectors>
  <ssd:Connector name="u" kind="input"><ssc:Real/></ssd:Connector>
  <ssd:Connector name="theta" kind="output"><ssc:Real unit="rad"/></ssd:Connector>
 </ssd:Connectors>
 <ssd:ParameterBindings><ssd:ParameterBinding><ssd:ParameterValues>
  <ssv:ParameterSet version="1.0" name="arm"><ssv:Parameters>
   <ssv:Parameter name="b"><ssv:Real value="0.1"/></ssv:Parameter>
   <ssv:Parameter name="J"><ssv:Real value="500" unit="kg.cm2"/></ssv:Parameter>
  </ssv:Parameters></ssv:ParameterSet></ssd:ParameterValues></ssd:ParameterBinding></ssd:ParameterBindings>
</ssd:Component>"""
LAW = """<ssd:Component name="law" source="resources/pi_controller.fmu">
 <ssd:Connectors>
  <ssd:Connector name="r" kind="input"><ssc:Real/></ssd:Connector>
  <ssd:Connector name="y" kind="input"><ssc:Real/></ssd:Connector>
  <ssd:Connector name="u" kind="output"><ssc:Real/></ssd:Connector>
 </ssd:Connectors>
</ssd:Component>"""
FLAT = f"""{HEAD}<ssd:System name="top">
<ssd:Connectors>
 <ssd:Connector name="set" kind="input"><ssc:Real/></ssd:Connector>
 <ssd:Connector name="angle" kind="output"><ssc:Real unit="rad"/></ssd:Connector>
</ssd:Connectors>
<ssd:ParameterBindings><ssd:ParameterBinding source="resources/values.ssv"/></ssd:ParameterBindings>
<ssd:Elements>{ARM}{LAW}</ssd:Elements>
<ssd:Connections>
 <ssd:Connection startConnector="set" endElement="law" endConnector="r"/>
 <ssd:Connection startElement="arm" startConnector="theta" endElement="law" endConnector="y"/>
 <ssd:Connection startElement="law" startConnector="u" endElement="arm" endConnector="u">
  <ssc:LinearTransformation factor="0.5"/></ssd:Connection>
 <ssd:Connection startElement="arm" startConnector="theta" endConnector="angle"/>
</ssd:Connections></ssd:System>
<ssd:Units>
 <ssc:Unit name="rad"><ssc:BaseUnit rad="1"/></ssc:Unit>
 <ssc:Unit name="kg.cm2"><ssc:BaseUnit kg="1" m="2" factor="1e-4"/></ssc:Unit>
</ssd:Units></ssd:SystemStructureDescription>"""
NESTED = FLAT.replace(
    f"{ARM}{LAW}</ssd:Elements>",
    f"""{ARM}<ssd:System name="box"><ssd:Connectors>
 <ssd:Connector name="wish" kind="input"><ssc:Real/></ssd:Connector>
 <ssd:Connector name="seen" kind="input"><ssc:Real/></ssd:Connector>
 <ssd:Connector name="out" kind="output"><ssc:Real/></ssd:Connector></ssd:Connectors>
 <ssd:Elements>{LAW}</ssd:Elements><ssd:Connections>
 <ssd:Connection startConnector="wish" endElement="law" endConnector="r"/>
 <ssd:Connection startConnector="seen" endElement="law" endConnector="y"/>
 <ssd:Connection startElement="law" startConnector="u" endConnector="out"/></ssd:Connections></ssd:System>
</ssd:Elements>""",
)
for _old, _new in (
    (
        'endElement="law" endConnector="r"/>\n <ssd:Connection startElement="arm"',
        'endElement="box" endConnector="wish"/>\n <ssd:Connection startElement="arm"',
    ),
    (
        'startConnector="theta" endElement="law" endConnector="y"',
        'startConnector="theta" endElement="box" endConnector="seen"',
    ),
    (
        'startElement="law" startConnector="u" endElement="arm"',
        'startElement="box" startConnector="out" endElement="arm"',
    ),
):
    assert _old in NESTED
    NESTED = NESTED.replace(_old, _new)
VALUES = """<?xml version="1.0" encoding="UTF-8"?>
<ssv:ParameterSet xmlns:ssv="http://ssp-standard.org/SSP1/SystemStructureParameterValues" version="1.0" name="v">
<ssv:Parameters>
 <ssv:Parameter name="{law}.Kp"><ssv:Real value="0.8"/></ssv:Parameter>
 <ssv:Parameter name="{law}.Ki"><ssv:Real value="0.3"/></ssv:Parameter>
 <ssv:Parameter name="arm.b"><ssv:Real value="0.05"/></ssv:Parameter>
</ssv:Parameters></ssv:ParameterSet>"""


def package(
    path: Path, ssd: str = FLAT, law: str = "law", extra: Callable[[zipfile.ZipFile], Any] | None = None
) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("SystemStructure.ssd", ssd)
        archive.writestr("resources/values.ssv", VALUES.format(law=law))
        for name in ("pendulum", "pi_controller"):
            archive.write(mockup(name), f"resources/{name}.fmu")
        if extra is not None:
            extra(archive)
    return path


def flat(path: Path) -> FlatSystem:
    with opened(path) as found:
        return flatten(found.description, describe_fmu)


def make(id: str, options: dict[str, Any]) -> Plant:
    plant: Plant = registry.create("plants", id, **options)
    return plant


def motion(plant: Plant) -> np.ndarray:
    rows = [plant.reset(rng=RNG)]
    rows += [plant.step(np.array([0.4])) for _ in range(100)]
    return np.array(rows)


@pytest.mark.parametrize(("ssd", "law"), [(FLAT, "law"), (NESTED, "box.law")])
def test_a_package_moves_as_the_same_coupling_in_python(tmp_path: Path, ssd: str, law: str) -> None:
    written = Coupled(
        {  # the outer binding's b goes before the component's own; J = 500 kg cm^2
            "arm": FmuPlant(mockup("pendulum"), sample_time=DT, outputs=["theta"], parameters={"b": 0.05, "J": 0.05}),
            "law": FmuPlant(mockup("pi_controller"), sample_time=DT, parameters={"Kp": 0.8, "Ki": 0.3}),
        },
        [
            ("set", "law.r"),
            ("arm.theta", "law.y"),
            Connection("law.u", "arm.u", gain=0.5, gain_unit="N m"),
        ],
        inputs={"set": "law.r"},
        outputs=["arm.theta"],
    )
    path = package(tmp_path / "loop.ssp", ssd, law)
    with couple_ssp(path, make, describe_fmu, changes={"sample_time": DT}) as read, written:
        assert [c.name for c in read.spec.inputs] == ["set"]
        assert [c.name for c in read.spec.outputs] == ["angle"]
        np.testing.assert_allclose(motion(read), motion(written), rtol=0, atol=1e-14)


def boxed(inner: Path, path: Path) -> Path:
    """Write a package whose controller is a package: its system is the nested one of NESTED."""
    head, rest = NESTED.split('<ssd:System name="box">')
    body, tail = rest.split("</ssd:System>", 1)
    with zipfile.ZipFile(inner, "w") as archive:
        archive.writestr(
            "SystemStructure.ssd", f'{HEAD}<ssd:System name="box">{body}</ssd:System></ssd:SystemStructureDescription>'
        )
        archive.write(mockup("pi_controller"), "resources/pi_controller.fmu")
    connectors = body.split("<ssd:Elements>")[0]
    head_of = '<ssd:Component name="box" type="application/x-ssp-package" source="resources/inner.ssp">'
    component = f"{head_of}{connectors}</ssd:Component>"
    text = f"{head}{component}{tail}"
    return package(path, text, "box.law", extra=lambda archive: archive.write(inner, "resources/inner.ssp"))


def test_a_package_in_a_package_is_one_part(tmp_path: Path) -> None:
    scratch = Path(tempfile.gettempdir())
    before = set(scratch.glob("sysid-ssp-*"))
    with couple_ssp(
        boxed(tmp_path / "inner.ssp", tmp_path / "outer.ssp"), make, describe_fmu, changes={"sample_time": DT}
    ) as nested:
        boxes = motion(nested)
    with couple_ssp(package(tmp_path / "flat.ssp"), make, describe_fmu, changes={"sample_time": DT}) as flat:
        assert motion(flat) == pytest.approx(boxes, abs=1e-12)
    assert np.ptp(boxes) > 0.01
    assert set(scratch.glob("sysid-ssp-*")) == before


def test_packages_that_hold_themselves_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("harness.cosim.structure.ssd.DEEPEST", 1)
    with pytest.raises(InputError, match=r"outer\.ssp: packages inside packages.*'box'"):
        couple_ssp(boxed(tmp_path / "inner.ssp", tmp_path / "outer.ssp"), make, describe_fmu)


def test_a_package_is_a_plant_of_the_command_and_leaves_no_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    record = api.simulate(str(package(tmp_path / "loop.ssp")), scenario="multisine")
    assert [c.name for c in record.spec.outputs] == ["angle"]
    assert np.ptp(record.y) > 0.01
    assert list(scratch.iterdir()) == []
    bad = package(
        tmp_path / "bad.ssp", FLAT.replace('name="theta" kind', 'name="thetb" kind').replace('"theta"', '"thetb"')
    )
    with pytest.raises(InputError, match=r"bad\.ssp.*component 'arm' \(pendulum\.fmu\).*thetb"):
        couple_ssp(bad, make, describe_fmu)
    assert list(scratch.iterdir()) == []


def _link(archive: zipfile.ZipFile) -> None:
    entry = zipfile.ZipInfo("resources/link")
    entry.create_system, entry.external_attr = 3, 0o120777 << 16
    archive.writestr(entry, "/etc/passwd")


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        (lambda archive: archive.writestr("../evil.fmu", b"x"), r"leaves its folder.*\.\./evil\.fmu"),
        (lambda archive: archive.writestr("/evil/absolute", b"x"), r"leaves its folder"),
        (_link, "an entry is a link"),
        (lambda archive: archive.writestr("resources/zeros.bin", bytes(40 << 20)), "unpacks like a bomb"),
        (lambda archive: archive.writestr("Resources/Values.ssv", b"x"), "two entries share a name"),
        (lambda archive: archive.writestr("resources/x.ssv", b"<!DOCTYPE a><a/>"), r"x\.ssv.*DOCTYPE"),
    ],
)
def test_a_hostile_package_is_refused_before_anything_is_unpacked(tmp_path: Path, extra: Any, words: str) -> None:
    with pytest.raises(InputError, match=words):
        couple_ssp(package(tmp_path / "hostile.ssp", extra=extra), make, describe_fmu)
    assert [p.name for p in tmp_path.iterdir()] == ["hostile.ssp"]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            '<ssc:Real unit="rad"/></ssd:Connector>\n </ssd:Connectors>\n <ssd:P',
            '<ssc:Real unit="rad"/></ssd:Connector>\n </ssd:Connectors>\n <ssd:Q',
            "SystemStructure.ssd",
        ),
        (
            'name="theta" kind="output"><ssc:Real unit="rad"/>',
            'name="theta" kind="output"><ssc:Real unit="V"/>',
            r"arm\.theta: unit of a connector.*converts to rad.*got V",
        ),
        ("resources/pendulum.fmu", "resources/pendel.fmu", r"'arm'.*inside the package.*pendel\.fmu"),
        ("resources/pendulum.fmu", "http://example.org/pendulum.ssp", r"component 'arm'.*an FMU"),
        (
            'startElement="law" startConnector="u"',
            'startElement="law" startConnector="w"',
            r"declared connector.*law\.w",
        ),
    ],
)
def test_what_does_not_fit_is_named(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert old in FLAT
    path = package(tmp_path / "odd.ssp", FLAT.replace(old, new))
    with pytest.raises(InputError, match=words) as caught:
        couple_ssp(path, make, describe_fmu)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_input_that_nothing_drives_keeps_its_start_value(tmp_path: Path) -> None:
    wire = ' <ssd:Connection startConnector="set" endElement="law" endConnector="r"/>\n'
    assert wire in FLAT
    with couple_ssp(package(tmp_path / "open.ssp", FLAT.replace(wire, "")), make, describe_fmu) as free:
        assert free.spec.inputs == ()
        free.reset(rng=RNG, x0={"arm.theta": 0.5})
        for _ in range(3000):
            y = free.step(np.zeros(0))
        assert abs(y[0]) < 1e-3  # the reference rests at 0


def test_values_go_through_a_parameter_mapping(tmp_path: Path) -> None:
    mapping = """<?xml version="1.0" encoding="UTF-8"?>
<ssm:ParameterMapping xmlns:ssm="http://ssp-standard.org/SSP1/SystemStructureParameterMapping"
 xmlns:ssc="http://ssp-standard.org/SSP1/SystemStructureCommon" version="1.0">
 <ssm:MappingEntry source="law.Kp" target="law.Kp">
  <ssc:LinearTransformation factor="2" offset="0.5"/></ssm:MappingEntry>
</ssm:ParameterMapping>"""
    ssd = FLAT.replace(
        '<ssd:ParameterBinding source="resources/values.ssv"/>',
        '<ssd:ParameterBinding source="resources/values.ssv"><ssd:ParameterMapping source="resources/map.ssm"/>'
        "</ssd:ParameterBinding>",
    )
    path = package(tmp_path / "map.ssp", ssd, extra=lambda archive: archive.writestr("resources/map.ssm", mapping))
    law = next(one for one in flat(path).components if one.name == "law")
    assert law.parameters == {"Kp": 2 * 0.8 + 0.5}  # and Ki is not mapped


def test_no_package_is_said_so(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such package"):
        couple_ssp(tmp_path / "none.ssp", make, describe_fmu)
    (tmp_path / "text.ssp").write_text("text")
    with pytest.raises(InputError, match="not an SSP package"):
        couple_ssp(tmp_path / "text.ssp", make, describe_fmu)
