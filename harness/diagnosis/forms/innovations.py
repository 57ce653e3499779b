"""Whitened innovations of a fit: their derivatives, and what they answer to forces and readings along its motion."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from harness.diagnosis.directions.directions import Direction
from harness.diagnosis.forms.fit_records import likelihood_detail
from harness.diagnosis.forms.predictive import whitened
from harness.diagnosis.search.fit import Column, Fit, Linearised
from harness.effects.effect import Placed
from harness.physics.compiled.kalman_pass import Filtered
from harness.physics.compiled.smoother import innovation_response
from harness.signals import FloatArray

_TOGETHER = 64
"""Columns of the score test that are answered together."""


def linearised(
    fit: Fit, paths: Mapping[str, Sequence[Filtered]], spread: FloatArray, states: dict[str, float]
) -> Linearised:
    """Return the whitened innovations of a fit and their derivatives.

    - ``paths``: by use, the pass over every record, with derivatives by what is free and by initial states
    - ``spread`` (shared, k): see :class:`harness.diagnosis.search.fit.Linearised`
    - ``states``: initial states of the estimation records
    """
    residual, nuisance = {}, {}
    count = len(fit.free)
    for use, filtered in paths.items():
        residual[use] = np.concatenate([whitened(passed.e, passed.s) for passed in filtered])
        parts = []
        for number, passed in enumerate(filtered):
            assert passed.j is not None
            j = whitened(passed.j, passed.s[..., None])
            wide = np.zeros((len(j), count + len(filtered) * (j.shape[1] - count)))
            own = j.shape[1] - count
            wide[:, :count] = j[:, :count]
            wide[:, count + number * own : count + (number + 1) * own] = j[:, count:]
            parts.append(wide)
        nuisance[use] = np.concatenate(parts)
    return Linearised(residual, nuisance, tuple(fit.free), spread, likelihood_detail(fit).predictive.moved, states)


def answered(
    asked: Sequence[Direction],
    paths: Mapping[str, Sequence[Filtered]],
    held: Callable[[Placed | None], bool],
    rates_over: float | None,
) -> list[Column]:
    """Return the columns of directions.

    - ``paths``: by use, the pass over every record, with derivatives
    - ``held``: True for an effect whose force is held between samples
    - ``rates_over``: sample time where forces are changes of rates; None for forces on coordinates
    """
    return [column for group in _portions(asked) for column in _together(group, paths, held, rates_over)]


def _together(
    group: Sequence[Direction],
    paths: Mapping[str, Sequence[Filtered]],
    held: Callable[[Placed | None], bool],
    rates_over: float | None,
) -> list[Column]:
    """Return the columns of a few directions."""
    edges = np.cumsum([0, *(len(direction.names) for direction in group)])
    holds = np.repeat([held(direction.placed) for direction in group], np.diff(edges))
    made = dict.fromkeys(("estimation", "validation"), np.zeros((0, edges[-1])))
    for use, filtered in paths.items():
        parts = []
        for number, passed in enumerate(filtered):
            forces = np.concatenate([direction.forces[use][number] for direction in group], axis=2)
            readings = np.concatenate([direction.readings[use][number] for direction in group], axis=2)
            response = innovation_response(passed, forces, readings, rates_over=rates_over, held=holds)
            parts.append(whitened(response, passed.s[..., None]))
        made[use] = np.concatenate(parts)
    return [
        Column(
            direction.placed,
            direction.given,
            direction.names,
            made["estimation"][:, first:last],
            made["validation"][:, first:last],
            direction.kind,
        )
        for direction, first, last in zip(group, edges[:-1], edges[1:], strict=True)
    ]


def _portions(asked: Sequence[Direction]) -> list[list[Direction]]:
    """Return directions in groups of few enough columns to stay in the cache."""
    groups: list[list[Direction]] = []
    size = _TOGETHER
    for direction in asked:
        size += len(direction.names)
        if size > _TOGETHER:
            groups.append([])
            size = len(direction.names)
        groups[-1].append(direction)
    return groups
