"""The page of a learned residual force: what it is not, what it gains, the force with the data it knows."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.display import STYLE, table
from harness.physics.compiled.windows import data_states
from harness.physics.fitting.output_error import simulate_error
from harness.physics.fitting.residual_force import LABEL
from harness.plots import plain_texts
from harness.signals import Dataset, FloatArray, Trajectory

if TYPE_CHECKING:
    from harness.physics.compiled.system import System
    from harness.physics.fitting.residual_learning import LearnedForce

_BEYOND = 0.25  # How far beyond the data a force is drawn, in their range: there it fades, and that must be seen.
_DOTS = 3000  # Most samples that are drawn as dots.

_STYLE = STYLE + "strong{background:#ffe9b0;color:#000;padding:.1em .4em}"


def page(
    data: Mapping[str, Any], learned: LearnedForce, system: System, before: Mapping[str, float], dataset: Dataset
) -> str:
    """Return the page as one HTML text.

    - ``data``: the content of ``learned.json``
    - ``system``: without the force
    - ``before``: its parameters
    """
    rows = [
        (use, f"{name} [{one['unit']}]", _digits(one["before"]), _digits(one["after"]))
        for use, outputs in data["errors"].items()
        for name, one in outputs.items()
    ]
    moved = [
        (name, _digits(value), _digits(data["parameters"]["after"][name]))
        for name, value in data["parameters"]["before"].items()
    ]
    horizon = data["horizon_s"]
    runs = "whole records" if horizon is None else f"windows of {horizon:g} s"
    title = f"A learned force on {escape(learned.force.coordinate)}: {escape(str(data['dataset']))}"
    parts = [
        f'<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>{title}</title><style>{_STYLE}</style><h1>{title}</h1>",
        f"<p><strong>{escape(LABEL)}</strong> The closed loop ended with <em>"
        f"{escape(str(data['loop']['verdict']).replace('_', ' '))}</em>. What it left is fitted by a force without a "
        f"name. Use it to predict inside its data, not as a cause.</p><p>{escape(str(data['summary']))}</p>",
        f"<h2>Free runs, {runs}: rms</h2><div>{table(['use', 'output', 'named model', 'with the force'], rows)}</div>",
        _picture(_force_figure(learned, system, before, dataset)),
        _picture(_error_figure(learned, system, before, dataset, data)),
        "<ul>" + "".join(f"<li>{escape(text)}</li>" for text in data["warnings"]) + "</ul>",
        f"<h2>Named parameters</h2><div>{table(['parameter', 'loop', 'with the force'], moved)}</div></html>",
    ]
    return "".join(parts)


def _digits(value: float | None) -> str:
    """Return a number in four digits."""
    return "-" if value is None else f"{value:.4g}"


def _states(system: System, before: Mapping[str, float], learned: LearnedForce, records: Any) -> FloatArray:
    """Return the arguments (n, d) of the force along records."""
    parts = []
    for record in records:
        states, _ = data_states(system.simulator(record.spec.sample_time), record, system.vector(before))
        parts.append(learned.force.rows(system, states, record.u))
    rows = np.concatenate(parts)
    return rows[:: max(1, len(rows) // _DOTS)]


def _force_figure(learned: LearnedForce, system: System, before: Mapping[str, float], dataset: Dataset) -> Any:
    """Return the force against one argument, or as a map over the first two (the others at their median)."""
    from harness.plots import sheet

    force = learned.force
    units = {channel.name: channel.unit for channel in (*system.states, *system.inputs)}
    labels = [f"{name} [{units[name]}]" for name in force.arguments]
    data = _states(system, before, learned, dataset.estimation)
    low, high = force.hull.low, force.hull.high
    edge = _BEYOND * np.maximum(high - low, 1e-12)
    figure = sheet(figsize=(8, 3.6), layout="constrained")
    axes = figure.subplots()
    if len(force.arguments) == 1:
        grid = np.linspace(low - edge, high + edge, 400)
        axes.axvspan(low[0], high[0], color="#4477aa", alpha=0.12, label="hull of the data")
        axes.plot(grid[:, 0], force(grid), color="#4477aa", label=LABEL)
        axes.plot(data[:, 0], np.full(len(data), axes.get_ylim()[0]), "|", color="#888888", ms=6, label="data")
        axes.axhline(0.0, color="#888888", lw=0.6)
        axes.set(xlabel=labels[0], ylabel=f"force on {force.coordinate} [{force.unit}]")
        axes.legend(fontsize=8)
    else:
        sides = [np.linspace(low[i] - edge[i], high[i] + edge[i], 120) for i in range(2)]
        first, second = np.meshgrid(*sides)
        rows = np.tile(np.median(data, axis=0), (first.size, 1))
        rows[:, 0], rows[:, 1] = first.ravel(), second.ravel()
        values = force(rows).reshape(first.shape)
        size = float(np.abs(values).max()) or 1.0
        drawn = axes.pcolormesh(first, second, values, cmap="RdBu_r", vmin=-size, vmax=size, shading="auto")
        inside = force.hull.contains(rows).reshape(first.shape).astype(float)
        axes.contour(first, second, inside, levels=[0.5], colors="k", linewidths=1.0)
        axes.plot(data[:, 0], data[:, 1], ".", color="k", ms=1, alpha=0.4)
        figure.colorbar(drawn, ax=axes, label=f"force on {force.coordinate} [{force.unit}]")
        axes.set(xlabel=labels[0], ylabel=labels[1], title="black line: hull of the data", xmargin=0)
    return figure


def _error_figure(
    learned: LearnedForce, system: System, before: Mapping[str, float], dataset: Dataset, data: Mapping[str, Any]
) -> Any:
    """Return measured minus simulated of the first validation record, without and with the force."""
    from harness.plots import sheet

    record: Trajectory = dataset.validation[0]
    how = {"horizon": data["horizon_s"], "intersample": data["intersample"]}
    pairs = [simulate_error(system, before, [record], **how)[0], simulate_error(learned.system, {}, [record], **how)[0]]
    outputs = dataset.spec.outputs
    figure = sheet(figsize=(8, 1.9 * len(outputs) + 0.6), layout="constrained")
    for j, axes in enumerate(figure.subplots(len(outputs), 1, squeeze=False, sharex=True)[:, 0]):
        for errors, colour, label in zip(pairs, ("#888888", "#cc3311"), ("named model", "with the force"), strict=True):
            axes.plot(record.t[: len(errors)], errors[:, j], color=colour, lw=0.8, label=label)
        axes.set_ylabel(f"error of {outputs[j].name} [{outputs[j].unit}]", fontsize=8)
    figure.axes[0].legend(fontsize=8)
    figure.axes[0].set_title("first validation record, free run: measured minus simulated", fontsize=9)
    figure.axes[-1].set_xlabel("time [s]")
    return figure


def _picture(figure: Any) -> str:
    """Return a figure inlined as PNG: a map has too many tiles for SVG."""
    buffer = io.BytesIO()
    plain_texts(figure).savefig(buffer, format="png", dpi=130)
    return f'<p><img alt="" src="data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}"></p>'
