"""Functions to write effects with: each takes floats, numpy arrays or CasADi symbols, and is smooth where it can be.

An effect is written once with these and then serves three uses: symbolic (fits, exported C), vectorised over a record
(screens) and sample by sample (around a plant).
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np


def _casadi(*arguments: Any) -> Any:
    """Return the casadi module if one of the arguments is one of its symbols, else None (it is not loaded for that)."""
    module = sys.modules.get("casadi")
    if module is not None and any(isinstance(argument, module.SX | module.MX | module.DM) for argument in arguments):
        return module
    return None


def sin(x: Any) -> Any:
    """Return the sine."""
    return (_casadi(x) or np).sin(x)


def cos(x: Any) -> Any:
    """Return the cosine."""
    return (_casadi(x) or np).cos(x)


def tanh(x: Any) -> Any:
    """Return the hyperbolic tangent; ``tanh(v / w)`` is the smooth sign of a velocity."""
    return (_casadi(x) or np).tanh(x)


def exp(x: Any) -> Any:
    """Return the exponential."""
    return (_casadi(x) or np).exp(x)


def sqrt(x: Any) -> Any:
    """Return the square root."""
    return (_casadi(x) or np).sqrt(x)


def floor(x: Any) -> Any:
    """Return the largest integer not above x."""
    return (_casadi(x) or np).floor(x)


def sign(x: Any) -> Any:
    """Return -1, 0 or 1."""
    return (_casadi(x) or np).sign(x)


def absolute(x: Any) -> Any:
    """Return the absolute value."""
    return (_casadi(x) or np).fabs(x)


def larger(x: Any, y: Any) -> Any:
    """Return the larger of two."""
    module = _casadi(x, y)
    return module.fmax(x, y) if module else np.fmax(x, y)


def smaller(x: Any, y: Any) -> Any:
    """Return the smaller of two."""
    module = _casadi(x, y)
    return module.fmin(x, y) if module else np.fmin(x, y)


def no_sooner(rate: Any, eigenvalue: Any, time: Any) -> Any:
    """Return a rate slowed down where its eigenvalue says that it settles within a time: what comes of it is the same.

    It is divided by ``(1 + (eigenvalue time)^4)^(1/4)``, which is 1 as long as it is slow.

    Examples
    --------
    >>> round(float(no_sooner(2.0, 1.0, 1e-3)), 9), round(float(no_sooner(2e6, 1e6, 1e-3)), 3)
    (2.0, 2000.0)
    """
    return rate / sqrt(sqrt(1.0 + (eigenvalue * time) ** 4))  # a power takes as long as ten roots


def power(x: Any, exponent: Any) -> Any:
    """Return a power of a positive number; its derivatives by both come from one logarithm and one exponential.

    Examples
    --------
    >>> round(float(power(2.0, 0.5)), 6)
    1.414214
    """
    module = _casadi(x, exponent) or np
    return module.exp(exponent * module.log(x))


def softplus(x: Any) -> Any:
    """Return ``log(1 + exp(x))``, a smooth ``max(x, 0)``; does not overflow.

    Examples
    --------
    >>> float(softplus(1e4)), round(float(softplus(0.0)), 4)
    (10000.0, 0.6931)
    """
    return larger(x, 0.0) + (_casadi(x) or np).log1p(exp(-absolute(x)))


def sigmoid(x: Any) -> Any:
    """Return ``1 / (1 + exp(-x))``, a smooth step and the derivative of :func:`softplus`; does not overflow.

    Examples
    --------
    >>> float(sigmoid(-1e4)), float(sigmoid(0.0))
    (0.0, 0.5)
    """
    return 0.5 * (1.0 + tanh(0.5 * x))


def dead_band(x: Any, width: Any, smoothing: Any) -> Any:
    """Return x outside a band, moved towards 0 by the band's half width; odd in x, and x itself at width 0.

    ``smoothing`` is the length over which the corner is rounded, in the unit of x.

    Examples
    --------
    >>> [round(float(dead_band(x, 1.0, 0.01)), 6) for x in (-3.0, 0.0, 0.5, 3.0)]
    [-2.0, 0.0, 0.0, 2.0]
    """
    return smoothing * (softplus((x - width) / smoothing) - softplus((-x - width) / smoothing))


def dead_band_slope(x: Any, width: Any, smoothing: Any) -> Any:
    """Return the derivative of :func:`dead_band` with respect to x: 0 inside the band, 1 outside."""
    return sigmoid((x - width) / smoothing) + sigmoid((-x - width) / smoothing)


def clip(x: Any, limit: Any, smoothing: Any) -> Any:
    """Return x limited to [-limit, limit] with rounded corners; odd in x.

    Examples
    --------
    >>> [round(float(clip(x, 1.0, 0.01)), 6) for x in (-3.0, 0.5, 3.0)]
    [-1.0, 0.5, 1.0]
    """
    return x - dead_band(x, limit, smoothing)
