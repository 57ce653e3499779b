"""What is asked of a fitted model: poles, gains, responses or parameters, each with the covariance of its error."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from harness.errors import InputError
from harness.models.estimate import estimate_of
from harness.models.lqr import spectral_radius
from harness.models.spread import Matrices, gains, steps
from harness.signals import FloatArray, PlantSpec
from harness.units import quotient

Asked = Literal["gain", "pole", "response", "parameter"]

_INTEGRATES = 1e-6  # Distance of a pole from 1 below which it is an integrator's, and a static gain has no value.
_DIED, _LONGEST = 1e-3, 400
"""A response is followed until it has fallen to this share of its largest value, and over so many samples at most."""
_DRAWS, _DIRECTIONS = 4000, 20
"""Draws of an error's size (its 95 % quantile is then known to 1 or 2 %), and directions of the error that count."""


@dataclass(frozen=True, eq=False)
class Item:
    """One thing that is asked for."""

    name: str
    unit: str
    of: Callable[[Matrices], FloatArray] | None
    """From (A, B, C, D) to its value (k,); None of a parameter, which is read from the estimate."""
    value: FloatArray  # (k,): Accuracy is relative to the norm of it

    @property
    def size(self) -> float:
        """The norm that an accuracy is relative to."""
        return float(np.linalg.norm(self.value))


def items_of_matrices(
    matrices: Matrices, spec: PlantSpec, asked: Asked, frequency: float | None = None
) -> tuple[list[Item], list[str]]:
    """Return what is asked of a linear model, and words on what has no relative accuracy.

    A pole is ``s = ln(p) / dt``: a time constant where it is real, else natural frequency and damping in one complex
    number, so that 5 % means 5 % of these and not of a number that lies near 1 at any fast sampling. A gain is that at
    rest, or the complex gain at a frequency. A response is the impulse response, its error the norm over all samples.

    - ``matrices`` (A, B, C, D)
    - ``frequency``: [Hz] of a gain

    Examples
    --------
    >>> from harness.signals import Channel
    >>> spec, one = PlantSpec((Channel("u", "V"),), (Channel("y", "m"),), 0.1), np.ones((1, 1))
    >>> [item] = items_of_matrices((0.5 * one, one, one, 0 * one), spec, "gain")[0]
    >>> item.name, item.unit, item.value.tolist()
    ('y per u, static', 'm/V', [2.0])
    >>> [item] = items_of_matrices((0.5 * one, one, one, 0 * one), spec, "pole")[0]
    >>> round(float(item.value[0]), 4)
    -6.9315
    """
    if asked == "pole":
        return _poles(matrices[0], spec.sample_time)
    items, words = [], []
    settles = not len(matrices[0]) or float(np.abs(np.linalg.eigvals(matrices[0]) - 1.0).min()) > _INTEGRATES
    if asked == "gain" and frequency is None and not settles:
        raise InputError(
            "gain at rest", expected="a model without an integrator", got="a pole at 1", remedy="give a frequency [Hz]"
        )
    if asked == "response" and spectral_radius(matrices[0]) >= 1.0:
        raise InputError(
            "impulse response", expected="a stable model", got="a pole on or outside the unit circle",
            remedy="ask for poles, or for the gain at a frequency",
        )  # fmt: skip
    length = _length(matrices) if asked == "response" else 0
    for i, output in enumerate(spec.outputs):
        for j, given in enumerate(spec.inputs):
            pair, unit = f"{output.name} per {given.name}", quotient(output.unit, given.unit)
            if asked == "response":
                of = _response(i, j, length)
            else:
                of = _static(i, j) if frequency is None else _gain(i, j, frequency, spec.sample_time)
            place = "impulse response" if asked == "response" else "static"
            name = f"{pair}, {place if frequency is None or asked == 'response' else f'{frequency:g} Hz'}"
            value = of(matrices)
            if float(np.linalg.norm(value)) > 0:
                items.append(Item(name, unit, of, value))
            else:
                words.append(f"{name} is 0: no relative accuracy")
    return items, words


def items_of_estimate(model: Any) -> list[tuple[Item, FloatArray]]:
    """Return the parameters of an estimate with their variances (1, 1); those without a finite one are left out."""
    estimate = estimate_of(model)
    if estimate is None or estimate.covariance is None:
        return []
    found = []
    for row, (name, unit) in enumerate(zip(estimate.names, estimate.units, strict=True)):
        variance = estimate.covariance[row, row]
        if np.isfinite(variance) and variance > 0 and estimate.values[row] != 0:
            item = Item(name, unit, None, estimate.values[row : row + 1])
            found.append((item, np.array([[variance]])))
    return found


