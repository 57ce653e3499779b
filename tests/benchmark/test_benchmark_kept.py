"""What a benchmark keeps and shows: tables, plans, traces, stores and probes, figure by figure."""

from __future__ import annotations

import csv
import io
import json
import typing
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_rows import SCORES, row, task

from harness.benchmark import BenchResult, running
from harness.benchmark.columns import arrow_table, columns_of_files, plain_values, rows_of, write_rows
from harness.benchmark.page.exports import latex_text, render
from harness.benchmark.page.tables import _Column, _folded, _reasons, _status
from harness.benchmark.parts import ScoreSettings, Suite, SuitePart, Task
from harness.benchmark.planning import BenchPlan, plan_of
from harness.benchmark.row import STATUSES, Row, blank, encoded, one_line, read_row, sound
from harness.benchmark.running import _batches, _logged, _missing, _result, plan
from harness.benchmark.store import BATCH, Store, versions
from harness.benchmark.suite import _job, cells_of, load_suite, tasks_of
from harness.benchmark.summary import figure, summarise
from harness.errors import InputError, PlantError


def result(rows: list[Row], **more: Any) -> BenchResult:
    cells = tuple(dict.fromkeys((one.plant, one.scenario, one.identifier) for one in rows))
    return BenchResult(
        "suite", tuple(rows), len(rows) + 2, None, {"numpy": "2.0", "fmpy": "not installed"}, cells, **more
    )


def test_tables_for_papers_hold_every_figure_in_its_column() -> None:
    rng = np.random.default_rng(1)
    names = [*SCORES, "noise_floor", "least_equation_error"]
    rows = [
        row(who, seed, **{name: float(value) for name, value in zip(names, rng.uniform(1, 2, len(names)), strict=True)})
        for who in ("arx", "a|b_c") for seed in range(3)
    ]  # fmt: skip
    for one in rows:
        one.control_status = "held"
    rows.append(row("none", 0, plant="other", status="unfit", reason="too little"))
    made = result(rows)
    assert "| p | s | late | 0/0 |" in render(BenchResult("s", (), 1, None, {}, (("p", "s", "late"),)), "markdown")
    lines = {line.identifier: line for line in made.summary()}
    table = list(csv.DictReader(io.StringIO(render(made, "csv"))))
    assert [one["identifier"] for one in table] == ["arx", "a|b_c", "none"]
    for one in table:
        line = lines[one["identifier"]]
        for name in (*names, "best_possible", "over_best"):
            score = getattr(line, name)
            for part in ("median", "low", "high"):
                assert one[f"{name}_{part}"] == ("" if score is None else repr(getattr(score, part))), name
        assert (one["ok"], one["run"], one["bound"]) == (str(line.ok), str(line.run), line.bound)
    assert table[2]["problems"] == "1 unfit: too little"
    head, rule, *body = render(made, "markdown").splitlines()
    titles = [cell.strip() for cell in head.strip("|").split("|")]
    assert rule.count("---") == len(titles)
    cells = [[cell.strip() for cell in line.replace("\\|", "!").strip("|").split("|")] for line in body]
    by_title = [dict(zip(titles, own, strict=True)) for own in cells]
    columns = {"equation error": "equation_error", "simulation error": "simulation_error", "regret": "regret",
               "log score": "log_score", "90 % sets hold": "coverage", "log regret": "log_regret",
               "regret's rise over theory's": "regret_over_theory"}  # fmt: skip
    for own, line in zip(by_title, lines.values(), strict=True):
        for title, name in columns.items():
            score = getattr(line, name)
            shown = "" if score is None else str(score)
            assert own[title] in (shown, f"**{shown}**", "unfit")
        assert own["ok/run"] == f"{line.ok}/{line.run}"
        best, seconds = line.best_possible, line.fit_seconds
        assert own["best possible"] == ("" if best is None else figure(best.median))
        assert own["over best"] == ("" if line.over_best is None else figure(line.over_best.median))
        assert own["fit"] == (f"{figure(seconds.median, 2)} s" if line.ok else "")
    assert by_title[2]["simulation error"] == "unfit"
    latex = render(made, "latex").splitlines()
    columns_of_latex = latex[2].removeprefix(r"\begin{tabular}{").removesuffix("}")
    lines_of_latex = [line for line in latex if line.endswith(r" \\")]
    assert {len(line.split(" & ")) for line in lines_of_latex} == {len(columns_of_latex)} == {len(titles)}
    assert latex.count(r"\addlinespace") == 1
    assert latex.index(r"\addlinespace") == len(latex) - 5
    assert "Versions: numpy 2.0." in latex[1]
    assert latex_text("a_b~^\\") == r"a\_b\textasciitilde{}\textasciicircum{}\textbackslash{}"
    assert str(made) == "suite suite: 6 ok of 7 run, 9 planned"


