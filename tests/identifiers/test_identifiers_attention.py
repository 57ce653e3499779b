"""Attention over past samples: finds the lag that matters, bands hold, runs without torch."""

from __future__ import annotations

import importlib.util
import json

import numpy as np
import pytest

from harness.errors import InputError
from harness.scoring import equation_error
from harness.scoring.predictive import probability_score
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.learned.attention import AttentionEnsemble, AttentionNetwork
from identifiers.linear.least_squares import Arx

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("torch") is None, reason="torch is not installed: pip install 'sysid-harness[learned]'"
)
SPEC = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
DELAY = 9


def late(samples: int, seed: int) -> Trajectory:
    """A square of the input that comes nine samples late: no affine model sees it."""
    rng = np.random.default_rng(seed)
    u, y = rng.uniform(-1, 1, samples), np.zeros(samples)
    for k in range(samples - 1):
        push = u[k - DELAY] ** 2 if k >= DELAY else 0.0
        y[k + 1] = 0.5 * y[k] + push + 0.02 * rng.normal()
    return Trajectory(np.arange(float(samples)), u[:, None], y[:, None], SPEC)


@pytest.fixture(scope="module")
def fitted():
    options = dict(order=14, width=8, heads=2, hidden=12, members=2, steps=500, batch=96, rate=1e-2)
    return AttentionNetwork(**options).fit([late(1500, 0)], rng=np.random.default_rng(0))


def test_it_finds_what_came_late_and_its_bands_hold(fitted):
    held = late(600, 1)
    affine = Arx(order=14).fit([late(1500, 0)], rng=np.random.default_rng(0))
    assert equation_error(fitted, held).rms[0] < 0.5 * equation_error(affine, held).rms[0]
    assert 0.85 < probability_score(fitted, held).coverage[2, 0] < 0.95


def test_attention_is_a_distribution_and_rests_on_the_lag_that_matters(fitted):
    from identifiers.common.lag_state import regression_data

    rows, _ = regression_data([late(400, 2)], 14)
    shares = [member.attention(rows) for member in fitted.members]
    for share in shares:
        assert share.sum(axis=-1) == pytest.approx(1.0)
        assert share.mean(axis=0).max(axis=0).argmax() in (0, DELAY)
        assert share.mean(axis=0)[:, DELAY].max() > 2.0 / 14


def test_the_model_runs_without_torch_and_comes_back_from_its_file(fitted):
    read = AttentionEnsemble.from_dict(json.loads(json.dumps(fitted.to_dict())))
    held = late(100, 3)
    assert np.array_equal(equation_error(read, held).rms, equation_error(fitted, held).rms)


def test_the_same_seed_gives_the_same_model_and_bad_options_are_refused():
    options = dict(order=3, width=4, heads=2, hidden=4, members=1, steps=20)
    one, two = (AttentionNetwork(**options).fit([late(80, 0)], rng=np.random.default_rng(1)) for _ in range(2))
    assert json.dumps(one.to_dict()) == json.dumps(two.to_dict())
    with pytest.raises(InputError, match="multiple of heads"):
        AttentionNetwork(width=5, heads=2).fit([late(80, 0)], rng=np.random.default_rng(1))
