"""The arrays behind the figures of the report, taken from a diagnosis."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from harness.diagnosis.equation import decimated
from harness.diagnosis.figures import Overlay, Pictures, ResidualView
from harness.diagnosis.forms import Fitted
from harness.diagnosis.isolability import isolability
from harness.diagnosis.motion import smooth_motion
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
    if found.inverse and found.strong is not None:
        step *= found.strong.motions["estimation"][0].factor
    pictures.sample_time = step
    pictures.output_name = found.form.columns[0][0]
    pictures.before = max(found.nominal.validation, key=len)[:, 0]
    pictures.after = max(found.final.validation, key=len)[:, 0] if accepted else None
    pictures.overlays = _overlays(found, bool(accepted))
    if found.dataset.spec.inputs:
        record = max(found.dataset.validation, key=len)
        u = record.u[:, 0]
        if found.inverse and found.strong is not None:
            motion = max(found.strong.motions["validation"], key=lambda one: one.q.shape[0])
            u = decimated(motion.u, motion)[:, 0]
        if np.ptp(u) > 0:
            pictures.u = u[: pictures.before.size]
            pictures.input_name = found.dataset.spec.inputs[0].name
    if found.result.rounds:
        test = found.result.rounds[0].surrogates
        pictures.null, pictures.observed = test.null, test.by_effect
    if found.strong is not None:
        _coverage(found, pictures)
    if found.strong is not None and all(map(found.strong.judges, found.final.effects)):
        _force_views(found, pictures, bool(accepted))
    else:
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


def _force_views(found: SimulatedDiagnosis, pictures: Pictures, changed: bool) -> None:
    """Add the force that the nominal part leaves over, against every axis, with the fitted effect on top."""
    strong = found.strong
    assert strong is not None
    motion = strong.motions["estimation"][0]
    final = found.final
    nominal = strong.equations(())
    # with the parameters that hold once the effect is in: what is left over is the effect and the rest
    p = nominal.system.vector({name: final.values[name] for name in nominal.system.parameter_names})
    before, _ = nominal.residual(motion, p, "strong", ())
    after: FloatArray | None = None
    fitted: FloatArray | None = None
    if changed:
        full = strong.equations(final.effects)
        after, _ = full.residual(motion, full.system.vector(final.values), "strong", ())
        fitted = before - after
    q, v, u = (decimated(one, motion) for one in (motion.q, motion.v, motion.u))
    t = decimated(motion.t[:, None], motion)[:, 0]
    touched = [one.at for one in final.effects]
    for row, one in enumerate(strong.nominal.coordinates):
        axes = [(one.name, one.unit, q[:, row]), (f"{one.name}'", f"{one.unit}/s", v[:, row])]
        axes += [(c.name, c.unit, u[:, k]) for k, c in enumerate(strong.nominal.inputs[:1])]
        axes.append(("time", "s", t))
        if len(strong.nominal.coordinates) > 2 and one.name not in touched and row > 0:
            continue
        for name, unit, x in axes:
            pictures.views.append(
                ResidualView(
                    name,
                    unit,
                    x,
                    before[:, row],
                    None if after is None else after[:, row],
                    None if fitted is None else fitted[:, row],
                    one.force_unit,
                    one.name,
                )
            )


def _coverage(found: SimulatedDiagnosis, pictures: Pictures) -> None:
    """Add where estimation and validation have been, coordinate by coordinate."""
    strong = found.strong
    assert strong is not None
    motion = strong.motions["estimation"][0]
    from harness.diagnosis.motion import measured_coordinates

    columns = measured_coordinates(strong.nominal)
    if columns is not None:
        other = smooth_motion(max(found.dataset.validation, key=len), columns)
        for row, one in enumerate(strong.nominal.coordinates):
            pictures.coverage.append(
                (one.name, one.unit, motion.q[:, row], motion.v[:, row], other.q[:, row], other.v[:, row])
            )


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
