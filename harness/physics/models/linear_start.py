"""Where the fit of a linear model starts: a discrete least-squares model, brought to continuous time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from harness.errors import InputError
from harness.signals import FloatArray, Trajectory


def start_of(
    n: int, nu: int, lengths: Sequence[int], time_scale: float, offsets: bool
) -> Callable[[Sequence[Trajectory]], Mapping[str, float]]:
    """Return the function that finds start values of :func:`harness.physics.models.linear` in records.

    - ``n, nu``: number of states and inputs
    - ``lengths``: length of the chain of each output
    - ``time_scale``: T of the model [s]
    - ``offsets``: the model has an offset for each output
    """
    return _Starts(n, nu, tuple(lengths), float(time_scale), offsets)


class _Starts:
    """Callable and picklable, so that a system travels with its way to start."""

    def __init__(self, n: int, nu: int, lengths: tuple[int, ...], time_scale: float, offsets: bool) -> None:
        self.n, self.nu, self.lengths, self.time_scale, self.offsets = n, nu, lengths, time_scale, offsets

    def __call__(self, trajectories: Sequence[Trajectory]) -> Mapping[str, float]:
        """Return parameter values by name (the caller's fit refines them)."""
        if not self.nu:
            raise InputError(
                "a linear model without an input",
                expected="a recorded input to start from",
                got="outputs alone",
                remedy="name the input (sysid: --input NAME); sysid identify --identifier n4sid fits free motion",
            )
        a, b, mean = _subspace(trajectories, self.n)
        return self._canonical(a, b, mean, trajectories[0].spec.sample_time)

    def _canonical(
        self, model: tuple[FloatArray, FloatArray], b: FloatArray, mean: FloatArray, dt: float
    ) -> dict[str, float]:
        """Return the parameters of the canonical form of a discrete model (A, C), B."""
        from scipy.linalg import expm, logm

        a, c = model
        values, vectors = np.linalg.eig(a)
        # Eigenvalues on or beyond the negative axis have no real logarithm: they are noise of the fast modes.
        bad = (np.abs(values) < 1e-3) | ((values.real <= 0) & (np.abs(values.imag) < 1e-9))
        values = np.where(bad, 0.05, values)
        values = np.where(np.abs(values) > 0.9999, values / np.abs(values) * 0.9999, values)
        a = np.real(vectors @ np.diag(values) @ np.linalg.inv(vectors))
        continuous = np.real(logm(a)) / dt
        n = self.n
        augmented = np.zeros((n + 1, n + 1))
        augmented[:n, :n] = continuous * dt
        integral = np.zeros((n, n))
        block = np.zeros((2 * n, 2 * n))
        block[:n, :n], block[:n, n:] = continuous * dt, np.eye(n) * dt
        integral = expm(block)[:n, n:]
        b_continuous = np.linalg.lstsq(integral, b, rcond=None)[0]
        scaled = continuous * self.time_scale
        rows = []
        for output, length in enumerate(self.lengths):
            row = c[output]
            for _ in range(length):
                rows.append(row)
                row = row @ scaled
        transform = np.array(rows)
        inverse = np.linalg.pinv(transform)
        a_form = transform @ scaled @ inverse
        b_form = self.time_scale * transform @ b_continuous
        result: dict[str, float] = {}
        head = 0
        for output, length in enumerate(self.lengths):
            for column in range(n):
                result[f"a{output + 1}_{column + 1}"] = float(-a_form[head + length - 1, column])
            head += length
        for state in range(n):
            for column in range(self.nu):
                result[f"b{state + 1}_{column + 1}"] = float(b_form[state, column])
        if self.offsets:
            for output in range(len(self.lengths)):
                result[f"offset_{output + 1}"] = float(mean[output])
        return result


def _subspace(
    trajectories: Sequence[Trajectory], n: int
) -> tuple[tuple[FloatArray, FloatArray], FloatArray, FloatArray]:
    """Return ((A, C), B, output offset) of a discrete model of order n.

    A long ARX model by least squares (every record by itself), its impulse response, and a balanced realisation of it
    (Kung 1978): robust where the data are short and noisy.
    """
    spec = trajectories[0].spec
    ny, nu = spec.ny, spec.nu
    total = sum(len(record) for record in trajectories)
    lag = int(max(n + 1, min(30, total // (6 * (ny + nu)))))
    rows, targets = [], []
    u_mean = np.mean(np.vstack([record.u for record in trajectories]), axis=0)
    y_mean = np.mean(np.vstack([record.y for record in trajectories]), axis=0)
    for record in trajectories:
        u, y = record.u - u_mean, record.y - y_mean
        for k in range(lag, len(record)):
            rows.append(np.concatenate([y[k - lag : k][::-1].ravel(), u[k - lag : k][::-1].ravel()]))
            targets.append(y[k])
    regressor, target = np.array(rows), np.array(targets)
    ridge = 1e-8 * np.trace(regressor.T @ regressor) / regressor.shape[1] * np.eye(regressor.shape[1])
    theta = np.linalg.solve(regressor.T @ regressor + ridge, regressor.T @ target).T
    a_lags = theta[:, : ny * lag].reshape(ny, lag, ny)
    b_lags = theta[:, ny * lag :].reshape(ny, lag, nu)
    length = 2 * lag
    markov = np.zeros((length, ny, nu))
    for k in range(length):
        markov[k] = b_lags[:, k, :] if k < lag else 0.0
        for j in range(min(k, lag)):
            markov[k] += a_lags[:, j, :] @ markov[k - 1 - j]
    half = lag
    hankel = np.block([[markov[i + j] for j in range(half)] for i in range(half)])
    shifted = np.block([[markov[min(i + j + 1, length - 1)] for j in range(half)] for i in range(half)])
    left, sizes, right = np.linalg.svd(hankel, full_matrices=False)
    root = np.sqrt(np.maximum(sizes[:n], 1e-12 * sizes[0]))
    a = (left[:, :n] / root).T @ shifted @ (right[:n].T / root)
    c = left[:ny, :n] * root
    b = (right[:n, :nu].T * root).T
    gain = c @ np.linalg.solve(np.eye(n) - a + 1e-9 * np.eye(n), b)
    return (a, c), b, y_mean - gain @ u_mean
