"""What a diagnosis does without SciPy against SciPy: low-pass filters, the spectrum behind them, p-values."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal, special

from harness.diagnosis.records.low_pass import LowPass, butterworth, chebyshev, without_line
from harness.diagnosis.records.motion import _spectrum
from harness.diagnosis.runs.residual_tests import chi2_beyond, kolmogorov_beyond


def walk(rows: int, columns: int) -> np.ndarray:
    return 30.0 + np.cumsum(np.random.default_rng(rows).standard_normal((rows, columns)), axis=0)


@pytest.mark.parametrize(
    ("ours", "theirs", "edge"),
    [
        (butterworth(4, 0.2), signal.butter(4, 0.2, output="sos"), 90),
        (butterworth(4, 0.008), signal.butter(4, 0.008, output="sos"), 499),
        (butterworth(2, 0.9), signal.butter(2, 0.9, output="sos"), 0),
        (chebyshev(8, 0.05, 0.4), signal.cheby1(8, 0.05, 0.4, output="sos"), 12),
        (chebyshev(8, 0.05, 0.04), signal.cheby1(8, 0.05, 0.04, output="sos"), 120),
    ],
)
@pytest.mark.parametrize("columns", [1, 3])
def test_a_filter_is_that_of_scipy(ours: LowPass, theirs: np.ndarray, edge: int, columns: int) -> None:
    rows = walk(500, columns)
    expected = signal.sosfiltfilt(theirs, rows, axis=0, padlen=edge)
    np.testing.assert_allclose(ours.both_ways(rows, edge), expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(ours.both_ways(rows[:, 0], edge), expected[:, 0], rtol=0, atol=1e-9)


@pytest.mark.parametrize(("rows", "length"), [(1000, 256), (777, 257), (64, 64)])
def test_the_spectrum_is_that_of_welch(rows: int, length: int) -> None:
    x = walk(rows, 1)[:, 0]
    np.testing.assert_allclose(without_line(x), signal.detrend(x), atol=1e-9)
    f, power = _spectrum(x, 0.01, length)
    frequencies, density = signal.welch(x, 100.0, "blackman", nperseg=length)
    np.testing.assert_allclose(f, frequencies)
    np.testing.assert_allclose(power / power.sum(), density / density.sum(), rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("dof", [1, 2, 3, 25, 26, 60, 301])
def test_chi_square_beyond(dof: int) -> None:
    x = np.concatenate([[0.0, 1e-8], dof * np.geomspace(0.01, 30, 40), [1e5, np.inf]])
    ours = [chi2_beyond(float(one), dof) for one in x]
    np.testing.assert_allclose(ours, special.chdtrc(dof, x), rtol=1e-10, atol=1e-300)
    assert np.isnan(chi2_beyond(np.nan, dof))


def test_kolmogorov() -> None:
    x = np.concatenate([[0.0, 0.01], np.geomspace(0.05, 12.0, 200), [50.0, np.inf]])
    np.testing.assert_allclose(
        [kolmogorov_beyond(float(one)) for one in x], special.kolmogorov(x), rtol=1e-10, atol=1e-14
    )
    assert np.isnan(kolmogorov_beyond(np.nan))
