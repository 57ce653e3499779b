"""Excitation signals have the properties that their users rely on."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.errors import InputError
from scenarios import signals


def autocorrelation(sequence: np.ndarray) -> np.ndarray:
    """Return the periodic autocorrelation."""
    return np.fft.ifft(np.abs(np.fft.fft(sequence)) ** 2).real


@pytest.mark.parametrize("order", range(2, 16))
def test_prbs_is_of_maximal_length(order: int) -> None:
    period = 2**order - 1
    sequence = signals.prbs(period, order)
    lags = autocorrelation(sequence)
    assert lags[0] == pytest.approx(period)
    np.testing.assert_allclose(lags[1:], -1, atol=1e-6)
    assert sequence.sum() == 1


@pytest.mark.parametrize("order", range(16, 33))
def test_high_orders_visit_every_window_at_most_once(order: int) -> None:
    bits = (signals.prbs(60_000 + order, order, rng=np.random.default_rng(order)) > 0).astype(np.uint64)
    windows = sum(bits[i : i + 60_000] << np.uint64(i) for i in range(order))
    assert np.unique(windows).size == 60_000  # a shorter cycle would repeat a state of the register
    assert (windows != 0).all()


@given(order=st.integers(2, 12), hold=st.integers(1, 7), shift=st.integers(0, 5000), n=st.integers(1, 400))
def test_prbs_repeats_holds_and_shifts(order: int, hold: int, shift: int, n: int) -> None:
    period = 2**order - 1
    base = signals.prbs(n, order, hold=hold, shift=shift)
    assert base.shape == (n,)
    assert set(base) <= {-1.0, 1.0}
    np.testing.assert_array_equal(base, signals.prbs(n, order, hold=hold, shift=shift % period))
    bits = signals.prbs(shift + n, order)[shift:]
    np.testing.assert_array_equal(base[::hold], bits[: base[::hold].size])


@pytest.mark.parametrize("order", [1, 33])
def test_prbs_order_out_of_range(order: int) -> None:
    with pytest.raises(InputError, match="2 to 32"):
        signals.prbs(10, order)


@given(seed=st.integers(0, 1000), period=st.integers(8, 300), periods=st.integers(1, 4))
def test_multisine_has_equal_lines_exact_periods_and_nothing_else(seed: int, period: int, periods: int) -> None:
    rng = np.random.default_rng(seed)
    top = (period - 1) // 2
    lines = np.sort(rng.choice(np.arange(1, top + 1), size=min(top, 5), replace=False))
    signal = signals.multisine(periods * period, period, lines, rng=rng)
    np.testing.assert_array_equal(signal[:period], signal[-period:])
    spectrum = np.abs(np.fft.rfft(signal[:period]))
    chosen = np.isin(np.arange(spectrum.size), lines)
    assert np.ptp(spectrum[chosen]) < 1e-9 * spectrum.max()
    assert spectrum[~chosen].max() < 1e-9 * spectrum.max()
    assert np.abs(signal).max() == pytest.approx(1.0)


def test_crest_factor_option() -> None:
    lines = np.arange(1, 101)
    plain = signals.multisine(1000, 1000, lines, rng=np.random.default_rng(0))
    flat = signals.multisine(1000, 1000, lines, rng=np.random.default_rng(0), crest=1.6)
    assert signals.crest_factor(plain) > 2.5
    assert signals.crest_factor(flat) <= 1.6


def test_odd_lines_and_empty_band() -> None:
    assert signals.lines_of_band(100, 0.01, (0, 10), "odd").tolist() == [1, 3, 5, 7, 9]
    with pytest.raises(InputError, match="empty band"):
        signals.lines_of_band(100, 0.01, (1.2, 1.8))


@pytest.mark.parametrize("law", ["linear", "logarithmic"])
@pytest.mark.parametrize("rotate", [0.0, 0.4])
def test_chirp_sweeps_the_band_without_jumps(law: str, rotate: float) -> None:
    n, dt, band = 20_000, 1e-3, (0.5, 20.0)
    signal = signals.chirp(n, dt, band, law=law, rotate=rotate)  # type: ignore[arg-type]
    assert np.abs(np.diff(signal)).max() <= 2 * np.pi * band[1] * dt * 1.01  # phase continuous everywhere
    ups = np.flatnonzero((signal[1:] > 0) & (signal[:-1] <= 0))
    rates = 1 / (np.diff(ups) * dt)
    if rotate == 0:
        assert rates[0] < 2
        assert rates[-1] == pytest.approx(band[1], rel=0.1)
        middle = (band[0] * band[1]) ** 0.5 if law == "logarithmic" else sum(band) / 2
        assert rates[np.searchsorted(ups[:-1], n // 2)] == pytest.approx(middle, rel=0.1)


def test_band_noise_is_stationary_and_band_limited() -> None:
    dt, band = 0.01, (1.0, 5.0)
    draws = np.array([signals.band_noise(256, dt, band, rng=np.random.default_rng(i)) for i in range(1500)])
    power = (draws**2).mean(axis=0)
    assert power == pytest.approx(np.ones(256), abs=0.2)  # from the first sample to the last
    long = signals.band_noise(2**15, dt, band, rng=np.random.default_rng(0))
    spectrum = np.abs(np.fft.rfft(long * np.hanning(long.size))) ** 2
    frequency = np.fft.rfftfreq(long.size, dt)
    outside = (frequency < band[0] - 0.1) | (frequency > band[1] + 0.1)
    assert spectrum[outside].sum() < 1e-5 * spectrum.sum()


def test_steps_and_staircase() -> None:
    signal = signals.steps(5000, 50, rng=np.random.default_rng(0))
    changes = np.flatnonzero(np.diff(signal))
    assert 25 <= np.diff(changes).min()
    assert np.diff(changes).max() <= 75
    assert np.abs(signal).max() <= 1
    stairs = signals.staircase(160, 5)
    assert np.unique(stairs).tolist() == [-1, -0.5, 0, 0.5, 1]
    assert np.abs(np.diff(stairs)).max() == 0.5
