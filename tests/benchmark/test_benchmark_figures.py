"""Figures of a benchmark against computations of their own: cells, summaries, statistics, control."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_rows import SCORES, row, task
from scipy import stats

from harness.benchmark.control import _point, _regret
from harness.benchmark.parts import ScoreSettings, SuitePart, Task
from harness.benchmark.statistics import Ranking, Standing, _median_ratio, ranking, replicates, standings
from harness.benchmark.summary import figure, pairs_in_words, summarise
from harness.benchmark.work import _do_cell, _score_distributions
from harness.scoring.control import LinearPlantModel, control_regret
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.linear.least_squares import StateLeastSquares
from plants.equations.linear import LinearPlant


def held(n: int, seed: int) -> Trajectory:
    """Return a record of an output that wanders, one that stands still, and one that wanders far."""
    rng = np.random.default_rng(seed)
    far = 1e3 * np.cumsum(rng.normal(size=n))
    y = np.column_stack([np.cumsum(rng.normal(size=n)) + 5.0, np.full(n, 2.0), far])
    spec = PlantSpec((Channel("u", "V"),), (Channel("y", "m"), Channel("still", "K"), Channel("far", "m")), 0.1)
    return Trajectory(np.arange(n) * 0.1, rng.normal(size=(n, 1)), y, spec)


def test_a_cell_is_scored_on_all_held_out_records_and_keeps_where_it_is_farthest_off() -> None:
    """Holding the last output errs by its steps, and in free run by its distance from the first sample."""
    out = [held(1234, 1), held(300, 2)]
    found = _do_cell(task(), task().cells[0], [held(40, 3), held(25, 4)], out, trace=True)
    assert (found.status, found.samples, found.held_out_samples) == ("ok", 65, 1534)
    assert (found.outputs, found.units) == (("y", "still", "far"), ("m", "K", "m"))
    steps = [np.diff(one.y, axis=0) for one in out]
    squares = np.array([np.mean(one**2, axis=0) for one in steps])
    weights = np.array([len(one) for one in steps]) / sum(map(len, steps))
    assert found.equation_rms == pytest.approx(np.sqrt(weights @ squares))
    spreads = np.array([one.y[1:].std(axis=0) for one in out])
    relative = squares[:, [0, 2]] / spreads[:, [0, 2]] ** 2
    # an output that stands still is foretold without an error: it counts as 0
    assert found.equation_error == pytest.approx(np.sqrt(weights @ relative.sum(axis=1) / 3))
    assert found.reason == ""
    miss = np.abs(out[0].y - out[0].y[0]) / np.maximum(out[0].y.std(axis=0), 1e-9)
    edges = np.unique(np.linspace(0, 1234, 501).astype(int))
    worst = [a + int(np.argmax(miss[a:b].max(axis=1))) for a, b in itertools.pairwise(edges)]
    kept = sorted({*edges[:-1].tolist(), *worst})
    assert found.trace_t == pytest.approx(out[0].t[kept])
    assert found.trace_measured[0] == pytest.approx(out[0].y[kept, 0])
    residual = np.array(found.trace_residual)
    assert residual.shape == (3, len(kept))
    free = out[0].y[kept].T - residual  # what holding said: one value from first to last
    assert np.ptp(free, axis=1) == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)
    assert found.fit_seconds >= 0.0 < found.score_seconds < 60.0
    blind = _do_cell(task(), task().cells[0], [held(40, 3)], out, trace=False)
    assert (blind.trace_t, blind.simulation_error) == ((), found.simulation_error)
    short = _do_cell(task(), task().cells[0], [held(40, 3)], [held(7, 1)], trace=True)
    assert short.trace_t == pytest.approx(np.arange(7) * 0.1)


def test_scores_of_distributions_are_means_over_outputs_and_records() -> None:
    class Says:
        """A normal distribution about the last output."""

        burn_in, spec = 1, PlantSpec((), (Channel("a"), Channel("b")), 1.0)

        def initial_state(self, data: Trajectory) -> Any:
            return data.y[0]

        def correct(self, x: Any, u: Any, y: Any) -> Any:
            return y

        def step(self, x: Any, u: Any) -> Any:
            return x

        def output(self, x: Any, u: Any) -> Any:
            return x

        def predictive(self, x: Any, u: Any) -> Any:
            from harness.models.distributions import normal

            return normal(x, np.full_like(x, 1.5), self.spec.outputs)

    rng = np.random.default_rng(0)
    data = [Trajectory(np.arange(float(n)), np.zeros((n, 0)), rng.normal(size=(n, 2)), Says.spec) for n in (40, 90)]
    found = row()
    _score_distributions(Says(), data, found)
    gains, shares = [], []
    for one in data:
        told = stats.norm(one.y[:-1], 1.5)
        marginal = stats.norm(one.y[1:].mean(axis=0), one.y[1:].std(axis=0))
        gains.append(np.mean(told.logpdf(one.y[1:]) - marginal.logpdf(one.y[1:])))
        shares.append(np.mean(np.abs(one.y[1:] - one.y[:-1]) / 1.5 < stats.norm.ppf(0.95)))
    assert found.log_score == pytest.approx(np.mean(gains))
    assert found.coverage == pytest.approx(np.mean(shares))


def test_every_score_of_a_summary_is_the_quartiles_of_its_own_column_over_the_rows_that_are_ok() -> None:
    rng = np.random.default_rng(0)
    values = {name: rng.uniform(1.0, 2.0, 7) for name in (*SCORES, "noise_floor", "least_equation_error")}
    rows = [row(seed=k, **{name: float(own[k]) for name, own in values.items()}) for k in range(7)]
    bad = [row("arx", 7 + k, status="timeout", reason=why, noise_floor=0.1) for k, why in enumerate("aab")]
    (line, never) = summarise([*rows, *bad], [("p", "s", "arx"), ("p", "s", "never")])
    for name, own in values.items():
        own = np.append(own, [0.1] * 3) if name == "noise_floor" else own
        found = getattr(line, name)
        assert (found.low, found.median, found.high) == pytest.approx(np.quantile(own, [0.25, 0.5, 0.75])), name
    over = np.quantile(values["simulation_error"] / values["noise_floor"], [0.25, 0.5, 0.75])
    assert (line.over_best.low, line.over_best.median, line.over_best.high) == pytest.approx(over)
    assert (line.ok, line.run, line.bound) == (7, 10, "noise")
    assert line.problems == (("timeout", "a", 2), ("timeout", "b", 1))
    assert (never.ok, never.run, never.equation_error, never.standing, never.bound) == (0, 0, None, None, "")
    bounded = summarise([row(simulation_error=0.3, noise_floor=0.1, least_simulation_error=0.2)])[0]
    assert (bounded.bound, bounded.best_possible.median, bounded.over_best.median) == pytest.approx(
        ("Cramer-Rao", 0.2, 1.5)
    )
    assert summarise([row(simulation_error=0.3, noise_floor=0.0)])[0].over_best is None


def test_what_is_said_of_control_is_what_most_rows_say() -> None:
    known = {"model_order": 4, "controllable": 3, "observable": 2, "stabilisable": True, "detectable": True}
    full = row(seed=0, control_status="ok", **known)
    lost = [
        row(seed=k, control_status="unstable", **{**known, "stabilisable": False, "detectable": False}) for k in (1, 2)
    ]
    none = [row(seed=k, control_status="not for control") for k in (3, 4, 5)]
    said = "3 controllable and 2 observable of 4"
    assert summarise([full])[0].control == said
    assert summarise([full, *lost])[0].control == f"unstable; {said}, not stabilisable, not detectable"
    assert summarise([full, *lost, *none])[0].control == "not for control"
    assert summarise([])[:] == []


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (1e-3, "0.001"), (9.994e-4, "9.99e-4"), (0.0012345, "0.00123"), (-0.0012345, "-0.00123"),
     (9999.0, "9999"), (9999.9, "10000"), (1e4, "1.00e4"), (-12345.0, "-1.23e4"), (999.6, "1000"), (12.345, "12.3"),
     (1.4e-3, "0.0014")],
)  # fmt: skip
def test_a_figure_has_three_digits_and_no_power_between_a_thousandth_and_ten_thousand(value: float, text: str) -> None:
    assert figure(value) == text


def test_a_figure_has_as_many_digits_as_are_asked_for() -> None:
    assert (figure(1.2345, 2), figure(12345.0, 2), figure(0.00012345, 4)) == ("1.2", "1.2e4", "1.234e-4")


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 40), st.integers(0, 999))
def test_the_interval_of_a_median_ratio_is_the_narrowest_pair_of_order_statistics_that_holds_95_percent(
    n: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    best = rng.uniform(1.0, 2.0, n)
    ratios = rng.permutation(np.geomspace(0.5, 3.0, n))
    low, high = _median_ratio(ratios * best, best)
    # outside [k-th, (n+1-k)-th] lies the median where at most k - 1 signs are of one kind
    held = [k for k in range(1, n // 2 + 1) if 2 * stats.binom.cdf(k - 1, n, 0.5) <= 0.05]
    ordered = np.sort(ratios)
    expected = (ordered[held[-1] - 1], ordered[n - held[-1]]) if held else (0.0, np.inf)
    assert (low, high) == pytest.approx(expected)


def test_a_standing_has_its_chance_from_the_signs_and_its_marks_from_five_pairs_on() -> None:
    best = np.array([1.0, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6, 1.7, 1.8, 1.9])
    for worse in range(6, 11):
        other = best * np.where(np.arange(10) < worse, 1.2, 0.99)
        found = standings({"a": list(best), "b": list(other)})["b"]
        assert found.chance == pytest.approx(min(1.0, 2 * stats.binom.sf(worse - 1, 10, 0.5)))
        assert found.state == ("worse" if found.chance < 0.05 else "tied")
    even = standings({"a": [1.0] * 5, "b": [1.0] * 5})
    assert {name: (one.state, one.chance, one.marked) for name, one in even.items()} == {
        "a": ("best", 1.0, True), "b": ("undecided", 1.0, False)
    }  # fmt: skip
    assert even["a"] == Standing("best", 1.0, (1.0, 1.0), 5, 1)
    assert not standings({"a": [1.0] * 4, "b": [1.0] * 4})["a"].marked
    failing = standings({"a": [1.0] * 9, "b": [None] * 4 + [1.5] * 5, "c": [None] * 5 + [1.0] * 4})
    assert set(failing) == {"a", "b"}
    assert standings({"a": [None], "b": []}) == {}
    near = best * np.where(np.arange(10) % 2, 2.1, 0.99)
    assert standings({"a": list(best), "b": list(near)})["b"].state == "undecided"


def test_seeds_with_the_same_scores_for_most_are_one_replicate() -> None:
    same = {0: 0.3, 1: 0.3}
    other = {0: 0.1, 1: 0.2}
    assert replicates({"a": same, "b": same, "c": other}) == {"a": [0.3], "b": [0.3], "c": [pytest.approx(0.15)]}
    assert len(replicates({"a": same, "b": other})["a"]) == 2  # a half is not the larger part
    nothing = {0: 0.0, 1: 0.0}
    assert len(replicates({"a": nothing, "b": other})["a"]) == 2
    failed = {0: None, 1: None}
    assert replicates({"a": failed, "b": same}) == {"a": [None], "b": [0.3]}
    assert replicates({"a": {0: 0.3, 1: 0.2, 2: 0.3}}) == {"a": [0.3, 0.2]}


@pytest.mark.parametrize(("k", "q"), [(2, 1.960), (3, 2.343), (4, 2.569), (5, 2.728), (10, 3.164)])
def test_the_critical_difference_is_that_of_the_published_table(k: int, q: float) -> None:
    """Demsar 2006, table 5a: q of Nemenyi's test at 5 %; ties share their ranks, failures come last."""
    names = [chr(97 + i) for i in range(k)]
    scores = np.random.default_rng(k).integers(0, 4, size=(6, k)).astype(float)
    blocks: list[dict[str, float | None]] = [dict(zip(names, map(float, own), strict=True)) for own in scores]
    blocks[0][names[0]] = None
    scores[0, 0] = 99.0
    found = ranking(blocks, ["place"])
    assert found is not None
    assert found.critical == pytest.approx(q * np.sqrt(k * (k + 1) / (6 * 6)), rel=5e-4)
    means = {
        name: np.mean([sum(own < own[i]) + (sum(own == own[i]) + 1) / 2 for own in scores])
        for i, name in enumerate(names)
    }
    assert found.ranks == pytest.approx(sorted(means.values()))
    assert [means[name] for name in found.names] == pytest.approx(list(found.ranks))
    assert (found.blocks, found.places) == (6, ("place",))
    assert ranking(blocks[:4]) is None
    assert ranking([{"a": 1.0}] * 9) is None


