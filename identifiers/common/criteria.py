"""Other criteria than least squares for one-step equations: instruments, total least squares, l1 and l-infinity."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from harness.algebra import column_norms, divisor
from harness.errors import FitError
from harness.signals import FloatArray, Trajectory


def instrumental_variables(records: Sequence[Trajectory], offset: bool, what: str, lags: int = 3) -> FloatArray:
    """Return theta (p, ny) of ``y[k+1] = theta' [y[k], u[k], 1]`` by instruments that sensor noise does not reach.

    Outputs measured before k and inputs up to k move with the regressors, but white noise on the outputs at k and k + 1
    is none of theirs (Soderstrom & Stoica 1983, *Instrumental Variable Methods for System Identification*, eq. 3.10).

    - ``offset``: fit a constant too
    - ``what``: for messages
    - ``lags``: how many earlier outputs and inputs serve as instruments
    """
    x, z, y = instruments_of(records, offset, lags)
    if not len(x):
        raise FitError(
            f"{what}: records too short", expected=f"{lags + 2} samples", got="fewer", remedy="record longer"
        )
    size, lengths = column_norms(x), column_norms(z)
    # The regressors as far as the instruments explain them.
    q, s, _ = np.linalg.svd(z / lengths, full_matrices=False)
    q = q[:, s > 1e-10 * s[0]]
    seen = q @ (q.T @ (x / size))
    return _determined(seen, q @ (q.T @ y), size, what)


def instruments_of(
    records: Sequence[Trajectory], offset: bool, lags: int = 3
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return regressors ``[y[k], u[k], 1]``, instruments of :func:`instrumental_variables`, and next outputs.

    - ``records``: those of fewer than ``lags + 2`` samples have no part
    - ``offset``: with the constant
    """
    spec = records[0].spec
    regressors = [np.zeros((0, spec.ny + spec.nu + offset))]
    instruments = [np.zeros((0, lags * spec.ny + (lags + 1) * spec.nu + offset))]
    targets = [np.zeros((0, spec.ny))]
    for record in records:
        n = len(record)
        if n < lags + 2:
            continue
        now = slice(lags, n - 1)
        constant = [np.ones((n - 1 - lags, 1))] if offset else []
        regressors.append(np.hstack([record.y[now], record.u[now], *constant]))
        earlier = [record.y[lags - j : n - 1 - j] for j in range(1, lags + 1)]
        earlier += [record.u[lags - j : n - 1 - j] for j in range(lags + 1)]
        instruments.append(np.hstack([*earlier, *constant]))
        targets.append(record.y[lags + 1 :])
    return np.concatenate(regressors), np.concatenate(instruments), np.concatenate(targets)


def total_least_squares(records: Sequence[Trajectory], offset: bool, what: str) -> FloatArray:
    """Return theta (p, ny) of ``y[k+1] = theta' [y[k], u[k], 1]`` with noise on both sides, none on inputs.

    Exact columns are projected out first; outputs weigh by the least-squares residual (Golub, Hoffman & Stewart 1987,
    Linear Algebra Appl. 88:317; Van Huffel & Vandewalle 1991, algorithm 3.1).

    - ``records, offset, what``: as of :func:`instrumental_variables`
    """
    before = np.concatenate([record.y[:-1] for record in records])
    after = np.concatenate([record.y[1:] for record in records])
    exact = np.concatenate([record.u[:-1] for record in records])
    if offset:
        exact = np.hstack([exact, np.ones((len(exact), 1))])
    ny, size = before.shape[1], column_norms(exact)
    noise = _noise_sizes(records)
    both = np.hstack([before, after]) / np.tile(noise, 2)
    q, r = np.linalg.qr(exact / size) if exact.shape[1] else (np.zeros((len(before), 0)), np.zeros((0, 0)))
    residual = both - q @ (q.T @ both)
    vectors = np.linalg.svd(residual, full_matrices=True)[2] if residual.shape[0] < 2 * ny else _right_vectors(residual)
    upper, lower = vectors[ny:, :ny], vectors[ny:, ny:]
    if np.linalg.cond(lower) > 1e10:
        raise FitError(
            f"{what}: no total least squares solution",
            expected="states excited in every direction",
            got="a direction without motion",
            remedy="excite the plant more richly",
        )
    states = -np.linalg.solve(lower, upper).T  # (ny, ny): next = before @ states, in scaled outputs
    inputs = np.linalg.lstsq(r, q.T @ (both[:, ny:] - both[:, :ny] @ states), rcond=None)[0]
    theta: FloatArray = np.vstack([states / noise[:, None] * noise, inputs / size[:, None] * noise])
    return theta


def _noise_sizes(records: Sequence[Trajectory]) -> FloatArray:
    """Return what each output's noise may be: the residual of its least-squares equation, never 0."""
    x = np.concatenate([np.hstack([record.y[:-1], record.u[:-1]]) for record in records])
    y = np.concatenate([record.y[1:] for record in records])
    size = column_norms(x)
    miss = y - x / size @ np.linalg.lstsq(x / size, y, rcond=None)[0]
    spread = np.maximum(np.std(y, axis=0), 1e-300)
    found: FloatArray = np.maximum(np.sqrt(np.mean(miss**2, axis=0)), 1e-9 * spread)
    return found