def test_a_line_without_an_answer_says_why_and_reasons_are_told_once() -> None:
    rows = [row("x", k, plant=plant, status="crashed", reason=f"{why} {'word ' * 60}") for k, (plant, why) in
            enumerate((("p", "rare"), ("p", "often"), ("p", "often"), ("q", "rare"), ("r", "rare")))]  # fmt: skip
    lines = summarise([*rows, row("fine", simulation_error=1.0)])
    (text,) = _reasons(lines)
    assert text.startswith("5 crashed: x on p x s and 2 more: often word")
    assert text.endswith(" ...")
    assert len(text.partition("more: ")[2]) <= 200
    assert [_status(line) for line in lines[:1]] == ["crashed"]
    assert _status(summarise([], [("p", "s", "late")])[0]) == "not run"
    assert (_folded("nine sign"), _folded("ten  signs"), _folded("a b control score")) == (
        "nine sign", "ten \nsigns", "a b control\nscore"
    )  # fmt: skip
    fine = lines[-1]
    assert [_Column("x best").text(fine), _Column("s", "simulation_error").text(fine, quartiles=False)] == ["", "1"]


def test_the_log_says_a_row_and_its_seconds() -> None:
    one = row(seed=4, fit_seconds=1.25, score_seconds=0.5)
    assert _logged(one) == "p x s x arx seed 4 1.75 s"
    assert _logged(row(reason="late")) == "p x s x arx seed 0 0.00 s: late"


@pytest.mark.parametrize(
    ("traces", "kept"), [("first", [True, False, True]), ("all", [True] * 3), ("none", [False] * 3)]
)
def test_traces_are_kept_of_the_seeds_that_are_asked_for(traces: str, kept: list[bool]) -> None:
    tasks = [task(seed=3), task(seed=1), task(seed=1, plant="q")]
    batches = _batches(tasks, traces)
    assert [batch.trace for batch in batches] == kept
    with pytest.raises(InputError, match=r"^traces: expected one of first, all, none, got 'some'"):
        _batches(tasks, "some")
    several = _batches([task(jobs=("a", "b", "c")), task(jobs=("d",))], traces)
    left = list(_missing(several, {"b": row(), "d": row()}))
    assert [(batch.jobs, batch.trace) for batch in left] == [(("a", "c"), several[0].trace)]
    assert several[0].only(["c"]).jobs == ("c",)


def test_a_plan_multiplies_cells_by_the_mean_times_of_their_kind(tmp_path: Path) -> None:
    tasks = [task(jobs=(f"{plant}{seed}a", f"{plant}{seed}b"), plant=plant, seed=seed, time_limit=30.0)
             for plant in "pq" for seed in range(3)]  # fmt: skip
    timed = [
        Row(job=f"old{k}", plant="p", scenario="s", identifier=who, seed=seed, data_seconds=4.0, fit_seconds=fit,
            score_seconds=1.0)
        for k, (who, seed, fit) in enumerate((("hold", 0, 2.0), ("other", 0, 9.0), ("hold", 1, 5.0)))
    ]  # fmt: skip
    file = tmp_path / "timings.parquet"
    write_rows(file, columns_of_files()[1], timed)
    # the data of seed 0 are shared by two cells: 2 + 2 + 1 and 4 + 5 + 1 s
    found = plan_of(tasks, {"p0a"}, [file, tmp_path / "none.parquet"], workers=2, declared=3.0)
    assert (found.todo, found.found, found.known) == (11, 1, 5)
    assert found.cells == {("p", "s", "hold"): 5, ("q", "s", "hold"): 6}
    assert found.seconds == pytest.approx(7.5 * 11 / 2)
    assert (found.limit, found.declared) == (30.0 * 11 / 2, 3.0 * 11 / 2)
    assert str(found) == "11 cells to run, 1 already there; about 41 s, from the times of 5 like them"
    fresh = plan_of(tasks, set(), [], workers=1)
    assert (fresh.seconds, fresh.known, fresh.declared) == (None, 0, None)
    assert str(fresh) == "12 cells to run, 0 already there; time unknown until some have run, at most 6 min"
    assert str(BenchPlan({}, 3, None, 0, 0.0)) == "0 cells to run, 3 already there"


