"""What a reader of a benchmark's tables relies on, letter by letter, and what a suite that says nothing gets."""

from __future__ import annotations

import io
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from made_rows import row, task
from rich.console import Console

from harness.benchmark import BenchResult, rich_table
from harness.benchmark.columns import columns_of_files, rows_of, write_rows
from harness.benchmark.control import _point, _regret
from harness.benchmark.page.exports import render
from harness.benchmark.parts import ScoreSettings, SuitePart, Task
from harness.benchmark.planning import read_shard, share
from harness.benchmark.records import _recorded
from harness.benchmark.row import Row
from harness.benchmark.suite import load_suite
from harness.benchmark.work import CellBatch, _doubts
from harness.errors import InputError
from harness.models.estimate import Estimate, RankDecision
from harness.scoring.control import LinearPlantModel, control_regret
from harness.signals import Trajectory
from identifiers.linear.least_squares import StateLeastSquares
from plants.equations.linear import LinearPlant


def compared() -> BenchResult:
    """Return a benchmark with a leader, one that ties with nobody, one that never fits, and a learner."""
    rows: list[Any] = []
    for seed in range(6):
        own = {"noise_floor": 0.1, "equation_error": 0.11 + 0.001 * seed, "fit_seconds": 1.25}
        rows.append(row("arx", seed, simulation_error=0.12 + 0.001 * seed, coverage=0.9, **own))
        rows.append(row("deep", seed, simulation_error=0.61 + 0.02 * seed, **own))
    rows += [row("kern", seed, status="unfit", reason="expected more, got less") for seed in range(6)]
    rows += [row("rls", seed, plant="q", regret=2.0 + seed) for seed in range(6)]
    rows.append(row("rls", 6, plant="q", status="timeout", reason="rls took more than 60 s"))
    return BenchResult("told", tuple(rows), len(rows), None, {"numpy": "2.0"}, ())


def printed(width: int) -> str:
    stream = io.StringIO()
    Console(file=stream, width=width, highlight=False).print(rich_table(compared()))
    return "\n".join(line.rstrip() for line in stream.getvalue().splitlines())


WIDE = """\


 plant, scenario  identifier   ok  equation error  simulation error  best  x best  regret
 ───────────────────────────────────────────────────────────────────────────────────────────────
 p                arx         6/6  0.113           0.122             0.1   1.23
   s              deep        6/6  0.113           0.66 [.64 .68]          6.6
                  kern        0/6  unfit

 q                rls         6/7                                                  4.5 [3.2 5.8]
   s


 plant, scenario  identifier   ok  90 % sets hold
 ────────────────────────────────────────────────
 p                arx         6/6  0.9
   s

6 unfit: kern on p x s: expected more, got less
1 timeout: rls on q x s: rls took more than 60 s
"""
HEADED = """\

p, s, best 0.1
                 equation  simulation
identifier   ok  error     error           x best  regret
────────────────────────────────────────────────────────────────
arx         6/6  0.113     0.122           1.23
deep        6/6  0.113     0.66 [.64 .68]  6.6
kern        0/6  unfit

q, s
rls         6/7                                    4.5 [3.2 5.8]
"""
NARROW = """\


p, s, best 0.1
arx 6/6
  equation error: 0.113
  simulation error: 0.122
  x best: 1.23
  90 % sets hold: 0.9
deep 6/6
  equation error: 0.113
  simulation error: 0.66 [.64 .68]
  x best: 6.6
kern 0/6 unfit

q, s
rls 6/7
  regret: 4.5 [3.2 5.8]

6 unfit: kern on p x s: expected more,
got less
1 timeout: rls on q x s: rls took more
than 60 s
"""


def test_a_table_is_printed_to_the_letter() -> None:
    wide = printed(110)
    assert wide[wide.index("\n\n") : wide.index("Marked: ")] == WIDE
    assert HEADED in printed(90)
    narrow = printed(40)
    assert narrow[narrow.index("\n\n") : narrow.index("Marked: ")] == NARROW
    assert wide.endswith("below 2.\n18 ok of 25 run, 25 planned")
    stream = io.StringIO()
    Console(file=stream, width=110, highlight=False, force_terminal=True, color_system="standard").print(
        rich_table(compared())
    )
    assert stream.getvalue().count("\x1b[1;32m") == 3  # the leader's name, twice, and its error


