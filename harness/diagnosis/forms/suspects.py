"""Effects that no first-order test sees: hidden resonances and play, piled-up sensors, lost signs."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from harness.diagnosis.effort import EFFORT
from harness.diagnosis.forms.fit_records import reading_noise
from harness.diagnosis.forms.form import WholeForm
from harness.diagnosis.records.stretches import uncut
from harness.diagnosis.records.unfold import HIDING, unfoldings
from harness.diagnosis.search.fit import Fit, Suspect
from harness.effects.effect import Placed
from harness.effects.places import port_of
from harness.physics.compiled.system import System
from harness.physics.fitting.likelihood_fit import sensor_noise
from harness.signals import Dataset, FloatArray, Run

_WIDER = 4
"""Widths of a pile within which a smooth peak has twice as many readings as within one: it is a parabola."""

Lightened = Callable[[Placed, Mapping[str, float]], Mapping[str, float]]


class HoldingForm(WholeForm, Protocol):
    """A form that can fit an effect with the nominal parameters held first."""

    def held_fit(self, placed: Placed, start: Mapping[str, float], plain: Fit) -> Fit | None:
        """Return the fit with an effect, from a fit without; its parameters are held until the others are found."""
        ...


def hidden(
    nominal: System, sizes: Mapping[str, Mapping[str, float]], candidates: Sequence[Placed], lightened: Lightened
) -> list[Suspect]:
    """Return hidden resonances and play: what has no effect at first order, at every start of its parameters.

    - ``sizes``: sizes of the data by port
    - ``lightened``: returns the nominal parameters that go with a start
    """
    suspects = []
    for placed in candidates:
        if placed.effect.linearises or port_of(nominal, placed).kind != "coordinate":
            continue
        at = sizes.get(placed.at, {})
        free = [parameter for parameter in placed.effect.parameters if not parameter.fixed]
        grids = itertools.product(*(parameter.starts(at) for parameter in free))
        starts = [
            {placed.name(parameter.name): v for parameter, v in zip(free, choice, strict=True)} for choice in grids
        ]
        suspects.append(Suspect(placed, tuple({**lightened(placed, start), **start} for start in starts)))
    return suspects


def piled_up(form: HoldingForm, base: Fit, candidates: Sequence[Placed]) -> list[Suspect]:
    """Return sensors whose readings pile up at their largest value, to start from there.

    A nominal model that was made to follow the ceiling is no start: it is fitted to what lies below it first.
    """
    names = [channel.name for channel in form.nominal.outputs]
    # a model that does not fit at all may blame a force for everything, and nothing on the sensor
    noise = np.maximum(reading_noise(base), sensor_noise(form.records["estimation"]))
    suspects = []
    for placed in candidates:
        main = placed.effect.main
        limits = main is not None and main.unit == "y" and main.neutral is None and main.minimum >= 0
        if not limits or main is None or placed.at not in names:
            continue
        column = names.index(placed.at)
        size = np.abs(np.concatenate([record.y[:, column] for record in form.records["estimation"]]))
        top = float(np.nanmax(size))
        ceiling = top - EFFORT.pile_width * float(noise[column])
        piled = size[size > ceiling]
        near = np.count_nonzero(size > top - _WIDER * EFFORT.pile_width * float(noise[column]))
        if len(piled) <= EFFORT.pile * len(size) or near > EFFORT.pile_flat * len(piled):
            continue
        start = {placed.name(main.name): float(np.median(piled))}
        anew = None if base.effects else _from_uncut(form, placed, column, ceiling, start)
        suspects.append(Suspect(placed, (start if anew is None else anew.values,), anew))
    return suspects


def _from_uncut(form: HoldingForm, placed: Placed, column: int, ceiling: float, start: dict[str, float]) -> Fit | None:
    """Return the fit with a sensor's ceiling that starts from the nominal fit to what lies below it."""
    below = uncut(form.dataset, column, ceiling)
    plain = None if below is None else form.on(below).fit((), form.first_starts(), None)
    if plain is None:
        return form.fit([placed], [first | start for first in form.first_starts()], None)
    return form.held_fit(placed, start, plain)


def lost_signs(form: WholeForm, base: Fit, candidates: Sequence[Placed]) -> list[Suspect]:
    """Return sensors that may have lost a sign, with the fit of the nominal model to the unfolded output."""
    names = [channel.name for channel in form.nominal.outputs]
    suspects: list[Suspect] = []
    for placed in candidates if not base.effects else ():
        if placed.effect.name not in HIDING or placed.at not in names:
            continue
        best = _unfolded_fit(form, names.index(placed.at))
        if best is not None:
            suspects.append(Suspect(placed, ({},), best))
    return suspects


def _unfolded_fit(form: WholeForm, column: int) -> Fit | None:
    """Return the likeliest fit of the nominal model to an output whose signs were found; None if there are none."""
    runs = [*form.records["estimation"], *form.records["validation"]]
    best: Fit | None = None
    for signs in unfoldings(runs, column, most=2):
        if any(len(sign) != len(run) for sign, run in zip(signs.signs, runs, strict=True)):
            continue
        other = form.on(_unfolded(form, signs.signs, column))
        plain = other.fit((), other.first_starts(), None)
        if plain is not None and (best is None or plain.penalised > best.penalised):
            best = plain
    return best


def _unfolded(form: WholeForm, signs: Sequence[FloatArray], column: int) -> Dataset:
    """Return the data with the signs of one output."""
    given = iter(signs)
    runs = []
    for use in ("estimation", "validation"):
        for record in form.records[use]:
            y = record.y.copy()
            y[:, column] *= next(given)
            runs.append(Run(replace(record, y=y), use))
    return replace(form.dataset, runs=tuple(runs))