def test_every_part_of_a_cell_makes_its_job_another() -> None:
    def job(**more: Any) -> str:
        own = {
            "plant": SuitePart("p"),
            "scenario": SuitePart("s"),
            "identifier": SuitePart("i"),
            "seed": 0,
            "score": ScoreSettings(),
        } | more
        return _job(**own)

    jobs = [job(), job(seed=1), job(score=ScoreSettings(runs=2))]
    for kind, letter in (("plant", "p"), ("scenario", "s"), ("identifier", "i")):
        jobs += [job(**{kind: SuitePart(letter, **own)}) for own in ({"options": {"a": 1}}, {"label": "other"})]
        jobs.append(job(**{kind: SuitePart("other", label=letter)}))
    jobs += [job(plant=SuitePart("p", streams="x")), job(scenario=SuitePart("s", streams="x"))]
    assert len(set(jobs)) == len(jobs)
    assert job() == jobs[0]


@pytest.mark.parametrize(
    ("line", "fits"),
    [
        ("score = { runs = 1, held_out = 1, curve = 2 }", True), ("score = { runs = 0 }", False),
        ("score = { held_out = 0 }", False), ("score = { curve = 1 }", False), ("score = { horizon = 0.0 }", False),
        ("score = { horizon = 0.1 }", True), ("time_limit = 0.0", False), ("time_limit = 0.1", True),
        ("seeds = [0, 3]", True), ("seeds = [0, -1]", False),
    ],
)  # fmt: skip
def test_a_group_is_refused_where_it_says_nothing_that_can_be_run(line: str, fits: bool, tmp_path: Path) -> None:
    file = tmp_path / "s.toml"
    file.write_text(
        'name = "s"\n[[groups]]\nplants = [{ id = "linear-ode" }]\nscenarios = [{ id = "prbs" }]\n'
        f'identifiers = [{{ id = "hold" }}]\n{line}\n'
    )
    if fits:
        assert load_suite(file).name == "s"
    else:
        with pytest.raises(InputError, match=r"of a group.*groups\[0\]|groups\[0\].*of a group"):
            load_suite(file)


def test_a_plan_without_a_folder_counts_nothing_as_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    suite = load_suite("quick")
    pairs = cells_of(tasks_of(suite, [0]))
    store = Store(tmp_path)
    store.open(suite, pairs, resume=False)
    (store.shards / "one.json").write_bytes(encoded(blank(*pairs[0])))
    monkeypatch.chdir(tmp_path)
    assert (plan("quick", seeds=[0]).found, plan("quick", seeds=[0], out=tmp_path).found) == (0, 1)


def full(job: str = "j", **more: Any) -> Row:
    """Return a row with something in every field."""
    content: dict[str, Any] = {}
    for number, (name, kind) in enumerate(typing.get_type_hints(Row).items()):
        text = str(kind)
        if "tuple" in text:
            continue
        value: Any = 0.5 + number
        if "str" in text:
            value = f"text {number}"
        elif "bool" in text:
            value = number % 2 == 0
        elif "int" in text:
            value = number
        content[name] = value
    lists = {
        "axes": ("a",), "axis_values": (1.5,), "outputs": ("y", "z"), "units": ("m", "1"), "equation_rms": (0.1, None),
        "simulation_rms": (0.2, 0.3), "curve_steps": (1, 5), "curve_regret": (0.5, 1.5), "curve_theory": (None, 2.5),
        "trace_t": (0.0, 0.1, 0.2), "trace_measured": ((1.0, 2.0, 3.0), (4.0, 5.0, 6.0)),
        "trace_residual": ((None, 0.5, 0.25), (0.125, None, 1.0)),
    }  # fmt: skip
    return Row(**{**content, **lists, "job": job, "status": "ok", **more})


