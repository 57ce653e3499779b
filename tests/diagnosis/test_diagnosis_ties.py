"""Ties: of laws that the data cannot tell apart the simplest one stands."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from harness.diagnosis.accept import Comparison, Judgement
from harness.diagnosis.confirm import Candidate
from harness.diagnosis.forms import Fitted
from harness.diagnosis.ties import leader, simplest, tie_set
from harness.effects import builtin
from harness.effects.effect import Placed

FORM: Any = SimpleNamespace(floors=(None,))


def candidate(name: str, delta_bic: float, parameters: int, size: float, *, accepted: bool = True) -> Candidate:
    """Return a refit with one effect whose residual is one fixed noise times ``size``."""
    rest = size * np.random.default_rng(0).standard_normal((2000, 1))
    placed = Placed(builtin()[name], "q")
    fitted = Fitted((placed,), None, {}, (), True, "", (rest,), (rest,), (np.zeros((2000, 1, 0)),))
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
