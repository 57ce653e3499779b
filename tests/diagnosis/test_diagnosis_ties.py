"""Ties: of laws that the data cannot tell apart the simplest one stands."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from harness.diagnosis.accept import Comparison, Judgement
from harness.diagnosis.confirm import Candidate
from harness.diagnosis.exchange import with_ties
from harness.diagnosis.forms import Fitted
from harness.diagnosis.ties import leader, simplest, tie_set
from harness.effects import builtin
from harness.effects.effect import Placed

FORM: Any = SimpleNamespace(floors=(None,))


def candidate(
    name: str, delta_bic: float, parameters: int, size: float, *, outside: float | None = None, accepted: bool = True
) -> Candidate:
    """Return a refit with one effect whose residual is one fixed noise times ``size``, ``outside`` on validation."""
    noise = np.random.default_rng(0).standard_normal((2000, 1))
    rest, other = size * noise, (size if outside is None else outside) * noise
    placed = Placed(builtin()[name], "q")
    fitted = Fitted((placed,), None, {}, (), True, "", (rest,), (other,), (np.zeros((2000, 1, 0)),))
    verdict = Judgement(accepted, () if accepted else ("not sure",))
    return Candidate((placed,), fitted, delta_bic, Comparison(0.99, 1e-3), {}, verdict, parameters)


@pytest.mark.parametrize("better", [-20.0, 3.0, 60.0])
def test_a_law_of_free_shape_that_only_imitates_a_spring_leaves_it_standing(better: float) -> None:
    spring = candidate("cubic_spring", 45000.0, 4, 1.0)
    cogging = candidate("cogging", 45000.0 + better, 6, 1.0 - 1e-4)
    poor = candidate("hysteresis", 13000.0, 5, 8.0)
    judged = [cogging, spring, poor]
    tied = tie_set(FORM, leader(judged, seed=0), judged, seed=0)
    assert {one.name for one in tied} == {"cubic_spring@q", "cogging@q"}
    assert simplest(tied) is spring


def test_a_better_law_is_no_tie_however_simple_its_rival() -> None:
    spring = candidate("quadratic_spring", 3000.0, 4, 1.2)
    cogging = candidate("cogging", 3800.0, 6, 1.0)
    best = leader([spring, cogging], seed=0)
    assert tie_set(FORM, best, [spring, cogging], seed=0) == [cogging]


def test_what_nests_in_most_rivals_stands_among_equals() -> None:
    cubic, tilt = candidate("cubic_spring", 100.0, 4, 1.0), candidate("force_bias", 103.0, 4, 1.0)
    cogging = candidate("cogging", 104.0, 6, 1.0)
    tied = tie_set(FORM, cogging, [cubic, tilt, cogging], seed=0)
    assert len(tied) == 3
    assert simplest(tied) is cubic
    assert simplest([candidate("cubic_spring", 100.0, 4, 1.0, accepted=False), cogging]) is cogging


@pytest.mark.parametrize(
    ("outside", "lost", "accepted", "ties"),
    [
        (0.97, 300.0, True, True),  # predicts better
        (1.0, 300.0, True, True),  # as well
        (1.03, 300.0, True, False),  # worse: the further parameter is needed
        (0.97, 500.0, True, False),  # much of what the best gains is lost
        (0.97, 300.0, False, False),  # no answer by itself
    ],
)
def test_a_special_case_that_predicts_as_well_stands(outside: float, lost: float, accepted: bool, ties: bool) -> None:
    """Under a disturbance the criterion finds asymmetry in one record of a symmetric friction."""
    general = candidate("asymmetric_friction", 8000.0, 6, 1.0)
    plain = candidate("coulomb_friction", 8000.0 - lost, 5, 1.02, outside=outside, accepted=accepted)
    tied = tie_set(FORM, general, [general, plain], seed=0)
    assert (plain in tied) is ties
    assert simplest(tied) is (plain if ties else general)


@pytest.mark.parametrize(
    ("floor", "worse", "accepted", "ties"),
    [
        (1.0, 0.0, True, True),  # 1.3 noise floors: something else is in the residual
        (1.3, 0.0, True, False),  # only noise is left, and the criterion is right
        (1.0, 0.2, True, False),  # every second of the record tells them apart
        (1.0, 0.0, False, False),
    ],
)
def test_under_a_disturbance_rivals_tie_unless_blocks_tell_them_apart(
    floor: float, worse: float, accepted: bool, ties: bool
) -> None:
    best = candidate("load_dependent_friction", 8000.0, 5, 1.3)
    rival = candidate("coulomb_friction", 7700.0, 5, 1.3 + worse, outside=1.3, accepted=accepted)
    assert rival.fitted is not None
    rest = rival.fitted.estimation[0] + 0.02 * np.random.default_rng(1).standard_normal((2000, 1))
    rival = replace(rival, fitted=replace(rival.fitted, estimation=(rest,)))
    form: Any = SimpleNamespace(floors=(floor,))
    assert (rival in tie_set(form, best, [best, rival], seed=0)) is ties


def test_another_law_that_predicts_as_well_is_no_special_case() -> None:
    best = candidate("hysteresis", 8000.0, 6, 1.0)
    assert tie_set(FORM, best, [best, candidate("coulomb_friction", 7700.0, 5, 1.02, outside=0.97)], seed=0) == [best]


def test_what_ties_with_the_answer_is_said_though_the_best_is_far_ahead() -> None:
    """The best, of free shape, gives way to a special case: a third law is told from the best, not from the answer."""
    best = candidate("asymmetric_friction", 8000.0, 6, 1.0)
    plain = candidate("coulomb_friction", 7940.0, 5, 1.005)
    third = candidate("load_dependent_friction", 7941.0, 5, 1.004, outside=1.003)
    poor = candidate("quadratic_drag", 7940.0, 5, 1.005, accepted=False)
    judged = (best, plain, third, poor)
    for one in judged:
        assert one.fitted is not None
        one.fitted.record["cost"] = 1.0
    search: Any = SimpleNamespace(form=FORM, seed=0)
    rounds: Any = [SimpleNamespace(candidates=judged)]
    assert plain.fitted is not None
    found, more = with_ties(search, plain.fitted, plain.fitted, [plain.added[0]], rounds)
    assert more == []
    names = [str(placed) for members in found[0].tie for placed in members]
    assert names == ["coulomb_friction@q", "asymmetric_friction@q", "load_dependent_friction@q"]
