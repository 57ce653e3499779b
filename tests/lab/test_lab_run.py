"""The command: rows at once, resume, force, budget, the summary; and two real rows."""

from __future__ import annotations

import json
import time

import pytest
from sysid_lab import running
from sysid_lab.pages.tables import counts, summary
from sysid_lab.plan import plan
from sysid_lab.row import COLUMNS, do_row
from sysid_lab.store import ROWS, RowStore, read_rows

from harness.errors import InputError
from harness.jobs import run_jobs
from harness.jobs.batch import write_shard


def row(number, outcome="right", study="confusion", truth="coulomb_friction@x", **more):
    values = {
        "key": f"k{number}", "study": study, "plant": "cart-pole", "engine": "laws", "truth": truth,
        "level": "nominal" if truth else "", "noise": "low", "disturbance": "0.0", "status": "ok",
        "outcome": outcome, "verdict": "effects_found" if outcome == "wrong" or truth else "nothing_missing",
        "accepted": truth, "ratio": "1.0", "improvement": "200", "oracle_improvement": "210", "cpu_s": "3",
        "wall_s": "4", "covered": "5", "intervals": "5", "adequacy": "explained", **more,
    }  # fmt: skip
    return dict.fromkeys(COLUMNS, "") | values


def test_rows_survive_a_killed_run_and_come_back(tmp_path):
    store = RowStore(tmp_path)
    for number in range(3):
        store.add(row(number, reason='a "quoted", odd reason'))
    with (tmp_path / ROWS).open("a") as file:
        file.write("k3,confusion,cart-po")  # the process was killed in the middle of a line
    again = RowStore(tmp_path, resume=True)
    assert list(again.rows) == ["k0", "k1", "k2"]
    again.add(row(4))
    assert list(read_rows(tmp_path / ROWS)) == ["k0", "k1", "k2", "k4"]
    assert read_rows(tmp_path / ROWS)["k0"]["reason"] == 'a "quoted", odd reason'


def test_a_resumed_study_tries_again_what_crashed(tmp_path):
    store = RowStore(tmp_path)
    for number, status in enumerate(("ok", "crashed", "timeout", "diverged")):
        store.add(row(number, status=status))
    assert list(RowStore(tmp_path, resume=True).rows) == ["k0", "k3"]


def test_rows_that_were_not_taken_over_before_the_end_are_taken_then(tmp_path):
    store = RowStore(tmp_path)
    for number, status in enumerate(("ok", "crashed")):
        write_shard(store.shards, f"job{number}", json.dumps(row(number, status=status)).encode())
    write_shard(store.shards, "job2", b"{}")  # of a row that was not begun
    again = RowStore(tmp_path, resume=True)
    assert list(again.rows) == list(read_rows(tmp_path / ROWS)) == ["k0"]
    again.close()
    assert not again.shards.exists()


def test_after_the_budget_no_row_is_begun(tmp_path):
    job = running.StudyJob(plan("confusion")[0], 400, time.time() - 1)
    run_jobs([job], tmp_path, workers=1)
    assert [path.read_bytes() for path in tmp_path.glob("*.json")] == [b"{}"]


def test_a_row_that_breaks_its_worker_says_so(tmp_path):
    job = running.StudyJob(plan("confusion")[0], 400, None)
    (name,) = job.jobs
    store = RowStore(tmp_path)
    write_shard(store.shards, name, job.lost(name, "timeout", "is over its time limit of 900 s", shared=False))
    assert store.take(name)
    found = store.rows[job.task.key]
    assert (found["status"], found["reason"]) == ("timeout", "the diagnosis is over its time limit of 900 s")
    assert found["seed"] == str(job.task.seed)


def test_a_folder_with_rows_is_not_overwritten(tmp_path):
    RowStore(tmp_path).add(row(0))
    with pytest.raises(InputError, match="--resume"):
        RowStore(tmp_path)
    assert RowStore(tmp_path, force=True).rows == {}


def test_a_study_is_by_one_state_of_the_code(tmp_path):
    RowStore(tmp_path).add(row(0))
    (tmp_path / "code.txt").write_text("another")
    with pytest.raises(InputError, match="made by other code"):
        RowStore(tmp_path, resume=True)
    assert RowStore(tmp_path, force=True).rows == {}
    assert RowStore(tmp_path, resume=True).rows == {}


