"""Transfer functions fitted to frequency responses: Sanathanan and Koerner's iteration, then maximum likelihood."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from harness.algebra import least_squares
from harness.errors import FitError
from harness.signals import FloatArray
from identifiers.linear.continuous.rational import Rational

ITERATIONS = 25  # Of Sanathanan and Koerner; it has settled long before, or swings.
DELAYS = 9  # Dead times from which the search begins, from none to that of the steepest phase.
FINE, ROUGH = (1e-12, 1000), (1e-5, 20)
"""Relative change of parameters, sum and gradient below which the search has arrived, and evaluations at most."""
NEARLY = 1e-12  # Weights never below this share of the largest: a variance of nothing is not believed.


@dataclass(frozen=True, eq=False)
class ResponseFit:
    """A transfer function of one output, and how it fits."""

    model: Rational
    covariance: FloatArray  # (k, k): Of its parameter vector
    misfit: float
    """Mean square of the residual over its standard deviation: 1 where nothing but noise is left. Where no variance is
    known the residual itself is taken for it, and this is the residual's share of the response (rms)."""
    criterion: float  # Minus twice the log-likelihood plus ``k ln N`` (Schwarz 1978)
    known: bool  # The variance was


def fit_to_response(
    frequency: FloatArray,
    response: npt.NDArray[np.complex128],
    variance: FloatArray | None,
    order: int,
    *,
    zeros: int | None = None,
    delay: float | None = 0.0,
    rough: bool = False,
) -> ResponseFit:
    """Return the transfer function of an order that is most likely for a measured response.

    Residuals ``(G - B exp(-s T) / A) / sigma`` are minimised (Pintelon & Schoukens 2012, *System Identification: A
    Frequency Domain Approach*, eq. 9-2), by Levenberg and Marquardt's method with exact gradients from the end of
    Sanathanan & Koerner's iteration (1963, IEEE Trans. AC 8:56), each of some dead times. Raises FitError if there are
    fewer numbers than unknowns.

    - ``frequency`` (F,): [Hz]
    - ``response`` (F, nu)
    - ``variance`` (F, nu): ``E |error|^2``; without it every response counts by its own size
    - ``order``: of the denominator
    - ``zeros``: degree of the numerators; by default ``order - 1``
    - ``delay``: [s], of all inputs; None estimates one for each input
    - ``rough``: where the answer is only where another search begins

    Examples
    --------
    >>> f = np.geomspace(0.01, 10, 40)
    >>> s = 2j * np.pi * f
    >>> g = (3.0 / (s + 2.0) * np.exp(-0.1 * s))[:, None]
    >>> found = fit_to_response(f, g, 1e-6 * np.abs(g) ** 2, 1, delay=None).model
    >>> found.denominator.round(4).tolist(), found.numerators.round(4).tolist(), float(found.delay[0].round(4))
    ([1.0, 2.0], [[3.0]], 0.1)
    """
    degree = order - 1 if zeros is None else zeros
    nu = response.shape[1]
    free = order + nu * (degree + 1) + (nu if delay is None else 0)
    if order < 1 or not 0 <= degree <= order or 2 * frequency.size * nu <= free:
        raise FitError(
            "transfer-function: order",
            expected=f"1 or more, zeros from 0 to it, and more than {free / 2:g} frequencies",
            got=f"order={order}, zeros={degree}, {frequency.size} frequencies",
            remedy="lower the order, or measure at more frequencies",
        )
    size = np.abs(response)
    sigma = np.sqrt(variance) if variance is not None else np.maximum(size, 1e-9 * size.max())
    sigma = np.maximum(sigma, NEARLY * sigma.max())
    rate = _rate(frequency)
    best: tuple[float, Rational, FloatArray] | None = None
    for late in _delays(frequency, response, delay)[:: 2 if rough else 1]:
        start = _sanathanan(frequency, response, sigma, order, degree, np.full(nu, late), rate)
        found = _search(frequency, response, sigma, start, delay is None, ROUGH if rough else FINE)
        if best is None or found[0] < best[0]:
            best = found
    assert best is not None
    cost, model, gradients = best
    rows = 2 * size.size
    spare = max(rows - free, 1)
    known = variance is not None
    each = 2 * cost / spare  # of a real or imaginary part, which has half of E |error|^2
    covariance = _covariance(gradients) * (max(each, 0.5) if known else each)
    likelihood = 4 * cost if known else rows * np.log(max(2 * cost, 1e-300) / rows)
    return ResponseFit(
        model,
        covariance,
        2 * each if known else float(np.sqrt(cost / size.size)),
        float(likelihood + free * np.log(rows)),
        known,
    )


def fit_response(
    frequency: FloatArray,
    response: npt.NDArray[np.complex128],
    variance: FloatArray | None,
    orders: tuple[int, ...],
    *,
    zeros: int | None = None,
    delay: float | None = 0.0,
) -> tuple[ResponseFit, dict[int, float]]:
    """Return the fit of the order with the least criterion, and the criteria of all that could be fitted."""
    fits: dict[int, ResponseFit] = {}
    refused: FitError | None = None
    for order in orders:
        degree = None if zeros is None else min(zeros, order)
        try:
            fits[order] = fit_to_response(frequency, response, variance, order, zeros=degree, delay=delay)
        except FitError as error:
            refused = error
    if not fits:
        assert refused is not None
        raise refused
    best = min(fits, key=lambda order: fits[order].criterion)
    return fits[best], {order: fit.criterion for order, fit in fits.items()}