def quantile_of_norm(covariance: FloatArray, freedom: float, rng: np.random.Generator) -> float:
    """Return what the norm of an error stays below with a probability, for an error of a covariance (k, k).

    - ``covariance`` (k, k)
    - ``freedom``: degrees of freedom of the covariance: the error is Student's t with these
    - ``rng``: for the draws of an error in more than one direction

    Examples
    --------
    >>> round(quantile_of_norm(np.array([[4.0]]), np.inf, np.random.default_rng(0)), 3)
    3.92
    >>> found = quantile_of_norm(np.eye(2), np.inf, np.random.default_rng(0))
    >>> bool(abs(found - np.sqrt(-2 * np.log(0.05))) < 0.05)
    True
    """
    from scipy.stats import norm, t

    if covariance.shape[0] == 1:
        one = norm.ppf(0.975) if np.isinf(freedom) else t.ppf(0.975, freedom)
        return float(one) * float(np.sqrt(covariance[0, 0]))
    values = np.clip(np.linalg.eigvalsh(covariance)[::-1][:_DIRECTIONS], 0.0, None)
    squares = rng.standard_normal((_DRAWS, len(values))) ** 2 @ values
    if np.isfinite(freedom):
        squares = squares * freedom / rng.chisquare(freedom, _DRAWS)
    return float(np.sqrt(np.quantile(squares, 0.95)))


def _poles(a: FloatArray, sample_time: float) -> tuple[list[Item], list[str]]:
    poles = np.linalg.eigvals(a).astype(np.complex128)
    upper = poles[poles.imag >= 0]
    upper = upper[np.lexsort((upper.imag, -np.abs(upper)))]
    items, words = [], []
    for number, pole in enumerate(upper, 1):
        name = f"pole {number}"
        if abs(pole - 1.0) <= _INTEGRATES:
            words.append(f"{name} is that of an integrator: no relative accuracy")
        elif pole.imag == 0 and pole.real <= 0:
            words.append(f"{name} ({pole.real:.3g} of a sample) has no time constant: no relative accuracy")
        else:
            of = _pole(complex(pole), sample_time)
            items.append(Item(name, "1/s", of, of((a, a, a, a))))
    return items, words


def _pole(pole: complex, sample_time: float) -> Callable[[Matrices], FloatArray]:
    def of(matrices: Matrices) -> FloatArray:
        found = np.linalg.eigvals(matrices[0]).astype(np.complex128)
        near = found[int(np.argmin(np.abs(found - pole)))]
        s = np.log(complex(near)) / sample_time
        return np.array([s.real]) if pole.imag == 0 else np.array([s.real, s.imag])

    return of


def _static(i: int, j: int) -> Callable[[Matrices], FloatArray]:
    def of(matrices: Matrices) -> FloatArray:
        a, b, c, d = matrices
        return np.array([float(c[i] @ np.linalg.solve(np.eye(len(a)) - a, b[:, j]) + d[i, j])])

    return of


def _gain(i: int, j: int, frequency: float, sample_time: float) -> Callable[[Matrices], FloatArray]:
    def of(matrices: Matrices) -> FloatArray:
        a, b, c, d = matrices
        one = (a, b[:, j : j + 1], c[i : i + 1], d[i : i + 1, j : j + 1])
        found = gains(one, np.array([frequency]), sample_time)[0, 0, 0]
        return np.array([found.real, found.imag])

    return of


def _response(i: int, j: int, length: int) -> Callable[[Matrices], FloatArray]:
    def of(matrices: Matrices) -> FloatArray:
        a, b, c, d = matrices
        one = (a, b[:, j : j + 1], c[i : i + 1], d[i : i + 1, j : j + 1])
        return np.asarray(steps(one, length, "impulse")[:, 0, 0])

    return of


def _length(matrices: Matrices) -> int:
    """Return the samples until every response has died away."""
    response = np.abs(steps(matrices, _LONGEST, "impulse")).reshape(_LONGEST, -1)
    alive = np.flatnonzero((response > _DIED * response.max(axis=0)).any(axis=1))
    return int(alive[-1]) + 2 if alive.size else 2
