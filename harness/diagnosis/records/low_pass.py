"""Low-pass filters without delay, by their frequency response.

``scipy.signal`` has them too, but its import (with ``scipy.stats`` behind it) costs half a second, a tenth of a
diagnosis that needs nothing else of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from harness.signals import FloatArray

__all__ = ["LowPass", "butterworth", "chebyshev", "without_line"]

FADED = 1e-17
"""Share of a filter's response that is taken for nothing."""
Poles = npt.NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class LowPass:
    """Discrete low-pass filter of even order, all its zeros at half the sample rate.

    Attributes
    ----------
    poles : array (k,)
        One of each conjugate pair, in the z-plane; complex.
    gain : float
        At frequency 0.
    """

    poles: Poles
    gain: float

    def both_ways(self, rows: FloatArray, edge: int) -> FloatArray:
        """Return rows (N,) or (N, k) filtered forward and backward: no delay, the gain squared.

        Parameters
        ----------
        rows : array (N,) or (N, k)
        edge : int
            Samples by which the record is continued at both ends, turned about its end points; below N. Each way
            begins as if the first value had been there for ever.
        """
        low, high = 2 * rows[:1] - rows[edge:0:-1], 2 * rows[-1:] - rows[-2 : -edge - 2 : -1]
        longer = np.concatenate([low, rows, high]) if edge else rows
        smooth = self._one_way(self._one_way(longer)[::-1])[::-1]
        return smooth[edge : edge + len(rows)]

    def _one_way(self, rows: FloatArray) -> FloatArray:
        """Return rows filtered forward, by the frequency response; what follows a record has room to fade first."""
        steady, n = rows[:1], len(rows)
        tail = np.log(FADED) / np.log(np.abs(self.poles).max())
        size = 2 ** int(np.ceil(np.log2(n + tail)))
        late = np.exp(-2j * np.pi * np.fft.rfftfreq(size))
        response = np.full(len(late), self.gain, dtype=complex)
        for pole in self.poles:
            back, far = -2 * pole.real, abs(pole) ** 2
            response *= (1 + back + far) / 4 * (1 + late) ** 2 / (1 + back * late + far * late**2)
        seen = np.fft.rfft(rows - steady, size, axis=0)
        made = np.fft.irfft(seen * response.reshape(-1, *[1] * (rows.ndim - 1)), size, axis=0)
        return np.asarray(made[:n] + self.gain * steady)


def butterworth(order: int, cutoff: float) -> LowPass:
    """Return the maximally flat low-pass (Oppenheim & Schafer, *Discrete-Time Signal Processing*, section 7.3).

    Parameters
    ----------
    order : int
        Even.
    cutoff : float
        Where the power is halved, over half the sample rate.

    Examples
    --------
    >>> flat = butterworth(4, 0.1).both_ways(np.ones(50), 10)
    >>> bool(np.allclose(flat, 1.0))
    True
    """
    return LowPass(_discrete(np.exp(1j * _angles(order)), cutoff), 1.0)


def chebyshev(order: int, ripple: float, cutoff: float) -> LowPass:
    """Return the low-pass with equal ripples in its band (type I; Oppenheim & Schafer, appendix B.2).

    Parameters
    ----------
    order : int
        Even.
    ripple : float
        Depth of the ripples [dB]; at frequency 0 the gain is that far below 1.
    cutoff : float
        End of the band, over half the sample rate.
    """
    flat = np.arcsinh(1 / np.sqrt(10 ** (0.1 * ripple) - 1)) / order
    angles = _angles(order)
    poles = np.sinh(flat) * np.cos(angles) + 1j * np.cosh(flat) * np.sin(angles)
    return LowPass(_discrete(poles, cutoff), 10 ** (-0.05 * ripple))


def _angles(order: int) -> FloatArray:
    """Return where the poles of a Butterworth filter lie on the left half of the unit circle, above the real axis."""
    return np.pi / 2 + np.pi * (2 * np.arange(order // 2) + 1) / (2 * order)


def _discrete(poles: Poles, cutoff: float) -> Poles:
    """Return poles of a filter with cutoff 1 rad/s in the z-plane, by the bilinear transform to another cutoff."""
    moved = np.tan(np.pi * cutoff / 2) * poles
    return np.asarray((1 + moved) / (1 - moved), dtype=np.complex128)


def without_line(x: FloatArray) -> FloatArray:
    """Return values (N,) without their straight line of least squares."""
    t = np.linspace(-1.0, 1.0, len(x))
    return np.asarray(x - x.mean() - t * (t @ x) / (t @ t))
