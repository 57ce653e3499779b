"""How the coefficients of a recursive model went along records: values, bands, trace of the covariance, its guard."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np

from harness.errors import FitError
from harness.models.analysis import Findings, Takes
from harness.signals import Dataset, FloatArray, Trajectory
from identifiers.online.recursive_polynomial import RecursiveOptions, RecursivePolynomial

DRAWN = 12  # Coefficients that are drawn, one below the other; the table has all.
BAND = 1.96  # Standard deviations to either side: 95 % of a normal distribution.


@dataclass(frozen=True, eq=False)
class Recursion:
    """A recursive model's way along records, sample by sample."""

    names: tuple[str, ...]
    time: FloatArray  # (M,): Since the start of the first record, record after record without the gaps between them [s]
    # (M, k): In the units of the channels; NaN during the burn-in
    values: FloatArray
    deviations: FloatArray
    trace: FloatArray  # (M,): Of the covariance, relative to that before any data
    guarded: Any  # array of bool (M,): Samples at which the covariance was kept from growing: the inputs did not excite
    errors: FloatArray  # (M, ny): Prediction errors

    def plot(self) -> Any:
        """Draw the coefficients with 95 % bands, and the trace of the covariance with the stretches of the guard."""
        from harness.plots import sheet

        shown = min(DRAWN, len(self.names))
        figure = sheet(figsize=(8, 1.3 * shown + 2.0), layout="constrained")
        axes = figure.subplots(shown + 1, 1, sharex=True)
        for j, axis in enumerate(axes[:-1]):
            low, high = (self.values[:, j] + side * BAND * self.deviations[:, j] for side in (-1, 1))
            axis.fill_between(self.time, low, high, alpha=0.25, lw=0)
            axis.plot(self.time, self.values[:, j], lw=1)
            late = slice(len(self.time) // 5, None)  # the first bands are wide: they would flatten all the rest
            if np.isfinite(low[late]).any():
                edges = float(np.nanmin(low[late])), float(np.nanmax(high[late]))
                room = 0.1 * (edges[1] - edges[0]) + 1e-12
                axis.set_ylim(edges[0] - room, edges[1] + room)
            axis.set_ylabel(self.names[j], fontsize=8, rotation=0, ha="right", va="center")
            axis.grid(alpha=0.3)
        axes[-1].semilogy(self.time, self.trace, color="C3")
        if self.guarded.any():
            axes[-1].plot(
                self.time[self.guarded], self.trace[self.guarded], ".", ms=3, color="k", label="held by the guard"
            )
            axes[-1].legend(fontsize=8)
        axes[-1].set(xlabel="time [s]")
        axes[-1].set_ylabel("trace of P", fontsize=8, rotation=0, ha="right", va="center")
        axes[-1].grid(alpha=0.3)
        axes[0].set_title("coefficients along the records, with 95 % bands if they are constant", fontsize=10)
        return figure


def recursion_along(online: RecursivePolynomial, trajectories: Sequence[Trajectory]) -> Recursion:
    """Run a recursive model over records and keep its way.

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec
    >>> spec, rng = PlantSpec((Channel("u"),), (Channel("y"),), 1.0), np.random.default_rng(0)
    >>> u, y = rng.normal(size=(600, 1)), np.zeros((600, 1))
    >>> for k in range(599):  # the gain changes half way
    ...     y[k + 1] = 0.5 * y[k] + (1.0 if k < 300 else 2.0) * u[k] + 0.1 * rng.normal()
    >>> online = RecursivePolynomial(structure="arx", order=1, forgetting=0.95)
    >>> found = recursion_along(online, [Trajectory(np.arange(600.0), u, y, spec)])
    >>> found.names[1], found.values[[290, 598], 1].round(1).tolist()
    ('y: b1 of u', [1.0, 2.0])
    """
    spec = trajectories[0].spec
    state = online.init(spec, rng=np.random.default_rng(0))
    values, deviations, trace, guarded, errors, time = [], [], [], [], [], []
    passed = 0.0
    for record in trajectories:
        state = online.start(state, record.y[0])
        for k in range(len(record) - 1):
            errors.append(record.y[k + 1] - online.predict(state, record.u[k]))
            before = state.guarded
            state = online.update(state, record.u[k], record.y[k + 1])
            now, spread = state.coefficients
            values.append(now)
            deviations.append(spread)
            trace.append(state.trace)
            guarded.append(bool(state.filters) and state.guarded > before)
            time.append(passed + (k + 1) * spec.sample_time)
        passed += len(record) * spec.sample_time
    if not state.filters:
        raise FitError(
            "coefficients along records",
            expected="more samples than the burn-in",
            got=str(sum(map(len, trajectories))),
            remedy="record longer, or shorten burn_in",
        )
    columns = (np.array(part) for part in (time, values, deviations, trace, guarded, errors))
    return Recursion(tuple(state.names), *columns)


@dataclass(frozen=True)
class ParameterTrajectory(RecursiveOptions):
    """Coefficients of a recursive ARX, ARMAX or output-error model along records, with bands and the covariance.

    Parameters
    ----------
    structure, order, na, nb, nc, nf, nk, method, forgetting, burn_in
        As of the identifier ``recursive-polynomial``.
    """

    takes: ClassVar[Takes] = "data"

    forgetting: float = 0.99

    def of(self, subject: Dataset, *, rng: np.random.Generator) -> Findings:
        """Return the last values with their standard deviations, how far each moved, and the picture."""
        online = RecursivePolynomial(**{one.name: getattr(self, one.name) for one in fields(RecursiveOptions)})
        found = recursion_along(online, [record.measured() for record in subject.estimation])
        late = found.values[len(found.values) // 5 :]
        rows = [
            {
                "coefficient": name,
                "last": float(found.values[-1, j]),
                "deviation": float(found.deviations[-1, j]),
                "least": float(np.nanmin(late[:, j])),
                "most": float(np.nanmax(late[:, j])),
                "moved": bool(np.ptp(late[:, j]) > 2 * 2 * BAND * np.nanmedian(found.deviations[:, j])),
            }
            for j, name in enumerate(found.names)
        ]
        held = int(found.guarded.sum())
        words = [
            f"trace of the covariance at the end: {found.trace[-1]:.3g} of that before any data",
            f"the guard held the covariance at {held} of {len(found.trace)} samples"
            + (": the inputs did not excite there" if held else ""),
        ]
        details = {"time": found.time, "values": found.values, "deviations": found.deviations, "trace": found.trace}
        return Findings(f"coefficients of {subject.name} along time", rows, words, details, found.plot)
