"""Frequency responses from records: local polynomials or Welch's averages, with coherence and bands, and the ETFE."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.comparison.local_polynomial import local_polynomial
from harness.errors import InputError
from harness.frequency.segments import segment_spectra
from harness.signals import FloatArray, PlantSpec, Trajectory
from harness.units import own_gains

ComplexArray = npt.NDArray[np.complex128]

OVERLAP = 9.0 / 11.0
"""Independent averages for each segment at half overlap (Welch 1967, eq. 12: a variance 11/9 times larger)."""
LEAST = 8  # Averages below which bands and coherence say nothing.


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Frequency response of a plant as its records show it.

    Parameters
    ----------
    spec : PlantSpec
    frequency : array (F,)
        [Hz].
    response : array (F, ny, nu)
        Output over input, complex, in their units; NaN at frequencies at which the input has no power.
    deviation : array (F, ny, nu)
        Standard deviation of its magnitude (Bendat and Piersol 2010, eq. 9.90); infinite where there is none.
    coherence : array (F, ny)
        Share of each output that the inputs together explain (multiple coherence), 0 to 1; 0 where none has power.
    averages : float
        Independent averages; of local polynomials the lines of a window, in the median.
    etfe : array (F2, ny, nu) or None
        Empirical transfer function of the longest record (Ljung 1999, eq. 6.24), of plants with one input.
    etfe_frequency : array (F2,)
        [Hz].
    method : {"local polynomials", "Welch"}
    recorded : mapping
        Units in which channels were recorded (``Dataset.recorded``): those of rows and pictures.
    """

    spec: PlantSpec
    frequency: FloatArray
    response: ComplexArray
    deviation: FloatArray
    coherence: FloatArray
    averages: float
    etfe: ComplexArray | None
    etfe_frequency: FloatArray
    method: str = "Welch"
    recorded: Mapping[str, str] = field(default_factory=dict)

    def __repr__(self) -> str:
        low, high = self.frequency[1], self.frequency[-1]
        return f"<Spectrum {self.spec}: {low:.3g} to {high:.3g} Hz, {self.method}, {self.averages:.0f} averages>"

    def rows(self, count: int = 16) -> list[dict[str, float | str]]:
        """Return the response at some frequencies, evenly on a logarithmic scale: magnitude, phase, band, coherence."""
        if self.recorded:
            return self.as_recorded(self.recorded).rows(count)
        wanted = np.geomspace(self.frequency[1], self.frequency[-1], count)
        picked = np.unique([int(np.argmin(np.abs(self.frequency - frequency))) for frequency in wanted])
        found: list[dict[str, float | str]] = []
        for k in picked:
            for row, output in enumerate(self.spec.outputs):
                for column, source in enumerate(self.spec.inputs):
                    value = self.response[k, row, column]
                    found.append(
                        {
                            "frequency": float(self.frequency[k]),
                            "input": source.name,
                            "output": output.name,
                            "magnitude": float(abs(value)),
                            "phase": float(np.degrees(np.angle(value))),
                            "deviation": float(self.deviation[k, row, column]),
                            "coherence": float(self.coherence[k, row]),
                        }
                    )
        return found

    def gains(self) -> str:
        """Return in words of what the magnitudes are, with the units of :meth:`rows`."""
        spec = own_gains(self.spec, self.recorded)[0]
        return ", ".join(f"{output} / {source}" for output in spec.outputs for source in spec.inputs)

    def unexcited(self) -> str:
        """Return in words at which frequencies inputs have no power; empty where all have some."""
        dark: npt.NDArray[np.bool_] = np.any(np.isnan(self.response[1:]), axis=1, keepdims=True)[:, 0]
        return "; ".join(
            f"{source.name} has no power at {dark[:, j].sum()} of {len(dark)} frequencies "
            f"({f[0]:.3g} to {f[-1]:.3g} Hz): no response is shown there"
            for j, source in enumerate(self.spec.inputs)
            if len(f := self.frequency[1:][dark[:, j]])
        )

    def as_recorded(self, recorded: Mapping[str, str]) -> Spectrum:
        """Return the same in the units in which the channels were recorded (``Dataset.recorded``)."""
        spec, times = own_gains(self.spec, recorded)
        etfe = None if self.etfe is None else self.etfe * times
        return replace(
            self, spec=spec, response=self.response * times, deviation=self.deviation * times, etfe=etfe, recorded={}
        )

    def _repr_html_(self) -> str:
        from harness.display import page
        from harness.plots import inlined

        return page(repr(self).strip("<>"), inlined(self.plot(), "frequency response"))

    def plot(self, colour: str | None = None) -> Any:
        """Draw magnitude with a band of two standard deviations, phase and coherence; returns the figure.

        Parameters
        ----------
        colour : str, optional
            Of all lines; by default each has its own.
        """
        from harness.plots import sheet

        if self.recorded:
            return self.as_recorded(self.recorded).plot(colour)
        figure = sheet(figsize=(8, 7), layout="constrained")
        axes = figure.subplots(3, 1, sharex=True)
        f = self.frequency[1:]
        sizes = np.abs(self.response[1:][np.isfinite(self.response[1:])])
        floor = 0.3 * sizes[sizes > 0].min(initial=1.0)  # here a band that holds zero ends, on an axis of logarithms
        for row, output in enumerate(self.spec.outputs):
            for column, source in enumerate(self.spec.inputs):
                value, spread = self.response[1:, row, column], 2 * self.deviation[1:, row, column]
                size = np.abs(value)
                (line,) = axes[0].loglog(f, size, linewidth=0.9, label=f"{output} / {source}", color=colour)
                low = np.maximum(size - spread, np.minimum(size, floor))
                axes[0].fill_between(f, low, size + spread, alpha=0.25, color=line.get_color(), linewidth=0)
                phase, told = np.degrees(np.angle(value)), np.isfinite(value)
                phase[told] = np.unwrap(phase[told], period=360.0)
                axes[1].semilogx(f, phase, linewidth=0.9, color=colour)
            axes[2].semilogx(f, self.coherence[1:, row], linewidth=0.9, label=output.name, color=colour)
        for axis, label in zip(axes, ("magnitude", "phase [deg]", "coherence"), strict=True):
            axis.set_ylabel(label)
        axes[0].legend(fontsize=8)
        axes[2].set_ylim(0, 1.02)
        axes[2].set_xlabel("frequency [Hz]")
        axes[0].set_title(self.unexcited(), fontsize=8)
        return figure


