"""``report.html`` of the likelihood's diagnosis: one self-contained page, the latent force first."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.diagnosis.forms.fit_records import likelihood_detail, reading_noise
from harness.diagnosis.policy import POLICY
from harness.diagnosis.report.candidates import answer_of
from harness.diagnosis.report.evidence_json import FREE, innovations
from harness.diagnosis.report.figures import Overlay, Pictures, ResidualView, draw
from harness.diagnosis.report.html import environment, error_rows
from harness.diagnosis.report.words import recorded_units, shown_in
from harness.diagnosis.store import write_atomic
from harness.diagnosis.systems import by_equations
from harness.physics.definition.ports import Coordinate
from harness.signals import FloatArray, Trajectory
from harness.units import own_record, own_values, told

if TYPE_CHECKING:
    from harness.diagnosis.diagnosis import Diagnosis
    from harness.diagnosis.search.fit import Fit

MOST_PORTS = 3
"""Latent forces that the page shows."""


def write_evidence(data: dict[str, Any], figures: dict[str, str], path: Path, odd: Sequence[str] = ()) -> None:
    """Write the page of a diagnosis; ``odd`` are drawings of channels with odd rows."""
    write_atomic(path, render_evidence(data, figures, odd))


def drawn(found: Diagnosis) -> dict[str, str]:
    """Return the figures of a diagnosis as SVG texts."""
    return draw(pictures(found))


def render_evidence(data: dict[str, Any], figures: dict[str, str], odd: Sequence[str] = ()) -> str:
    """Return the page.

    - ``data``: content of ``report.json``
    - ``figures``: SVG texts, see :func:`harness.diagnosis.report.figures.draw`
    - ``odd``: SVG texts of channels with odd rows
    """
    rows = error_rows(data)
    return str(
        environment()
        .get_template("evidence.html.j2")
        .render(
            data=data,
            figures=figures,
            odd=odd,
            rows=rows,
            cards=[] if data["misfit"] else _cards(rows, bool(data["effects"])),
            refits=[row for row in data["candidates"] if row["refitted"]],
            aside=[row for row in data["candidates"] if not row["refitted"] and row["round"] == 1],
            parameter_names=list(data["parameters"]["after"]),
            free_swing=FREE if data["ratios"] else "",
        )
    )


def _cards(rows: list[dict[str, Any]], changed: bool) -> list[dict[str, Any]]:
    """Return the figures of the first cards: those that fell most first; if none fell, those that grew most."""
    first = [row for row in rows if row["use"] == "validation" and row["kind"] == "simulation error"]
    horizon = first[0]["horizon"] if first else ""
    chosen = [row for row in first if row["horizon"] == horizon]
    chosen += [
        row
        for row in rows
        if row["use"] == "validation" and row["kind"] == "equation error" and row["after"] is not None
    ]
    if not changed:
        return chosen
    fell = any((row["factor"] or 0.0) >= POLICY.changed for row in chosen)
    return sorted(chosen, key=lambda row: -(row["factor"] or 0.0) if fell else row["factor"] or np.inf)


def pictures(found: Diagnosis) -> Pictures:
    """Return the arrays behind the figures."""
    answer = answer_of(found)
    accepted = [str(effect.placed) for effect in answer.accepted]
    names, cosines = found.test.cosines(accepted)
    made = Pictures(isolability=(names, cosines))
    record = max(found.form.records["validation"], key=len)
    made.sample_time = found.form.dataset.spec.sample_time
    made.output_name = found.dataset.spec.outputs[0].name
    made.before = max(innovations(found, found.nominal, "validation"), key=len)[:, 0]
    made.after = max(innovations(found, answer.fit, "validation"), key=len)[:, 0] if accepted else None
    if found.dataset.spec.inputs and np.ptp(record.u[:, 0]) > 0:
        made.u, made.input_name = record.u[:, 0], found.dataset.spec.inputs[0].name
    made.overlays = _overlays(found, bool(accepted))
    made.views = _views(found, bool(accepted))
    made.coverage = _coverage(found)
    return made


def _overlays(found: Diagnosis, changed: bool) -> list[Overlay]:
    """Return measured and simulated outputs of the longest validation record."""
    runs, last = found.runs, answer_of(found).runs
    if runs.before is None or last is None:
        return []
    number = int(np.argmax([len(run) for run in found.dataset.validation]))
    record, recorded = found.dataset.validation[number], found.dataset.recorded
    own = own_record(record, recorded)
    before, after = (
        own_values(
            record.y - runs.output.simulated(fitted, "validation", runs.horizon.seconds)[0][number],
            record.spec.outputs,
            recorded,
        )
        for fitted in (runs.before, last)
    )
    return [
        Overlay(channel.name, channel.unit, own.t, own.y[:, j], before[:, j], after[:, j] if changed else None)
        for j, channel in enumerate(own.spec.outputs)
    ]


def _own(
    found: Diagnosis, at: str, unit: str, *values: FloatArray | None, reading: bool = False
) -> tuple[str, list[Any]]:
    """Return a unit and values at a port in the unit in which that was recorded."""
    own = shown_in(unit, at, recorded_units(found.dataset))
    return own, [None if one is None else told(one, unit, own, reading=reading)[0] for one in values]


def _axis(found: Diagnosis, at: str, unit: str, values: FloatArray, mark: str = "") -> tuple[str, str, FloatArray]:
    """Return name, unit and values of a port, or of its rate (``mark`` is a prime then), as they are drawn."""
    own, (shown,) = _own(found, at, unit, values, reading=not mark)
    return f"{at}{mark}", own, shown


def _force(found: Diagnosis, fit: Fit, port: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return states (N, nx), a latent force (N,) and its standard deviation on the first estimation record."""
    _, smooth = found.form.paths(fit, "estimation")
    row = likelihood_detail(fit).passes.start_size + port
    return smooth[0].x, smooth[0].x[:, row], smooth[0].deviation[:, row]