def test_a_row_comes_back_from_every_file_as_it_was(tmp_path: Path) -> None:
    rows = [full("a"), full("b", curve_steps=(), curve_regret=(), curve_theory=()), row("c")]
    paths = []
    for number, names in enumerate(columns_of_files()):
        paths.append(tmp_path / f"{number}.parquet")
        write_rows(paths[-1], names, rows)
    back = rows_of(paths)
    assert list(back) == [one.job for one in rows]
    for one in rows:
        assert back[one.job] == one
    shard = tmp_path / "shard.json"
    shard.write_bytes(encoded(full(equation_error=float("inf"), trace_residual=((float("nan"),) * 3,) * 2)))
    read = read_row(shard)
    assert (read.equation_error, read.trace_residual) == (None, ((None,) * 3,) * 2)
    table = arrow_table(columns_of_files()[0], rows)
    units = {field.name: (field.metadata or {}).get(b"unit") for field in table.schema}
    assert (units["simulation_error"], units["horizon"], units["log_score"]) == (b"1", b"s", b"nats")
    assert plain_values(table.column("burn_in"))[2] is None
    assert all(isinstance(value, int) for value in plain_values(table.column("burn_in"))[:2])


@pytest.mark.parametrize(
    "wrong",
    [{"units": ("m",)}, {"axis_values": ()}, {"curve_regret": (1.0,)},
     {"curve_theory": (1.0,)}, {"equation_rms": (1.0,)},
     {"simulation_rms": (1.0,)}, {"trace_measured": ((1.0,) * 3,)}, {"trace_residual": ((1.0,) * 3, (1.0,))},
     {"seed": 2**63}, {"curve_steps": (1, -(2**63))}, {"status": "fine"}],
)  # fmt: skip
def test_a_row_whose_parts_do_not_fit_is_refused(wrong: dict[str, Any]) -> None:
    assert sound(full(curve_steps=(1, 2**63 - 1))).job == "j"
    assert all(sound(full(status=status)) for status in STATUSES)
    with pytest.raises(ValueError, match=r"belong|above|status"):
        sound(full(**wrong))


def test_a_reason_is_one_line_of_four_hundred_letters() -> None:
    assert one_line("x" * 400) == "x" * 400
    assert one_line("x" * 401) == "x" * 397 + "..."
    assert one_line(" a\n b\t c ") == "a b c"
    made = blank(task(seed=5), task().cells[0], status="failed", reason="a \n b")
    assert (made.job, made.plant, made.scenario, made.identifier, made.seed) == ("j", "p", "s", "hold", 5)
    assert (made.status, made.reason, made.axes) == ("failed", "a b", ())
    assert (made.data_seconds, made.fit_seconds, made.score_seconds, made.memory_mib) == (0.0, 0.0, 0.0, None)