def test_runs_of_ranks_that_are_not_told_apart() -> None:
    def groups(*ranks: float) -> list[tuple[int, int]]:
        return Ranking(tuple("abcde"[: len(ranks)]), ranks, 9, 1.0).groups()

    assert groups(1.0, 1.9, 2.8, 5.0) == [(0, 1), (1, 2)]
    assert groups(1.0, 2.0, 3.5) == [(0, 1)]
    assert groups(1.0, 1.5, 1.9, 2.05) == [(0, 2), (1, 3)]
    assert groups(1.0, 2.1) == []


def test_pairs_are_told_in_words() -> None:
    few = [row(name, seed, simulation_error=error * (1 + 0.1 * seed)) for name, error in (("a", 1.0), ("b", 1.01))
           for seed in range(4)]  # fmt: skip
    many = [row(name, seed, plant="q", simulation_error=error * (1 + 0.1 * seed))
            for name, error in (("a", 1.0), ("b", 3.0), ("c", 2.0)) for seed in range(9)]  # fmt: skip
    text = pairs_in_words(summarise([*few, *many]))
    assert "over 4 to 9 replicates" in text
    assert "below 2." in text
    assert text.endswith(
        "2 of 5 lines have too few replicates to be told from the best or tied with it (up to 7 needed)."
    )
    assert "over 9 replicates" in pairs_in_words(summarise(many))
    assert "too few" not in pairs_in_words(summarise(many))
    assert pairs_in_words(summarise([row(simulation_error=1.0)])) == "No line is marked: nothing is compared."


