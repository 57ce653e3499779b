"""Couplings as SSP packages: read by us, held against the schema of SSP 1.0, and run by libcosim."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmu_files import in_degrees

from harness import api
from harness.errors import InputError
from harness.export.system_structure import OPEN_ENDS
from harness.signals import FloatArray

PAIR = """
sample_time = 0.01
order = "jacobi"
outputs = ["a.theta", "b.theta"]
{inputs}
[parts.a]
{a}
options = {{ parameters = {{ b = 0.05, J = 0.06 }}, sample_time = 0.01 }}
[parts.b]
mockup = "pendulum"
[[connections]]
from = "a.theta"
to = "b.u"
gain = 0.7
gain_unit = "N m/rad"
offset = 0.2
{more}
[[connections]]
from = "b.theta"
to = "a.u"
gain = -0.3
gain_unit = "N m/rad"
offset = 0.1
"""


def coupling(folder: Path, a: str = 'mockup = "pendulum"', more: str = "", inputs: str = "") -> Path:
    path = folder / "pair.toml"
    path.write_text(PAIR.format(a=a, more=more, inputs=inputs))
    return path


def by_libcosim(
    structure: Path, names: list[str], steps: int, inputs: dict[str, FloatArray] | None = None
) -> FloatArray:
    """Return the numbers (steps + 1, names) that libcosim's fixed-step algorithm finds."""
    pytest.importorskip("libcosimpy", reason="libcosimpy is not installed: pip install libcosimpy")
    from libcosimpy.CosimExecution import CosimExecution
    from libcosimpy.CosimLogging import CosimLogLevel, log_output_level
    from libcosimpy.CosimManipulator import CosimManipulator
    from libcosimpy.CosimObserver import CosimObserver

    log_output_level(CosimLogLevel.ERROR)
    execution = CosimExecution.from_ssp_file(str(structure))
    observer, manipulator = CosimObserver.create_last_value(), CosimManipulator.create_override()
    execution.add_observer(observer)
    execution.add_manipulator(manipulator)

    def place(name: str) -> tuple[int, int]:
        part, _, variable = name.partition(".")
        slave = execution.slave_index_from_instance_name(part)
        known = {one.name.decode(): one.reference for one in execution.slave_variables(slave)}
        return slave, known[variable]

    shown, driven = [place(name) for name in names], {place(name): u for name, u in (inputs or {}).items()}
    rows = []
    for k in range(steps + 1):
        if k:
            for (slave, reference), u in driven.items():
                manipulator.slave_real_values(slave, [reference], [float(u[k - 1])])
            execution.step()
        rows.append([observer.last_real_values(slave, [reference])[0] for slave, reference in shown])
    return np.array(rows)


def assert_valid(package: Path, name: str) -> None:
    """Hold a structure against the schema of SSP 1.0 that fmpy carries."""
    import fmpy.ssp
    from lxml import etree

    schema = Path(fmpy.ssp.__file__).parent / "schema" / "SystemStructureDescription.xsd"
    with zipfile.ZipFile(package) as archive:
        etree.XMLSchema(file=str(schema)).assertValid(etree.fromstring(archive.read(name)))


def unpacked(package: Path) -> Path:
    folder = package.with_suffix("")
    with zipfile.ZipFile(package) as archive:
        archive.extractall(folder)
    return folder


def exported(path: Path) -> Path:
    target = path.with_suffix(".ssp")
    assert api.export(path, out=target) == [target]
    return target


def run(path: Path) -> FloatArray:
    return api.simulate(str(path), stop=2.0).y


@pytest.mark.parametrize("degrees", [False, True], ids=["rad", "deg"])
def test_the_package_repeats_the_coupling_here_and_in_libcosim(tmp_path: Path, degrees: bool) -> None:
    from harness.trust import trusting

    a = f'fmu = "{in_degrees(tmp_path / "degrees.fmu").name}"' if degrees else 'mockup = "pendulum"'
    path = coupling(tmp_path, a)
    with trusting(tmp_path):
        package = exported(path)
        ours = run(path)
    folder = unpacked(package)
    np.testing.assert_allclose(run(package), ours, rtol=0, atol=1e-12)
    theirs = by_libcosim(folder / OPEN_ENDS, ["a.theta", "b.theta"], 200)
    own = np.array([np.pi / 180 if degrees else 1.0, 1.0])  # libcosim knows no units
    np.testing.assert_allclose(theirs * own, ours, rtol=0, atol=1e-9)
    assert np.ptp(ours, axis=0).min() > 1e-3


def test_a_calibrated_copy_begins_with_its_values_in_libcosim_too(tmp_path: Path) -> None:
    from harness.calibration.written import write_model
    from harness.trust import trusting

    turned = in_degrees(tmp_path / "degrees.fmu")
    path = coupling(tmp_path, f'fmu = "{turned.name}"')
    with trusting(tmp_path):
        package = exported(path)
    values = {"a.J": 0.09, "a.mgl": 1.3, "b.b": 0.2}
    copy = write_model(package, "ssp", values, {}, tmp_path / "copy.ssp")
    assert_valid(copy, OPEN_ENDS)
    ours, before = run(copy), run(package)
    assert np.abs(ours - before).max() > 0.1 * np.ptp(before)
    theirs = by_libcosim(unpacked(copy) / OPEN_ENDS, ["a.theta", "b.theta"], 200)
    np.testing.assert_allclose(theirs * np.array([np.pi / 180, 1.0]), ours, rtol=0, atol=1e-9)


def test_what_comes_from_outside_is_a_connector_of_the_system_and_an_open_end(tmp_path: Path) -> None:
    from fmpy.ssp.ssd import read_ssd  # held against the schema of SSP 1.0

    path = tmp_path / "one.toml"
    path.write_text(
        'sample_time = 0.01\norder = "jacobi"\noutputs = ["arm.theta"]\ninputs = { push = "arm.u" }\n'
        '[parts.arm]\nmockup = "pendulum"\n[[connections]]\nfrom = "push"\nto = "arm.u"\ngain = 0.5\n'
    )
    package = exported(path)
    described = read_ssd(str(package))
    assert_valid(package, OPEN_ENDS)
    assert {(one.name, one.kind) for one in described.system.connectors} == {("push", "input"), ("arm.theta", "output")}
    u = np.sin(np.arange(200) / 10)
    from harness.parts.files import make_plant

    with make_plant(str(package), {}) as plant:
        ours = [plant.reset(rng=np.random.default_rng(0))]
        ours += [plant.step(np.array([value])) for value in u]
    theirs = by_libcosim(unpacked(package) / OPEN_ENDS, ["arm.theta"], 200, {"arm.u": 0.5 * u})
    np.testing.assert_allclose(theirs, np.array(ours), rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "words"),
    [({"more": "delay = 1"}, "delay"), ({"a": 'plant = "pendulum-ode"'}, "the part 'a'")],
    ids=["delay", "no FMU"],
)
def test_what_ssp_cannot_say_is_refused_by_name(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        api.export(coupling(tmp_path, **change), out=tmp_path / "pair.ssp")
    with pytest.raises(InputError, match=r"pair\.ssp"):
        api.export(coupling(tmp_path), out=tmp_path / "pair.fmu")
