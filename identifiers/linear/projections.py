"""Past and future of records stacked in one triangle, and its projections: N4SID, MOESP, CVA, PARSIM-E, PBSID."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from harness.errors import FitError
from harness.models.lqr import spectral_radius
from harness.signals import FloatArray, Trajectory
from identifiers.common.linear_model import LinearModel
from identifiers.common.neighbours import stacked, triangles_without
from identifiers.common.observers import innovation_form, stationary_gain

# Candidates: none, and half decades of the largest squared singular value of the columns, down to rounding.
_PENALTIES = np.concatenate([[0.0], 10.0 ** np.arange(-16.0, 0.0, 0.5)])
# Directions of the columns below this share of the largest are rounding.
_ROUNDING = 1e-10

Method = Literal["n4sid", "moesp", "cva", "parsim", "pbsid"]
# Methods whose regressions hold under feedback too.
ANY_LOOP: tuple[Method, ...] = ("parsim", "pbsid")
_BLOCK = 8192
# Errors below this fraction of the outputs are rounding: no reason for another order.
ROUNDING = 1e-7
# The regression of the future on past and inputs is refused below this ratio of singular values.
RANK = 1e-10
# Columns of the windows beyond which no fit without a stretch is made: sixty triangles of that size.
_WIDE = 700
# Share of the mean power that breaks ties between directions of equal canonical correlation.
_TIE = 1e-6


@dataclass(frozen=True, eq=False)
class Stacked:
    """Triangle of rows ``[u, y of the samples k - p .. k + f - 1]``, centred, and the means of its columns.

    Sample s of the window (0 .. p + f - 1) has its inputs and outputs in columns ``u(s)`` and ``y(s)``.
    """

    triangle: FloatArray
    window: int
    nu: int
    ny: int
    means: FloatArray
    rows: int

    @classmethod
    def of(cls, records: Sequence[Trajectory], window: int, what: str) -> Stacked:
        """Return the triangle of records."""
        nu, ny = records[0].spec.nu, records[0].spec.ny
        width = 2 * window * (nu + ny)
        rows = sum(max(0, len(record) - 2 * window + 1) for record in records)
        if rows < width:
            raise FitError(
                f"{what}: fewer windows than columns",
                expected=f"at least {width} windows of {2 * window} samples",
                got=str(rows),
                remedy="record longer, or use a smaller past",
            )
        triangle = np.zeros((0, width + 1))
        for block in _windows(records, window):
            triangle = stacked(triangle, block)
        return cls._of(triangle, window, nu, ny, rows)

    @classmethod
    def _of(cls, triangle: FloatArray, window: int, nu: int, ny: int, rows: int) -> Stacked:
        # the constant's column is the first: its row holds the means of the others, and the rest is centred
        return cls(triangle[1:, 1:], window, nu, ny, triangle[0, 1:] / triangle[0, 0], rows)

    @classmethod
    def without_stretches(cls, records: Sequence[Trajectory], window: int) -> list[Stacked]:
        """Return the triangles of all windows but those of one stretch of the records each."""
        nu, ny = records[0].spec.nu, records[0].spec.ny
        width = 2 * window * (nu + ny) + 1
        rows = sum(max(0, len(record) - 2 * window + 1) for record in records)
        if width > _WIDE:
            return []
        found = triangles_without(_windows(records, window), rows, width)
        return [cls._of(triangle, window, nu, ny, kept) for triangle, kept in found]

    def u(self, first: int, last: int) -> FloatArray:
        """Return the inputs of samples first .. last - 1."""
        return self._columns(first, last, 0, self.nu)

    def y(self, first: int, last: int) -> FloatArray:
        """Return the outputs of samples first .. last - 1."""
        return self._columns(first, last, self.nu, self.nu + self.ny)

    def past(self, shift: int = 0) -> FloatArray:
        """Return inputs and outputs of the p samples before sample p + shift."""
        both = self.nu + self.ny
        return self.triangle[:, shift * both : (self.window + shift) * both]

    def _columns(self, first: int, last: int, low: int, high: int) -> FloatArray:
        both = self.nu + self.ny
        index = (np.arange(first, last)[:, None] * both + np.arange(low, high)).ravel()
        return self.triangle[:, index]


def _windows(records: Sequence[Trajectory], window: int) -> Iterator[FloatArray]:
    """Yield blocks of ``[1, u[s], y[s], u[s+1], ...]`` over two windows, none across a seam."""
    length = 2 * window
    for record in records:
        both = np.hstack([record.u, record.y])
        count = len(record) - length + 1
        for start in range(0, count, _BLOCK):
            stop = min(start + _BLOCK, count)
            view = np.lib.stride_tricks.sliding_window_view(both[start : stop + length - 1], length, axis=0)
            rows = view.transpose(0, 2, 1).reshape(stop - start, -1)
            yield np.hstack([np.ones((stop - start, 1)), rows])


def _solve(columns: FloatArray, targets: FloatArray) -> FloatArray:
    """Return least squares of least norm; columns are of similar size already."""
    return np.asarray(np.linalg.lstsq(columns, targets, rcond=RANK)[0], dtype=np.float64)


def oblique(data: Stacked) -> FloatArray:
    """Return the part of the future outputs that the past explains, given the future inputs (Van Overschee 1996)."""
    past, inputs, outputs = data.past(), data.u(data.window, 2 * data.window), data.y(data.window, 2 * data.window)
    theta = _solve(np.hstack([past, inputs]), outputs)
    return theta[: past.shape[1]]


def pbsid(data: Stacked, direct: bool) -> FloatArray:
    """Return the part of the future outputs that the past explains, by the predictor from the past alone (PBSID).

    A high-order ARX model, solved with a ridge, gives the Markov parameters of the predictor; what it says of output i
    ahead from the past is the same weights, moved by i samples (Chiuso 2007, Automatica 43, sec. 3). Nothing of the
    future is regressed on, so a smooth input does no harm.
    """
    past, window, both = data.past(), data.window, data.nu + data.ny
    columns = np.hstack([past, data.u(window, window + 1)]) if direct else past
    weights = ridge_by_cross_validation(columns, data.y(window, window + 1), data.rows)[: past.shape[1]]
    found = []
    for i in range(window):
        row = np.zeros_like(weights)
        row[i * both :] = weights[: weights.shape[0] - i * both]
        found.append(row)
    return np.hstack(found)


def parsim(data: Stacked, direct: bool) -> FloatArray:
    """Return the same row by row, with only inputs and innovations of the past: PARSIM-E (Qin & Ljung 2003)."""
    past, window = data.past(), data.window
    found, innovations = [], np.zeros((data.triangle.shape[0], 0))
    for i in range(window):
        last = window + i + (1 if direct else 0)
        inputs = data.u(window, last)
        columns = np.hstack([past, inputs, innovations])
        target = data.y(window + i, window + i + 1)
        theta = _solve(columns, target)
        innovations = np.hstack([innovations, target - columns @ theta])
        found.append(theta[: past.shape[1]])
    return np.hstack(found)


def weighted(data: Stacked, predicted: FloatArray, method: Method) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return (W^-1 U, singular values, V') of the weighted predictions: Gamma = W^-1 U S, states from V."""
    past, inputs, outputs = data.past(), data.u(data.window, 2 * data.window), data.y(data.window, 2 * data.window)
    if method == "n4sid":
        right = np.asarray(np.linalg.qr(past, mode="r"))
    else:  # what of the past the future inputs do not explain
        right = np.asarray(np.linalg.qr(past - inputs @ _solve(inputs, past), mode="r"))
    weight = np.eye(outputs.shape[1])
    if method in ("cva", *ANY_LOOP):
        residual = outputs - inputs @ _solve(inputs, outputs)
        values, vectors = np.linalg.eigh(residual.T @ residual)
        # Without noise all canonical correlations are 1: a little of the mean power lets the stronger directions lead.
        values = np.maximum(values, 0.0) + _TIE * max(float(values.mean()), 1e-300)
        weight = (vectors * values**0.25) @ vectors.T
        back, forth = weight @ weight, np.linalg.inv(weight @ weight)
    else:
        back = forth = weight
    left, values, _ = np.linalg.svd(forth @ (right @ predicted).T, full_matrices=False)
    # rows of predicted' are outputs: the map from past to the leading directions of the weighted future
    return back @ left, values, (left.T @ forth) @ predicted.T