def _views(found: Diagnosis, changed: bool) -> list[ResidualView]:
    """Return what is left against position, speed, input and time, before and after: forces, or output errors."""
    return _force_views(found, changed) if found.form.latent else _output_views(found, changed)


def _force_views(found: Diagnosis, changed: bool) -> list[ResidualView]:
    """Return the smoothed latent forces."""
    record = found.form.records["estimation"][0]
    views = []
    final = answer_of(found).fit
    ports = list(likelihood_detail(found.nominal).passes.forces)
    sizes = [float(np.std(_force(found, found.nominal, k)[1])) / s for k, s in
             enumerate(found.form.noise_model.force_scale)]  # fmt: skip
    shown = sorted(np.argsort(sizes)[::-1][:MOST_PORTS])
    for port in shown:
        force = ports[port]
        _, before, band = _force(found, found.nominal, port)
        x, after, later = _force(found, final, port)
        coordinate = next(c for c in _coordinates(found) if c.name == force.port)
        axes = [
            _axis(found, coordinate.name, coordinate.unit, x[:, coordinate.q]),
            _axis(found, coordinate.name, f"{coordinate.unit}/s", x[:, coordinate.v], "'"),
        ]
        axes += _driven(found, record)
        residual_unit, (before, after, band, later) = _own(found, force.port, force.unit, before, after, band, later)
        axes.append(("time", "s", record.t))
        views += [
            ResidualView(
                name,
                unit,
                values,
                before,
                after if changed else None,
                None,
                residual_unit,
                f"latent force at {force.port}",
                bands=(band, later if changed else None),
            )
            for name, unit, values in axes
        ]
    return views


def _driven(found: Diagnosis, record: Trajectory) -> list[tuple[str, str, FloatArray]]:
    """Return name, unit and values of the first input, if it moves."""
    return [_axis(found, c.name, c.unit, record.u[:, k]) for k, c in enumerate(found.dataset.spec.inputs[:1])
            if np.ptp(record.u[:, k]) > 0]  # fmt: skip


def _output_views(found: Diagnosis, changed: bool) -> list[ResidualView]:
    """Return the output errors of the free runs."""
    record = found.form.records["estimation"][0]
    final = answer_of(found).fit
    before, after = (found.form.paths(fit, "estimation")[0][0].e for fit in (found.nominal, final))
    views = []
    for j, channel in enumerate(found.dataset.spec.outputs[:MOST_PORTS]):
        axes = [_axis(found, channel.name, channel.unit, record.y[:, j])]
        axes += _driven(found, record)
        axes.append(("time", "s", record.t))
        there = np.isfinite(before[:, j])  # the others are missing readings
        errors = (before[there, j], after[there, j] if changed else None, reading_noise(final)[j : j + 1])
        own, (left, later, sd) = _own(found, channel.name, channel.unit, *errors)
        views += [
            ResidualView(name, unit, values[there], left, later, None, own,
                         f"error of {channel.name}", deviation=float(sd[0]))
            for name, unit, values in axes
        ]  # fmt: skip
    return views


def _coverage(found: Diagnosis) -> list[tuple[str, str, FloatArray, FloatArray, FloatArray, FloatArray]]:
    """Return where estimation and validation have been, coordinate by coordinate."""
    both = [np.concatenate([path.x for path in found.form.paths(answer_of(found).fit, use)[1]]) for use in
            ("estimation", "validation")]  # fmt: skip
    shown = []
    for place in _coordinates(found):
        unit, (q, qv) = _own(found, place.name, place.unit, *(x[:, place.q] for x in both), reading=True)
        _, (v, vv) = _own(found, place.name, f"{place.unit}/s", *(x[:, place.v] for x in both))
        shown.append((place.name, unit, q, v, qv, vv))
    return shown


def _coordinates(found: Diagnosis) -> tuple[Coordinate, ...]:
    """Return where positions and rates stand in the states; none of a process or an FMU."""
    return found.system.coordinates if found.form.latent and by_equations(found.system) else ()
