"""FMU files that must not be unpacked or cannot be run: each is refused in one line that says which entry."""

from __future__ import annotations

import os
import re
import stat
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from harness.errors import InputError
from plants.fmu import archive as fmu_archive
from plants.fmu.archive import read_fmu
from plants.fmu.plant import FmuPlant, describe
from plants.fmu.units import si_conversion
from plants.mockups import mockup

XML = "modelDescription.xml"
Change = Callable[[dict[str, bytes]], None]


def repacked(
    target: Path, change: Change | None = None, extra: Sequence[tuple[zipfile.ZipInfo | str, bytes]] = ()
) -> Path:
    """Write the pendulum FMU again with changed entries and more entries."""
    with zipfile.ZipFile(mockup("pendulum")) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    if change is not None:
        change(entries)
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
        for entry, content in extra:
            archive.writestr(entry, content)
    return target


def described(old: str, new: str) -> Change:
    """Return a change of the description's text."""

    def change(entries: dict[str, bytes]) -> None:
        text = entries["modelDescription.xml"].decode()
        assert old in text
        entries["modelDescription.xml"] = text.replace(old, new).encode()

    return change


def recoded(encoding: str, prolog: str) -> Change:
    """Return a change of the description's encoding, with something put before its root."""

    def change(entries: dict[str, bytes]) -> None:
        body = entries["modelDescription.xml"].decode().partition("?>")[2]
        entries["modelDescription.xml"] = f'<?xml version="1.0" encoding="{encoding}"?>{prolog}{body}'.encode(encoding)

    return change


def link() -> zipfile.ZipInfo:
    entry = zipfile.ZipInfo("resources/link")
    entry.create_system = 3
    entry.external_attr = (stat.S_IFLNK | 0o777) << 16
    return entry


BAD: dict[str, tuple[Callable[[Path], Path], str]] = {
    "not a zip": (lambda p: (p.write_text("hello"), p)[1], "not an FMU"),
    "empty file": (lambda p: (p.write_bytes(b""), p)[1], "not an FMU"),
    "no description": (lambda p: repacked(p, lambda e: e.pop("modelDescription.xml") and None), "modelDescription.xml"),
    "description is no XML": (lambda p: repacked(p, lambda e: e.update({"modelDescription.xml": b"<a"})), "XMLSyntax"),
    "entity bomb": (lambda p: repacked(p, described("<fmiModel", "<!DOCTYPE a []><fmiModel")), "document type"),
    "entity bomb in UTF-16": (lambda p: repacked(p, recoded("utf-16", "<!DOCTYPE a []>")), "document type"),
    "entity bomb in UTF-7": (lambda p: repacked(p, recoded("utf-7", "<!DOCTYPE a []>")), "document type"),
    "version 4": (lambda p: repacked(p, described('fmiVersion="2.0"', 'fmiVersion="4.0"')), "modelDescription.xml"),
    "no version": (lambda p: repacked(p, described('fmiVersion="2.0"', "")), "modelDescription.xml"),
    "nothing to run": (
        lambda p: repacked(p, lambda e: described(re.findall("(?s)<CoSim.*</CoSim[^>]*>", e[XML].decode())[0], "")(e)),
        "nothing to run",
    ),
    "identifier leaves the folder": (
        lambda p: repacked(p, described('modelIdentifier="Pendulum"', 'modelIdentifier="../../evil"')),
        "modelIdentifier",
    ),
    "parent folder": (lambda p: repacked(p, extra=[("resources/../../x", b"")]), "leaves its folder"),
    "absolute": (lambda p: repacked(p, extra=[("/absolute/x", b"")]), "leaves its folder"),
    "drive": (lambda p: repacked(p, extra=[("C:/x", b"")]), "leaves its folder"),
    "backslash": (lambda p: repacked(p, extra=[("resources\\..\\..\\x", b"")]), "leaves its folder"),
    "same name, other slash": (
        lambda p: repacked(p, extra=[("resources\\x", b"a"), ("resources/x", b"b")]),
        "share a name",
    ),
    "link": (lambda p: repacked(p, extra=[(link(), b"/etc/passwd")]), "is a link"),
    "bomb": (lambda p: repacked(p, extra=[("resources/bomb", bytes(64 << 20))]), "unpacks like a bomb"),
    "same name, other case": (lambda p: repacked(p, extra=[("MODELDESCRIPTION.xml", b"")]), "share a name"),
    "no binary for us": (
        lambda p: repacked(p, lambda e: [e.pop(n) for n in list(e) if n.startswith("binaries")] and None),
        "no binary for this system",
    ),
    "library is text": (
        lambda p: repacked(p, lambda e: e.update({n: b"text" for n in e if n.startswith("binaries")})),
        "cannot be loaded",
    ),
    "another token": (lambda p: repacked(p, described("sysid-harness-pendulum-1", "someone-elses")), "token is not"),
    "missing functions": (
        lambda p: repacked(p, _other_library),
        "cannot be loaded",
    ),
}


