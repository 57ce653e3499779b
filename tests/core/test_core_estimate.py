"""The record of an estimate: it holds together, travels through JSON, and says null directions in words."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.errors import InputError
from harness.models.estimate import Estimate, RankDecision, estimate_of, null_words


def test_what_json_cannot_hold_comes_back_as_what_it_meant():
    one = Estimate(
        ("a", "b"),
        ("kg", "1"),
        np.array([1.0, 2.0]),
        np.array([[0.1, 0.0], [0.0, np.inf]]),
        np.array([[0.5, 1.5], [np.nan, np.nan]]),
        method="normal",
        rank=RankDecision(1, 2, ("b has no effect",), ("b",), "noise"),
        converged=False,
        message="stopped",
        on_bound=("a",),
    )
    again = Estimate.from_dict(json.loads(json.dumps(one.to_dict(), allow_nan=False)))
    assert again.interval("a") == (0.5, 1.5)
    assert again.interval("b") is None
    assert again.deviation("b") == np.inf
    assert again.rank == one.rank
    assert str(again) == str(one)
    for word in ("b has no effect", "not converged: stopped", "on a bound: a"):
        assert word in str(one)


@pytest.mark.parametrize(
    "wrong",
    [
        {"units": ("kg",)},
        {"covariance": np.eye(3)},
        {"intervals": np.array([[2.0, 1.0], [0.0, 1.0]])},
        {"names": ("a", "a")},
        {"level": 95.0},
    ],
)
def test_records_that_do_not_hold_together_are_refused(wrong):
    parts = {"names": ("a", "b"), "units": ("kg", "1"), "values": np.ones(2)} | wrong
    with pytest.raises(InputError):
        Estimate(**parts)


def test_a_model_without_a_record_has_none():
    assert estimate_of(object()) is None


@given(st.integers(0, 10_000), st.integers(2, 5), st.integers(1, 2))
def test_words_name_every_parameter_that_has_a_part(seed, k, d):
    """A null direction of a random regressor with units of any size names its parameters and no other."""
    rng = np.random.default_rng(seed)
    d = min(d, k - 1)
    part = np.sort(rng.choice(k, size=d + 1, replace=False))
    null = np.zeros((k, d))
    null[part] = np.linalg.qr(rng.uniform(0.5, 1.0, size=(d + 1, d)))[0]
    names = [f"p{row}" for row in range(k)]
    text = " ".join(null_words(names, null, 10.0 ** rng.uniform(-3, 3, size=k)))
    assert all((f"p{row}" in text) == (np.abs(null[row]).max() > 0) for row in range(k))
