"""Suites: what is read, what is refused, and with which words."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest

from harness.benchmark.suite import cells_of, load_suite, tasks_of
from harness.errors import InputError
from harness.jobs import make_engine
from harness.registry import DISTRIBUTION, entries
from harness.trust import trusting

GROUP = """
[[groups]]
plants = [{id = "linear-ode"}]
scenarios = [{id = "prbs"}]
identifiers = [{id = "hold"}, {id = "dmdc"}]
"""


@pytest.mark.parametrize("name", ["quick", "smoke", "standard", "measured", "further"])
def test_bundled_suites_load(name: str) -> None:
    suite = load_suite(name)
    pairs = cells_of(tasks_of(suite))
    assert suite.name == name
    assert suite.description
    assert len({cell.job for _, cell in pairs}) == len(pairs)


def test_every_identifier_stands_in_a_suite() -> None:
    groups = [group for suite in entries("suites") for group in load_suite(suite.id).groups]
    held = {part.id for group in groups for part in group.identifiers}
    assert held >= {one.id for one in entries("identifiers") if one.distribution == DISTRIBUTION}


def test_quick_has_every_family() -> None:
    suite = load_suite("quick")
    plants = {part.id for group in suite.groups for part in group.plants}
    identifiers = {part.id for group in suite.groups for part in group.identifiers}
    assert {"pendulum-fmu", "iiwa-bullet", "linear-ode", "grid-mdp"} <= plants
    assert plants & {"cart-pole-pymunk", "cart-pole-ode"}
    assert {"hold", "true-model", "dmdc", "edmdc", "ho-kalman", "stlsq", "mdp-counting", "rls"} <= identifiers
    assert {"lumped-torque", "lumped-energy", "lumped-momentum"} <= identifiers


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('name = "x"\ncolour = 1\n' + GROUP, "colour"),
        (
            'name = "x"\n' + GROUP.replace('{id = "hold"}', '{id = "hold", optoins = {}}'),
            "groups[0].identifiers[0].optoins",
        ),
        ('name = "x"\n' + GROUP.replace('"prbs"', '"prsb"'), "did you mean prbs"),
        ('name = "x"\n' + GROUP.replace('"dmdc"', '"hold"'), "two rows with one name"),
        ('name = "x"\nseeds = ["a"]\n' + GROUP, "seeds[0]"),
        ("name = \n", "not TOML"),
        ('name = "x"\ngroups = []\n', "at least one group"),
        (GROUP, "name"),
        ('name = "x"\n' + GROUP.replace('"linear-ode"', '"recording:emps"'), "groups[0].scenarios"),
        ('name = "x"\n' + GROUP.replace('"prbs"', '"recorded"'), "groups[0].scenarios"),
    ],
)
def test_bad_suites_are_refused_with_file_and_key(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        load_suite(path)
    message = str(caught.value)
    assert says in message
    assert "bad.toml" in message
    assert "remedy" in message
    assert "\n" not in message


def test_a_recording_goes_with_the_scenario_of_recordings(tmp_path: Path) -> None:
    path = tmp_path / "recorded.toml"
    path.write_text('name = "x"\n' + GROUP.replace('"linear-ode"', '"recording:emps"').replace('"prbs"', '"recorded"'))
    assert load_suite(path).groups[0].plants[0].id == "recording:emps"


def test_missing_suites() -> None:
    with pytest.raises(InputError, match="no such suite"):
        load_suite("nowhere.toml")
    with pytest.raises(InputError, match="unknown suite"):
        load_suite("quikc")


def test_a_job_is_a_hash_of_what_decides_its_result(tmp_path: Path) -> None:
    def jobs(text: str) -> list[str]:
        path = tmp_path / "suite.toml"
        path.write_text(text)
        return [cell.job for _, cell in cells_of(tasks_of(load_suite(path), [0]))]

    base = jobs('name = "x"\n' + GROUP)
    assert jobs('name = "other"\ntime_limit = 1.0\n' + GROUP) == base
    assert not set(jobs('name = "x"\n' + GROUP.replace('{id = "prbs"}', '{id = "prbs", options = {hold = 3}}'))) & set(
        base
    )
    assert len(set(jobs('name = "x"\n' + GROUP.replace('{id = "hold"}, ', ""))) & set(base)) == 1


@pytest.mark.parametrize("text", ["cloud", "dask://nowhere", "dask"])
def test_unknown_engines(text: str) -> None:
    with pytest.raises(InputError, match="local or dask"):
        make_engine(text)


def test_workers_must_be_positive() -> None:
    with pytest.raises(InputError, match="at least 1"):
        make_engine("local", workers=0)


COUPLING = """
sample_time = 0.02
inputs = { u = "arm.u" }
outputs = ["arm.theta"]
[parts.arm]
fmu = "arm.fmu"
[[connections]]
from = "u"
to = "arm.u"
"""


def test_a_plant_in_a_file_lies_beside_its_suite_goes_by_its_name_and_is_another_with_its_content(
    tmp_path: Path,
) -> None:
    (tmp_path / "plants").mkdir()
    file, path = tmp_path / "plants" / "arm.fmu", tmp_path / "suite.toml"
    plants = [
        '{id = "plants/arm.fmu"}',
        '{id = "plants/arm.fmu", label = "own"}',
        '{id = "plants/arm.fmu", label = "x", streams = "y"}',
    ]
    path.write_text('name = "x"\n' + GROUP.replace('{id = "linear-ode"}', ", ".join(plants)))
    jobs, streams = set(), set()
    for content in (b"one", b"two"):
        file.write_bytes(content)
        with trusting(tmp_path):
            suite = load_suite(path)
            jobs |= {cell.job for _, cell in cells_of(tasks_of(suite, [0]))}
        found = suite.groups[0].plants
        assert [part.id for part in found] == [str(file.resolve())] * 3
        assert [part.name for part in found] == ["arm.fmu", "own", "x"]
        assert [part.stream for part in found[1:]] == ["own", "y"]
        streams.add(found[0].stream)
    assert (len(jobs), len(streams)) == (12, 2)


def test_a_coupling_and_an_fmu_are_plants_of_a_suite(tmp_path: Path) -> None:
    from harness.benchmark import bench
    from plants.mockups import mockup

    shutil.copy(mockup("pendulum"), tmp_path / "arm.fmu")
    (tmp_path / "loop.toml").write_text(COUPLING)
    path = tmp_path / "suite.toml"
    alone = '{id = "arm.fmu", label = "alone", options = {sample_time = 0.02, outputs = ["theta"]}}'
    plants = f'[{{id = "loop.toml"}}, {alone}]'
    scenario = '[{id = "prbs", options = {samples = 150}}]'
    group = f'[[groups]]\nplants = {plants}\nscenarios = {scenario}\nidentifiers = [{{id = "arx"}}]\n'
    path.write_text('name = "files"\nseeds = [0]\n' + group)
    with pytest.raises(InputError, match=r"plants\[1\]\.id: a file that runs code.*--trust arm\.fmu"):
        bench(path, out=tmp_path / "out", workers=1)
    with trusting(tmp_path / "arm.fmu"):
        rows = bench(path, out=tmp_path / "out", workers=1).rows
        assert [(row.plant, row.status) for row in rows] == [("loop.toml", "ok"), ("alone", "ok")], rows
        before = [cell.job for _, cell in cells_of(tasks_of(load_suite(path)))]
        shutil.copy(mockup("mass_spring"), tmp_path / "arm.fmu")
        after = [cell.job for _, cell in cells_of(tasks_of(load_suite(path)))]
        assert not set(before) & set(after), "another FMU makes another row"
    with trusting(path), pytest.raises(InputError, match=r"parts\.arm\.fmu: a file that runs code"):
        load_suite(path)
    (tmp_path / "arm.fmu").unlink()
    with trusting(tmp_path), pytest.raises(InputError, match=r"arm\.fmu: groups\[0\]\.plants\[0\]\.id.*no such plant"):
        load_suite(path)


def test_a_query_without_its_extra_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from harness.benchmark import query

    monkeypatch.setitem(sys.modules, "duckdb", None)
    with pytest.raises(InputError, match=r"sysid-harness\[query\]"):
        query(tmp_path, "select 1")
