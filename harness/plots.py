"""Plots of what a person looks at: records and scores (matplotlib is loaded when one is asked for)."""

from __future__ import annotations

from typing import Any

from harness.signals import Trajectory

__all__ = ["plot_trajectory"]


def plot_trajectory(record: Trajectory, axes: Any = None) -> Any:
    """Draw inputs as they are held and outputs as they are sampled, each with its unit.

    Parameters
    ----------
    record : Trajectory
    axes : sequence of matplotlib axes, optional
        One for each channel; made if not given.

    Returns
    -------
    matplotlib.figure.Figure
    """
    from matplotlib.figure import Figure

    spec = record.spec
    count = spec.nu + spec.ny
    if axes is None:
        figure = Figure(figsize=(8, 1.6 * count + 0.6), layout="constrained")
        axes = figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]
    for column, channel in enumerate(spec.inputs):
        axes[column].step(record.t, record.u[:, column], where="post", color="#888888", linewidth=0.8)
        axes[column].set_ylabel(str(channel))
    for column, channel in enumerate(spec.outputs):
        axis = axes[spec.nu + column]
        axis.plot(record.t, record.y[:, column], color="#4477aa", linewidth=0.8)
        axis.set_ylabel(str(channel))
    axes[count - 1].set_xlabel("time [s]")
    return axes[0].figure
