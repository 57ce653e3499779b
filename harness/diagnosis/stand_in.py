"""When the accepted effects describe what is missing, but cannot be what it is.

A law that the dictionary does not have is still imitated by one that it has, or by two together. The name is then a
stand-in, and a report that gives it as a diagnosis would be wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import TYPE_CHECKING

from harness.diagnosis.adequacy import Adequacy
from harness.diagnosis.residual_tests import RATIO
from harness.diagnosis.scores import noise_ratios
from harness.effects.effect import Placed

if TYPE_CHECKING:
    from harness.diagnosis.simulated import SimulatedDiagnosis

__all__ = ["stand_in", "stand_in_reasons"]

DRY = frozenset(
    {
        "coulomb_friction",
        "stribeck_friction",
        "asymmetric_friction",
        "hysteresis",
        "position_dependent_friction",
    }
)
"""Laws of the whole dry friction of a joint: each holds the constant level of the others, so a sum of two is neither.
Load-dependent friction is not among them: seals add a constant level to what the load makes."""


def stand_in_reasons(accepted: Sequence[Placed], adequacy: Adequacy, ratio: float | None) -> tuple[str, ...]:
    """Return why accepted effects are a stand-in for something else; empty if nothing says so.

    Two laws of dry friction at one joint are a description of its friction, for a joint has one such law. A rest that
    the motion still predicts, on held-out data and beyond its surrogates, is a force that is not yet in the model: it
    counts from 1.15 noise floors on, and below that where the whole residual is larger than sensor noise.

    Parameters
    ----------
    accepted : sequence of Placed
    adequacy : Adequacy
        Of the model with them.
    ratio : float or None
        Largest validation residual over its noise floor; None where no floor is known.

    Examples
    --------
    >>> from harness.diagnosis.adequacy import nothing_left
    >>> from harness.effects import builtin
    >>> known = builtin()
    >>> two = [Placed(known["coulomb_friction"], "theta"), Placed(known["stribeck_friction"], "theta")]
    >>> stand_in_reasons(two[:1], nothing_left(), 1.0)
    ()
    >>> print(stand_in_reasons(two, nothing_left(), 1.0)[0])
    the friction at theta is none of the dictionary's laws: coulomb friction and stribeck friction together imitate it
    """
    if not accepted:
        return ()
    reasons = []
    for one, other in combinations(accepted, 2):
        if one.at == other.at and one.effect.name in DRY and other.effect.name in DRY:
            names = " and ".join(placed.effect.name.replace("_", " ") for placed in (one, other))
            reasons.append(f"the friction at {one.at} is none of the dictionary's laws: {names} together imitate it")
    best = adequacy.best
    significant = best is not None and adequacy.rest > 1.0
    if best is not None and (adequacy.predictable or (significant and ratio is not None and ratio > RATIO)):
        cause = "a property of the sensor" if best.axes.startswith("reading") else "a force"
        reasons.append(f"what is left can still be predicted from {best.axes}: {cause} that is not in the model")
    return tuple(reasons)


def stand_in(found: SimulatedDiagnosis) -> tuple[str, ...]:
    """Return why the accepted effects of a diagnosis are a stand-in; see :func:`stand_in_reasons`."""
    ratios = noise_ratios({"validation": found.final.validation}, found.form.floors)
    return stand_in_reasons([one.placed for one in found.result.accepted], found.adequacy, ratios["validation"])
