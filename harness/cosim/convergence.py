"""How the answer changes when the communication step is halved, and the order at which it settles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.errors import InputError
from harness.signals import FloatArray, Trajectory

EXACT = 1e-12  # Share of an output's range below which a change is rounding, and says nothing of an order.


@dataclass(frozen=True)
class Convergence:
    """Runs of one system at ever finer steps."""

    steps: FloatArray  # (n + 1,): Communication steps [s], each half of the one before
    outputs: tuple[str, ...]  # Names (ny)
    changes: FloatArray
    """(n, ny): Largest difference of each output between a step and its half, at the instants of the coarsest."""
    ranges: FloatArray  # (ny,): Greatest less smallest value of each output at the finest step
    finest: Trajectory  # The record at the finest step

    @property
    def shares(self) -> FloatArray:
        """Changes as shares of the outputs' ranges (n, ny); 0 for an output that rests."""
        return np.divide(self.changes, self.ranges, out=np.zeros_like(self.changes), where=self.ranges > 0)

    @property
    def orders(self) -> FloatArray:
        """Binary logarithm of the ratio of one change to the next (n - 1, ny); NaN where either is rounding.

        A method of order p has changes that shrink by 2**p (Roache 1998, Verification and Validation, sec. 5.6).
        """
        small = self.shares <= EXACT
        known = ~(small[:-1] | small[1:])
        ratio = np.divide(self.changes[:-1], self.changes[1:], out=np.ones_like(self.changes[1:]), where=known)
        return np.where(known, np.log2(ratio), np.nan)

    def figure(self) -> Any:
        """Return a picture of the changes over the step, in shares of the ranges, with lines of order one and two."""
        from harness.plots import sheet

        figure = sheet(figsize=(6.4, 4.4), layout="constrained")
        axes = figure.subplots()
        steps = self.steps[:-1]
        moved = [j for j in range(len(self.outputs)) if (self.shares[:, j] > EXACT).any()]
        for j in moved:
            shares = np.where(self.shares[:, j] > EXACT, self.shares[:, j], np.nan)
            axes.loglog(steps, shares, marker="o", linewidth=1.2, label=self.outputs[j])
        if moved:
            top = float(self.shares[0].max())
            for order, style in ((1, "--"), (2, ":")):
                line = top * (steps / steps[0]) ** order
                axes.loglog(steps, line, style, color="#888888", linewidth=0.8, label=f"order {order}")
            axes.legend(fontsize="small")
        axes.set_xlabel("communication step [s]")
        axes.set_ylabel("change with half the step / range")
        return figure

    def rows(self) -> list[dict[str, object]]:
        """Return a row for each pair of steps: that of the output that changes most, with its order."""
        found: list[dict[str, object]] = []
        for k in range(len(self.changes)):
            worst = int(np.argmax(self.shares[k]))
            order = self.orders[k - 1, worst] if k else np.nan
            found.append(
                {
                    "step [s]": f"{self.steps[k]:.6g}",
                    "half [s]": f"{self.steps[k + 1]:.6g}",
                    "changes most": self.outputs[worst],
                    "by": f"{self.changes[k, worst]:.3g}",
                    "of its range": f"{100 * self.shares[k, worst]:.2g} %",
                    "order": "" if np.isnan(order) else f"{order:.2f}",
                }
            )
        return found


def halved(run: Callable[[float | None], Trajectory], times: int, step: float | None = None) -> Convergence:
    """Run something at a step, its half, and so on.

    Raises InputError if ``times`` is not 1 or more, or a run ends before the others do.

    - ``run``: from a step [s] (None: its own) to the record of a run; all runs begin together
    - ``times``: how often the step is halved
    - ``step``: the coarsest step [s]

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec
    >>> def euler(h):
    ...     h = h or 0.1
    ...     t = h * np.arange(round(1 / h) + 1)
    ...     y = (1 - h) ** (t / h)
    ...     return Trajectory(t, np.zeros((len(t), 0)), y[:, None], PlantSpec((), (Channel("x"),), h))
    >>> float(halved(euler, 3).orders[-1, 0].round(1))
    1.0
    """
    if not 1 <= times <= 20:
        raise InputError("how often to halve", expected="1 to 20 times", got=str(times), remedy="give another --halve")
    record = run(step)
    coarse, steps, changes = record, [record.spec.sample_time], []
    for level in range(1, times + 1):
        finer = run(coarse.spec.sample_time / 2**level)
        every = 2**level
        seen, before = finer.y[::every], record.y[:: every // 2]
        if len(seen) != len(coarse.y) or len(before) != len(coarse.y):
            raise InputError(
                "convergence",
                expected=f"runs of one length, {coarse.duration:g} s",
                got=f"one of {finer.duration:g} s at a step of {finer.spec.sample_time:g} s",
                remedy="choose a --stop before the run ends",
            )
        changes.append(np.abs(seen - before).max(axis=0))
        steps.append(finer.spec.sample_time)
        record = finer
    names = tuple(channel.name for channel in record.spec.outputs)
    return Convergence(np.array(steps), names, np.array(changes), np.ptp(record.y, axis=0), record)