def test_a_table_for_papers_marks_the_leader_in_one_column_of_each() -> None:
    latex = render(compared(), "latex").splitlines()
    head, *body = [line.removesuffix(r" \\").split(" & ") for line in latex if line.endswith(r" \\")]
    assert head == ["plant", "scenario", "identifier", "ok/run", "equation error", "simulation error", "best possible",
                    "bound", "over best", "regret", r"90 \% sets hold", "fit"]  # fmt: skip
    marked = [(own[2], head[k]) for own in body for k, cell in enumerate(own) if "textbf" in cell]
    assert marked == [("arx", "simulation error")]
    by_name = {own[2]: dict(zip(head, own, strict=True)) for own in body}
    assert by_name["kern"]["simulation error"] == "unfit"
    assert (by_name["rls"]["simulation error"], by_name["rls"]["regret"]) == ("", "4.5 [3.25, 5.75]")
    with pytest.raises(InputError, match="markdown, latex, csv"):
        render(compared(), "word")


def test_what_a_suite_does_not_say(tmp_path: Path) -> None:
    (tmp_path / "least.toml").write_text(
        'name = "least"\n[[groups]]\nplants = [{ id = "linear-ode" }]\nscenarios = [{ id = "prbs" }]\n'
        'identifiers = [{ id = "hold" }]\n'
    )
    read = load_suite(tmp_path / "least.toml")
    assert (read.seeds, read.time_limit, read.cell_seconds, read.description) == ((0, 1, 2), 60.0, None, "")
    assert read.groups[0].score == ScoreSettings(None, 1, 1, False, 40)
    for axes in ('"scenarios." = [1.0]', '"scenarios" = [1.0]', '"plant.mass" = [1.0]', '"plants.m" = [1.0, 1.0]'):
        (tmp_path / "axes.toml").write_text((tmp_path / "least.toml").read_text() + f"axes = {{ {axes} }}\n")
        with pytest.raises(InputError):
            load_suite(tmp_path / "axes.toml")
    assert [read_shard(text) for text in (None, "1/1", " 2 / 3 ", "3/3")] == [None, (1, 1), (2, 3), (3, 3)]
    dealt = [share("abcdefg", (number, 3)) for number in (1, 2, 3)]
    assert [share("abc", None), *dealt] == [("a", "b", "c"), ("a", "d", "g"), ("b", "e"), ("c", "f")]
    for text in ("0/3", "4/3", "/3", "1/", "1", "1/x", "-1/3", "0/0"):
        with pytest.raises(InputError, match="1 <= i <= n"):
            read_shard(text)


def test_a_row_that_is_lost_says_who_was_slow() -> None:
    batch = CellBatch(task(jobs=("a", "b")), trace=False)

    def reason(status: str, shared: bool) -> str:
        found = msgspec.json.decode(batch.lost("b", status, "took more than 1 s", shared=shared), type=Row)
        assert (found.job, found.status, found.data_seconds, found.fit_seconds, found.score_seconds) == (
            "b", status, 0.0, 0.0, 0.0,
        )  # fmt: skip
        return found.reason

    assert reason("timeout", True) == "no data: the plant or scenario took more than 1 s"
    assert reason("timeout", False) == "hold took more than 1 s"
    assert reason("crashed", True) == "no data: took more than 1 s"
    assert reason("crashed", False) == "took more than 1 s"


def test_doubts_of_an_estimate_are_said_once_each() -> None:
    def said(**more: Any) -> str:
        made = Estimate(("m",), ("kg",), np.array([2.0]), method="none", **more)
        return _doubts(SimpleNamespace(notes={"estimate": made.to_dict()}))

    assert said() == said(rank=RankDecision(1, 1)) == _doubts(object()) == ""
    assert said(rank=RankDecision(1, 2), on_bound=("m",)) == "on a bound: m; rank 1 of 2"
    assert said(converged=False) == "not converged"
    assert said(converged=False, message="100 steps") == "not converged: 100 steps"
    assert said(on_bound=("m",)) == "on a bound: m"
    assert said(converged=False, message="m is on a bound", on_bound=("m",)) == "not converged: m is on a bound"
    assert said(message="m is on a bound", on_bound=("m",)) == ""


