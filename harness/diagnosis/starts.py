"""Where refits start: values from the screens, the frequency of a pure line, the place where the best rival ended."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from harness.diagnosis.accept import LEVEL
from harness.diagnosis.confirm import Candidate
from harness.diagnosis.forms import Fitted
from harness.diagnosis.refit import Task
from harness.diagnosis.residual_tests import fisher_g
from harness.diagnosis.screens import Probe
from harness.effects.effect import Placed

if TYPE_CHECKING:
    from harness.diagnosis.subset import Search

__all__ = ["line_of", "polished", "starts_of"]


def starts_of(
    search: Search,
    model: Fitted,
    added: Sequence[Placed],
    probes: Mapping[str, Probe],
    line: float | None = None,
) -> tuple[dict[str, float], ...]:
    """Return starting parameters: the model's own with the screened values."""
    base = dict(model.values)
    lists: list[list[dict[str, float]]] = []
    for placed in added:
        probe = probes.get(str(placed))
        own = list(probe.starts) if probe is not None else [placed.effect.complete({}, search._size(placed))]
        if placed.effect.name == "periodic_disturbance" and line is not None:
            own = [{**own[0], "omega": line}]
        several = any(len(one.grid) > 1 and not one.nuisance for one in placed.effect.parameters)
        lists.append([{placed.name(k): v for k, v in one.items()} for one in own[: 3 if several else 1]])
    starts: list[dict[str, float]] = []
    for k in range(max(len(one) for one in lists)):
        start = dict(base)
        for own in lists:
            start.update(own[min(k, len(own) - 1)])
        starts.append(start)
    return tuple(starts)


def polished(tasks: Sequence[Task], candidates: Sequence[Candidate]) -> dict[str, Task]:
    """Return second refits for the close rivals of the best candidate, by the key of the first.

    They start from the parameters at which the best one ended: rivals must not lose by a local minimum.
    """
    ranked = [one for one in candidates if one.fitted is not None and np.isfinite(one.delta_bic)]
    if not ranked:
        return {}
    best = max(ranked, key=lambda one: one.delta_bic)
    assert best.fitted is not None
    first = best.added[0]
    shared = {one.name: best.fitted.values[first.name(one.name)] for one in first.effect.parameters}
    result: dict[str, Task] = {}
    for task, one in zip(tasks, candidates, strict=True):
        placed = one.added[0]
        if one is best or one.fitted is None or one.delta_bic < 0.5 * best.delta_bic or best.delta_bic <= 10:
            continue
        start = {k: v for k, v in best.fitted.values.items() if not k.startswith(f"{first}.")}
        for other in placed.effect.parameters:
            own = one.fitted.values[placed.name(other.name)]
            start[placed.name(other.name)] = shared.get(other.name, own) if other.nuisance else own
        result[task.key] = Task(task.effects, (start,))
    return result


def line_of(search: Search, model: Fitted) -> float | None:
    """Return the angular frequency of a pure line that stands in estimation and in validation, or None."""
    dt = getattr(search.form, "sample_time", 1.0)
    longest = [max(parts, key=len) for parts in (model.estimation, model.validation)]
    for j in range(longest[0].shape[1]):
        inside, outside = (fisher_g(one[:, j], dt) for one in longest)
        width = 2 * np.pi / (dt * min(len(one) for one in longest))
        if max(inside.p, outside.p) <= LEVEL and abs(inside.omega - outside.omega) < 1.5 * width:
            return inside.omega
    return None