def spectrum(records: Sequence[Trajectory], *, segment: int | None = None) -> Spectrum:
    """Return the frequency response that records show: by local polynomials, which choose their resolution.

    With ``segment`` by Welch's method instead, with a Hann window and half overlap: every line is then a mean over the
    width of the window, and a resonance narrower than that is too low by far more than the band tells. Where an input
    has no power, as beyond the lines of a multisine, the response is NaN.

    Parameters
    ----------
    records : sequence of Trajectory
        No segment crosses from one to the next.
    segment : int, optional
        Samples of a segment of Welch's method.

    Raises
    ------
    InputError
        If there is no input, an input never moves, or the records are too short (for 8 averages of Welch's method).

    Examples
    --------
    >>> from harness.signals import Channel
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 0.1)
    >>> u = np.random.default_rng(0).normal(size=4000)
    >>> y = 2.0 * u
    >>> found = spectrum([Trajectory(np.arange(4000) * 0.1, u[:, None], y[:, None], spec)])
    >>> bool(np.abs(found.response - 2.0).max() < 1e-9), bool(found.coherence.min() > 0.999)
    (True, True)
    """
    if not records or records[0].spec.nu == 0:
        raise InputError(
            "a frequency response", expected="a record with an input", got="none",
            remedy="name the input (sysid: --input NAME); sysid modes finds resonances in outputs alone",
        )  # fmt: skip
    spec = records[0].spec
    total = sum(len(record) for record in records)
    n = segment or int(2 ** np.clip(np.floor(np.log2(max(total / 16, 2))), 4, 13))
    for column, channel in enumerate(spec.inputs):
        if not any(np.ptp(record.u[:, column]) for record in records):
            raise InputError(
                f"input {channel.name} never moves", expected="excitation", got="a constant", remedy="excite it"
            )
    longest = max(records, key=len)
    etfe, etfe_frequency = _etfe(longest) if spec.nu == 1 else (None, np.zeros(0))
    local = None if segment is not None else local_polynomial(records)
    if local is not None:
        f, g, variance, explained_share, lines = local
        # as the other method, whose first line is that of the mean, which was taken away
        return _shown(
            spec,
            np.concatenate([[0.0], f]),
            np.concatenate([g[:1], g]),
            np.sqrt(np.concatenate([variance[:1], variance]) / 2.0),
            np.concatenate([explained_share[:1], explained_share]),
            lines,
            etfe,
            etfe_frequency,
            "local polynomials",
        )
    found = segment_spectra(records, n)
    suu, syu, syy, count = found[:4]
    averages = OVERLAP * count if count > 1 else float(count)
    if averages < max(LEAST, spec.nu + 1):
        raise InputError(
            "records too short for a spectrum",
            expected=f"at least {LEAST} averages over segments of {n} samples",
            got=f"{averages:.1f} from {total} samples",
            remedy="record longer, or give a shorter segment (--segment)",
        )
    suu, syu, syy = suu / count, syu / count, syy / count
    power = np.real(np.trace(suu, axis1=1, axis2=2))[:, None, None] / spec.nu
    inverse = np.linalg.inv(suu + 1e-12 * power * np.eye(spec.nu))
    response: ComplexArray = syu @ inverse
    explained = np.real(np.einsum("fij,fij->fi", syu @ inverse, np.conj(syu)))
    coherence: FloatArray = np.clip(explained / np.maximum(syy, 1e-300), 0.0, 1.0)
    noise = np.maximum(syy - explained, 0.0) / max(averages - spec.nu, 1.0)
    own = np.real(np.einsum("fii->fi", inverse))
    deviation: FloatArray = np.sqrt(noise[:, :, None] * own[:, None, :] / 2.0)
    deviation[np.broadcast_to(~found.excited(records)[:, None, :], deviation.shape)] = np.inf
    frequency: FloatArray = np.asarray(np.fft.rfftfreq(n, spec.sample_time), dtype=np.float64)
    return _shown(spec, frequency, response, deviation, coherence, averages, etfe, etfe_frequency, "Welch")


def _shown(
    spec: PlantSpec, f: FloatArray, g: ComplexArray, deviation: FloatArray, coherence: FloatArray, *rest: Any
) -> Spectrum:
    """Return a spectrum without a figure where its deviation is infinite: at no power of an input."""
    dark = np.isinf(deviation)
    return Spectrum(spec, f, np.where(dark, np.nan, g), deviation, np.where(dark.all(axis=2), 0.0, coherence), *rest)


def _etfe(record: Trajectory) -> tuple[ComplexArray, FloatArray]:
    """Return Y / U of one record where the input has power, and the frequencies [Hz]."""
    u = np.fft.rfft(record.u[:, 0] - record.u[:, 0].mean())
    y = np.fft.rfft(record.y - record.y.mean(axis=0), axis=0)
    frequency = np.fft.rfftfreq(len(record), record.spec.sample_time)
    lit = segment_spectra([record], len(record)).excited([record], LEAST)[:, 0]
    strong = lit & (np.abs(u) > 1e-3 * np.abs(u).max())
    return (y[strong] / u[strong, None])[:, :, None], frequency[strong]