SPRING: dict[str, Any] = {"A": [[0.9, 0.2], [-0.3, 0.8]], "B": [[0.1], [0.5]], "sample_time": 0.1}


def about(offset: float, swing: float) -> tuple[Task, list[Trajectory]]:
    """Return a task of a linear plant and a record about where an input holds it, off by ``offset`` of the spread."""
    a, b = np.array(SPRING["A"]), np.array(SPRING["B"])
    with LinearPlant(**SPRING) as plant:
        spec = plant.spec
    hold = np.array([2.0])
    rest = np.linalg.solve(np.eye(2) - a, b @ hold)
    rng = np.random.default_rng(0)
    n = 200
    x = rest + swing * (rng.normal(size=(n, 2)) * [1.0, 3.0])
    x += rest + offset * x.std(axis=0) - x.mean(axis=0)
    u = hold + 0.5 * rng.normal(size=(n, 1))
    u += hold - u.mean(axis=0)
    made = Task(SuitePart("linear", SPRING), SuitePart("s"), 0, ScoreSettings(), 1.0, ())
    return made, [Trajectory(np.arange(n) * 0.1, u, x, spec, x)]


def test_control_is_scored_at_the_equilibrium_next_to_the_mean_of_the_records() -> None:
    made, runs = about(0.02, 0.7)
    point = _point(made, runs)
    assert not isinstance(point, str)
    a, b = np.array(SPRING["A"]), np.array(SPRING["B"])
    x = np.array(list(point.centre.values()))
    assert a @ x + b @ point.hold == pytest.approx(x, abs=1e-9)
    assert point.target == pytest.approx(x)
    assert point.around.a_matrix == pytest.approx(a)
    assert point.spread == pytest.approx([*runs[0].x.std(axis=0), runs[0].u.std()])  # type: ignore[union-attr]
    far = _point(*about(1.0, 0.7))
    assert far == "the records do not move about an equilibrium"
    blind = [Trajectory(runs[0].t, runs[0].u, runs[0].y, runs[0].spec)]
    assert _point(made, blind) == "the plant does not tell its states"


def test_an_input_that_stands_still_has_the_size_one() -> None:
    made, (run,) = about(0.0, 0.7)
    still = Trajectory(run.t, np.full_like(run.u, 2.0), run.y, run.spec, run.x)
    point = _point(made, [still])
    assert not isinstance(point, str)
    assert point.spread == pytest.approx([*run.x.std(axis=0), 1.0])  # type: ignore[union-attr]
    assert point.hold == pytest.approx([2.0])


def test_the_regret_of_control_is_in_samples_of_the_optimal_cost() -> None:
    stable = LinearPlantModel(np.array([[0.9, 0.1], [0.0, 0.8]]), np.array([[0.0], [1.0]]), np.eye(2), np.zeros((2, 1)))
    spread = np.array([2.0, 0.5, 3.0])
    found = _regret(StateLeastSquares(), stable, stable, spread, np.random.default_rng(3))
    change = spread[:2]
    a, b = stable.a_matrix * change / change[:, None], stable.b_matrix * 3.0 / change[:, None]
    run = control_regret(StateLeastSquares(), (a, b), steps=400, rng=np.random.default_rng(3), noise=0.1)
    assert found == pytest.approx(run.total / run.optimal)
