"""The triangle passes standstill slowly, never jumps, and climbs through its amplitudes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.errors import InputError
from scenarios.triangles import triangle


@given(st.floats(0.01, 1.0), st.integers(1, 4), st.floats(0.0, 1.0), st.integers(50, 2000))
def test_it_never_jumps_and_stays_within_its_levels(frequency: float, levels: int, start: float, n: int) -> None:
    wave = triangle(n, 0.01, frequency, levels=levels, start=start)
    assert np.abs(wave).max() <= 1 + 1e-12
    assert np.abs(np.diff(wave)).max(initial=0.0) <= 4 * frequency * 0.01 + 1e-9
    assert np.abs(wave[: max(n // (2 * levels), 1)]).max() <= 1 / levels + 1e-9 or frequency * n * 0.01 < levels


def test_each_level_is_reached() -> None:
    wave = triangle(6000, 0.01, 0.5, levels=3)
    for part, peak in zip(np.split(wave, 3), (1 / 3, 2 / 3, 1.0), strict=True):
        assert np.abs(part).max() == pytest.approx(peak, abs=1e-3)


def test_what_is_no_triangle_is_refused() -> None:
    for frequency, levels in ((0.0, 1), (20.0, 1), (1.0, 0)):
        with pytest.raises(InputError, match="triangle"):
            triangle(100, 0.01, frequency, levels=levels)