def test_a_foreign_table_is_refused(tmp_path):
    (tmp_path / ROWS).write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="another version"):
        RowStore(tmp_path, resume=True)


def test_the_summary_counts_what_the_rows_say():
    rows = [
        row(0),
        row(1, "tied"),
        row(2, "wrong", accepted="cogging@x", how="another effect", ratio="1.5"),
        row(3, "missed", accepted="", verdict="nothing_missing"),
        row(4, study="none", truth=""),
        row(5, "wrong", study="none", truth="", accepted="force_bias@x"),
        row(6, status="timeout", reason="took longer", outcome=""),
    ]
    text = summary(rows, seeds="tuning", planned=9, keys={one["key"] for one in rows})
    assert counts(rows) == {"right": 2, "tied": 1, "wrong": 2, "flagged": 0, "missed": 1}
    assert "7 of 9 planned records done" in text
    assert "| **right, no rival tied**, without disturbance | 1 of 4 (25.0 %" in text
    assert "| right or tied, nominal size, without disturbance | 2 of 4 (50.0 %" in text
    assert "| right or tied, and its validation error within 1.1 of the oracle's | 2 of 4" in text
    assert "| named with confidence, and wrong | 1 of 4" in text
    assert "| white sensor noise alone | 2 | 1 | 97.47 % | 0 |" in text
    assert (
        "| coulomb_friction@x | cart-pole, laws, nominal, low, 0 % | cogging@x | wrong: another effect | 1.5 |" in text
    )
    assert "`k6`: timeout: took longer" in text


def test_laws_outside_the_dictionary_count_by_what_the_report_says():
    law = {"study": "outside", "truth": "root_friction@x", "verdict": "effects_found"}
    rows = [
        row(0, outcome="wrong", **law, residual_over_floor="1.2"),
        row(1, outcome="flagged", **law, stand_in="two laws imitate it"),
        row(2, outcome="flagged", **{**law, "verdict": "unexplained"}),
        row(3, outcome="missed", **{**law, "verdict": "nothing_missing"}),
        row(4, outcome="right", stand_in="doubted"),
        *(row(n, outcome="flagged", **{**law, "verdict": "model_does_not_fit"}) for n in (5, 6)),
    ]
    text = summary(rows, seeds="tuning", planned=7, keys={f"k{n}" for n in range(7)})
    assert "| root_friction@x | 6 | 1 | 2 | 1 | 1 | 1 |" in text
    assert "`k0`: named root_friction@x, 1.2 x floor" in text
    assert "`k1`" not in text
    assert "| right or tied, but called a stand-in | 1 of 1" in text


def test_the_cost_of_a_command_that_compiles_first_has_no_wall_time_of_the_one_after():
    rows = [row(0, study="cost", cpu_s="2.5", cpu_cold_s="7.5", wall_s="3.5")]
    text = summary(rows, seeds="tuning", planned=1, keys={"k0"})
    assert "| command, cart-pole | 1 | 2.5 | 2.5 | 2.5 | 3.5 | 3.5 |" in text
    assert "| command, cart-pole, cold | 1 | 7.5 | 7.5 | 7.5 |  |  |" in text


def test_other_rows_of_the_folder_are_left_out():
    text = summary([row(0), row(1)], seeds="tuning", planned=1, keys={"k0"})
    assert "1 of 1 planned records done" in text


@pytest.fixture
def quick_rows(monkeypatch):
    """Replace the engine by rows that cost nothing; returns the keys that were asked for."""
    asked = []

    def run_jobs(batches, shards, *, moved, **options):
        for one in batches:
            asked.append(one.task.key)
            write_shard(shards, one.jobs[0], json.dumps(row(0, truth="", study="none", key=one.task.key)).encode())
            moved(one.title, one.jobs)

    monkeypatch.setattr(running, "run_jobs", run_jobs)
    return asked


