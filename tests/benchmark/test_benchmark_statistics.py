"""Who is no worse than the best, and ranks: decided by pairs of seeds, with failures counted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.benchmark import BenchResult
from harness.benchmark.page.exports import render
from harness.benchmark.row import Row
from harness.benchmark.statistics import MARGIN, enough_pairs, ranking, replicates, standings
from harness.benchmark.summary import pairs_in_words, rankings, summarise

UNLIKE = [1.0, 1.3, 0.8, 1.1, 0.9, 1.2]
"""Scores of six seeds whose data differ."""


def no_worse(scores: Mapping[str, Sequence[float | None]]) -> set[str]:
    """Return the name with the least median and those that tie with it."""
    return {name for name, one in standings(scores).items() if one.marked}


def rows(scores: dict[str, list[float | None]], plant: str = "p") -> list[Row]:
    """Return rows of some identifiers; None is a failure."""
    return [
        Row(
            job=f"{plant}{name}{seed}",
            plant=plant,
            scenario="s",
            identifier=name,
            seed=seed,
            status="ok" if score is not None else "diverged",
            reason="" if score is not None else "100 % of it & more",
            simulation_error=score,
            noise_floor=0.01,
        )
        for name, values in scores.items()
        for seed, score in enumerate(values)
    ]


def test_pairs_decide_where_the_spread_over_seeds_hides_the_difference() -> None:
    hard = np.geomspace(0.01, 10.0, 12)  # seeds differ a thousandfold, the two methods by 5 % on each
    assert no_worse({"good": list(hard), "bad": list(1.05 * hard)}) == {"good"}
    unpaired = np.random.default_rng(0).permutation(1.05 * hard)
    found = standings({"good": list(hard), "other": list(unpaired)})
    assert found["other"].state == "undecided"  # not told apart, but it may as well be a hundred times worse
    assert found["other"].ratio[1] > 10.0
    alike = hard * np.where(np.arange(12) % 2, 1.02, 0.99)
    assert no_worse({"good": list(hard), "alike": list(alike)}) == {"good", "alike"}


def test_six_seeds_with_one_inverted_never_tie_a_factor_of_ten() -> None:
    found = standings({"good": UNLIKE, "bad": [10.0 * s for s in UNLIKE[:-1]] + [0.5 * UNLIKE[-1]]})
    assert found["bad"].state == "undecided"
    assert no_worse({"good": UNLIKE, "bad": [10.0 * s for s in UNLIKE[:-1]] + [0.5 * UNLIKE[-1]]}) == {"good"}


@given(st.integers(1, 12))
def test_enough_pairs_is_where_all_of_one_sign_are_told_and_one_fewer_are_not(others: int) -> None:
    def states(pairs: int) -> set[str]:
        scores = {f"b{k}": [3.0 + n for n in range(pairs)] for k in range(others)}
        found = standings({"a": [1.0 + n for n in range(pairs)], **scores})
        return {one.state for name, one in found.items() if name != "a"}

    assert states(enough_pairs(others)) == {"worse"}
    assert "worse" not in states(enough_pairs(others) - 1)


@given(st.integers(0, 2**32 - 1), st.integers(2, 6))
def test_holm_seldom_tells_apart_what_is_alike(seed: int, names: int) -> None:
    rng = np.random.default_rng(seed)
    wrong = 0
    for _ in range(20):
        found = standings({str(k): list(rng.lognormal(size=12)) for k in range(names)})
        wrong += any(one.state == "worse" for one in found.values())
        for one in found.values():
            assert one.state != "tied" or one.ratio[1] < MARGIN
    assert (
        wrong <= 10
    )  # the best of the group is chosen from the same data, so a little more than 5 % is to be expected


def test_the_same_record_under_six_seeds_is_one_replicate() -> None:
    same = {"arx": dict.fromkeys(range(6), 0.3), "dmdc": dict.fromkeys(range(6), 0.5), "net": dict(enumerate(UNLIKE))}
    assert replicates(same) == {"arx": [0.3], "dmdc": [0.5], "net": [1.05]}
    unlike = {"arx": dict(enumerate(UNLIKE)), "perfect": dict.fromkeys(range(6), 0.0)}
    assert len(replicates(unlike)["arx"]) == 6
    failed = {"arx": dict.fromkeys(range(6), 0.3), "net": dict.fromkeys(range(6), None)}
    assert replicates(failed) == {"arx": [0.3], "net": [None]}
    found = summarise(rows({"a": [1.0] * 6, "b": [2.0] * 6}))
    assert not any(line.leading for line in found)
    assert "have too few replicates" in pairs_in_words(found)
    assert rankings(rows({"a": [1.0] * 6, "b": [2.0] * 6})) == []


@given(st.lists(st.floats(0.1, 10.0), min_size=5, max_size=15), st.floats(0.01, 100.0))
def test_scale_and_order_of_seeds_do_not_matter(values: list[float], scale: float) -> None:
    other = [1.5 * value for value in reversed(values)]
    found = no_worse({"a": values, "b": other})
    assert found == no_worse({"a": [scale * v for v in values], "b": [scale * v for v in other]})
    assert found


def test_failures_count_and_few_seeds_decide_nothing() -> None:
    assert no_worse({"a": [1.0] * 8, "b": [0.5, 0.5] + [None] * 6}) == {"a"}
    assert no_worse({"a": [1.0] * 4, "b": [9.0] * 4}) == set()
    assert no_worse({"a": [None] * 6}) == set()


def test_ranks_of_random_scores_seldom_differ_by_more_than_the_critical_difference() -> None:
    rng = np.random.default_rng(0)
    wrong = 0
    for _ in range(200):
        made = ranking([dict(zip("abcde", rng.normal(size=5), strict=True)) for _ in range(20)])
        assert made is not None
        wrong += made.ranks[-1] - made.ranks[0] > made.critical
    assert wrong <= 20  # 5 % of 200 are 10, four standard deviations more are 22


def test_ranks_come_from_places_with_the_same_identifiers() -> None:
    scores = {"a": UNLIKE, "b": [2.0 * score for score in UNLIKE]}
    many = rows(scores, "p") + rows(scores, "q")
    alone = rows({"a": UNLIKE, "c": [None] * 6}, "r")
    (made,) = rankings([*many, *alone])
    assert (made.names, made.ranks, made.blocks) == (("a", "b"), (1.0, 2.0), 12)
    assert made.groups() == []


def test_over_the_floor_is_paired_with_the_floor_of_the_same_seed() -> None:
    own = rows({"a": [0.2, 0.4, 0.9]})
    for row, floor in zip(own, (0.1, 0.4, 0.3), strict=True):
        row.noise_floor = floor
    (line,) = summarise(own)
    assert line.over_best is not None
    assert line.over_best.median == pytest.approx(2.0)
    own[0].noise_floor = None
    (line,) = summarise(own)
    assert line.over_best is not None
    assert line.over_best.median == pytest.approx(2.0)


def test_the_cramer_rao_bound_goes_before_the_noise() -> None:
    own = rows({"a": [0.2, 0.4, 0.9]})
    assert summarise(own)[0].bound == "noise"
    for row in own:
        row.least_simulation_error, row.least_equation_error = 0.1, 0.05
    (line,) = summarise(own)
    assert line.bound == "Cramer-Rao"
    assert line.best_possible is not None
    assert line.over_best is not None
    assert (line.best_possible.median, line.over_best.median) == (0.1, pytest.approx(4.0))
    result = BenchResult("s", tuple(own), 3, None, {}, (("p", "s", "a"),))
    header, values = (text.split(",") for text in render(result, "csv").splitlines())
    cells = dict(zip(header, values, strict=True))
    assert cells["bound"] == "Cramer-Rao"
    assert float(cells["least_equation_error_median"]) == 0.05
    assert "| 0.1 | Cramer-Rao | 4 |" in render(result, "markdown")


def test_summaries_mark_the_leaders_but_never_the_truth() -> None:
    hard = [*UNLIKE, 1.4, 0.7]
    alike = [score * (0.99 if k % 2 else 1.01) for k, score in enumerate(hard)]
    scores = {"true-model": [0.5 * s for s in hard], "a": hard, "b": alike, "c": [3.0 * s for s in hard]}
    found = summarise(rows({**scores, "d": [*hard[:-1], None]}))
    marked = {line.identifier for line in found if line.leading}
    assert marked == {"a", "b"}
    assert {line.identifier: (line.ok, line.run) for line in found}["d"] == (7, 8)
    assert "8 replicates" in pairs_in_words(found)