def _other_library(entries: dict[str, bytes]) -> None:
    """Put a library without FMI functions in the place of the model's."""
    from plants.fmu.engine import native_library

    library = native_library()
    if library is None:
        pytest.skip("no C compiler: install gcc")
    for name in entries:
        if name.startswith("binaries"):
            entries[name] = Path(library._name).read_bytes()


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused_in_one_line(name: str, tmp_path: Path, temporary_folder: Path) -> None:
    make, words = BAD[name]
    file = make(tmp_path / "bad.fmu")
    here = os.getcwd()
    with pytest.raises(InputError, match=words) as caught:
        FmuPlant(file, sample_time=0.01)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(str(file))
    assert os.getcwd() == here
    assert list(temporary_folder.iterdir()) == [file]


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_duplicate_entries_are_refused(tmp_path: Path) -> None:
    file = repacked(tmp_path / "bad.fmu", extra=[("modelDescription.xml", b"<other/>")])
    with pytest.raises(InputError, match=r"modelDescription\.xml: two entries share a name"):
        read_fmu(file)


def test_limits_on_count_and_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = repacked(tmp_path / "big.fmu")
    monkeypatch.setattr(fmu_archive, "MAX_ENTRIES", 1)
    with pytest.raises(InputError, match="too many entries"):
        read_fmu(file)
    monkeypatch.setattr(fmu_archive, "MAX_ENTRIES", 10)
    monkeypatch.setattr(fmu_archive, "MAX_TOTAL", 1000)
    with pytest.raises(InputError, match="too large"):
        read_fmu(file)


def test_no_such_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such FMU"):
        describe(tmp_path / "nothing.fmu")


def test_flaws_of_the_description_are_told_and_the_fmu_still_runs(tmp_path: Path) -> None:
    file = repacked(
        tmp_path / "odd.fmu", described('initial="exact" description="angular velocity"', 'initial="exact" oddity="1"')
    )
    with FmuPlant(file, sample_time=0.01) as plant:
        assert any("oddity" in text for text in plant.warnings)
        assert plant.reset(rng=np.random.default_rng(0)).shape == (2,)
    assert describe(file)["problems"]


def test_what_the_check_itself_stumbles_over_is_said_and_runs(tmp_path: Path) -> None:
    file = repacked(tmp_path / "shown.fmu", described('unit="rad" displayUnit="deg"', 'displayUnit="deg"'))
    with FmuPlant(file, sample_time=0.01) as plant:
        assert any("broke off" in text for text in plant.warnings)
        assert plant.reset(rng=np.random.default_rng(0)).shape == (2,)


def test_a_reference_that_would_become_another_variables_is_refused(tmp_path: Path) -> None:
    file = repacked(tmp_path / "far.fmu", described('valueReference="1"', f'valueReference="{2**32 + 1}"'))
    with pytest.raises(InputError, match=r"valueReference.*32 bits"):
        FmuPlant(file, sample_time=0.01)


def test_only_once_per_process_is_honoured(tmp_path: Path) -> None:
    file = repacked(
        tmp_path / "single.fmu",
        described("<CoSimulation ", '<CoSimulation canBeInstantiatedOnlyOncePerProcess="true" '),
    )
    first = FmuPlant(file, sample_time=0.01)
    with pytest.raises(InputError, match="only once in a process"):
        FmuPlant(file, sample_time=0.01)
    first.close()
    FmuPlant(file, sample_time=0.01).close()


