"""From where a set of effects starts again: from the ends of sets that it contains, is contained in, or replaces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import permutations

from harness.diagnosis.effort import EFFORT
from harness.diagnosis.search.compare import impossible
from harness.diagnosis.search.fit import Fit
from harness.diagnosis.search.table import FitTable, named, value
from harness.effects.effect import Placed

Fits = dict[Placed, Fit | None]
"""Fits of a base with one effect more, by that effect; None where it could not be simulated, or was left."""


def own_values(placed: Placed, fit: Fit) -> dict[str, float]:
    """Return the values of the parameters of one effect, by full name."""
    names = {*map(placed.name, placed.effect.parameter_names)}
    return {name: number for name, number in fit.values.items() if name in names}


def start_between(mine: Placed, fit: Fit | None, theirs: Placed, other: Fit) -> dict[str, float]:
    """Return where a law starts from the end of one that it contains or is contained in; the rest as it was."""
    start = dict(other.values)
    for parameter in mine.effect.parameters:
        if parameter.name in theirs.effect.parameter_names:
            start[mine.name(parameter.name)] = other.values[theirs.name(parameter.name)]
        elif fit is not None:
            start[mine.name(parameter.name)] = fit.values[mine.name(parameter.name)]
    return start


def as_good(fit: Fit, other: Fit, *, contains: bool) -> bool:
    """Return True if a fit has nothing to learn from where another ended; a law that contains it may not be worse.

    What it fits too closely costs a law that contains the other some of the validation records' likelihood, not much.
    """
    if contains:
        lost = other.log_likelihood("validation") - fit.log_likelihood("validation")
        return lost < EFFORT.close and fit.log_likelihood("estimation") > other.log_likelihood("estimation") - 1.0
    return value(fit) > value(other) - 1.0


def share_ends(
    table: FitTable,
    base: Fit,
    fits: Fits,
    rival: Callable[[Placed], Fit | None],
    among: Sequence[Placed] | None = None,
    *,
    upward: bool = False,
) -> None:
    """Fit a law and its special cases from each other's ends: no rival loses by a bad start.

    Parameters
    ----------
    table : Table
    base : Fit
        Beside which they stand.
    fits : dict
        By law, changed.
    rival : callable
        The fit that puts an end to the one of a law, if any.
    among : sequence of Placed, optional
        Only these laws.
    upward : bool
        Only from special cases to what contains them.
    """
    for mine, theirs in permutations(fits if among is None else among, 2):
        contains = mine.generalises(theirs)
        if not contains and (upward or not theirs.generalises(mine)):
            continue
        fit, other = fits.get(mine), fits.get(theirs)
        if other is None or (fit is not None and as_good(fit, other, contains=contains)):
            continue
        again = table.fit([*base.effects, mine], [start_between(mine, fit, theirs, other)], other, rival(mine))
        if again is not None and (fit is None or value(again) > value(fit)):
            fits[mine] = again


def polished(table: FitTable, base: Fit, fits: Sequence[Fit]) -> Fit:
    """Return the base fitted again from where its best rival ended, if that is better; it is then that of its set.

    Nothing is compared with a model that is not at its maximum.
    """
    best = max(fits, key=lambda fit: fit.penalised, default=None)
    if best is None or best.penalised < base.penalised:
        return base
    known = base.log_likelihood("estimation")
    begun = table.begin(base.effects, [best.values], best, known)
    if begun is None or begun.log_likelihood < known - EFFORT.margin:
        return base
    again = table.form.finish(begun, best)
    if again is None or again.penalised <= base.penalised + 0.5 or (base.converged and not again.converged):
        return base
    for placed in base.effects:  # it was accepted as a law
        if impossible(table.form, placed, again) and not impossible(table.form, placed, base):
            return base
    table.fits[named(base.effects)] = again
    return again
