"""Poles of models that registered identifiers fit, and their deviations by leaving out stretches of the data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, cast

import numpy as np

from harness import registry
from harness.errors import FitError, InputError
from harness.modal.poles import Pole, mac, poles_of
from harness.protocols import Identifier
from harness.rng import stream
from harness.signals import FloatArray, Trajectory

LEFT_OUT = 20
"""Stretches that are left out in turn: each costs a fit."""
NEAR = 0.1
"""Share of a frequency within which a mode is looked for again when a stretch is left out."""


def fitted(
    name: str, order: int, options: Mapping[str, Any], records: Sequence[Trajectory], seed: int
) -> tuple[FloatArray, FloatArray]:
    """Return A and C of the model of one order that an identifier fits.

    Raises InputError if the identifier has no order, or its models are not linear; FitError if the data give no model
    of this order.

    - ``name``: id of an identifier of linear models with the option ``order``, or ``rank`` and ``delays``
    - ``order``: states; of an identifier with delays the least multiple of the outputs that reaches it
    - ``options``: further options
    """
    known, outputs = registry.named_options("identifiers", name), records[0].spec.ny
    if "order" in known:
        size = {"order": order}
    elif {"rank", "delays"} <= set(known):
        size = {"rank": order} if order < outputs else {"delays": -(-order // outputs)}
    else:
        raise InputError(
            f"identifier {name!r} has no order",
            expected="an identifier of linear models with the option order, such as n4sid or ho-kalman, or dmdc",
            got=f"options {', '.join(known) or 'none'}",
            remedy="name another (--identifier)",
        )
    made = cast(Identifier, registry.create("identifiers", name, **{**options, **size}))
    model: Any = made.fit(records, rng=stream("modes", name, seed))
    if not (hasattr(model, "a_matrix") and hasattr(model, "c_matrix")):
        raise InputError(
            f"identifier {name!r}",
            expected="linear models (A and C)",
            got=type(model).__name__,
            remedy="name another (--identifier)",
        )
    return np.asarray(model.a_matrix), np.asarray(model.c_matrix)


def jackknifed(
    name: str, poles: Sequence[Pole], options: Mapping[str, Any], records: Sequence[Trajectory], seed: int
) -> list[Pole]:
    """Return poles of one order with the deviations that leaving out one stretch after the other shows.

    Delete-a-group jackknife (Efron & Tibshirani 1993, *An Introduction to the Bootstrap*, sec. 11.5). A mode that one
    of the fits does not find has no deviation.

    - ``name, options, records, seed``: as for :func:`fitted`
    - ``poles``: of one order
    """
    found: list[list[Pole | None]] = []
    for part in _without(records):
        try:
            again = poles_of(*fitted(name, poles[0].order, options, part, seed), records[0].spec.sample_time)
        except FitError:
            again = []
        found.append([_same(pole, again) for pole in poles])
    result = []
    for place, pole in enumerate(poles):
        others = [row[place] for row in found]
        if any(other is None for other in others):
            result.append(pole)
            continue
        kept = [other for other in others if other is not None]
        count = len(kept)

        def deviation(values: Any, count: int = count) -> Any:
            spread = np.asarray(values) - np.mean(values, axis=0)
            return np.sqrt((count - 1) / count * np.sum(spread**2, axis=0))

        shapes = np.array([other.shape for other in kept])
        result.append(
            replace(
                pole,
                frequency_deviation=float(deviation([other.frequency for other in kept])),
                damping_deviation=float(deviation([other.damping for other in kept])),
                shape_deviation=deviation(shapes.real) + 1j * deviation(shapes.imag),
                freedom=count - 1.0,
            )
        )
    return result


def _same(pole: Pole, others: Sequence[Pole]) -> Pole | None:
    """Return the pole of the same mode among others."""
    near = [other for other in others if abs(other.frequency - pole.frequency) <= NEAR * pole.frequency]
    best = max(
        near, key=lambda o: mac(o.shape, pole.shape) - abs(o.frequency - pole.frequency) / pole.frequency, default=None
    )
    if best is not None and (np.vdot(pole.shape, best.shape)).real < 0:  # a shape has no sign
        return replace(best, shape=-best.shape)
    return best


def _without(records: Sequence[Trajectory]) -> list[list[Trajectory]]:
    """Return the records without one stretch after the other."""
    total = sum(map(len, records))
    found = []
    for place, record in enumerate(records):
        turns = max(round(LEFT_OUT * len(record) / total), 1)
        edges = np.linspace(0, len(record), turns + 1).astype(int)
        for first, last in pairwise(edges.tolist()):
            rest = [record[rows] for rows in (slice(0, first), slice(last, len(record))) if rows.stop > rows.start + 1]
            found.append([*records[:place], *rest, *records[place + 1 :]])
    return found
