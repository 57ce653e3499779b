"""What ``identify`` returns: a model and its scores, printed, drawn, stored."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.errors import InputError
from harness.fitted import Usable
from harness.protocols import Model
from harness.signals import Channel, Trajectory, Use
from harness.units import behind, own_record, own_unit, own_values, told

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from harness.models.analysis import Findings
    from harness.physics.definition.parameters import FarOff
    from harness.scoring import Score, TorqueError
    from harness.scoring.predictive import ProbabilityScore

_DRAWN = 20_000
"""Samples that a notebook draws by itself: longer records ask for plot()."""


@dataclass(frozen=True)
class Identified(Usable):
    """What ``identify`` returns: the model, and its scores by use of the data; to be used as a :class:`FittedModel`."""

    model: Model
    equation_error: dict[Use, list[Score]]
    simulation_error: dict[Use, list[Score]]
    warnings: tuple[str, ...]
    probability: dict[Use, list[ProbabilityScore]] = field(default_factory=dict)
    """One step ahead, of a model that predicts distributions; empty for others."""
    judged: Trajectory | None = field(default=None, repr=False, compare=False)
    """The record that the picture in a notebook shows: the first that validates."""
    bounds: Findings | None = field(default=None, repr=False)
    """What theorems for finite samples promise beside what was measured, where it was asked for."""

    torque_errors: dict[Use, list[tuple[TorqueError, ...]]] = field(default_factory=dict)
    """Of an arm: rms and NRMSE of every joint's torque along the measured motion, by use and run; empty for others."""

    recorded: Mapping[str, str] = field(default_factory=dict, repr=False, compare=False)
    """Unit by channel in which the data came; what is not there is in that of the channel."""

    far_from_declared: tuple[FarOff, ...] = ()
    """Parameters of a physical model that lie a factor of 100 and more from what it declares: check the units."""

    def in_own_unit(self, size: float, channel: Channel) -> str:
        """Return a size in the unit of a channel as text, in the unit in which the channel was recorded."""
        own, unit = told(size, channel.unit, self.recorded.get(channel.name, channel.unit))
        return f"{own:.3g}{behind(unit)}"

    def units_said(self) -> str:
        """Return which signals a model holds in other units than those in which they were recorded; empty if none."""
        channels = [*self.model.spec.inputs, *self.model.spec.outputs]
        own = [(one, unit) for one in channels if (unit := own_unit(one, self.recorded)) != one.unit]
        said = ", ".join(f"{one.name} in {one.unit} ({unit} in the data)" for one, unit in own)
        return f"parameters, equations and residuals are those of SI units: {said}" if own else ""

    def plot(self) -> Figure:
        """Return the figure of the record that judges: its inputs, what was measured, and the free run of the model."""
        from harness.scoring import predict

        if self.judged is None:
            raise InputError("no record to plot", expected="what identify returned", got="none", remedy="plot a record")
        figure: Figure = own_record(self.judged, self.recorded).plot()
        free = np.asarray(predict(self.model, self.judged, horizon=None))
        run = own_values(free, self.judged.spec.outputs, self.recorded)
        for axis, values in zip(figure.axes[self.judged.spec.nu :], run.T, strict=True):
            low, high = axis.get_ylim()
            axis.lines[0].set_label("measured")
            axis.plot(self.judged.t, values, "--", color="#cc6677", linewidth=0.9, label="free run")
            room = 0.4 * (high - low)
            axis.set_ylim(max(axis.get_ylim()[0], low - room), min(axis.get_ylim()[1], high + room))
            axis.legend(loc="upper right", fontsize=8)
        return figure

    def errors(self) -> dict[str, tuple[float, str]]:
        """Return the rms of the free run on validation data (on estimation data where none validates), with its unit.

        By output, over all runs of that use.
        """
        from harness.comparison.models import free_run_errors

        return free_run_errors(self.model, self.simulation_error)

    def to_dict(self) -> dict[str, Any]:
        """Return model, scores and warnings, ready for JSON."""
        scores: dict[str, Any] = {
            name: {
                use: [{"rms": s.rms.tolist(), "nrmse": s.nrmse.tolist(), "samples": s.samples} for s in own]
                for use, own in found.items()
            }
            for name, found in (("equation_error", self.equation_error), ("simulation_error", self.simulation_error))
        }
        bounds = {} if self.bounds is None else {"bounds": self.bounds.to_dict()}
        torques = {use: [[asdict(joint) for joint in run] for run in runs] for use, runs in self.torque_errors.items()}
        if torques:
            scores["torque_error"] = torques
        far = {"far_from_declared": [one.to_dict() for one in self.far_from_declared]}
        return {"model": self.model.to_dict(), **far, **scores, "warnings": list(self.warnings), **bounds}

    def torque_rows(self) -> list[tuple[str, ...]]:
        """Return use, run, torque, rms with unit and NRMSE of every joint of an arm, of held-out runs if there are."""
        uses: tuple[Use, ...] = ("validation", "test")
        held_out = [use for use in uses if self.torque_errors.get(use)]
        return [
            (use, str(run), one.joint, f"{one.rms:.3g}{behind(one.unit)}", f"{one.nrmse:.3g}")
            for use in held_out or self.torque_errors
            for run, joints in enumerate(self.torque_errors[use])
            for one in joints
        ]

    def _rows(self) -> list[tuple[str, ...]]:
        """Return use, run, output, NRMSE one step ahead and in free run, rms in free run."""
        return [
            (
                use,
                str(run),
                channel.name,
                *(f"{s.nrmse[k]:.4g}" for s in pair),
                self.in_own_unit(pair[1].rms[k], channel),
            )
            for use in self.equation_error
            for run, pair in enumerate(zip(self.equation_error[use], self.simulation_error[use], strict=True))
            for k, channel in enumerate(self.model.spec.outputs)
        ]

    def __repr__(self) -> str:
        rows = [f"{use} {run} {name} {free}" for use, run, name, _, free, _ in self._rows()]
        far = "".join(f"{one}; " for one in self.far_from_declared)
        return f"<Identified {type(self.model).__name__}: {far}NRMSE in free run: {', '.join(rows)}>"

    def _repr_html_(self) -> str:
        from harness.display import page, table

        titles = ["use", "run", "output", "NRMSE one step ahead", "NRMSE in free run", "rms in free run"]
        far = [table(["far from declared: check the units"], [[str(one)] for one in self.far_from_declared])]
        parts = [*(far if self.far_from_declared else ()), table(titles, self._rows())]
        if torques := self.torque_rows():
            parts.append(table(["use", "run", "torque", "rms", "NRMSE"], torques))
        if values := getattr(self.model, "parameters", None):
            spread, found = getattr(self.model, "deviations", {}), self.estimate
            units = {} if found is None else dict(zip(found.names, found.units, strict=True))
            shown = [
                (n, f"{v:.6g}", f"{spread[n]:.2g}" if n in spread else "", units.get(n, "")) for n, v in values.items()
            ]
            parts.append(table(["parameter", "value", "standard deviation", "unit"], shown))
        if said := self.units_said():
            parts.append(f"<p>{escape(said)}</p>")
        if self.judged is not None and len(self.judged) <= _DRAWN:
            from harness.plots import inlined

            parts.append(inlined(self.plot(), "measured and simulated"))
        return page(f"{type(self.model).__name__}: {self.model.spec}", *parts)
