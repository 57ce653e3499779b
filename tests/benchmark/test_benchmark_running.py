"""Benchmarks: rows for whatever happens, the same rows however they are computed, nothing finished is lost."""

from __future__ import annotations

import io
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from harness.benchmark import BenchResult, bench, rich_table, table
from harness.errors import InputError

FAILURES = ("raise", "hang", "hang-in-c", "segfault", "exit", "sys-exit", "unfit", "unstable")


def write_suite(folder: Path, groups: str, **top: Any) -> Path:
    """Write a suite file."""
    lines = [f"{key} = {json.dumps(value)}" for key, value in {"name": "trial", "seeds": [0, 1], **top}.items()]
    path = folder / "trial.toml"
    path.write_text("\n".join(lines) + "\n" + groups)
    return path


GOOD = """
[[groups]]
plants = [{id = "test-lag"}, {id = "test-lag", label = "slow lag", options = {pole = 0.98}}]
scenarios = [{id = "prbs", options = {samples = 200, noise = 0.01}}]
identifiers = [{id = "test-fit"}, {id = "test-online"}]
"""


def by_label(result: BenchResult) -> dict[str, Any]:
    """Return the rows of seed 0 by identifier."""
    return {row.identifier: row for row in result.rows if row.seed == 0}


def test_good_cells_are_scored(good: BenchResult) -> None:
    result = good
    assert len(result.rows) == result.planned == 8
    assert {row.status for row in result.rows} == {"ok"}
    fit = next(row for row in result.rows if row.identifier == "test-fit")
    assert 0 < fit.simulation_error < 0.2
    assert fit.regret is None
    assert fit.initial_state
    assert fit.burn_in == 1
    online = next(row for row in result.rows if row.identifier == "test-online")
    assert online.regret > 0
    assert online.simulation_error is None
    assert online.curve_regret[-1] == pytest.approx(online.regret)
    assert [(r.plant, r.seed) for r in result.rows if r.identifier == "test-fit"] == [
        ("test-lag", 0), ("test-lag", 1), ("slow lag", 0), ("slow lag", 1),
    ]  # fmt: skip
    assert result.folder is not None
    assert not (result.folder / "shards").exists()


def test_every_way_to_break_is_a_row_and_costs_no_other_row(plugins: Path, tmp_path: Path) -> None:
    parts = [f'{{id = "test-fit", label = "{how}", options = {{fail = "{how}"}}}}' for how in FAILURES]
    parts.insert(3, '{id = "test-fit"}')
    parts += ['{id = "test-nothing"}', '{id = "mdp-counting"}', '{id = "test-fit", label = "after"}']
    groups = f"""
    [[groups]]
    plants = [{{id = "test-lag"}}]
    scenarios = [{{id = "prbs", options = {{samples = 100}}}}]
    identifiers = [{", ".join(parts)}]
    """
    rows = by_label(bench(write_suite(tmp_path, groups, time_limit=3.0, seeds=[0]), out=tmp_path / "out", workers=2))
    assert len(rows) == len(parts)
    assert rows["test-fit"].status == rows["after"].status == "ok"
    assert rows["raise"].status == "crashed"
    assert "ZeroDivisionError: by intent" in rows["raise"].reason
    for how in ("hang", "hang-in-c"):
        assert rows[how].status == "timeout"
        assert "3 s" in rows[how].reason
    assert (rows["segfault"].status, "SIGSEGV" in rows["segfault"].reason) == ("crashed", True)
    assert (rows["exit"].status, "7" in rows["exit"].reason) == ("crashed", True)
    assert (rows["sys-exit"].status, "leaving" in rows["sys-exit"].reason) == ("crashed", True)
    assert (rows["unfit"].status, "record more" in rows["unfit"].reason) == ("unfit", True)
    assert rows["unstable"].status == "diverged"
    assert rows["unstable"].simulation_error is None
    assert rows["test-nothing"].status == "crashed"
    assert rows["mdp-counting"].status in ("unfit", "refused")
    assert rows["mdp-counting"].reason


@pytest.mark.parametrize(
    ("how", "status"), [("raise", "crashed"), ("diverge", "diverged"), ("hang", "timeout"), ("segfault", "crashed")]
)
def test_a_plant_that_breaks_is_a_row_for_each_identifier(plugins: Path, tmp_path: Path, how: str, status: str) -> None:
    groups = f"""
    [[groups]]
    plants = [{{id = "test-lag", label = "bad", options = {{fail = "{how}"}}}}, {{id = "test-lag"}}]
    scenarios = [{{id = "prbs", options = {{samples = 100}}}}]
    identifiers = [{{id = "test-fit"}}, {{id = "test-online"}}]
    """
    result = bench(write_suite(tmp_path, groups, time_limit=3.0, seeds=[0]), workers=1)
    assert [(row.plant, row.status) for row in result.rows] == [
        ("bad", status), ("bad", status), ("test-lag", "ok"), ("test-lag", "ok"),
    ]  # fmt: skip
    assert "no data" in result.rows[0].reason
    assert result.folder is None


