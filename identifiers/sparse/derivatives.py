"""Rows of a regression for derivatives of sampled signals: weak form, smoothed, or plain differences."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Literal

import numpy as np

from harness.signals import FloatArray, Trajectory

Derivative = Literal["weak", "smooth", "difference"]
Functions = Callable[[FloatArray], FloatArray]  # ``functions(arguments (n, rows)) -> (p, rows)``.

_BLOCK = 8192


def polynomial_test_function(half: int, dt: float, order: int = 0) -> FloatArray:
    """Return a derivative of the test function ``(1 - s^2)^6`` on 2 half + 1 samples; the function sums to 1.

    - ``half``: half width in samples
    - ``dt``: sample time [s]
    - ``order``: 0, 1 or 2: which derivative

    Examples
    --------
    >>> plain, rate = polynomial_test_function(5, 0.1), polynomial_test_function(5, 0.1, 1)
    >>> float(plain.sum().round(12)), float(abs(rate.sum()).round(12))
    (1.0, 0.0)
    """
    width = half + 1
    s = np.arange(-half, half + 1) / width
    polynomial = np.polynomial.Polynomial([1.0, 0.0, -1.0]) ** 6
    area = polynomial(s).sum()
    values: FloatArray = polynomial.deriv(order)(s) if order else polynomial(s)
    scaled: FloatArray = values / area / (width * dt) ** order
    return scaled


def measured_motion(record: Trajectory, order: int) -> tuple[FloatArray, FloatArray]:
    """Return smoothed outputs (N, ny) and their rates (N, ny); the outputs as they are where ``order`` is 1."""
    if order == 1:
        return unwrapped(record), np.zeros((len(record), 0))
    from harness.physics.fitting.smoothing import smooth

    dt = record.spec.sample_time
    parts = [smooth(record.y[:, i], dt, period=c.period) for i, c in enumerate(record.spec.outputs)]
    return np.column_stack([p.value for p in parts]), np.column_stack([p.rate for p in parts])


def unwrapped(record: Trajectory) -> FloatArray:
    """Return the outputs (N, ny) with the jumps of angles taken out."""
    if all(channel.period is None for channel in record.spec.outputs):
        return record.y
    y = np.array(record.y)
    for column, channel in enumerate(record.spec.outputs):
        if channel.period is not None:
            y[:, column] = np.unwrap(y[:, column], period=channel.period)
    return y


def derivative_rows(
    record: Trajectory,
    functions: Functions,
    *,
    order: int,
    method: Derivative,
    half: int | None,
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield blocks of rows ``(Phi (p, n), target (ny, n))`` for the derivative of the given order of the outputs.

    - ``functions``: the candidate functions of ``[y, rates if order is 2, u]``
    - ``order``: 1 or 2
    - ``method`` {"weak", "smooth", "difference"}: both sides averaged with a test function and the derivative moved
      onto it by parts (Messenger & Bortz 2021, SIAM Multiscale Model. Simul. 19:1474, eq. 2.4); local cubics; central
      differences.
    - ``half``: half width of the test function in samples; by default from the amount of smoothing that the signals ask
      for

    Notes
    -----
    The input is held over each sample, so that a function of it jumps at every sample: the mean of both sides is used.
    """
    dt, n = record.spec.sample_time, len(record)
    y, rates = measured_motion(record, order)
    held = record.u
    jumps = record.spec.nu > 0

    def columns(first: int, last: int) -> FloatArray:
        state = [y[first:last], rates[first:last]]
        after = functions(np.hstack([*state, held[first:last]]).T)
        if not jumps:
            return after
        late = held[np.maximum(np.arange(first, last) - 1, 0)]
        return 0.5 * (after + functions(np.hstack([*state, late]).T))

    if method == "weak":
        reach = half if half is not None else fitting_half_width(record)
        reach = min(reach, (n - 3) // 2)
        if reach < 2:
            return
        weights, steep = polynomial_test_function(reach, dt), polynomial_test_function(reach, dt, order)
        sign = -1.0 if order % 2 else 1.0
        width, hop = 2 * reach + 1, max(1, reach // 3)
        raw = unwrapped(record)
        starts = np.arange(0, n - width + 1, hop)
        many = max(1, _BLOCK // width)
        for first in range(0, len(starts), many):
            some = starts[first : first + many]
            low, high = int(some[0]), int(some[-1]) + width
            phi = columns(low, high)
            pick = (some - low)[:, None] + np.arange(width)
            yield phi[:, pick] @ weights, sign * np.einsum("rwi,w->ir", raw[low:high][pick], steep)
        return
    if method == "smooth":
        from harness.physics.fitting.smoothing import smooth

        parts = [smooth(record.y[:, i], dt, period=c.period) for i, c in enumerate(record.spec.outputs)]
        if order == 1:
            y = np.column_stack([p.value for p in parts])
        target = np.column_stack([p.rate if order == 1 else p.acceleration for p in parts])
        first, last = (2, n - 2) if n > 8 else (1, n - 1)
    else:
        target = np.empty_like(y)
        if order == 1:
            target[1:-1] = (y[2:] - y[:-2]) / (2 * dt)
        else:
            y = unwrapped(record)
            target[1:-1] = (y[2:] - 2 * y[1:-1] + y[:-2]) / dt**2
            rates = np.gradient(y, dt, axis=0)
        first, last = 1, n - 1
    for low in range(first, last, _BLOCK):
        high = min(low + _BLOCK, last)
        yield columns(low, high), target[low:high].T


def fitting_half_width(record: Trajectory) -> int:
    """Return a half width for test functions: what smooths the outputs best, a few samples at least."""
    from harness.physics.fitting.smoothing import smooth

    dt = record.spec.sample_time
    part = record[: min(len(record), 4000)]
    widths = [smooth(part.y[:, i], dt, period=c.period).width for i, c in enumerate(part.spec.outputs)]
    return int(np.clip(2 * np.median(widths), 12, max(6, len(record) // 8)))
