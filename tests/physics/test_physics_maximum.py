"""What a maximum of a likelihood tells of its estimates: alone, and where others are known."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.diagnosis.forms.named import beside
from harness.effects import builtin
from harness.effects.effect import Placed
from harness.physics.fitting.maximum import LikelihoodFit

DRAG = Placed(builtin()["quadratic_drag"], "q")
NAMES = ("J", "G", "b", DRAG.name("c"))


def fit(covariance: np.ndarray[Any, Any], undetermined: tuple[str, ...] = ()) -> Any:
    """Return as much of a fit as is asked for here: three nominal parameters and a drag."""
    made: Any = SimpleNamespace(
        names=NAMES, covariance=covariance, undetermined=undetermined, logarithmic=np.array([True, True, True, False]),
        on_bound=(), system=SimpleNamespace(parameter_names=NAMES),
    )  # fmt: skip
    made.deviation = lambda name: LikelihoodFit.deviation(made, name)
    made.deviation_given = lambda name, held: LikelihoodFit.deviation_given(made, name, held)
    return made


@given(seed=st.integers(0, 1000), count=st.integers(1, 3))
def test_what_is_held_leaves_the_information_of_the_rest(seed: int, count: int) -> None:
    root = np.random.default_rng(seed).normal(size=(7, 4))
    information = root.T @ root + 0.01 * np.eye(4)
    held, rest = NAMES[:count], np.arange(count, 4)
    known = np.linalg.inv(information[np.ix_(rest, rest)])[-1, -1]
    found = fit(np.linalg.inv(information)).deviation_given(NAMES[3], held)
    assert found == pytest.approx(np.sqrt(known), rel=1e-6)


def test_a_scale_that_the_nominal_model_leaves_open_makes_no_law_unknown() -> None:
    """J, G, b and c all times 3 are the same motion: a drag seen by 861 in log-likelihood was "not determined"."""
    along = np.array([1.0, 1.0, 1.0, 0.02])  # c is 0.02
    covariance = 9.0 * np.outer(along, along) + np.diag([1e-4, 1e-4, 1e-4, 1e-8])
    assert fit(covariance).deviation(NAMES[3]) > 0.02
    assert beside([DRAG], fit(covariance))[NAMES[3]] < 2e-4
    assert beside([DRAG], fit(covariance / 1e4)) == {}, "what is told needs nothing held"
    exact = fit(np.diag([1e-4, 1e-4, 1e-4, 1e-8]), undetermined=NAMES)
    assert beside([DRAG], exact)[NAMES[3]] == pytest.approx(1e-4), "of combinations only, the scale is left out already"
