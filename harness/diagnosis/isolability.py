"""What this experiment could tell apart at all, computed from the model and the excitation, before the residual."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from harness.diagnosis.screens import SEEN, Screen
from harness.effects.effect import Placed
from harness.signals import FloatArray

__all__ = ["ALIKE", "isolability", "separating", "unseen"]

ALIKE = 0.95
INVISIBLE = 0.03
"""Share of a barely visible effect that must be left beside the nominal parameters (a simulation is not linear)."""
MOST = 26


def isolability(screen: Screen, *, first: Sequence[str] = ()) -> tuple[tuple[str, ...], FloatArray]:
    """Return how well each effect's change of the outputs is mimicked by every other.

    Parameters
    ----------
    screen : Screen
        Of the nominal model.
    first : sequence of str
        Effects to show in any case, e.g. those found.

    Returns
    -------
    names : tuple of str
    cosines : array (n, n)
        Entry (i, j): cosine between the change of effect i and the span of effect j (its parameters free), the nominal
        Jacobian and the initial states taken out of both; 1 means that j can do all that i does.
    """
    seen = [one for one in screen.probes if one.left >= SEEN and one.rank]
    seen.sort(key=lambda one: (str(one.placed) not in first, str(one.placed)))
    seen = seen[:MOST]
    cosines = np.eye(len(seen))
    for i, a in enumerate(seen):
        for j, b in enumerate(seen):
            if i != j:
                cosines[i, j] = min(float(np.linalg.norm(b.basis.T @ a.direction)), 1.0)
    return tuple(str(one.placed) for one in seen), cosines


def unseen(screen: Screen) -> list[dict[str, Any]]:
    """Return the effects that this experiment cannot show, each with the reason."""
    rows = []
    for one in screen.probes:
        if one.left < SEEN or one.least < INVISIBLE or not one.rank:
            by = f"nominal parameter {one.absorbed_by}" if one.absorbed_by else "nominal parameters or initial states"
            rows.append(
                {
                    "name": one.placed.effect.name,
                    "at": one.placed.at,
                    "reason": f"the {by} can do the same" if one.absorbed_by else f"{by} can do the same",
                    "parameter": one.absorbed_by or None,
                }
            )
    return sorted(rows, key=lambda row: (row["name"], row["at"]))


def separating(members: Sequence[Placed]) -> list[str]:
    """Return the experiments that would separate the members of a tie set, each once."""
    texts = [f"{one.effect.name}: {one.effect.experiment}" for one in members if one.effect.experiment]
    return list(dict.fromkeys(texts))
