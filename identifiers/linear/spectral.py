"""Frequency responses from records without a model, with bands: Welch's averaged spectra, and the smoothed ETFE."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from harness.errors import FitError
from harness.frequency.segments import segment_spectra
from harness.signals import FloatArray, Trajectory
from identifiers.common.records import learnable

ComplexArray = npt.NDArray[np.complex128]
# Neighbouring Hann segments that overlap by half are correlated by 1/6: averages count for so many fewer.
_OVERLAP = 1.0 + 2.0 / 36.0
_AROUND = 8  # Lines of a whole record over which its inputs' power is asked for: one line is small by chance.


@dataclass(frozen=True, eq=False)
class SpectralEstimate:
    """An estimated frequency response and how sure it is.

    Parameters
    ----------
    frequency : array (F,)
        Hz.
    response : array (F, ny, nu), complex
        NaN at frequencies at which an input has no power of its own, as beyond the lines of a multisine.
    deviation : array (F, ny, nu)
        Root mean squared size of the error of each entry, a complex number whose parts are equally large.
    coherence : array (F, ny)
        Share of each output's power that the inputs explain (multiple coherence).
    noise : array (F, ny)
        Power spectral density of what they do not explain, per Hz, one-sided.
    averages : float
        How many independent estimates were averaged.
    """

    frequency: FloatArray
    response: ComplexArray
    deviation: FloatArray
    coherence: FloatArray
    noise: FloatArray
    averages: float

    def radius(self, probability: float = 0.95) -> FloatArray:
        """Return the radius (F, ny, nu) of circles that hold the true response with this probability.

        The squared error over its mean has the F distribution of 2 and 2 (averages - inputs) degrees of freedom
        (Bendat & Piersol 2010, *Random Data*, sec. 9.2).
        """
        from scipy.stats import f

        free = max(2.0 * (self.averages - self.response.shape[2]), 1.0)
        found: FloatArray = self.deviation * np.sqrt(f.ppf(probability, 2, free))
        return found


def welch(trajectories: Sequence[Trajectory], *, segment: int = 256) -> SpectralEstimate:
    """Return the frequency response by averaged cross-spectra: ``G = S_yu S_uu^-1`` (Welch 1967; Ljung 1999, sec. 6.4).

    Hann windows that overlap by half, of every record by itself, their means taken away. Under feedback the estimate is
    biased towards minus the inverse of the controller (Ljung 1999, sec. 13.4).

    Parameters
    ----------
    trajectories : sequence of Trajectory
        Records of one plant, with as many segments as inputs at least.
    segment : int
        Samples of a segment: the frequencies are ``1 / (segment sample_time)`` apart.

    Raises
    ------
    FitError
        If no record is as long as a segment, or the inputs do not excite some frequency.

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 0.1)
    >>> u = np.random.default_rng(0).normal(size=(4000, 1))
    >>> y = np.vstack([np.zeros((1, 1)), 2.0 * u[:-1]])
    >>> found = welch([Trajectory(np.arange(4000) * 0.1, u, y, spec)], segment=64)
    >>> np.abs(found.response[1:-1, 0, 0]).round(1).min()
    np.float64(2.0)
    """
    what = "welch"
    records, spec = learnable(trajectories, samples=segment, what=what)
    if segment < 8 or spec.nu == 0:
        raise FitError(
            f"{what}: options",
            expected="segment >= 8, an input",
            got=f"{segment}, {spec.nu} inputs",
            remedy="correct it",
        )
    found = segment_spectra(records, segment)
    averages = max(1.0, found.segments / _OVERLAP)
    frequency = np.arange(segment // 2 + 1) / (segment * spec.sample_time)
    density = 2.0 * spec.sample_time / (found.power * found.segments)
    lit = found.excited(records)
    return _response(frequency, found.uu, found.yu, found.yy, averages, density, lit, what)


def etfe(trajectories: Sequence[Trajectory], *, smoothing: int = 1) -> SpectralEstimate:
    """Return the empirical transfer function estimate, smoothed over neighbouring frequencies (Ljung 1999, sec. 6.3-4).

    One record, or several of one length, averaged; for periodic inputs give whole periods. The Fourier transforms of
    whole records are multiplied and averaged over ``smoothing`` neighbours on each side (a Daniell window).

    Parameters
    ----------
    trajectories : sequence of Trajectory
        All of one length.
    smoothing : int
        Neighbours on each side; 0 takes the plain quotient, which has no bands from one record.

    Raises
    ------
    FitError
        If records differ in length, or there are fewer averages than inputs.
    """
    what = "etfe"
    records, spec = learnable(trajectories, samples=8, what=what)
    n = len(records[0])
    width = 2 * smoothing + 1
    if smoothing < 0 or spec.nu == 0 or width * len(records) < spec.nu or any(len(record) != n for record in records):
        raise FitError(
            f"{what}: records and options",
            expected="records of one length with an input, smoothing >= 0, as many averages as inputs",
            got=f"lengths {sorted({len(record) for record in records})}, smoothing {smoothing}, {spec.nu} inputs",
            remedy="cut the records to one length, or smooth more",
        )
    count = n // 2 + 1
    s_uu = np.zeros((count, spec.nu, spec.nu), dtype=complex)
    s_yu = np.zeros((count, spec.ny, spec.nu), dtype=complex)
    s_yy, lit = np.zeros((count, spec.ny)), np.zeros((count, spec.nu), dtype=bool)
    for record in records:
        lit |= segment_spectra([record], n).excited([record], max(width, _AROUND))
        fu, fy = (np.fft.rfft(part - part.mean(axis=0), axis=0) for part in (record.u, record.y))
        s_uu += _smoothed(np.einsum("fi,fj->fij", fu, fu.conj()), smoothing)
        s_yu += _smoothed(np.einsum("fi,fj->fij", fy, fu.conj()), smoothing)
        s_yy += np.real(_smoothed(np.abs(fy) ** 2, smoothing))
    frequency = np.arange(count) / (n * spec.sample_time)
    averages = float(width * len(records))
    # the constant was taken away: the first lines say nothing
    keep = slice(1, None)
    density = 2.0 * spec.sample_time / (n * averages)
    return _response(frequency[keep], s_uu[keep], s_yu[keep], s_yy[keep], averages, density, lit[keep], what)


def _smoothed(spectrum: npt.NDArray[np.inexact], smoothing: int) -> ComplexArray:
    """Return sums over neighbours; beyond the ends the lines are mirrored."""
    padded = np.concatenate(
        [
            np.conj(spectrum[smoothing:0:-1]),
            spectrum,
            np.conj(spectrum[-2 : -2 - smoothing : -1]),
        ]
    )
    cumulated = np.cumsum(np.concatenate([np.zeros_like(padded[:1]), padded]), axis=0)
    width = 2 * smoothing + 1
    return np.asarray(cumulated[width:] - cumulated[:-width], dtype=np.complex128)


def _response(
    frequency: FloatArray,
    s_uu: ComplexArray,
    s_yu: ComplexArray,
    s_yy: FloatArray,
    averages: float,
    density: float,
    lit: npt.NDArray[np.bool_],
    what: str,
) -> SpectralEstimate:
    """Return the response and its deviation from summed spectra."""
    size = np.sqrt(np.real(np.einsum("fii->fi", s_uu)))
    scale = np.maximum(size, 1e-300)
    values = np.linalg.eigvalsh(s_uu / (scale[:, :, None] * scale[:, None, :]))
    silent = (~lit).any(axis=1) | (values[:, 0] <= 1e-10)
    if silent.all():
        raise FitError(
            f"{what}: the inputs excite no frequency by themselves",
            expected="inputs that are not multiples of each other, and as many segments as inputs",
            got=f"{averages:.0f} averages",
            remedy="excite the inputs independently, or use shorter segments",
        )
    nu, ny = s_uu.shape[1], s_yu.shape[1]
    inverse = np.full_like(s_uu, np.nan)
    inverse[~silent] = np.linalg.inv(s_uu[~silent])
    response = s_yu @ inverse
    residual = np.real(s_yy - np.einsum("fij,fij->fi", response @ s_uu, response.conj()))
    free = max(averages - nu, 1e-9)
    noise = np.clip(residual, 0.0, None) * averages / free
    # var G_ij = noise_i (S_uu^-1)_jj, both summed: the sums carry the number of averages
    spread = np.sqrt(np.clip(np.real(np.einsum("fjj->fj", inverse)), 0.0, None))
    deviation = np.sqrt(noise / averages)[:, :, None] * spread[:, None, :] * np.ones((1, ny, nu))
    coherence = np.clip(1.0 - residual / np.maximum(s_yy, 1e-300), 0.0, 1.0)
    if averages <= nu:
        deviation = np.full_like(deviation, np.inf)
    return SpectralEstimate(frequency, response, deviation, coherence, noise * density, averages)
