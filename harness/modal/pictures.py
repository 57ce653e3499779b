"""Pictures of modes: stabilisation diagram, shapes over the outputs, coordinates over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from harness.errors import InputError
from harness.modal.poles import ComplexArray, Mode
from harness.modal.stabilisation import Criteria, Track
from harness.plots import plain_texts
from harness.signals import FloatArray

PERIODS = 12.0
"""Periods of a mode that its space-time picture shows: enough to see it swing, few enough to see its shape."""
DRAWN = 1000
"""Stretches of a drawn line, the largest of each shown: two of each column of pixels would not be seen."""
MOST = 8
"""Modes that are drawn; the table has all of them."""


def stabilisation_diagram(
    modes: Sequence[Mode], tracks: Sequence[Track], criteria: Criteria, sample_time: float
) -> Any:
    """Draw the poles of every order over frequency, and damping over frequency with intervals.

    - ``tracks``: the poles of all orders, sorted into modes
    - ``criteria``: of stabilisation, for the title
    - ``sample_time``: [s]; the axis ends at half of the sampling rate
    """
    from harness.plots import sheet

    figure = sheet(figsize=(8, 6.6), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[2.2, 1])
    values = {mode.pole.value for mode in modes}
    loose: list[tuple[float, int]] = []
    stable: list[tuple[float, int]] = []
    taken: list[tuple[float, int]] = []
    for track in tracks:
        is_mode = any(pole.value in values for pole in track.poles)
        for pole, kept in zip(track.poles, track.stable, strict=True):
            point = (pole.frequency, pole.order)
            (taken if is_mode and kept else stable if kept else loose).append(point)
    for points, style in (
        (loose, {"marker": ".", "color": "#b0b0b0", "s": 14, "label": "changes with the order"}),
        (stable, {"marker": "o", "facecolors": "none", "edgecolors": "#4477aa", "s": 18, "label": "stable"}),
        (taken, {"marker": "o", "color": "#228833", "s": 20, "label": "stable, of a mode"}),
    ):
        if points:
            x, y = zip(*points, strict=True)
            upper.scatter(x, y, **style)
    for mode in modes:
        upper.axvline(mode.frequency, color="#228833", linewidth=0.6, alpha=0.6)
    upper.set_ylabel("order (states)")
    upper.set_title(f"stable: {criteria.text}", fontsize=8)
    upper.legend(fontsize=8, loc="upper right")
    for mode in modes:
        low, high = (100 * end for end in mode.damping_interval)
        color = "#228833" if mode.damping_determined else "#cc3311"
        if np.isfinite(low):
            lower.plot([mode.frequency] * 2, [max(low, 0.0), high], color=color, linewidth=1.2)
        if mode.damping_determined:
            lower.plot(mode.frequency, 100 * mode.damping, "o", ms=4, color=color)
    lower.set_ylim(bottom=0.0)
    lower.set_ylabel("damping [%], 95 %")
    lower.set_xlabel("frequency [Hz]")
    lower.set_xlim(0.0, 0.5 / sample_time)
    for axis in (upper, lower):
        axis.grid(alpha=0.3)
    return plain_texts(figure)


def shapes_and_coordinates(
    modes: Sequence[Mode], names: Sequence[str], time: FloatArray, coordinates: ComplexArray
) -> Any:
    """Draw every mode in space (size with its interval, real and imaginary part) and in time (its coordinate).

    - ``modes``: M of them
    - ``names``: of the outputs
    - ``time`` (K,): [s]
    - ``coordinates`` (K, M): complex coordinate of each mode
    """
    from harness.plots import sheet

    drawn = modes[:MOST]
    figure = sheet(figsize=(9, max(1.7 * len(drawn), 2.0)), layout="constrained")
    if not drawn:
        figure.text(0.5, 0.5, "no mode determined", ha="center")
        return figure
    axes = figure.subplots(len(drawn), 2, squeeze=False, width_ratios=[1, 1.6], sharex="col")
    for row, mode in enumerate(drawn):
        _shape(axes[row, 0], mode, names)
        axis = axes[row, 1]
        wave = coordinates[:, row]
        edges = np.linspace(0, len(wave), min(len(wave), DRAWN) + 1).astype(int)[:-1]
        size = np.maximum.reduceat(2 * np.abs(wave), edges)
        axis.fill_between(time[edges], -size, size, color="#4477aa", linewidth=0.3)
        axis.set_title(f"its part of the motion: {100 * mode.share:.2g} %", fontsize=8)
        axis.tick_params(labelsize=7)
    axes[-1, 1].set_xlabel("time [s] (size of the coordinate, to both sides)", fontsize=8)
    return plain_texts(figure)


def shapes_over_places(modes: Sequence[Mode], places: FloatArray) -> Any:
    """Draw every mode over the plane in which its outputs stand: of a complex shape the part in its main phase.

    Raises InputError if the outputs stand on one line, or one is nowhere.

    - ``places`` (ny, 2): of the outputs [m]
    """
    from harness.plots import sheet

    spread = np.linalg.svd(places - places.mean(axis=0), compute_uv=False) if np.isfinite(places).all() else np.zeros(2)
    if len(places) < 3 or spread[1] <= 1e-9 * spread[0]:
        raise InputError(
            "places of the outputs",
            expected="three and more that span a plane",
            got=f"{len(places)} on one line" if np.isfinite(places).all() else "numbers that are not finite",
            remedy="give [x, y] in metres for every output, or draw the shapes over the outputs (plot_shapes)",
        )
    drawn = modes[:MOST]
    rows = max(-(-len(drawn) // 4), 1)
    width, height = np.ptp(places, axis=0)
    tall = float(np.clip(2.2 * height / max(width, 1e-300), 0.8, 4.0))
    figure = sheet(figsize=(10, (tall + 0.7) * rows + 0.3), layout="constrained")
    grid = figure.subplots(rows, 4, squeeze=False, sharex=True, sharey=True)
    axes = grid.ravel()
    for number, (axis, mode) in enumerate(zip(axes, drawn, strict=False)):
        shape = np.where(mode.seen, mode.shape, 0.0)
        phase = 0.5 * np.angle(np.sum(shape**2))  # the axis along which the shape is longest
        values = np.real(shape * np.exp(-1j * phase))
        values = values / (float(np.abs(values).max()) or 1.0)
        filled = axis.tricontourf(*places.T, values, levels=np.linspace(-1.0, 1.0, 15), cmap="RdBu_r")
        axis.plot(*places[mode.seen].T, "k.", ms=3)
        axis.plot(*places[~mode.seen].T, "kx", ms=4)
        axis.set_aspect("equal")
        axis.set_title(f"{number + 1}: {mode.frequency:.4g} Hz", fontsize=8)
        axis.tick_params(labelsize=6)
    for axis in axes[len(drawn) :]:
        axis.set_axis_off()
    for axis in grid[-1]:
        axis.set_xlabel("x [m]", fontsize=7)
    for axis in grid[:, 0]:
        axis.set_ylabel("y [m]", fontsize=7)
    if drawn:
        bar = figure.colorbar(filled, ax=grid, ticks=[-1, 0, 1], shrink=0.8)
        bar.set_label("motion over the largest (x: not seen in the noise)", fontsize=7)
    return plain_texts(figure)


def space_and_time(modes: Sequence[Mode], names: Sequence[str], time: FloatArray, coordinates: ComplexArray) -> Any:
    """Draw what each mode does at every output over some of its periods, where its coordinate is largest.

    Parameters are those of :func:`shapes_and_coordinates`; times are evenly spaced.
    """
    from harness.plots import sheet

    drawn = modes[:MOST]
    rows = max(-(-len(drawn) // 2), 1)
    figure = sheet(figsize=(9, 2.1 * rows), layout="constrained")
    axes = figure.subplots(rows, 2, squeeze=False).ravel()
    for number, (axis, mode) in enumerate(zip(axes, drawn, strict=False)):
        wave = coordinates[:, number]
        length = int(np.clip(PERIODS / mode.frequency / (time[1] - time[0]), 4, len(wave)))
        power = np.convolve(np.abs(wave) ** 2, np.ones(length), mode="valid")
        start = int(np.argmax(power))
        picked = slice(start, start + length)
        shown = 2 * np.real(np.outer(np.where(mode.seen, mode.shape, 0.0), wave[picked]))
        most = float(np.abs(shown).max()) or 1.0
        axis.pcolormesh(
            time[picked], np.arange(len(names)), shown, cmap="RdBu_r", vmin=-most, vmax=most, shading="nearest"
        )
        axis.set_yticks(np.arange(len(names)), names, fontsize=7)
        axis.set_title(f"{number + 1}: {mode.frequency:.4g} Hz, up to {most:.2g}", fontsize=8)
        axis.tick_params(labelsize=7)
        axis.set_xlabel("time [s]", fontsize=7)
    for axis in axes[len(drawn) :]:
        axis.set_axis_off()
    return plain_texts(figure)


def _shape(axis: Any, mode: Mode, names: Sequence[str]) -> None:
    """Draw one shape over the outputs."""
    place = np.arange(len(names))
    spread = mode.pole.shape_deviation
    kept = mode.seen
    for values, deviation, color, shift in (
        (mode.shape.real, None if spread is None else spread.real, "#4477aa", 0.0),
        (mode.shape.imag, None if spread is None else spread.imag, "#ee7733", 0.12),
    ):
        axis.plot(place, np.where(kept, values, 0.0), color=color, linewidth=0.8, alpha=0.6)
        error = None if deviation is None else 2 * deviation[kept]
        axis.errorbar(place[kept] + shift, values[kept], yerr=error, fmt="o", ms=3, color=color, linewidth=1)
    if not kept.all():
        axis.errorbar(place[~kept], 0 * place[~kept], yerr=mode.bound[~kept], fmt="x", ms=4, color="#888888")
    axis.axhline(0.0, color="#888888", linewidth=0.5)
    axis.set_ylim(-1.05, 1.05)
    axis.set_xticks(place, names, fontsize=7)
    axis.tick_params(labelsize=7)
    axis.set_title(f"{mode.frequency:.4g} Hz (blue: real, orange: imaginary, x: not seen)", fontsize=8)