def test_resume_does_only_what_is_left(tmp_path, quick_rows):
    seen = []
    running.study("false-alarms", out=tmp_path, records=4, progress=lambda *step: seen.append(step[:2]))
    assert len(quick_rows) == 4
    assert seen[0] == (0, 4)
    assert seen[-1] == (4, 4)
    result = running.study("false-alarms", out=tmp_path, records=6, resume=True)
    assert len(quick_rows) == 6
    assert (result.done, result.planned) == (6, 6)
    assert (tmp_path / running.SUMMARY).read_text() == result.text


@pytest.mark.parametrize("wrong", [{"seeds": "mine"}, {"budget": 0.0}, {"workers": 0}, {"plants": ["crane"]}])
def test_wrong_options_are_refused_before_anything_is_written(tmp_path, wrong):
    with pytest.raises(InputError):
        running.study("all", out=tmp_path / "new", **wrong)
    assert not (tmp_path / "new").exists()


def test_the_picture_shows_single_effects(tmp_path):
    from sysid_lab.pages.picture import confusion_picture

    rows = [row(0), row(1, "wrong", accepted="cogging@x"), row(2, truth="", accepted="")]
    assert confusion_picture(rows, tmp_path / "matrix.png")
    assert (tmp_path / "matrix.png").stat().st_size > 5000
    assert not confusion_picture([row(0, study="two")], tmp_path / "none.png")


def test_a_fault_is_a_row_with_its_reason(monkeypatch):
    from sysid_lab import row as module

    from harness.errors import PlantError

    def broken(task, samples):
        raise PlantError("the truth leaves every bound", status="diverged")

    monkeypatch.setattr(module, "make_records", broken)
    found = do_row(plan("confusion")[0])
    assert (found["status"], found["reason"]) == ("diverged", "the truth leaves every bound")


def test_the_cost_is_that_of_the_command_with_its_children(monkeypatch):
    from sysid_lab import cost
    from sysid_lab.plan import Task
    from sysid_lab.records import make_records

    burn = "import time; end = time.process_time() + 0.3\nwhile time.process_time() < end: pass"
    command = f"""
import json, os, pathlib, subprocess, sys
cache = pathlib.Path(os.environ["SYSID_HARNESS_CACHE"])
if not cache.exists():  # as a compiler would be called once
    subprocess.run([sys.executable, "-c", {burn!r}], check=True)
    cache.mkdir()
out = pathlib.Path(sys.argv[sys.argv.index("--out") + 1])
out.mkdir()
(out / "report.json").write_text(json.dumps({{"verdict": "nothing_missing", "effects": []}}))
"""
    monkeypatch.setattr(cost, "_COMMAND", command)
    one = Task("cost", "pendulum", "laws", (), "", "high", 0.0, 0, 0)
    found = cost.timed_command(one, make_records(one, samples=300))
    assert found["verdict"] == "nothing_missing"
    assert float(found["cpu_cold_s"]) > float(found["cpu_s"]) + 0.2
    monkeypatch.setattr(cost, "_COMMAND", "import sys; sys.exit('no such model')")
    assert "no such model" in do_row(one, samples=300)["reason"]


def test_a_wrong_name_is_an_interval_that_misses():
    from types import SimpleNamespace

    from sysid_lab.row import _coverage

    records = SimpleNamespace(parameters={"J": 0.1}, known=())
    fit = SimpleNamespace(free=("J",), on_bound=(), interval=lambda name: (0.09, 0.11), values={"J": 0.1})
    found = _coverage(fit, records, {"force_bias@theta"})
    assert found == {"covered": 1, "intervals": 2, "outside_interval": "force_bias@theta (not there)"}


def test_an_answer_with_rivals_tied_is_not_right_alone():
    rows = [row(0, tie_size="1"), row(1, tie_size="3"), row(2, "tied", tie_size="2"), row(3, tie_size="")]
    text = summary(rows, seeds="tuning", planned=4, keys={one["key"] for one in rows})
    assert "| **right, no rival tied**, without disturbance | 2 of 4" in text
    assert "1: 2, 2: 1, 3: 1, 4 or more: 0" in text


