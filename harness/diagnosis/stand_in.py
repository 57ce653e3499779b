"""Effects that imitate something else: what the dictionary does not have, or has under another name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from harness.effects.effect import Placed

if TYPE_CHECKING:
    from harness.diagnosis.search.fit import Fit


def same_whole(one: Placed, other: Placed) -> bool:
    """Return True for two laws at one place that each are the whole law of the same thing there: dry friction, say."""
    return bool(one.effect.whole) and (one.at, one.effect.whole) == (other.at, other.effect.whole)


def of_nothing(fit: Fit) -> list[tuple[Placed, tuple[float, float]]]:
    """Return the effects of a fit whose size may be nothing at all, with its 95 % interval."""
    found = []
    for one in fit.effects:
        main, name = one.effect.main, one.main()
        if main is None or name not in fit.free or name in fit.on_bound or not np.isfinite(fit.deviations[name]):
            continue
        low, high = fit.interval(name)
        if main.neutral is not None and low <= main.neutral <= high:
            found.append((one, (low, high)))
    return found


def traded(fit: Fit) -> str | None:
    """Return why effects that stand beside each other imitate another law: of none of them is a size told, if so."""
    names = [one.effect.name.replace("_", " ") for one, _ in of_nothing(fit)]
    if len(names) < 2:
        return None
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
