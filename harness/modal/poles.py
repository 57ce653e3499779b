"""Poles of models as modes of vibration: frequency, damping, shape, and the covariance that goes with them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.signals import FloatArray

_STANDING = 0.3
# Share of a shape's length that its sum of squares must have to say how it is turned: a wave that travels has none.

ComplexArray = npt.NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class Pole:
    """A pair of complex poles of a model of one order, as a mode of vibration.

    Parameters
    ----------
    order : int
        Of the model.
    value : complex
        Eigenvalue in the z plane, the one with positive imaginary part.
    frequency : float
        Undamped natural frequency ``|ln value| / (2 pi T)`` [Hz].
    damping : float
        Damping ratio ``-Re(ln value) / |ln value|``; negative where the motion grows.
    shape : array (ny,), complex
        What each output does in the mode: of length 1, turned to be as real as it can be, its largest part positive.
    frequency_deviation, damping_deviation : float
        Standard deviations [Hz], [1]; NaN where none were estimated.
    shape_deviation : array (ny,), complex
        Standard deviations of the real and the imaginary part of each component.
    freedom : float
        Degrees of freedom of the deviations.
    """

    order: int
    value: complex
    frequency: float
    damping: float
    shape: ComplexArray
    frequency_deviation: float = np.nan
    damping_deviation: float = np.nan
    shape_deviation: ComplexArray | None = None
    freedom: float = np.inf


@dataclass(frozen=True, eq=False)
class PoleSpread:
    """What every stretch of data adds to A and C to first order, from which follow covariances."""

    # (M, nx, nx), (M, ny, nx): Their sums over the stretches are 0
    a_shifts: FloatArray
    c_shifts: FloatArray
    factor: float  # The covariance of a quantity is this times the sum of the squares of its shifts
    freedom: float  # Degrees of freedom of that sum


@dataclass(frozen=True, eq=False)
class Mode:
    """A mode that the data determine.

    Parameters
    ----------
    pole : Pole
        Of the order it was taken from.
    orders : tuple of int
        Orders at which it was found.
    frequency_interval, damping_interval : (float, float)
        95 % [Hz], [1]; NaN where no deviations were estimated.
    damping_determined : bool
        False where the interval of the damping is as wide as the damping itself: only its upper end is then worth
        printing.
    seen : array of bool (ny,)
        False for outputs whose part in the mode is no more than chance makes.
    bound : array (ny,)
        Largest part that the data leave to each output (95 %).
    share : float
        Share of the outputs' variance, each counted by its size, that goes with the mode.
    """

    pole: Pole
    orders: tuple[int, ...]
    frequency_interval: tuple[float, float]
    damping_interval: tuple[float, float]
    damping_determined: bool
    seen: npt.NDArray[np.bool_]
    bound: FloatArray
    share: float = np.nan

    @property
    def frequency(self) -> float:
        """Natural frequency [Hz]."""
        return self.pole.frequency

    @property
    def damping(self) -> float:
        """Damping ratio [1]."""
        return self.pole.damping

    @property
    def shape(self) -> ComplexArray:
        """What each output does in the mode (ny,), complex, of length 1."""
        return self.pole.shape

    def to_dict(self, outputs: tuple[str, ...]) -> dict[str, Any]:
        """Return a JSON-ready description; numbers that the data do not determine are None."""
        spread = self.pole.shape_deviation
        return {
            "frequency": self.frequency,
            "frequency_interval": [_number(end) for end in self.frequency_interval],
            "damping": self.damping if self.damping_determined else None,
            "damping_interval": [_number(end) for end in self.damping_interval],
            "share": _number(self.share),
            "order": self.pole.order,
            "orders": list(self.orders),
            "shape": {
                name: {
                    "seen": bool(self.seen[k]),
                    "real": float(self.shape[k].real) if self.seen[k] else None,
                    "imaginary": float(self.shape[k].imag) if self.seen[k] else None,
                    "deviation": None if spread is None else [float(spread[k].real), float(spread[k].imag)],
                    "bound": _number(self.bound[k]),
                }
                for k, name in enumerate(outputs)
            },
        }


def _number(value: float) -> float | None:
    """Return a number as JSON can hold it."""
    return float(value) if np.isfinite(value) else None


def mac(first: ComplexArray, second: ComplexArray) -> float:
    """Return the modal assurance criterion of two shapes: 1 for the same direction, 0 for orthogonal ones.

    Allemang & Brown 1982 (Proc. 1st IMAC, 110, eq. 5).

    Examples
    --------
    >>> mac(np.array([1.0, 1.0j]), np.array([2.0j, -2.0]))
    1.0
    >>> mac(np.array([1.0, 1.0]), np.array([1.0, -1.0]))
    0.0
    """
    size = float(np.vdot(first, first).real * np.vdot(second, second).real)
    return float(np.abs(np.vdot(first, second)) ** 2 / size) if size > 0 else 0.0


def poles_of(a: FloatArray, c: FloatArray, sample_time: float, spread: PoleSpread | None = None) -> list[Pole]:
    """Return the vibrating modes of ``x+ = A x, y = C x`` by frequency, with deviations from what stretches change.

    First-order perturbation of eigenvalues and eigenvectors (Reynders, Pintelon & De Roeck 2008, Mech. Syst. Signal
    Process. 22:948, eq. 51 to 56).

    - ``a, c`` (nx, nx), (ny, nx)
    - ``sample_time``: [s]

    Examples
    --------
    >>> turn = np.exp(-0.01) * np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])
    >>> (pole,) = poles_of(turn, np.array([[1.0, 0.0], [0.0, 2.0]]), 0.1)
    >>> round(pole.frequency, 4), round(pole.damping, 4), pole.shape.round(6)
    (0.7959, 0.02, array([0.      -0.447214j, 0.894427+0.j      ]))
    """
    values, right = np.linalg.eig(a)
    left = np.linalg.pinv(right)
    shapes = c @ right
    found = []
    for i in np.argsort(np.abs(np.angle(values)), kind="stable"):
        value, shape = complex(values[i]), shapes[:, i]
        if not value.imag > 1e-9 * abs(value) or not np.any(shape):
            continue
        pole = np.log(value) / sample_time
        factor = _factor(shape)
        scaled = np.asarray(shape * factor, dtype=np.complex128)
        size = abs(pole)
        known: dict[str, Any] = {}
        if spread is not None:
            gaps = value - values
            gaps[i] = np.inf
            pushed = spread.a_shifts @ right[:, i] @ left.T
            moved = pushed[:, i] / (value * sample_time)
            change = spread.c_shifts @ right[:, i] + (pushed / gaps) @ shapes.T
            bent = change * factor + scaled * (1j * _turned(shape, change) - _stretched(shape, change))[:, None]
            speed = (pole.conjugate() * moved).real / size
            known = {
                "frequency_deviation": float(_deviation(speed / (2 * np.pi), spread)),
                "damping_deviation": float(_deviation(pole.real * speed / size**2 - moved.real / size, spread)),
                "shape_deviation": _deviation(bent.real, spread) + 1j * _deviation(bent.imag, spread),
                "freedom": spread.freedom,
            }
        frequency, damping = float(size / (2 * np.pi)), float(-pole.real / size)
        found.append(Pole(len(a), value, frequency, damping, scaled, **known))
    return found


def _square(shape: ComplexArray) -> complex:
    """Return what the turn of a shape follows from: the sum of squares, or the square of the largest where it waves."""
    total, lead = complex(np.sum(shape**2)), complex(shape[np.argmax(np.abs(shape))])
    return total if abs(total) > _STANDING * np.vdot(shape, shape).real else lead**2


def _factor(shape: ComplexArray) -> complex:
    """Return what makes a shape of length 1 and as real as it can be, its largest part positive."""
    turn = np.exp(-0.5j * np.angle(_square(shape))) / np.linalg.norm(shape)
    return complex(turn if (shape[np.argmax(np.abs(shape))] * turn).real > 0 else -turn)


def _turned(shape: ComplexArray, change: ComplexArray) -> FloatArray:
    """Return how far changes (M, ny) of a shape turn its factor [rad]."""
    square = _square(shape)
    lead = int(np.argmax(np.abs(shape)))
    half = change @ shape if square != complex(shape[lead]) ** 2 else change[:, lead] * shape[lead]
    return np.asarray(-(half / square).imag)


def _stretched(shape: ComplexArray, change: ComplexArray) -> FloatArray:
    """Return by what share changes (M, ny) lengthen a shape."""
    return np.asarray((change @ shape.conj()).real / np.vdot(shape, shape).real)


def _deviation(shifts: FloatArray, spread: PoleSpread) -> FloatArray:
    """Return the standard deviation of quantities from their shifts (M, ...)."""
    return np.asarray(np.sqrt(spread.factor * np.sum(shifts**2, axis=0)))
