"""A high-order black box: how well these outputs can be predicted without any physics.

ARX models of growing order, linear and with polynomial terms, fitted by least squares on the estimation runs and
chosen by their free run on the validation runs. They serve as reference where the noise floor is not known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harness.diagnosis.residual_tests import max_autocorrelation
from harness.signals import Dataset, FloatArray, Trajectory

__all__ = ["BlackBox", "fit_black_box", "one_step_error"]

ORDERS = (2, 4, 8, 16, 32)
POLYNOMIAL_ORDERS = (2, 3, 4)


@dataclass(frozen=True)
class BlackBox:
    """What the best black box reached on the validation runs.

    Attributes
    ----------
    innovations : tuple of float
        One-step error of each output (rms).
    free_run : tuple of (float or None)
        Free-run error of each output at the horizon (rms); None if its one-step errors are not valid or it diverges.
    validated : bool
        True if the one-step errors on validation and estimation agree within 30 %, are nearly white, and the free
        run is finite.
    note : str
        Structure and verdict in words.
    """

    innovations: tuple[float, ...]
    free_run: tuple[float | None, ...]
    validated: bool
    note: str


@dataclass(frozen=True)
class _Structure:
    """Lags and polynomial degree of an ARX model with constant."""

    lags: int
    degree: int

    def __str__(self) -> str:
        kind = "linear" if self.degree == 1 else f"degree-{self.degree} polynomial"
        return f"{kind} ARX of order {self.lags}"


def fit_black_box(dataset: Dataset, *, horizon: float | None = None) -> BlackBox:
    """Fit black boxes of growing order; return the best free run of a validated one, else the best one-step error.

    Parameters
    ----------
    dataset : Dataset
        With estimation and validation runs; test runs are not looked at.
    horizon : float, optional
        Seconds of each free-run window; None is the whole record.
    """
    ny = dataset.spec.ny
    estimation, validation = _scaled(dataset)
    shortest = min(len(run[1]) for run in (*estimation, *validation))
    samples = None if horizon is None else max(round(horizon / dataset.spec.sample_time), 2)
    width = ny + estimation[0][0].shape[1]
    best: tuple[float, BlackBox] | None = None
    scale = np.std(np.concatenate([t.y for t in dataset.estimation]), axis=0)
    candidates = [_Structure(order, 1) for order in ORDERS]
    candidates += [_Structure(order, 3) for order in POLYNOMIAL_ORDERS if width * order <= 8]
    for structure in candidates:
        if structure.lags * 4 > shortest or (samples is not None and structure.lags * 2 > samples):
            continue
        if structure.degree > 1 and best is not None and best[1].validated:
            break  # a linear model already does; the polynomials are slow and rarely run freely
        fitted = _fit(structure, estimation)
        if fitted is None:
            continue
        inside = _one_step(structure, fitted, estimation)
        outside = _one_step(structure, fitted, validation)
        validated, words = _validate(inside, outside)
        free = np.full(ny, np.nan)
        if validated:
            free = _free_run(structure, fitted, validation, samples)
            if not np.isfinite(free).all():
                validated, words = False, "not validated: its free run diverges"
        error = np.sqrt(np.mean((free if validated else np.concatenate(outside)) ** 2))
        total = float(error) if np.isfinite(error) else np.inf
        if best is not None and (not validated, total) >= (not best[1].validated, best[0]):
            continue
        rms = np.sqrt(np.mean(np.concatenate(outside) ** 2, axis=0)) * scale
        run = tuple(float(v) if np.isfinite(v) else None for v in free * scale)
        best = (total, BlackBox(tuple(float(v) for v in rms), run, validated, f"{structure}, {words}"))
    if best is None:
        nothing = (float("nan"),) * ny
        return BlackBox(nothing, (None,) * ny, False, "no black box could be fitted or run freely")
    return best[1]


def one_step_error(dataset: Dataset) -> FloatArray:
    """Return how well linear models predict each output one sample ahead on the validation runs (rms (ny,)).

    The best over the orders; infinite if there are too few samples for any.
    """
    estimation, validation = _scaled(dataset)
    scale = np.std(np.concatenate([t.y for t in dataset.estimation]), axis=0)
    best = np.full(dataset.spec.ny, np.inf)
    shortest = min(len(run[1]) for run in (*estimation, *validation))
    for order in (one for one in ORDERS if 4 * one <= shortest):
        structure = _Structure(order, 1)
        fitted = _fit(structure, estimation)
        if fitted is None:
            continue
        errors = np.concatenate(_one_step(structure, fitted, validation))
        best = np.fmin(best, np.sqrt(np.mean(errors**2, axis=0)) * scale)
    return best


_Record = tuple[FloatArray, FloatArray]


def _scaled(dataset: Dataset) -> tuple[list[_Record], list[_Record]]:
    """Return (u, y) of the runs, centred and scaled by the estimation runs."""
    u = np.concatenate([t.u for t in dataset.estimation])
    y = np.concatenate([t.y for t in dataset.estimation])
    um, ym = u.mean(axis=0), y.mean(axis=0)
    us, ys = u.std(axis=0), y.std(axis=0)
    us, ys = np.where(us > 0, us, 1.0), np.where(ys > 0, ys, 1.0)

    def of(runs: Sequence[Trajectory]) -> list[_Record]:
        return [((t.u - um) / us, (t.y - ym) / ys) for t in runs]

    return of(dataset.estimation), of(dataset.validation or dataset.estimation)


def _exponents(structure: _Structure, width: int) -> list[tuple[int, ...]]:
    """Return the index tuples of the products of lagged signals, degree 1 up to the structure's degree."""
    from itertools import combinations_with_replacement

    size = structure.lags * width
    products: list[tuple[int, ...]] = []
    for degree in range(1, structure.degree + 1):
        products += list(combinations_with_replacement(range(size), degree))
    return products