def completed(
    records: Sequence[Trajectory],
    data: Stacked,
    left: FloatArray,
    values: FloatArray,
    right: FloatArray,
    order: int,
    direct: bool,
) -> LinearModel:
    """Return A, B, C, D, K from the states that the leading directions give."""
    root = np.sqrt(values[:order])
    to_state = right[:order] / root[:, None]  # x = to_state @ past, in balanced size
    p, nu, ny = data.window, data.nu, data.ny
    state, following = data.past() @ to_state.T, data.past(1) @ to_state.T
    inputs, outputs = data.u(p, p + 1), data.y(p, p + 1)
    seen = np.hstack([state, inputs]) if direct else state
    theta = _solve(seen, outputs)
    c, d = theta[:order].T, theta[order:].T if direct else np.zeros((ny, nu))
    innovation = outputs - seen @ theta
    if np.linalg.norm(innovation) <= ROUNDING * np.linalg.norm(outputs):
        innovation = np.zeros_like(innovation)  # exact data tell no filter
    moved = _solve(np.hstack([state, inputs, innovation]), following)
    a, b, k = moved[:order].T, moved[order : order + nu].T, moved[order + nu :].T
    if spectral_radius(a - k @ c) >= 1.0:
        k = np.zeros_like(k)  # predictions that grow tell nothing of the noise
    # The state of data that are not centred is the same sum of their past; its means give the constants.
    both, means = nu + ny, data.means
    now, then = to_state @ means[: p * both], to_state @ means[both : (p + 1) * both]
    u_mean, y_mean = means[p * both : p * both + nu], means[p * both + nu : (p + 1) * both]
    state_offset = then - a @ now - b @ u_mean
    output_offset = y_mean - c @ now - d @ u_mean
    model = innovation_form(records[0].spec, a, b, c, d, k, state_offset, output_offset)
    return model if np.any(k) else replace(model, filter_gain=stationary_gain(a, c))


