"""Smoothed signals and derivatives from a Kalman filter run forwards and backwards (RTS smoother, filterpy)."""

from __future__ import annotations

from typing import Any

import numpy as np

from harness.signals import FloatArray

_TUNED_ON = 800


def rts(signal: FloatArray, dt: float, *, noise: float | None = None) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a signal smoothed by a Kalman filter and its backward pass, with its first and second derivative.

    The third derivative is modelled as white noise (Bar-Shalom, Li & Kirubarajan 2001, sec. 6.2.3); its intensity is
    the one of largest likelihood on the first samples. The backward pass is that of Rauch, Tung & Striebel (1965, AIAA
    J. 3:1445).

    Parameters
    ----------
    signal : array (N,)
        Uniformly sampled, N >= 8.
    dt : float
        Sample time [s].
    noise : float, optional
        Standard deviation of the sensor; by default from the fourth difference of the signal.

    Returns
    -------
    value, rate, acceleration : array (N,)

    Examples
    --------
    >>> t = np.arange(300) * 0.01
    >>> rough = np.sin(2 * t) + 1e-3 * np.random.default_rng(0).normal(size=300)
    >>> value, rate, _ = rts(rough, 0.01)
    >>> bool(np.abs(rate - 2 * np.cos(2 * t))[20:-20].max() < 0.03)
    True
    """
    y = np.asarray(signal, dtype=float)
    if noise is None:
        fourth = np.diff(y, 4)
        noise = 1.4826 * float(np.median(np.abs(fourth - np.median(fourth)))) / np.sqrt(70.0)
    scale = float(np.ptp(y)) or 1.0
    sigma = max(noise, 1e-9 * scale)
    part = y[:_TUNED_ON]
    span = max(dt * len(part), dt)
    candidates = scale / span**3 * np.sqrt(span) * np.logspace(0, 7, 15)
    best = max(candidates, key=lambda intensity: _likelihood(part, dt, sigma, float(intensity)))
    filtered = _filter(y, dt, sigma, float(best))
    means, covariances, _, _ = filtered.batch_filter(y)
    smoothed = filtered.rts_smoother(means, covariances)[0]
    found: FloatArray = np.asarray(smoothed, dtype=float).reshape(len(y), 3)
    return found[:, 0], found[:, 1], found[:, 2]


def _filter(y: FloatArray, dt: float, sigma: float, intensity: float) -> Any:
    """Return a filter for position, rate and acceleration, started on the first samples."""
    from filterpy.kalman import KalmanFilter

    kalman = KalmanFilter(dim_x=3, dim_z=1)
    kalman.F = np.array([[1.0, dt, dt**2 / 2], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])
    kalman.H = np.array([[1.0, 0.0, 0.0]])
    kalman.R = np.array([[sigma**2]])
    powers = np.array(
        [[dt**5 / 20, dt**4 / 8, dt**3 / 6], [dt**4 / 8, dt**3 / 3, dt**2 / 2], [dt**3 / 6, dt**2 / 2, dt]]
    )
    kalman.Q = intensity**2 * powers
    scale = float(np.ptp(y)) or 1.0
    kalman.x = np.array([[y[0]], [0.0], [0.0]])
    kalman.P = np.diag([sigma**2, (scale / dt) ** 2, (scale / dt**2) ** 2])
    return kalman


def _likelihood(y: FloatArray, dt: float, sigma: float, intensity: float) -> float:
    """Return the log-likelihood of the innovations, the start left out."""
    kalman = _filter(y, dt, sigma, intensity)
    total = 0.0
    for k, value in enumerate(y):
        kalman.predict()
        kalman.update(value)
        if k >= 5:
            variance = float(np.squeeze(kalman.S))
            miss = float(np.squeeze(kalman.y))
            total -= 0.5 * (miss**2 / variance + np.log(variance))
    return total
