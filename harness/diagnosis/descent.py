"""How a refit goes down: several starts over short windows, the losers dropped early, the hopeless given up.

A search refits dozens of models, and most of its time would go into those that cannot win: starts that end in a poor
minimum, and stiff simulations (a corner of a law shrunk to nothing) of effects that explain next to nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from harness.effects.effect import Placed
from harness.signals import FloatArray

__all__ = ["STIFFER", "Bar", "GivenUp", "by_expense", "excess", "first_ends", "promise"]

STIFFER = 4
"""A start that needs more than so many times the steps of another one is put off."""
STIFF_GAIN = 0.05
"""Share of the error that a much stiffer model (``STIFFER`` times the steps) must take away over short windows."""
HEAT = 12
"""Iterations after which starts are compared for the first time."""
FINALISTS = 2
BEHIND = 4.0
"""A start whose error beyond the noise is so many times that of the best one is dropped."""


@dataclass(frozen=True)
class Bar:
    """What a refit must promise over short windows to be carried on to long ones.

    Parameters
    ----------
    effects : tuple of Placed
        Of the model before.
    values : mapping
        Its parameters.
    gain : float
        Share of its squared error beyond the noise that must be gone; 0 asks stiff simulations only. A negative one is
        for a rival of that model: its whole squared error may be larger by this share.
    """

    effects: tuple[Placed, ...]
    values: Mapping[str, float]
    gain: float = 0.0


class GivenUp(ArithmeticError):
    """A refit that was not carried on; the text is the reason in the evidence table."""


def excess(form: Any, cost: float, windows: int, states: int) -> float:
    """Return a cost (half a sum of squares) less what the sensors' noise alone would leave."""
    records = form.records["estimation"]
    share = 1.0 - min(windows * states / max(sum(one.y.size for one in records), 1), 0.9)
    noise = sum(len(one) * s**2 for one in records for s in form.floors if s)
    return float(max(cost - 0.5 * share * noise, 0.0))


def first_ends(
    form: Any,
    system: Any,
    vectors: Sequence[FloatArray],
    free: Any,
    horizon: float | None,
    bar: Bar | None = None,
) -> list[Any]:
    """Return where starts end over short windows, best first; after a few iterations only the best two go on.

    Raises
    ------
    GivenUp
        If the best one is stiff and does not come up to the bar by then.
    """
    short = len(vectors) > 1 or bar is not None
    heats = [form._stage(system, p, None, free, horizon, HEAT if short else None) for p in vectors]
    alive = sorted((one for one in heats if one is not None), key=lambda one: float(one.evaluation.cost))
    if alive and bar is not None:
        promise(
            form, replace(bar, gain=0.0), system, alive[0], horizon
        )  # so early only what is stiff must show promise
    ends: list[Any] = []
    for one in alive[:FINALISTS]:
        if ends and beyond(form, one) > BEHIND * beyond(form, alive[0]):
            break
        done = one.converged or not short
        ends.append(one if done else form._stage(system, one.p, one.states, free, horizon))
    return sorted((one for one in ends if one is not None), key=lambda one: float(one.evaluation.cost))


def beyond(form: Any, solution: Any) -> float:
    """Return the error of a solution beyond the noise."""
    return excess(form, solution.evaluation.cost, *solution.x0.shape)


def promise(form: Any, bar: Bar | None, system: Any, solution: Any, horizon: float | None) -> None:
    """Return if a solution over short windows is worth carrying on.

    Raises
    ------
    GivenUp
        If it takes away less of the error of the model before than its bar asks.
    """
    if bar is None:
        return
    before = form.cost_of(bar, horizon)
    if before is None:
        return
    asked = bar.gain if all(form.floors) else 0.0  # without a noise floor nobody knows what share could be gone
    needed = getattr(form.simulator(system, solution.p), "substeps", 1)
    usual = getattr(form.simulator(form.system(bar.effects), before.p), "substeps", 1)
    stiff = needed > STIFFER * usual
    old, new = beyond(form, before), beyond(form, solution)
    if bar.gain < 0:  # against a model that may have reached the noise: all of the error counts
        asked, old, new = bar.gain, float(before.evaluation.cost), float(solution.evaluation.cost)
    elif stiff:
        asked = max(asked, STIFF_GAIN)
    if asked == 0.0 or not old > 0.0 or new <= (1.0 - asked) * old:
        return
    where = "over whole records" if horizon is None else f"over windows of {horizon:.3g} s"
    if bar.gain < 0:
        raise GivenUp(f"given up: {where} its squared error is {new / old:.3g} times that of the model that stands")
    gone = f"takes away {100 * (1 - new / old):.1f} % of the error" if new <= old else "makes the error larger"
    steep = f"; its simulation needs {needed} steps a sample" if stiff else ""
    raise GivenUp(f"given up: {where} it {gone}, {100 * asked:.0f} % less is asked to carry it on{steep}")


def by_expense(form: Any, system: Any, starts: Sequence[Mapping[str, float]]) -> list[list[FloatArray]]:
    """Return distinct starts (np,): first those with the fewest steps in a sample, then the much stiffer ones.

    A start that is much stiffer than another one costs more than all the others, and is tried if these diverge.
    """
    vectors: list[FloatArray] = []
    for start in starts:
        p = system.vector({name: value for name, value in start.items() if name in system.parameter_names})
        if not any(np.allclose(p, other, rtol=1e-9) for other in vectors):
            vectors.append(p)
    steps = [getattr(form.simulator(system, p), "substeps", 1) for p in vectors]
    easy = [p for p, count in zip(vectors, steps, strict=True) if count <= STIFFER * min(steps)]
    stiff = [p for p, count in zip(vectors, steps, strict=True) if count > STIFFER * min(steps)]
    return [easy, stiff]
