"""Effects that imitate something else: what the dictionary does not have, or has under another name."""

from __future__ import annotations

from collections.abc import Sequence

from harness.effects.effect import Effect, Placed

__all__ = ["DRY", "is_dry", "stand_in_reasons"]

DRY = frozenset({"coulomb_friction", "stribeck_friction", "asymmetric_friction", "hysteresis",
                 "position_dependent_friction", "sublinear_friction", "yield_friction"})  # fmt: skip
"""Laws of the whole dry friction of a joint: a sum of two is neither."""
_MEMORY = frozenset({"bristles", "slip elements"})
"""What makes a law of dry friction remember its last reversal: a joint has one presliding."""


def is_dry(effect: Effect) -> bool:
    """Return True for a law of the whole dry friction of a joint, or one with a presliding of its own."""
    return effect.name in DRY or effect.grows in _MEMORY


def stand_in_reasons(accepted: Sequence[Placed], left: str | None) -> tuple[str, ...]:
    """Return why accepted effects imitate something else; ``left`` names the axis of a force that still predicts."""
    reasons = []
    for place in dict.fromkeys(law.at for law in accepted):
        dry = [law.effect.name.replace("_", " ") for law in accepted if law.at == place and is_dry(law.effect)]
        if len(dry) > 1:
            reasons.append(
                f"the friction at {place} is none of the dictionary's laws: {' and '.join(dry)} together imitate it"
            )
    if accepted and left is not None:
        reasons.append(f"what is left can still be predicted, as a force at {left}")
    return tuple(reasons)