def ridge_by_cross_validation(columns: FloatArray, targets: FloatArray, samples: int) -> FloatArray:
    """Return the ridge solution of least generalised cross-validation (Golub, Heath & Wahba 1979, eq. 1.4).

    - ``columns`` (n, k): centred columns of similar size, or the triangle of their QR decomposition
    - ``targets`` (n, m): what they explain, in the same rows
    - ``samples``: rows before the decomposition

    Examples
    --------
    Two columns that are almost the same share what one of them would have to take alone:

    >>> rng = np.random.default_rng(0)
    >>> first = rng.normal(size=(200, 1))
    >>> columns = np.hstack([first, first + 1e-6 * rng.normal(size=(200, 1))])
    >>> targets = 2.0 * first + 0.1 * rng.normal(size=(200, 1))
    >>> ridge_by_cross_validation(columns, targets, 200).round(1).ravel()
    array([1., 1.])
    """
    left, values, right = np.linalg.svd(columns, full_matrices=False)
    keep = values > _ROUNDING * values[0]
    left, values, right = left[:, keep], values[keep], right[keep]
    found = left.T @ targets
    unexplained = float(np.sum(targets**2) - np.sum(found**2))

    def criterion(penalty: float) -> float:
        share = values**2 / (values**2 + penalty)
        residual = max(unexplained, 0.0) + float(np.sum(((1.0 - share)[:, None] * found) ** 2))
        return residual / max(samples - float(share.sum()), 1.0) ** 2

    penalties = _PENALTIES * values[0] ** 2
    penalty = penalties[int(np.argmin([criterion(trial) for trial in penalties]))]
    solution: FloatArray = right.T @ ((values / (values**2 + penalty))[:, None] * found)
    return solution
