"""Dampings and gains that drift along a record."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.effects import builtin

DAMPING, GAIN, SENSOR = (builtin()[name] for name in ("drifting_damping", "drifting_gain", "sensor_drift"))


def force(d: float, T: float, v: float, t: float) -> float:
    return float(DAMPING.function(0.0, None, SimpleNamespace(d=d, T=T), 0.0, v, t))


@given(d=st.floats(-2.0, 2.0), T=st.floats(0.1, 1e4), v=st.floats(-5.0, 5.0), share=st.floats(0.0, 1.0))
def test_the_mean_over_the_change_is_the_nominals_own(d: float, T: float, v: float, share: float) -> None:
    """What is more than the nominal at one instant is as much less at its mirror image."""
    assert force(d, T, v, share * T) == pytest.approx(-force(d, T, v, (1.0 - share) * T), abs=1e-9)


def test_beyond_the_change_it_stays_as_it_is() -> None:
    assert force(0.4, 20.0, 1.0, 1e6) == force(0.4, 20.0, 1.0, 20.0) == pytest.approx(-0.2)
    assert force(0.4, 20.0, 1.0, -5.0) == force(0.4, 20.0, 1.0, 0.0) == pytest.approx(0.2)


def test_a_gain_that_halves_passes_three_quarters_in_the_middle() -> None:
    p = SimpleNamespace(g=-0.5, T=10.0)
    passed = [float(GAIN.function(2.0, None, p, 0.0, 0.0, t)) for t in (0.0, 5.0, 10.0)]
    assert passed == pytest.approx([2.5, 2.0, 1.5])


def test_a_damping_that_would_drive_at_the_end_of_a_record_is_forbidden() -> None:
    """Damping as told where a record begins: with d = -0.5, 0.3 more of it than in the end."""
    places = np.linspace(-1.0, 1.0, 5)
    assert not DAMPING.violations_along({"d": -0.5, "T": 20.0}, places, np.full(5, 0.6))
    assert DAMPING.violations_along({"d": -0.5, "T": 20.0}, places, np.full(5, 0.3))
    assert not DAMPING.violations_along({"d": 0.5, "T": 20.0}, places, np.full(5, 0.1))
    assert not GAIN.violations({"g": -1.0, "T": 20.0})
    assert GAIN.violations({"g": -2.5, "T": 20.0})


@given(d=st.floats(-2.0, 2.0), y=st.floats(-5.0, 5.0), share=st.floats(0.0, 1.0))
def test_a_sensor_that_drifts_reads_right_at_first_and_is_wrong_by_d_in_the_end(
    d: float, y: float, share: float
) -> None:
    p = SimpleNamespace(d=d, T=20.0)
    read = [float(SENSOR.function(y, None, p, 0.0, 0.0, t)) for t in (0.0, 20.0 * share, 20.0, 1e4)]
    assert read == pytest.approx([y, y + d * share, y + d, y + d], abs=1e-9)