def test_a_row_with_one_output_and_one_step_comes_back_and_damage_names_its_file(tmp_path: Path) -> None:
    small = row(outputs=("y",), units=("m",), equation_rms=(0.5,), curve_steps=(7,), curve_regret=(1.5,),
                trace_t=(0.0,), trace_measured=((1.0,),), trace_residual=((0.1,),), axes=("plants.m",),
                axis_values=(2.0,), model_order=3)  # fmt: skip
    paths = []
    for number, names in enumerate(columns_of_files()):
        paths.append(tmp_path / f"{number}.parquet")
        write_rows(paths[-1], names, [small])
    assert rows_of(paths) == {small.job: small}
    write_rows(paths[0], columns_of_files()[0], [row(outputs=("y",), units=("m", "s"))])
    with pytest.raises(InputError, match=r"0\.parquet"):
        rows_of(paths)


def test_the_floor_of_a_recording_leaves_out_runs_that_stand_still(tmp_path: Path) -> None:
    t = np.arange(200) * 0.01
    head = 'name = "x"\nsample_time = 0.01\n[signals.u]\nrole = "input"\nunit = "N m"\n'
    for name in ("theta", "phi"):
        head += f'[signals.{name}]\nrole = "output"\nunit = "rad"\nnoise = 0.05\n'
    for name, use in (("a", "estimation"), ("b", "validation"), ("c", "validation"), ("d", "validation")):
        size = {"b": 0.5, "c": 2.0}.get(name, 1.0)
        y = np.column_stack([np.sin(3 * t), size * np.sin(5 * t), np.full(200, 1.0) if name == "d" else np.cos(7 * t)])
        np.savetxt(tmp_path / f"{name}.csv", y, delimiter=",", header="u [N m],theta [rad],phi [rad]", comments="")
        head += f'[[runs]]\nfile = "{name}.csv"\nuse = "{use}"\n'
    (tmp_path / "dataset.toml").write_text(head)
    sizes = [np.array([np.std(s * np.sin(5 * t)), np.std(np.cos(7 * t))]) for s in (0.5, 2.0)]
    expected = np.sqrt(np.mean([np.mean((0.05 / size) ** 2) for size in sizes]))
    assert _recorded(str(tmp_path / "dataset.toml")).floor == pytest.approx(expected, rel=1e-9)


def test_a_plant_is_held_where_a_sample_moves_no_state_by_more_than_a_fiftieth_of_its_spread() -> None:
    options: dict[str, Any] = {"A": [[0.5, 0.0], [0.0, 0.5]], "B": [[1.0], [1.0]], "sample_time": 0.1}
    with LinearPlant(**options) as plant:
        spec = plant.spec
    made = Task(SuitePart("linear", options), SuitePart("s"), 0, ScoreSettings(), 1.0, ())
    t = np.arange(400) * 0.1
    x = np.column_stack([np.sin(0.2 * t), np.cos(0.2 * t)])
    x -= x.mean(axis=0)
    u = np.sin(t)[:, None]
    u -= u.mean()
    for part, fits in ((0.019, True), (0.021, False), (0.026, False)):
        off = x + 2.0 * part * x.std(axis=0)  # one sample goes half way to rest
        found = _point(made, [Trajectory(t, u, off, spec, off)])
        assert isinstance(found, str) is not fits, share


def test_whoever_learns_to_hold_an_unstable_plant_begins_with_four_fifths_of_the_optimal_gain() -> None:
    from harness.models.lqr import lqr_gain

    a, b = np.array([[1.1, 0.1], [0.0, 0.8]]), np.array([[0.0], [1.0]])
    truth = LinearPlantModel(a, b, np.eye(2), np.zeros((2, 1)))
    found = _regret(StateLeastSquares(), truth, truth, np.ones(3), np.random.default_rng(0))
    best = lqr_gain(a, b, np.eye(2), np.eye(1))
    assert best is not None
    run = control_regret(
        StateLeastSquares(), (a, b), steps=400, rng=np.random.default_rng(0), noise=0.1, first_gain=0.8 * best
    )
    assert found == pytest.approx(run.total / run.optimal)
    # one that four fifths do not hold begins with the whole
    wild = LinearPlantModel(np.array([[6.0]]), np.eye(1), np.eye(1), np.zeros((1, 1)))
    held = _regret(StateLeastSquares(), wild, wild, np.ones(2), np.random.default_rng(0))
    gain = lqr_gain(wild.a_matrix, wild.b_matrix, np.eye(1), np.eye(1))
    run = control_regret(
        StateLeastSquares(), (wild.a_matrix, wild.b_matrix), steps=400, rng=np.random.default_rng(0), noise=0.1,
        first_gain=gain,
    )  # fmt: skip
    assert held == pytest.approx(run.total / run.optimal)
