"""The arrays behind the figures of the report, taken from a diagnosis."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from harness.diagnosis.figures import Overlay, Pictures, ResidualView
from harness.diagnosis.forms import Fitted
from harness.diagnosis.screens import isolability
from harness.signals import FloatArray

if TYPE_CHECKING:
    from harness.diagnosis.simulated import SimulatedDiagnosis

__all__ = ["pictures_of"]


def pictures_of(found: SimulatedDiagnosis) -> Pictures:
    """Return what the figures need."""
    accepted = [str(one.placed) for one in found.result.accepted]
    names, cosines = isolability(found.first_screen, first=accepted)
    pictures = Pictures(isolability=(names, cosines))
    step = found.dataset.spec.sample_time
    pictures.sample_time = step
    pictures.output_name = found.form.columns[0][0]
    pictures.before = max(found.nominal.validation, key=len)[:, 0]
    pictures.after = max(found.final.validation, key=len)[:, 0] if accepted else None
    pictures.overlays = _overlays(found, bool(accepted))
    if found.dataset.spec.inputs:
        record = max(found.dataset.validation, key=len)
        u = record.u[:, 0]
        if np.ptp(u) > 0:
            pictures.u = u[: pictures.before.size]
            pictures.input_name = found.dataset.spec.inputs[0].name
    if found.result.rounds:
        test = found.result.rounds[0].surrogates
        pictures.null, pictures.observed = test.null, test.by_effect
    _output_views(found, pictures, bool(accepted))
    return pictures


def _overlays(found: SimulatedDiagnosis, changed: bool) -> list[Overlay]:
    """Return measured and simulated outputs of the longest validation record."""
    before, _, _ = found.output.simulated(found.nominal, "validation", found.horizon.seconds)
    after = None
    if changed:
        after, _, _ = found.output.simulated(found.final, "validation", found.horizon.seconds)
    number = int(np.argmax([len(run) for run in found.dataset.validation]))
    record = found.dataset.validation[number]
    result = []
    for j, channel in enumerate(found.dataset.spec.outputs):
        y = record.y[:, j]
        result.append(
            Overlay(
                channel.name,
                channel.unit,
                record.t,
                y,
                y - before[number][:, j],
                None if after is None else y - after[number][:, j],
            )
        )
    return result


def _output_views(found: SimulatedDiagnosis, pictures: Pictures, changed: bool) -> None:
    """Add the output residual against output, input and time, where forces cannot be formed or do not tell."""
    record = found.dataset.estimation[0]

    def raw(model: Fitted, j: int) -> FloatArray:
        return np.asarray(model.estimation[0][:, j] * found.form.weights[j])

    for j, channel in enumerate(found.dataset.spec.outputs):
        axes = [(channel.name, channel.unit, record.y[:, j])]
        axes += [(c.name, c.unit, record.u[:, k]) for k, c in enumerate(found.dataset.spec.inputs[:2])]
        axes.append(("time", "s", record.t))
        for name, unit, x in axes:
            after = raw(found.final, j) if changed else None
            pictures.views.append(
                ResidualView(name, unit, x, raw(found.nominal, j), after, None, channel.unit, channel.name)
            )
