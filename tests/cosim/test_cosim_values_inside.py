"""Values of a system that lie inside an FMU: sourceBase="component", as a vendor ships them with the model."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest

from harness import api
from harness.cosim.structure import opened
from harness.cosim.structure.flatten import flatten
from harness.errors import InputError
from harness.parts.files import describe_fmu
from plants.mockups import mockup

SSV = """<ssv:ParameterSet xmlns:ssv="http://ssp-standard.org/SSP1/SystemStructureParameterValues"
 xmlns:ssc="http://ssp-standard.org/SSP1/SystemStructureCommon" version="1.0" name="v"><ssv:Parameters>
 <ssv:Parameter name="inertia"><ssv:Real value="700" unit="kg.cm2"/></ssv:Parameter>
 <ssv:Parameter name="mgl"><ssv:Real value="{mgl}"/></ssv:Parameter>
</ssv:Parameters><ssv:Units><ssc:Unit name="kg.cm2"><ssc:BaseUnit kg="1" m="2" factor="1e-4"/></ssc:Unit></ssv:Units>
</ssv:ParameterSet>"""
SSM = """<ssm:ParameterMapping xmlns:ssm="http://ssp-standard.org/SSP1/SystemStructureParameterMapping"
 version="1.0"><ssm:MappingEntry source="inertia" target="J"/><ssm:MappingEntry source="mgl" target="mgl"/>
</ssm:ParameterMapping>"""
SSD = """<ssd:SystemStructureDescription xmlns:ssd="http://ssp-standard.org/SSP1/SystemStructureDescription"
 xmlns:ssc="http://ssp-standard.org/SSP1/SystemStructureCommon" version="1.0" name="one">
<ssd:System name="top"><ssd:Elements><ssd:Component name="arm" source="resources/arm.fmu">
 <ssd:Connectors><ssd:Connector name="theta" kind="output"><ssc:Real unit="rad"/></ssd:Connector></ssd:Connectors>
 <ssd:ParameterBindings>{binding}</ssd:ParameterBindings></ssd:Component></ssd:Elements></ssd:System>
<ssd:Units><ssc:Unit name="rad"><ssc:BaseUnit rad="1"/></ssc:Unit></ssd:Units></ssd:SystemStructureDescription>"""
INSIDE = '<ssd:ParameterBinding source="{source}" sourceBase="component">{mapping}</ssd:ParameterBinding>'
MAPPED = '<ssd:ParameterMapping source="resources/names.ssm" sourceBase="{base}"/>'


def package(path: Path, binding: str) -> Path:
    """A package whose arm brings its values along; the package itself has other files of the same names."""
    inner = path.with_suffix(".fmu")
    inner.write_bytes(mockup("pendulum").read_bytes())
    with zipfile.ZipFile(inner, "a") as fmu:
        fmu.writestr("resources/rig one.ssv", SSV.format(mgl=1.3))
        fmu.writestr("resources/names.ssm", SSM)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("SystemStructure.ssd", SSD.format(binding=binding))
        archive.write(inner, "resources/arm.fmu")
        archive.writestr("resources/rig one.ssv", SSV.format(mgl=9.9))
        archive.writestr("resources/names.ssm", SSM.replace('target="mgl"', 'target="b"'))
    return path


def values(path: Path) -> dict[str, float]:
    with opened(path) as found:
        (arm,) = flatten(found.description, describe_fmu).components
    return arm.parameters


SOURCES = ("resources/rig%20one.ssv", "resources/rig one.ssv", "./resources/../resources/rig%20one.ssv")


@pytest.mark.parametrize("source", SOURCES)
def test_values_are_read_from_the_fmu_and_not_from_the_package(tmp_path: Path, source: str) -> None:
    inside = package(tmp_path / "a.ssp", INSIDE.format(source=source, mapping=MAPPED.format(base="component")))
    assert values(inside) == pytest.approx({"J": 0.07, "mgl": 1.3})


def test_the_system_moves_as_the_fmu_with_these_values(tmp_path: Path) -> None:
    inside = package(tmp_path / "a.ssp", INSIDE.format(source=SOURCES[0], mapping=MAPPED.format(base="component")))
    moved = api.simulate(str(inside), stop=0.5, step=0.01, options={"parameters": {"arm.theta": 0.3}})
    theirs = api.simulate(
        str(mockup("pendulum")),
        stop=0.5,
        step=0.01,
        options={"parameters": {"J": 0.07, "mgl": 1.3}, "start": {"theta": 0.3}, "outputs": ["theta"]},
    )
    assert np.allclose(moved.y[:, :1], theirs.y, rtol=0, atol=1e-12)
    assert np.ptp(theirs.y) > 0.1


def test_each_of_values_and_mapping_has_a_base_of_its_own(tmp_path: Path) -> None:
    path = package(
        tmp_path / "a.ssp", INSIDE.format(source="resources/rig%20one.ssv", mapping=MAPPED.format(base="SSD"))
    )
    assert values(path) == pytest.approx({"J": 0.07, "b": 1.3})  # the package's own mapping


def test_a_later_binding_of_the_package_goes_before_what_the_fmu_brings(tmp_path: Path) -> None:
    inside = INSIDE.format(source="resources/rig%20one.ssv", mapping=MAPPED.format(base="component"))
    outside = '<ssd:ParameterBinding source="resources/rig%20one.ssv"/>'
    assert values(package(tmp_path / "a.ssp", inside + outside)) == pytest.approx({"J": 0.07, "mgl": 9.9})
    assert values(package(tmp_path / "b.ssp", outside + inside)) == pytest.approx({"J": 0.07, "mgl": 1.3})


@pytest.mark.parametrize(
    "source",
    [
        "resources/none.ssv",
        "../arm.fmu",
        "/etc/passwd",
        "http://host/rig.ssv",
        "file:///etc/passwd",
        "resources",
        "modelDescription.xml",
    ],
)
def test_what_is_no_parameter_set_of_the_fmu_is_refused(tmp_path: Path, source: str) -> None:
    path = package(tmp_path / "a.ssp", INSIDE.format(source=source, mapping=""))
    with pytest.raises(InputError) as caught:
        values(path)
    assert source in str(caught.value)
    assert "a.ssp" in str(caught.value)


def test_a_system_has_no_inside(tmp_path: Path) -> None:
    text = SSD.format(binding="").replace(
        "<ssd:Elements>",
        '<ssd:ParameterBindings><ssd:ParameterBinding source="v.ssv" sourceBase="component"/></ssd:ParameterBindings>'
        "<ssd:Elements>",
    )
    path = package(tmp_path / "a.ssp", "")
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(tmp_path / "b.ssp", "w") as new:
        for entry in old.infolist():
            new.writestr(entry, text if entry.filename == "SystemStructure.ssd" else old.read(entry))
    with pytest.raises(InputError, match="sourceBase"):
        values(tmp_path / "b.ssp")