def _features(structure: _Structure, lagged: FloatArray) -> FloatArray:
    """Return the regressors (..., k) of lagged signals (..., lags * width), constant last."""
    if structure.degree == 1:
        return np.concatenate([lagged, np.ones((*lagged.shape[:-1], 1))], axis=-1)
    products = _exponents(structure, lagged.shape[-1] // structure.lags)
    columns = [np.prod(lagged[..., list(index)], axis=-1) for index in products]
    return np.stack([*columns, np.ones(lagged.shape[:-1])], axis=-1)


def _lagged(structure: _Structure, record: _Record) -> FloatArray:
    """Return the lagged signals (N - lags, lags * width), newest first."""
    signals = np.concatenate([record[1], record[0]], axis=1)
    windows = np.lib.stride_tricks.sliding_window_view(signals[:-1], structure.lags, axis=0)
    return windows.transpose(0, 2, 1)[:, ::-1].reshape(windows.shape[0], -1)


def _fit(structure: _Structure, records: Sequence[_Record]) -> FloatArray | None:
    """Return the coefficients (k, ny) by least squares; None if there are too few samples for them."""
    gram: FloatArray | None = None
    rows = 0
    moment: FloatArray | None = None
    for record in records:
        lagged, target = _lagged(structure, record), record[1][structure.lags :]
        for start in range(0, lagged.shape[0], 8192):
            f = _features(structure, lagged[start : start + 8192])
            t = target[start : start + 8192]
            gram = f.T @ f if gram is None else gram + f.T @ f
            moment = f.T @ t if moment is None else moment + f.T @ t
            rows += f.shape[0]
    if gram is None or moment is None or rows < 5 * gram.shape[0]:
        return None
    diagonal = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    values, vectors = np.linalg.eigh(gram / np.outer(diagonal, diagonal))
    keep = values > 1e-13 * values[-1]
    inverse = (vectors[:, keep] / values[keep]) @ vectors[:, keep].T
    return np.asarray((inverse @ (moment / diagonal[:, None])) / diagonal[:, None])


def _one_step(structure: _Structure, theta: FloatArray, records: Sequence[_Record]) -> list[FloatArray]:
    """Return the one-step errors of each record."""
    return [
        record[1][structure.lags :] - _features(structure, _lagged(structure, record)) @ theta for record in records
    ]


def _free_run(structure: _Structure, theta: FloatArray, records: Sequence[_Record], samples: int | None) -> FloatArray:
    """Return the free-run rms of each output; windows start from the measured lags and count after them."""
    total, count = np.zeros(records[0][1].shape[1]), 0
    for u, y in records:
        length = len(y) if samples is None else min(samples, len(y))
        starts = np.arange(0, len(y) - length + 1, length)
        lags = structure.lags
        past = np.stack([np.concatenate([y[s : s + lags], u[s : s + lags]], axis=1)[::-1] for s in starts])
        for k in range(lags, length):
            predicted = _features(structure, past.reshape(len(starts), -1)) @ theta
            if not np.abs(predicted).max() < 1e3:
                return np.full_like(total, np.nan)
            total += np.sum((y[starts + k] - predicted) ** 2, axis=0)
            count += len(starts)
            past = np.concatenate([np.concatenate([predicted, u[starts + k]], axis=1)[:, None], past[:, :-1]], axis=1)
    return np.sqrt(total / max(count, 1))


def _validate(inside: Sequence[FloatArray], outside: Sequence[FloatArray]) -> tuple[bool, str]:
    """Judge a black box by its one-step errors; returns the verdict and its words."""
    a = float(np.sqrt(np.mean(np.concatenate(inside) ** 2)))
    b = float(np.sqrt(np.mean(np.concatenate(outside) ** 2)))
    n = min(one.shape[0] for one in outside)
    acf = max(max_autocorrelation(one[:, j]) for one in outside for j in range(one.shape[1]))
    if b > 1.3 * a:
        return False, f"not validated: its one-step error grows {b / a:.2f} times from estimation to validation"
    if acf > max(0.15, 4.0 / np.sqrt(n)):
        return False, f"not validated: its one-step error is coloured (largest autocorrelation {acf:.2f})"
    return True, "validated"
