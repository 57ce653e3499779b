"""Frequency responses, step responses and poles of linear models, each with its interval and where it is determined."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.models.determined import bands_of, outside
from harness.models.spread import (
    gain_and_phase_deviation,
    gains,
    pole_covariance,
    quantile,
    response_covariance,
    step_deviation,
    steps,
)
from harness.signals import FloatArray, PlantSpec
from harness.units import own_gains

ELLIPSE = np.linspace(0.0, 2 * np.pi, 73)
WIDEST, UNKNOWN = 1.0, 0.35
"""Half axis of an ellipse beyond which a pole may lie anywhere in the unit circle, and how dark such a pole is drawn.
"""
NONE: Mapping[str, str] = MappingProxyType({})
SHOWN = 400  # Samples of a step response that are drawn at most.


def is_linear(model: Any) -> bool:
    """Return True for a model with A, B, C, D and inputs."""
    return hasattr(model, "matrices") and model.spec.nu > 0


def bode_lines(axes: Any, name: str, model: Any, frequency: FloatArray, recorded: Mapping[str, str] = NONE) -> None:
    """Draw gain and phase of a linear model with 95 % bands; dotted where its data do not determine it.

    - ``axes``: gain and phase
    - ``frequency`` (F,): [Hz]
    - ``recorded``: units of the channels that are drawn (``Dataset.recorded``)
    """
    spec: PlantSpec = model.spec
    times = own_gains(spec, recorded)[1]
    response = gains(model.matrices, frequency, spec.sample_time)
    bands = bands_of(model) or {}
    deviations = None
    if getattr(model, "spread", None) is not None:
        deviations = gain_and_phase_deviation(response, response_covariance(model, frequency))
    for row, output in enumerate(spec.outputs):
        for column, given in enumerate(spec.inputs):
            one = response[:, row, column]
            own = bands.get(f"{output.name} per {given.name}")
            blind = np.zeros(len(frequency), dtype=bool) if own is None else outside(own, frequency)
            phase = np.degrees(np.unwrap(np.angle(one)))
            label = name if spec.nu * spec.ny == 1 else f"{name}: {output.name} / {given.name}"
            colour = _drawn(axes[0].loglog, frequency, np.abs(one) * times[row, column], blind, label, None)
            _drawn(axes[1].semilogx, frequency, phase, blind, "", colour)
            if deviations is None:
                continue
            wide = quantile(model.spread)
            gain, turn = (wide * part[:, row, column] for part in deviations)
            size, gain = np.abs(one) * times[row, column], gain * times[row, column]
            axes[0].fill_between(frequency, np.maximum(size - gain, size * 1e-3), size + gain, alpha=0.2, color=colour)
            turn = np.degrees(np.minimum(turn, np.pi))
            axes[1].fill_between(frequency, phase - turn, phase + turn, alpha=0.2, color=colour)


def _drawn(
    draw: Any, x: FloatArray, y: FloatArray, blind: npt.NDArray[np.bool_], label: str, colour: str | None
) -> str:
    """Draw a line, dashed where it is determined and dotted where not; returns its colour."""
    told = np.where(blind, np.nan, y)
    (line,) = draw(x, told, "--", linewidth=1.3, label=label or None, color=colour)
    found: str = line.get_color()
    if blind.any():
        draw(x, np.where(blind, y, np.nan), ":", linewidth=1.0, color=found)
    return found


def response_figure(models: Mapping[str, Any], recorded: Mapping[str, str] = NONE, kind: str = "step") -> Any:
    """Draw the answers to a unit step of each input, with 95 % bands, in the units in which channels were recorded.

    - ``kind``: ``step``, or ``impulse`` for those to a pulse of one sample
    """
    from harness.comparison.responses import length
    from harness.plots import sheet

    spec, times = own_gains(next(iter(models.values())).spec, recorded)
    figure = sheet(figsize=(5.0 * spec.nu, 2.4 * spec.ny + 0.5), layout="constrained")
    axes = figure.subplots(spec.ny, spec.nu, squeeze=False, sharex=True)
    count = min(max(length(model) for model in models.values()), SHOWN)
    t = spec.sample_time * np.arange(count)
    for name, model in models.items():
        y = steps(model.matrices, count, kind) * times
        spread = getattr(model, "spread", None)
        half = quantile(spread) * step_deviation(model, count, kind) * times if spread is not None else None
        for row in range(spec.ny):
            for column in range(spec.nu):
                (line,) = axes[row, column].plot(t, y[:, row, column], linewidth=1.2, label=name)
                if half is not None:
                    low, high = (y + sign * half for sign in (-1, 1))
                    axes[row, column].fill_between(
                        t, low[:, row, column], high[:, row, column], alpha=0.2, color=line.get_color()
                    )
    what = "unit step" if kind == "step" else "unit pulse"
    for row, output in enumerate(spec.outputs):
        for column, given in enumerate(spec.inputs):
            axes[row, column].set_title(f"{output} after a {what} of {given}", fontsize=9)
    axes[0, 0].legend(fontsize=8)
    for axis in axes[-1]:
        axis.set_xlabel("time [s]", fontsize=9)
    return figure


def pole_figure(models: Mapping[str, Any]) -> Any:
    """Draw the poles in the z plane with the unit circle and the ellipses that hold each with 95 %, and the zeros."""
    from scipy.stats import chi2

    from harness.plots import sheet

    figure = sheet(figsize=(5.2, 5.0), layout="constrained")
    axis = figure.subplots()
    axis.plot(np.cos(ELLIPSE), np.sin(ELLIPSE), color="#888888", linewidth=0.8)
    size = np.sqrt(chi2.ppf(0.95, 2))
    for name, model in models.items():
        if getattr(model, "spread", None) is None:
            poles, covariance = np.linalg.eigvals(model.matrices[0]), None
        else:
            poles, covariance = pole_covariance(model)
        (line,) = axis.plot([], [], "x", markersize=6, label=name)
        zeros = transmission_zeros(*model.matrices[:4])
        axis.plot(zeros.real, zeros.imag, "o", markersize=5, fillstyle="none", color=line.get_color())
        for k, pole in enumerate(poles):
            values, vectors = np.linalg.eigh(np.zeros((2, 2)) if covariance is None else covariance[k])
            half = size * np.sqrt(np.maximum(values, 0.0))
            known = half.max() <= WIDEST
            axis.plot(pole.real, pole.imag, "x", markersize=6, color=line.get_color(), alpha=1.0 if known else UNKNOWN)
            if known:
                x, y = vectors * half @ np.stack([np.cos(ELLIPSE), np.sin(ELLIPSE)])
                axis.plot(pole.real + x, pole.imag + y, linewidth=0.9, color=line.get_color())
    axis.set(aspect="equal", xlim=(-1.3, 1.3), ylim=(-1.3, 1.3), xlabel="real part of z", ylabel="imaginary part of z")
    axis.legend(fontsize=8, loc="upper left")
    return figure


def transmission_zeros(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> npt.NDArray[np.complex128]:
    """Return the finite zeros of a square system: where its Rosenbrock matrix loses rank (Emami-Naeini 1982).

    Examples
    --------
    >>> a, b, c, d = (np.array(m) for m in ([[0.5]], [[1.0]], [[-0.2]], [[1.0]]))
    >>> transmission_zeros(a, b, c, d).real.round(6).tolist()
    [0.7]
    """
    from scipy.linalg import eigvals

    if b.shape[1] != c.shape[0]:
        return np.zeros(0, dtype=np.complex128)
    n, m = len(a), b.shape[1]
    whole, shift = np.block([[a, b], [c, d]]), np.zeros((n + m, n + m))
    shift[:n, :n] = np.eye(n)
    found = np.asarray(eigvals(whole, shift), dtype=np.complex128)
    return found[np.isfinite(found) & (np.abs(found) < 1e6)]


def pole_rows(name: str, model: Any) -> list[tuple[str, str, str, str]]:
    """Return a row of a table for each pole in the upper half plane: model, modulus, frequency and damping."""
    poles = np.asarray(np.linalg.eigvals(model.matrices[0]), dtype=np.complex128)
    deviation = None
    if getattr(model, "spread", None) is not None:
        poles, covariance = pole_covariance(model)
        deviation = gain_and_phase_deviation(poles, covariance)
    rows = []
    for k, pole in enumerate(poles):
        if pole.imag < 0 or abs(pole) == 0:
            continue
        rate = np.log(complex(pole)) / model.spec.sample_time
        hertz = f"{abs(rate) / (2 * np.pi):.4g}"
        half = None if deviation is None else quantile(model.spread) * deviation[0][k]
        size = f"{abs(pole):.5g}" if not half else f"{abs(pole):.{_decimals(half)}f} ± {half:.2g}"
        rows.append((name, size, hertz, f"{-rate.real / max(abs(rate), 1e-300):.3g}"))
    return rows


def _decimals(half: float) -> int:
    """Return the decimals that an interval leaves a number: two digits of its half width."""
    return int(max(0, 1 - np.floor(np.log10(half))))