def test_a_store_batches_shards_and_gives_rows_in_the_order_of_the_suite(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert BATCH >= 1000
    monkeypatch.setattr("harness.benchmark.store.BATCH", 3)
    jobs = ("d", "a", "c", "b", "e")
    own = task(jobs=jobs)
    suite = Suite("name", (), "told")
    store = Store(tmp_path / "out")
    pairs = [(own, cell) for cell in own.cells]
    assert store.open(suite, pairs, resume=False) == {}
    with pytest.raises(InputError, match="the folder has results"):
        store.open(suite, pairs, resume=False)
    for job in jobs[:4]:
        (store.shards / f"{job}.json").write_bytes(encoded(full(job)))
    store.finished(jobs[:2])
    assert len(list(store.shards.glob("*.json"))) == 4
    store.finished(jobs[2:3])
    assert sorted(path.name for path in store.shards.iterdir()) == ["b.json", "d.parquet"]
    assert store.waiting()
    assert set(store.rows()) == set(jobs[:4])
    assert [one.job for one in store.consolidate(finished=False)] == list(jobs[:4])
    assert store.shards.is_dir()
    assert [one.job for one in store.consolidate(finished=True)] == list(jobs[:4])
    assert not store.shards.exists()
    assert not store.waiting()
    assert list(store.open(suite, pairs, resume=True)) == list(jobs[:4])
    read = _result(store, [full("d")])
    assert (read.suite, read.planned, read.cells, read.description) == ("name", 5, (("p", "s", "hold"),), "told")
    assert (read.rows, read.folder, read.versions) == ((full("d"),), store.folder, versions())
    manifest = store.read_manifest()
    assert (manifest["suite"], manifest["description"], manifest["planned"]) == ("name", "told", None)
    assert [cell[0] for cell in manifest["cells"]] == list(jobs)
    with pytest.raises(InputError, match=r"got 1 others, e\.g\."):
        store.open(suite, [pair for pair in pairs if pair[1].job != "c"], resume=True)


def test_a_row_that_came_late_has_its_place_in_the_order_of_the_suite(tmp_path: Path) -> None:
    own = task(jobs=("d", "a", "c", "b"))
    store = Store(tmp_path)
    store.open(Suite("name", ()), [(own, cell) for cell in own.cells], resume=False)
    for jobs, expected in ((("d", "b"), ["d", "b"]), (("c",), ["d", "c", "b"]), ((), ["d", "c", "b"])):
        for job in jobs:
            (store.shards / f"{job}.json").write_bytes(encoded(full(job)))
        assert [one.job for one in store.consolidate(finished=False)] == expected
        assert list(rows_of([store.results])) == expected
    (store.shards / "a.json").write_bytes(encoded(full("a")))
    assert [one.job for one in store.consolidate(finished=True)] == ["d", "a", "c", "b"]


def test_shares_are_put_together_in_the_order_of_the_suite(tmp_path: Path) -> None:
    jobs = ("d", "a", "c", "b", "e")
    own = task(jobs=jobs)
    pairs = [(own, cell) for cell in own.cells]
    for number, share in ((1, pairs[::2]), (2, pairs[1::2][:1])):
        store = Store(tmp_path / f"shard-{number}-of-3")
        store.open(Suite("name", ()), share, resume=False, order=jobs)
        for _, cell in share[:2]:
            (store.shards / f"{cell.job}.json").write_bytes(encoded(full(cell.job)))
    whole = Store(tmp_path)
    assert [one.folder.name for one in whole.shares()] == ["shard-1-of-3", "shard-2-of-3"]
    whole.merge()
    manifest = whole.read_manifest()
    assert [cell[0] for cell in manifest["cells"]] == ["d", "a", "c", "e"]
    assert manifest["planned"] == 5
    assert list(whole.rows()) == ["d", "a", "c"]
    file = tmp_path / "shard-2-of-3" / "bench.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"order": ["other"]}))
    with pytest.raises(InputError, match="do not belong together"):
        whole.merge()


def test_a_plant_is_probed_again_only_where_its_options_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []

    class Pool:
        def __enter__(self) -> Pool:
            return self

        def __exit__(self, *exc: object) -> None:
            pass

        def schedule(self, work: Any, args: Any, timeout: float) -> Future[Any]:
            asked.append((*args, timeout))
            future: Future[Any] = Future()
            if args[1].get("bad"):
                future.set_exception(PlantError("an output\nis not finite") if args[1]["bad"] == 1 else OSError("gone"))
            else:
                future.set_result({"passed": True})
            return future

    monkeypatch.setattr(running, "worker_pool", lambda workers: Pool())
    file = tmp_path / "probes.json"

    def probed(**options: Any) -> list[Any]:
        asked.clear()
        tasks = [Task(SuitePart(id, options, label), SuitePart("s"), seed, ScoreSettings(), 1.0, ()) for seed in (0, 1)
                 for id, label in (("mass-spring-fmu", "spring"), ("linear-ode", "ode"))]  # fmt: skip
        running.probe_plants(tasks, file)
        return list(asked)

    assert probed(a=1) == [("mass-spring-fmu", {"a": 1}, 120.0)]
    assert json.loads(file.read_text()) == {
        "spring": {"plant": "mass-spring-fmu", "options": {"a": 1}, "result": {"passed": True}}
    }
    assert probed(a=1) == []
    assert len(probed(a=2)) == 1
    assert json.loads(file.read_text())["spring"]["options"] == {"a": 2}
    probed(bad=1)
    assert json.loads(file.read_text())["spring"]["reason"] == "an output is not finite"
    probed(bad=2)
    assert json.loads(file.read_text())["spring"] == {
        "plant": "mass-spring-fmu", "options": {"bad": 2}, "result": None, "reason": "OSError"
    }  # fmt: skip
