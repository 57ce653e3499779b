"""A measured frequency response with its variance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.errors import InputError
from harness.signals import Channel, FloatArray, Ported


@dataclass(frozen=True, eq=False)
class FrequencyResponse(Ported):
    """Complex response of outputs to inputs at some frequencies.

    Parameters
    ----------
    frequency : array (F,)
        [Hz], rising, not negative.
    response : array (F, ny, nu)
        Complex; a one-dimensional array is that of one output and one input.
    variance : array (F, ny, nu), optional
        ``E |error|^2`` of each response, both parts together; None where nobody knows.
    inputs, outputs : tuple of Channel

    Raises
    ------
    InputError
        If shapes do not fit, or a number is not finite, or a frequency comes twice.

    Examples
    --------
    >>> f = np.array([0.1, 1.0, 10.0])
    >>> FrequencyResponse(f, 1 / (1 + 2j * np.pi * f))
    <FrequencyResponse u [1] -> y [1]: 3 frequencies from 0.1 to 10 Hz, no variance>
    """

    frequency: FloatArray
    response: npt.NDArray[np.complex128]
    variance: FloatArray | None = None
    inputs: tuple[Channel, ...] = (Channel("u"),)
    outputs: tuple[Channel, ...] = (Channel("y"),)

    def __post_init__(self) -> None:
        f = np.array(self.frequency, dtype=np.float64).ravel()
        shape = (f.size, len(self.outputs), len(self.inputs))
        given = np.asarray(self.response, dtype=np.complex128)
        if given.size != np.prod(shape) or given.shape[:1] != f.shape:
            _refuse("response", f"shape {shape}", str(given.shape))
        order = np.argsort(f, kind="stable")
        if not f.size or not np.isfinite(f).all() or f[order[0]] < 0:
            _refuse("frequency", "numbers [Hz], none negative", "none" if not f.size else "others")
        if np.any(np.diff(f[order]) == 0):
            twice = float(f[order][np.flatnonzero(np.diff(f[order]) == 0)[0]])
            _refuse("frequency", "each once", f"{twice:g} Hz twice")
        if not np.isfinite(given).all():
            row = int(np.flatnonzero(~np.isfinite(given.reshape(f.size, -1)).all(axis=1))[0])
            _refuse("response", "finite complex numbers", f"another at {f[row]:g} Hz (row {row + 1})")
        object.__setattr__(self, "frequency", f[order])
        object.__setattr__(self, "response", given.reshape(shape)[order])
        if self.variance is not None:
            spread = np.broadcast_to(np.asarray(self.variance, dtype=np.float64).reshape(f.size, *_rest(self.variance)),
                                     shape)  # fmt: skip
            if not np.isfinite(spread).all() or np.any(spread <= 0):
                _refuse("variance", "finite numbers above 0", "others")
            object.__setattr__(self, "variance", np.array(spread[order]))

    def between(self, low: float, high: float) -> FrequencyResponse:
        """Return the part from ``low`` to ``high`` [Hz], both included."""
        kept = (self.frequency >= low) & (self.frequency <= high)
        if not kept.any():
            span = f"{self.frequency[0]:g} to {self.frequency[-1]:g} Hz"
            _refuse("range of frequencies", f"a part of {span}", f"{low:g} to {high:g} Hz")
        variance = None if self.variance is None else self.variance[kept]
        return FrequencyResponse(self.frequency[kept], self.response[kept], variance, self.inputs, self.outputs)

    @classmethod
    def of_spectrum(cls, found: Any) -> FrequencyResponse:
        """Return the response that records showed (:func:`harness.spectrum`), where every input has power.

        Parameters
        ----------
        found : Spectrum
        """
        told = np.isfinite(found.response).all(axis=(1, 2)) & (found.frequency > 0)
        f, g = found.frequency[told], found.response[told]
        # the spectrum gives the deviation of the modulus: that of each part
        variance = np.maximum(2.0 * found.deviation[told] ** 2, 1e-24 * np.abs(g).max() ** 2)
        return cls(f, g, variance, found.spec.inputs, found.spec.outputs)

    def __repr__(self) -> str:
        sides = " -> ".join(", ".join(map(str, side)) for side in (self.inputs, self.outputs))
        span = f"{self.frequency[0]:g} to {self.frequency[-1]:g} Hz"
        known = "no variance" if self.variance is None else "with variance"
        return f"<FrequencyResponse {sides}: {self.frequency.size} frequencies from {span}, {known}>"


def _rest(variance: Any) -> tuple[int, ...]:
    """Return the axes of a variance after the first, one for every pair where there are none."""
    shape = np.shape(variance)[1:]
    return shape if len(shape) == 2 else (1, 1)


def _refuse(what: str, expected: str, got: str) -> None:
    raise InputError(f"{what} of a frequency response", expected=expected, got=got, remedy="correct the data")