def _right_vectors(rows: FloatArray) -> FloatArray:
    """Return the right singular vectors of tall rows, largest first."""
    vectors: FloatArray = np.linalg.svd(np.linalg.qr(rows, mode="r"))[2]
    return vectors


def absolute_deviations(x: FloatArray, y: FloatArray, what: str, *, largest: bool = False) -> FloatArray:
    """Return theta (p, m) that minimises the sum of absolute errors of each column, or the largest one.

    Linear programs, solved by HiGHS (Boyd & Vandenberghe 2004, *Convex Optimization*, sec. 6.1).

    - ``x, y`` (N, p), (N, m)
    - ``what``: for messages
    - ``largest``: l-infinity in place of l1

    Examples
    --------
    >>> x = np.ones((5, 1))
    >>> y = np.array([[1.0], [1.0], [1.0], [1.0], [50.0]])
    >>> [round(float(absolute_deviations(x, y, "x", largest=one)[0, 0]), 9) for one in (False, True)]
    [1.0, 25.5]
    """
    from scipy import sparse

    size = column_norms(x)
    scaled = sparse.csr_matrix(x / size)
    slack = sparse.csr_matrix(np.ones((len(x), 1))) if largest else sparse.identity(len(x), format="csr")
    unit = divisor(np.abs(y).max(axis=0))
    found = [_least_slack(scaled, slack, column, what) for column in (y / unit).T]
    return np.column_stack(found) * unit / size[:, None]


def largest_components(x: FloatArray, y: FloatArray, what: str) -> FloatArray:
    """Return theta (p, m) that minimises ``sum_n max_i |y[n, i] - (x[n] theta)_i|``, by a linear program.

    The l-infinity criterion of the exercise on objectives in Tedrake, *Underactuated Robotics*, ch. 18: the largest
    component of each sample's error, summed over samples.

    - ``x, y, what``: as of :func:`absolute_deviations`

    Examples
    --------
    >>> x, y = np.ones((3, 1)), np.array([[0.0, 0.0], [0.0, 4.0], [0.0, 4.0]])
    >>> largest_components(x, y, "x").round(6).tolist()
    [[0.0, 4.0]]
    """
    from scipy import sparse

    (n, p), m = x.shape, y.shape[1]
    size = column_norms(x)
    unit = float(np.abs(y).max()) or 1.0
    columns = sparse.kron(sparse.csr_matrix(x / size), sparse.identity(m), format="csr")  # rows: sample, component
    slack = sparse.kron(sparse.identity(n), np.ones((m, 1)), format="csr")
    theta: FloatArray = _least_slack(columns, slack, (y / unit).ravel(), what).reshape(p, m) * unit / size[:, None]
    return theta


def _least_slack(columns: Any, slack: Any, target: FloatArray, what: str) -> FloatArray:
    """Return theta with the least sum of s >= 0 for which ``|target - columns theta| <= slack s``.

    The program is that of the change from least squares, in the size of what these leave: a solver's tolerance is
    absolute, and of errors of 1e-5 beside signals of 1 it would let a hundredth pass.
    """
    from scipy import sparse
    from scipy.optimize import linprog

    first = np.linalg.lstsq((columns.T @ columns).toarray(), columns.T @ target, rcond=None)[0]
    left = target - columns @ first
    unit = max(float(np.sqrt(np.mean(left**2))), float(np.finfo(np.float64).eps * np.abs(target).max())) or 1.0
    target = left / unit
    p, n = columns.shape[1], slack.shape[1]
    above: Any = sparse.vstack([sparse.hstack([columns, -slack]), sparse.hstack([-columns, -slack])]).tocsr()
    found = linprog(
        np.concatenate([np.zeros(p), np.ones(n)]),
        A_ub=above,
        b_ub=np.concatenate([target, -target]),
        bounds=[(None, None)] * p + [(0.0, None)] * n,
        method="highs",
    )
    if found.status != 0 or found.x is None:
        raise FitError(
            f"{what}: the linear program has no solution",
            expected="a bounded optimum",
            got=str(found.message),
            remedy="use least squares",
        )
    return np.asarray(first + unit * found.x[:p], dtype=np.float64)


def _determined(x: FloatArray, y: FloatArray, size: FloatArray, what: str) -> FloatArray:
    """Return theta of ``y = (x * size) theta``, or refuse dependent columns."""
    left, values, right = np.linalg.svd(x, full_matrices=False)
    if values[-1] <= 1e-9 * values[0]:
        raise FitError(
            f"{what}: the instruments do not determine the model",
            expected=f"rank {len(values)}",
            got=f"rank {int(np.sum(values > 1e-9 * values[0]))}",
            remedy="excite the plant more richly",
        )
    theta: FloatArray = (right.T @ ((left.T @ y) / values[:, None])) / size[:, None]
    return theta