def _rate(frequency: FloatArray) -> float:
    """Return the middle of the frequencies on a logarithmic scale, in rad/s."""
    positive = frequency[frequency > 0]
    return float(2 * np.pi * np.sqrt(positive[0] * positive[-1])) if positive.size else 1.0


def _delays(frequency: FloatArray, response: npt.NDArray[np.complex128], delay: float | None) -> list[float]:
    """Return the dead times to begin from."""
    if delay is not None:
        return [delay]
    if frequency.size < 3:
        return [0.0]
    phase = np.unwrap(np.angle(response), axis=0)
    upper = slice(frequency.size // 2, None)
    slope = np.polyfit(frequency[upper], phase[upper], 1)[0]
    most = max(float(np.max(-slope)) / (2 * np.pi), 0.0)
    return [float(value) for value in np.linspace(0.0, most, DELAYS)] if most > 0 else [0.0]


def _sanathanan(
    frequency: FloatArray,
    response: npt.NDArray[np.complex128],
    sigma: FloatArray,
    order: int,
    degree: int,
    delay: FloatArray,
    rate: float,
) -> Rational:
    """Return the end of linear least squares, weighted with the denominator before, again and again."""
    s = 2j * np.pi * frequency
    small, nu, nb = s / rate, response.shape[1], degree + 1
    ahead = response * np.exp(s[:, None] * delay)
    bottom: npt.NDArray[np.complex128] = np.ones(s.size, dtype=np.complex128)
    best: tuple[float, Rational] | None = None
    for _ in range(ITERATIONS):
        weight = 1.0 / (sigma * np.abs(bottom)[:, None])
        rows = np.zeros((s.size, nu, order + nu * nb), dtype=np.complex128)
        rows[:, :, :order] = ahead[:, :, None] * (small[:, None] ** np.arange(order - 1, -1, -1))[:, None, :]
        for j in range(nu):
            rows[:, j, order + j * nb : order + (j + 1) * nb] = -(small[:, None] ** np.arange(degree, -1, -1))
        target = -ahead * (small**order)[:, None]
        left = (rows * weight[:, :, None]).reshape(-1, rows.shape[2])
        right = (target * weight).ravel()
        both, goal = np.vstack([left.real, left.imag]), np.concatenate([right.real, right.imag])
        theta = least_squares(both, goal, 1e-13)
        model = Rational(theta[:order], theta[order:].reshape(nu, nb), delay, rate)
        bottom = np.asarray(np.polyval(np.concatenate([[1.0], model.a]), small), dtype=np.complex128)
        bottom = np.where(np.abs(bottom) > 0, bottom, 1e-12)
        cost = float(np.sum(np.abs((model.response(frequency) - response) / sigma) ** 2))
        if best is None or cost < best[0]:
            best = (cost, model)
    assert best is not None
    return best[1]


def _search(
    frequency: FloatArray,
    response: npt.NDArray[np.complex128],
    sigma: FloatArray,
    start: Rational,
    free_delay: bool,
    ends: tuple[float, int],
) -> tuple[float, Rational, FloatArray]:
    """Return half of the least sum of squares, where it is, and the gradients of the residuals (N, k)."""
    from scipy.optimize import least_squares

    tight, most = ends
    count = start.vector.size if free_delay else start.vector.size - start.delay.size
    whole = start.vector

    def model_of(free: FloatArray) -> Rational:
        return start.moved(np.concatenate([free, whole[count:]]))

    def miss(free: FloatArray) -> FloatArray:
        wrong = ((model_of(free).response(frequency) - response) / sigma).ravel()
        return np.concatenate([wrong.real, wrong.imag])

    def slopes(free: FloatArray) -> FloatArray:
        found = model_of(free).gradients(frequency)[:, :, :count] / sigma[:, :, None]
        flat = found.reshape(-1, count)
        return np.concatenate([flat.real, flat.imag])

    low = np.full(count, -np.inf)
    if free_delay:
        low[-start.delay.size :] = 0.0
    begin = np.maximum(whole[:count], low)
    try:
        end = least_squares(
            miss, begin, slopes, bounds=(low, np.inf), x_scale="jac", xtol=tight, ftol=tight, gtol=tight, max_nfev=most
        )
        found = model_of(end.x)
        cost = float(end.cost)
    except ValueError:  # gradients that overflow: the start stands
        found, cost = start, float(0.5 * np.sum(miss(begin) ** 2))
    full = np.zeros((2 * response.size, whole.size))
    full[:, :count] = slopes(found.vector[:count])
    return cost, replace(found), full


def _covariance(gradients: FloatArray) -> FloatArray:
    """Return the inverse of the squared gradients in the directions that they determine."""
    length = np.linalg.norm(gradients, axis=0)
    kept = length > 0
    found = np.zeros((length.size,) * 2)
    _, values, right = np.linalg.svd(gradients[:, kept] / length[kept], full_matrices=False)
    good = values > 1e-12 * values[0]
    inverse = (right[good].T / values[good] ** 2) @ right[good]
    found[np.ix_(kept, kept)] = inverse / np.outer(length[kept], length[kept])
    return found
