"""Delays and rounding: the whole record, sample by sample, and their derivative."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from harness.effects import DelayLine, delay, quantisation_test, quantise
from harness.physics.compiled.sampled import delayed

records = hnp.arrays(float, st.integers(1, 40), elements=st.floats(-10, 10, width=32))
delays = st.floats(0.0, 12.0).map(lambda samples: samples * 0.1)


@settings(deadline=None)
@given(records, delays)
def test_the_line_the_filter_and_the_simulator_delay_alike(x, tau):
    line = DelayLine(tau, 0.1)
    one_by_one = np.array([line.step(value) for value in x])
    assert np.allclose(one_by_one, delay(x, tau, 0.1), atol=1e-12)
    assert np.allclose(delayed(x, tau, 0.1)[0], delay(x, tau, 0.1), atol=1e-6)


@settings(deadline=None)
@given(records, delays, st.integers(0, 39))
def test_a_delay_never_looks_ahead_and_peeking_changes_nothing(x, tau, k):
    k = min(k, len(x) - 1)
    changed = x.copy()
    changed[k] += 1.0
    assert np.array_equal(delay(changed, tau, 0.1)[:k], delay(x, tau, 0.1)[:k]) or k == 0
    line = DelayLine(tau, 0.1)
    for value in x:
        ahead = line.peek(value)
        state = line.get_state()
        assert line.step(value) == ahead
        line.set_state(state)
        assert line.step(value) == ahead


def test_a_whole_delay_shifts_and_a_zero_delay_does_not():
    x = np.arange(10.0) ** 2
    assert np.array_equal(delay(x, 0.0, 0.1), x)
    assert np.array_equal(delay(x, 0.3, 0.1)[3:], x[:-3])  # 0.3 / 0.1 is 2.9999999999999996
    assert (delay(x, 0.3, 0.1)[:3] == x[0]).all()


@given(st.floats(1e-3, 1.0), st.integers(0, 5))
@settings(deadline=None, max_examples=30)
def test_rounding_is_found_with_its_step(step, seed):
    y = np.random.default_rng(seed).standard_normal(3000) * step * 12
    found = quantisation_test(quantise(y, step))
    assert found.quantised
    assert abs(found.step / step - 1) < 1e-6
    assert abs(found.noise / np.std(quantise(y, step) - y) - 1) < 0.1


def test_a_smooth_or_still_record_is_not_called_rounded():
    t = np.linspace(0, 10, 4000)
    assert not quantisation_test(np.sin(t) + 1e-3 * np.random.default_rng(1).standard_normal(4000)).quantised
    assert not quantisation_test(np.zeros(100)).quantised
    assert not quantisation_test(np.sign(np.sin(t))).quantised  # two values are no grid
