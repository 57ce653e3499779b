"""Effects that imitate something else: what the dictionary does not have, or has under another name."""

from __future__ import annotations

from collections.abc import Sequence

from harness.effects.effect import Placed


def same_whole(one: Placed, other: Placed) -> bool:
    """Return True for two laws at one place that each are the whole law of the same thing there: dry friction, say."""
    return bool(one.effect.whole) and (one.at, one.effect.whole) == (other.at, other.effect.whole)


def traded(nothing: Sequence[Placed]) -> str | None:
    """Return why effects that each may be nothing imitate another law beside each other, if there are two of them."""
    if not nothing[1:]:
        return None
    names = [one.effect.name.replace("_", " ") for one in nothing]
    return f"each of {', '.join(names)} may be nothing by all readings: they trade with each other"


def stand_in_reasons(accepted: Sequence[Placed], left: str | None) -> tuple[str, ...]:
    """Return why accepted effects imitate something else; ``left`` names the axis of a force that still predicts."""
    reasons = []
    for at, whole in dict.fromkeys((law.at, law.effect.whole) for law in accepted if law.effect.whole):
        same = [law.effect.name.replace("_", " ") for law in accepted if (law.at, law.effect.whole) == (at, whole)]
        if len(same) > 1:
            reasons.append(
                f"the {whole} at {at} is none of the dictionary's laws: {' and '.join(same)} together imitate it"
            )
    if accepted and left is not None:
        reasons.append(f"what is left can still be predicted, as a force at {left}")
    return tuple(reasons)
