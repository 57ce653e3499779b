"""Adaptive control as an analysis: how well a mechanism tracks while its controller learns, and what it learned."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from harness.models.analysis import Findings, Takes
from harness.rng import Streams
from harness.rollout import perform
from scenarios.adaptive import AdaptiveControl


@dataclass(frozen=True)
class AdaptiveTracking:
    """Tracking by a controller that learns: what it believed, what it knows at the end, and how far the motion is off.

    Runs the scenario ``adaptive-control`` on a plant. A set point (``amplitude=0`` with a ``move``) is reached whatever
    is believed; only a rich reference brings the parameters near the truth (Slotine & Li 1987).

    Parameters
    ----------
    model : str
        Of the mechanism that the controller believes in.
    scenario : mapping
        Further options of ``adaptive-control``.
    """

    takes: ClassVar[Takes] = "maker"
    model: str = "pendulum"
    scenario: Mapping[str, Any] = field(default_factory=dict)

    def of(self, subject: Any, *, rng: np.random.Generator) -> Findings:
        """Return the lumped parameters at first and at the end, and the error of the motion.

        Raises
        ------
        InputError
            If model or options do not fit the plant.
        """
        streams = Streams("plant", "adaptive-control", seed=int(rng.integers(2**32)))
        with subject() as plant:
            experiment = AdaptiveControl(**{"mechanism": self.model, **self.scenario}).prepare(
                plant.spec, streams=streams, role="estimation/0"
            )
            record = perform(plant, experiment, rng=streams("estimation/0/plant"))
            controller: Any = experiment.controller
            known = getattr(plant, "true_parameters", {})
        titles = [str(channel) for channel in record.spec.outputs]
        columns = [titles.index(title) for title in controller.references]
        error = record.y[:, columns] - np.column_stack(list(controller.references.values()))
        law = controller.tracking.law
        told = set(law.parameters) <= set(known)
        truth = law.regression.values(known) if told else np.full(len(controller.names), np.nan)
        first, last = controller.estimates[0], controller.estimates[-1]
        rows = [
            {"lumped parameter": name, "believed": float(a), "learned": float(b), "true": float(c) if told else None}
            for name, a, b, c in zip(controller.names, first, last, truth, strict=True)
        ]
        part = max(len(error) // 10, 1)
        begins, ends = (float(np.sqrt(np.mean(one**2))) for one in (error[:part], error[-part:]))
        words = [f"the motion is off by {begins:.3g} (rms) in the first tenth, by {ends:.3g} in the last"]
        details: dict[str, Any] = {"error": error[-1], "rms": [begins, ends]}
        if told:
            off = [float(np.abs(one / truth - 1.0).max()) for one in (first, last)]
            details["parameters off"] = off
            words.append(f"parameters are off by up to {off[0]:.3g} of themselves at first, by {off[1]:.3g} at the end")

        def draw() -> Any:
            from matplotlib.figure import Figure

            figure = Figure(figsize=(9, 3.2), layout="constrained")
            motion, learned = figure.subplots(1, 2)
            motion.semilogy(record.t, np.maximum(np.abs(error), 1e-16), lw=1)
            motion.set(xlabel="time [s]", ylabel="error of the motion", title="tracking")
            learned.plot(record.t, controller.estimates, lw=1, label=list(controller.names))
            for value, line in zip(truth, learned.get_lines(), strict=True):
                learned.axhline(value, color=line.get_color(), ls="--", lw=1)
            learned.set(xlabel="time [s]", title="what it believes (dashed: true)")
            learned.legend(fontsize=8)
            return figure

        return Findings("tracking while learning", rows, words, details, draw)