def test_results_are_identical_for_any_number_of_workers_and_after_resume(
    plugins: Path, tmp_path: Path, good: BenchResult
) -> None:
    assert good.folder is not None
    suite, one, two = good.folder.parent / "trial.toml", tmp_path / "one", good.folder
    bench(suite, out=one, workers=1, seeds=(0, 0))
    bench(suite, out=one, workers=1, resume=True)
    assert (one / "results.parquet").read_bytes() == (two / "results.parquet").read_bytes()


def test_changing_the_identifiers_never_changes_the_data(plugins: Path, tmp_path: Path, good: BenchResult) -> None:
    alone = bench(write_suite(tmp_path, GOOD.replace(', {id = "test-online"}', "")), workers=1)
    fits = [[row.simulation_error for row in r.rows if row.identifier == "test-fit"] for r in (good, alone)]
    assert fits[0] == fits[1]


def test_a_folder_with_results_is_refused_unless_resumed(plugins: Path, good: BenchResult) -> None:
    assert good.folder is not None
    suite, out = good.folder.parent / "trial.toml", good.folder
    with pytest.raises(InputError, match="--resume"):
        bench(suite, out=out, workers=1)
    with pytest.raises(InputError, match="rows of other cells"):
        bench(suite, out=out, workers=1, seeds=(5, 5), resume=True)


SCRIPT = """
import signal, sys
from harness.benchmark import bench
signal.signal(signal.SIGINT, signal.default_int_handler)  # a test started in the background inherits it ignored
bench(sys.argv[1], out=sys.argv[2], workers=2)  # at the top level of a script, without a guard
"""


@pytest.mark.parametrize("how", [pytest.param(signal.SIGINT, marks=pytest.mark.slow), signal.SIGKILL])
def test_an_interrupted_run_keeps_its_rows_and_resumes(plugins: Path, tmp_path: Path, how: signal.Signals) -> None:
    groups = GOOD.replace('{id = "test-fit"}', '{id = "test-fit", options = {nap = 0.4}}')
    suite, out = write_suite(tmp_path, groups, seeds=list(range(8))), tmp_path / "out"
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(plugins), os.environ.get("PYTHONPATH", "")])}
    process = subprocess.Popen(
        [sys.executable, str(script), str(suite), str(out)], env=environment, stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 30
    while len(list(out.glob("shards/*.json"))) < 4 and time.monotonic() < deadline:
        assert process.poll() is None, process.stderr.read() if process.stderr else ""
        time.sleep(0.05)
    process.send_signal(how)
    process.communicate(timeout=20)
    assert process.returncode != 0
    kept = table(out)
    assert 4 <= len(kept.rows) < kept.planned == 32
    seen = []
    result = bench(
        suite, out=out, workers=2, resume=True, progress=lambda done, total, what: seen.append((done, total))
    )
    assert seen[0][0] >= len(kept.rows)
    assert seen[-1] == (32, 32)
    assert len(result.rows) == 32
    assert result.ok == 32, [row.reason for row in result.rows if row.status != "ok"]


def test_table_and_query_read_a_folder_back(tmp_path: Path, good: BenchResult) -> None:
    from rich.console import Console

    made = good
    assert made.folder is not None
    read = table(made.folder)
    assert read.rows == made.rows
    console = Console(width=160, record=True, file=io.StringIO())
    console.print(rich_table(read))
    text = console.export_text()
    assert "slow lag" in text
    assert "2/2" in text
    found = made.query(
        "select plant, count(*) as n, median(simulation_error) as m from results group by plant order by plant"
    )
    assert [(row["plant"], row["n"]) for row in found] == [("slow lag", 4), ("test-lag", 4)]
    with pytest.raises(InputError, match="query"):
        made.query("select nonsense")
    with pytest.raises(InputError, match="no benchmark here"):
        table(tmp_path)


def test_report_is_one_self_contained_page(plugins: Path, tmp_path: Path) -> None:
    groups = (
        GOOD.replace("[{id", '[{id = "test-fit", label = "<b>bad</b>", options = {fail = "raise"}}, {id', 3)
        .replace('plants = [{id = "test-fit", label = "<b>bad</b>", options = {fail = "raise"}}, ', "plants = [")
        .replace('scenarios = [{id = "test-fit", label = "<b>bad</b>", options = {fail = "raise"}}, ', "scenarios = [")
    )
    result = bench(write_suite(tmp_path, groups, description="what it is for"), out=tmp_path / "out", workers=2)
    assert result.report is not None
    page = result.report.read_text()
    assert page.count("<svg") == 2
    assert "what it is for" in page
    assert "ZeroDivisionError: by intent" in page
    assert "<b>bad</b>" not in page
    for link in ("src=", "<script", "@import", "<link"):
        assert link not in page
    links = re.findall(r'href="(overlays/\w+\.svg)"', page)
    assert len(links) == len({(row.plant, row.scenario, row.identifier) for row in result.rows if row.trace_t}) > 0
    for link in links:
        assert "residual" in (tmp_path / "out" / link).read_text()
    before = page
    table(tmp_path / "out")
    assert result.report.read_text() == before
