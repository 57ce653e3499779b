"""What an experiment can tell: the power of a decision between two models of the same records."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sysid_lab.power import power_of

from harness.diagnosis.policy import POLICY
from harness.diagnosis.search.compare import difference, expected_difference
from harness.diagnosis.search.fit import Fit
from harness.signals import FloatArray

N = 2000
USES = ("estimation", "validation")
SHAPE = np.sin(np.arange(N) / 30.0)
"""What a rival misses, over the size of the noise."""


def predicting(e: FloatArray, count: int = 3) -> Fit:
    """Return a fit with these innovations (2, N), of variance one, on both uses."""
    return Fit(
        effects=(), system=None, values={}, free=(), count=count,  # type: ignore[arg-type]
        terms={use: [-0.5 * (part**2 + np.log(2 * np.pi))] for use, part in zip(USES, e, strict=True)},
        deviations={}, logarithmic=frozenset(), converged=True, on_bound=(),
        innovations={use: [(part[:, None], np.ones((N, 1)))] for use, part in zip(USES, e, strict=True)},
    )  # fmt: skip


def pair(seed: int, size: float, price: int = 0) -> tuple[Fit, Fit]:
    """Return the truth and a rival that misses something of this size."""
    e = np.random.default_rng(seed).standard_normal((2, N))
    return predicting(e, 3 + price), predicting(e + size * SHAPE)


def test_what_is_expected_of_a_difference_is_its_mean_over_other_noise() -> None:
    pairs = [pair(seed, 0.1) for seed in range(200)]
    told = [difference(*models, USES)[0] for models in pairs]
    expected = [expected_difference(*models, USES) for models in pairs]
    assert np.ptp(expected) < 1e-9, "it does not say what these records happened to say"
    assert np.mean(told) == pytest.approx(expected[0], abs=3 * np.std(told) / np.sqrt(200))


@pytest.mark.parametrize("size", [0.03, 0.07, 0.085, 0.1, 0.2])
def test_the_power_is_the_share_of_records_that_decide(size: float) -> None:
    """Of records with other noise, as many tell the truth from its rival as their power says."""
    decided, powers = [], []
    for seed in range(300):
        truth, rival = pair(seed, size)
        gain, error = difference(truth, rival, USES)
        decided.append(gain >= max(POLICY.tie, POLICY.tie_z * error))
        powers.append(power_of(truth, rival, POLICY.tie))
    assert np.mean(powers) == pytest.approx(np.mean(decided), abs=0.1)
    assert np.std(powers) < 0.1, "what one pair of records happened to say is not in it"


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), size=st.floats(0.0, 0.3), more=st.floats(0.01, 0.3))
def test_more_that_a_rival_misses_is_told_more_surely(seed: int, size: float, more: float) -> None:
    less, wider = (power_of(*pair(seed, missing), POLICY.tie) for missing in (size, size + more))
    assert 0.0 <= less <= wider + 0.02 <= 1.02


def test_a_parameter_that_the_truth_needs_more_costs_it_power() -> None:
    assert power_of(*pair(0, 0.09, price=2), POLICY.tie) < power_of(*pair(0, 0.09), POLICY.tie) - 0.1


def test_two_names_of_one_model_are_never_told_apart() -> None:
    assert power_of(*pair(0, 0.0), POLICY.tie) < 0.01