def test_units_are_turned_into_si(tmp_path: Path) -> None:
    def change(entries: dict[str, bytes]) -> None:
        text = entries["modelDescription.xml"].decode()
        text = re.sub(r'<Unit name="rad">.*?</Unit>', "", text, flags=re.DOTALL)  # then known by its name only
        text = text.replace('unit="rad" displayUnit="deg"', 'unit="deg"')
        text = text.replace('<BaseUnit rad="1" s="-1" />', '<BaseUnit rad="1" s="-1" factor="0.5" />')
        entries["modelDescription.xml"] = text.replace('name="N m"', 'name="N.m"').replace('"N m"', '"N.m"').encode()

    with FmuPlant(repacked(tmp_path / "deg.fmu", change), sample_time=0.01) as plant:
        assert str(plant.spec) == "u [N m] -> theta [rad], omega [rad/s] every 0.01 s"
        y = plant.reset(rng=np.random.default_rng(0), x0={"theta": np.pi / 2, "omega": 0.25})
        assert y == pytest.approx([np.pi / 2, 0.25])
        assert plant.truth() == pytest.approx([np.pi / 2, 0.25])
        held = plant.get_state()
        moved = plant.step(np.ones(1))
        plant.set_state(held)
        assert np.array_equal(plant.rollout(np.ones((1, 1)))[0], moved)


@pytest.mark.parametrize(
    ("text", "unit", "scale", "offset"),
    [
        (None, "1", 1.0, 0.0),
        ("N.m", "N m", 1.0, 0.0),
        ("kg.m2", "kg m^2", 1.0, 0.0),
        ("m/s2", "m/s^2", 1.0, 0.0),
        ("N.m.s/rad", "N m s/rad", 1.0, 0.0),
        ("deg", "rad", np.pi / 180, 0.0),
        ("rpm", "rad/s", np.pi / 30, 0.0),
        ("degC", "K", 1.0, 273.15),
        ("mm", "m", 1e-3, 0.0),
        ("bar", "Pa", 1e5, 0.0),
        ("l/min", "m^3/s", 1e-3 / 60, 0.0),
        ("-", "1", 1.0, 0.0),
    ],
)
def test_units_by_name(text: str | None, unit: str, scale: float, offset: float) -> None:
    found = si_conversion(text)
    assert (found.unit, found.complaint) == (unit, None)
    assert (found.scale, found.offset) == pytest.approx((scale, offset))


def test_units_that_are_wrong_are_told() -> None:
    from fmpy.model_description import BaseUnit, Unit

    assert "unknown" in str(si_conversion("furlongs_per_fortnight_x").complaint)
    assert "declared as" in str(si_conversion("V", Unit("V", BaseUnit(m=1))).complaint)
    own = si_conversion("ticks", Unit("ticks", BaseUnit(rad=1, factor=0.001)))
    assert (own.unit, own.scale, own.complaint) == ("rad", 0.001, None)
    odd = si_conversion("x", Unit("x", BaseUnit(kg=2, m=-3, K=1)))
    assert (odd.unit, odd.complaint) == ("kg^2 K/m^3", None)


def test_binaries_of_other_processors_are_listed_and_the_folder_of_fmi_3_is_found(tmp_path: Path) -> None:
    import fmpy

    def foreign(entries: dict[str, bytes]) -> None:
        for name in [n for n in entries if n.startswith("binaries/")]:
            entries["binaries\\win64/Pendulum.dll"] = entries["binaries/aarch64-linux/Pendulum.so"] = entries.pop(name)

    bad = repacked(tmp_path / "foreign.fmu", foreign)
    assert describe(bad)["platforms"] == ["aarch64-linux", "win64", "c-code"]
    with pytest.raises(
        InputError, match=r"got aarch64-linux, win64, c-code; remedy: fmpy compile .*foreign.fmu"
    ) as caught:
        FmuPlant(bad, sample_time=0.01)
    assert f"binaries/{fmpy.platform_tuple}/ or binaries/{fmpy.platform}/" in str(caught.value)

    def tuples(entries: dict[str, bytes]) -> None:
        for name in [n for n in entries if n.startswith("binaries/")]:
            entries[f"binaries/{fmpy.platform_tuple}/{name.rpartition('/')[2]}"] = entries.pop(name)

    with FmuPlant(repacked(tmp_path / "tuple.fmu", tuples), sample_time=0.01) as plant:
        assert np.isfinite(plant.reset(rng=np.random.default_rng(0))).all()
