"""Axes of options: more cells with the same random numbers, and a floor that grows with the noise."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from harness.benchmark import bench, load_suite, plan, query, table
from harness.benchmark.planning import read_shard
from harness.benchmark.suite import tasks_of
from harness.errors import InputError

SUITE = """
name = "axis"
seeds = [0, 1]
[[groups]]
plants = [{ id = "linear-ode" }]
scenarios = [{ id = "prbs", options = { samples = 300, amplitude = 1.0 } }]
identifiers = [{ id = "arx" }, { id = "hold" }]
"""
NOISE = SUITE + 'axes = { "scenarios.noise" = [0.0, 0.01, 0.1] }\n'


@pytest.fixture
def suite(tmp_path: Path) -> Path:
    path = tmp_path / "axis.toml"
    path.write_text(NOISE)
    return path


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of that suite, run once; who changes it takes a copy."""
    folder = tmp_path_factory.mktemp("axes")
    (folder / "axis.toml").write_text(NOISE)
    bench(folder / "axis.toml", out=folder / "out", workers=1)
    return folder / "out"


def test_an_axis_makes_a_part_of_each_value(suite: Path) -> None:
    (group,) = load_suite(suite).groups
    assert [part.name for part in group.scenarios] == ["prbs [noise 0]", "prbs [noise 0.01]", "prbs [noise 0.1]"]
    assert [part.options["noise"] for part in group.scenarios] == [0.0, 0.01, 0.1]
    jobs = [cell.job for task in tasks_of(load_suite(suite)) for cell in task.cells]
    assert len(jobs) == len(set(jobs)) == 2 * 2 * 3


def test_two_axes_cross(tmp_path: Path) -> None:
    path = tmp_path / "two.toml"
    text = SUITE + 'axes = { "scenarios.noise" = [0.0, 0.1], "identifiers.order" = [1, 2] }\n'
    path.write_text(text.replace(', { id = "hold" }', ""))
    (group,) = load_suite(path).groups
    assert [part.name for part in group.identifiers] == ["arx [order 1]", "arx [order 2]"]
    assert len(tasks_of(load_suite(path))) == 4


@pytest.mark.parametrize(
    ("axes", "says"),
    [
        ('{ "noise" = [0.0] }', "names no kind"),
        ('{ "scenarios.noise" = [] }', "at least one"),
        ('{ "scenarios.noise" = ["loud"] }', "axes"),
    ],
)
def test_wrong_axes_are_refused(tmp_path: Path, axes: str, says: str) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(SUITE + f"axes = {axes}\n")
    with pytest.raises(InputError, match=says):
        load_suite(path)


def test_points_are_paired_and_the_floor_is_the_noise(ran: Path) -> None:
    arx = {(row.axis_values[0], row.seed): row for row in table(ran).rows if row.identifier == "arx"}
    assert arx[0.0, 0].axes == ("scenarios.noise",)
    for seed in (0, 1):
        assert arx[0.0, seed].noise_floor is None
        low, high = arx[0.01, seed].noise_floor, arx[0.1, seed].noise_floor
        assert high / low == pytest.approx(10.0, rel=0.3)  # the noise is the same, scaled; the outputs are nearly so
        for noise in (0.01, 0.1):
            assert arx[noise, seed].simulation_error > 0.9 * arx[noise, seed].noise_floor
    page = (ran / "report.html").read_text()
    assert "Along the axes" in page


@pytest.mark.slow
def test_shares_of_a_job_array_make_the_whole(suite: Path, ran: Path, tmp_path: Path) -> None:
    parts = tmp_path / "parts"
    for shard in ("1/2", "2/2"):
        bench(suite, out=parts, workers=1, shard=shard)
        if shard == "1/2":
            half = table(parts)
            assert (len(half.rows), half.planned) == (6, 12)
    assert len(table(parts).rows) == 12
    assert (parts / "results.parquet").read_bytes() == (ran / "results.parquet").read_bytes()
    assert query(parts, "select count(*) as n from results").records() == [{"n": 12}]
    for wrong in ("0/2", "3/2", "2", "a/b"):
        with pytest.raises(InputError, match="i/n"):
            read_shard(wrong)