def test_what_no_experiment_tells_apart_is_left_out_of_figures_of_its_own():
    rows = [
        row(0, truth="gravity_tilt@base", plant="pendulum", tie_size="3", shown="1.000", told="0.100"),
        row(1, truth="coulomb_friction@theta", plant="pendulum", engine="bullet", tie_size="1", told="0.960"),
        row(2, truth="coulomb_friction@theta", plant="pendulum", engine="hardware", tie_size="2"),
        row(3, truth="dead_zone@u", plant="pendulum", tie_size="2", shown="0.990", told="0.940"),
        row(4, "missed", truth="dead_zone@u", plant="pendulum", shown="0.400", told="0.400"),
        row(5, truth="dead_zone@u", plant="pendulum", tie_size="2", shown="0.990", told="0.980"),
    ]
    text = summary(rows, seeds="tuning", planned=6, keys={one["key"] for one in rows})
    assert "| **right, no rival tied**, without disturbance | 1 of 6" in text
    assert "| the same where nothing is exactly like the truth, without | 1 of 4" in text
    assert "| the same where the experiment can tell it apart, without | 1 of 2" in text
    assert "| right or tied, nominal size, without disturbance | 5 of 6" in text
    assert "| the same where the experiment can show it, nominal size, without disturbance | 3 of 3" in text


def test_false_alarms_are_counted_by_what_nobody_modelled():
    nothing = {"study": "none", "truth": "", "accepted": ""}
    rows = [
        row(0, **nothing, disturbance="0.02", shape="steps"),
        row(1, "wrong", **{**nothing, "accepted": "cogging@x"}, disturbance="0.02", shape="wheel", input_noise="0.01"),
        row(2, "wrong", **{**nothing, "accepted": "cogging@x"}, structure="heavy-rod"),
        row(3, "flagged", **nothing, structure="heavy-rod") | {"verdict": "unexplained"},
    ]
    text = summary(rows, seeds="tuning", planned=4, keys={one["key"] for one in rows})
    assert "| with 2 % unknown torque | 2 | 1 |" in text
    assert "| of them, wheel | 1 | 1 |" in text
    assert "| of them, steps | 1 | 0 |" in text
    assert "| nominal structure a little wrong: heavy-rod | 2 | 1 | 97.47 % | 1 |" in text
    assert "white sensor noise alone" not in text, "a structure that is wrong is no class of false alarms"


def test_coverage_compares_what_means_the_same():
    from types import SimpleNamespace

    from sysid_lab.row import _coverage
    from sysid_lab.truths.context import Hidden

    hidden = Hidden("position_dependent_friction", "theta", {}, {"Fc": 0.2, "a": 0.6, "phi": 1.0})
    records = SimpleNamespace(parameters={"J": 0.1, "b": 0.05}, known=(hidden,))
    name = "position_dependent_friction@theta"
    intervals = {
        "J": (0.09, 0.13),
        "b": (0.06, 0.10),
        f"{name}.Fc": (0.1, 0.3),
        f"{name}.a": (float("nan"), float("nan")),
        f"{name}.phi": (6.9, 7.1),
        f"{name}.w": (0.0, 0.02),
    }
    values = {key: 0.5 * (low + high) for key, (low, high) in intervals.items()}
    fit = SimpleNamespace(free=tuple(intervals), on_bound=(), interval=intervals.__getitem__, values=values)
    found = _coverage(fit, records)
    assert found == {"covered": 2, "intervals": 3, "outside_interval": "b (+1.5)"}
    foreign = SimpleNamespace(parameters=records.parameters, known=(Hidden("even_drag", "theta", {}, {"c": 0.1}),))
    plain = SimpleNamespace(free=("J", "b"), on_bound=(), interval=intervals.__getitem__, values=values)
    assert _coverage(plain, foreign)["intervals"] == 2, "a law outside the dictionary has no interval, the others have"


@pytest.mark.slow
def test_two_rows_end_to_end(tmp_path):
    result = running.study("false-alarms", out=tmp_path, records=2, plants=["pendulum"], workers=1, samples=1500)
    assert [one["status"] for one in result.rows] == ["ok", "ok"]
    assert {one["verdict"] for one in result.rows} == {"nothing_missing"}
    assert all(float(one["cpu_s"]) > 0 for one in result.rows)
    assert "2 of 2 planned records done" in (tmp_path / running.SUMMARY).read_text()
    assert "| with 2 % unknown torque | 1 | 0 |" in result.text