def test_a_plan_counts_and_estimates_without_running(suite: Path, tmp_path: Path) -> None:
    before = plan(suite, out=tmp_path / "out", workers=1)
    assert (before.todo, before.found, before.seconds) == (12, 0, None)
    assert not (tmp_path / "out").exists()
    bench(suite, out=tmp_path / "out", workers=1, seeds=(0, 0))
    after = plan(suite, out=tmp_path / "out", workers=2)
    assert (after.todo, after.found, after.known) == (6, 6, 6)
    assert after.seconds is not None
    assert after.seconds > 0
    assert "6 cells to run, 6 already there; about" in str(after)
    assert plan(suite, out=tmp_path / "new", workers=2).seconds == pytest.approx(2 * after.seconds), "from beside it"
    log = (tmp_path / "out" / "bench.log").read_text().splitlines()
    assert len(log) == 6
    assert all(" ok " in line for line in log)


def test_before_anything_has_run_a_plan_goes_by_what_the_suite_states(tmp_path: Path) -> None:
    path = tmp_path / "stated.toml"
    path.write_text("cell_seconds = 3.0\n" + SUITE)
    found = plan(path, out=tmp_path / "out", workers=2)
    assert (found.seconds, found.declared) == (None, 3.0 * 4 / 2)
    assert "about 6 s, by the mean time of a cell that the suite states" in str(found)


def test_rows_are_filtered_by_the_values_of_columns(ran: Path, sysid) -> None:
    out = ran
    found = query(out, filters={"identifier": "arx", "seed": 1})
    assert len(found) == 3
    assert {(row["identifier"], row["seed"]) for row in found.records()} == {("arx", 1)}
    assert query(out, "select count(*) as n from timings", filters={"identifier": "arx"}).records() == [{"n": 6}]
    with pytest.raises(InputError, match="a column: plant"):
        query(out, filters={"identifer": "arx"})
    with pytest.raises(InputError, match="int64"):
        query(out, filters={"seed": "first"})

    printed = sysid("query", out, "--filter", "identifier=hold", "--filter", "seed=0").out
    assert printed.count("hold") == 3
    assert "arx" not in printed
    assert "log_score" not in printed, "a column without a value is not shown"


def test_an_older_store_is_read_and_one_of_another_format_is_refused_by_name(ran: Path, tmp_path: Path) -> None:
    out = shutil.copytree(ran, tmp_path / "out")
    from pyarrow import parquet

    # as a version before these columns and tables would have written it
    (out / "traces.parquet").unlink()
    results = parquet.read_table(out / "results.parquet")
    older = results.drop_columns(["log_score", "coverage", "control_score", "axes", "axis_values"])
    parquet.write_table(older, out / "results.parquet")
    read = table(out)
    assert len(read.rows) == 12
    assert {row.axes for row in read.rows} == {()}
    assert len(query(out, "select * from results")) == 12
    manifest = out / "bench.json"
    text = manifest.read_text()
    manifest.write_text(text.replace("sysid-harness/bench/1", "sysid-harness/bench/7"))
    for read_it in (table, query):
        with pytest.raises(InputError, match=r"sysid-harness/bench/7, written by sysid-harness 0\."):
            read_it(out)
    manifest.write_text(text[:40])
    with pytest.raises(InputError, match="no JSON"):
        table(out)


def test_questions_reach_half_finished_runs_and_nothing_else(suite: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    bench(suite, out=out, workers=1, seeds=(0, 0))
    from harness.benchmark.row import encoded
    from harness.benchmark.store import Store
    from harness.jobs.batch import write_shard

    rows = list(Store(out).rows().values())
    (out / "shards").mkdir()
    rows[0].job, rows[0].seed = "f" * 20, 7
    write_shard(out / "shards", rows[0].job, encoded(rows[0]))  # as if another seed were running
    answer = query(out, "select seed, count(*) as n from results group by seed order by seed")
    assert answer.records() == [{"seed": 0, "n": 6}, {"seed": 7, "n": 1}]
    assert answer.table.num_rows == len(answer) == 2
    assert answer.pandas()["n"].tolist() == [6, 1]
    assert answer.polars()["n"].to_list() == [6, 1]
    answer.write(tmp_path / "a.csv")
    assert (tmp_path / "a.csv").read_text().splitlines()[1] == "0,6"
    with pytest.raises(InputError, match="file exists"):
        answer.write(tmp_path / "a.csv")
    with pytest.raises(InputError, match="lists in outputs"):
        query(out, "select outputs from results").write(tmp_path / "b.csv")
    with pytest.raises(InputError, match="query"):
        query(out, f"select * from read_csv('{tmp_path / 'a.csv'}')")
    with pytest.raises(InputError, match="no benchmark here"):
        query(tmp_path / "nowhere", "select 1")
    units = (
        query(out, "select 1").table is not None and Store(out).arrow()["timings"].schema.field("fit_seconds").metadata
    )
    assert units == {b"unit": b"s"}
