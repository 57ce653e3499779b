"""Fits made up of densities, and a form that tells of them what a test wants."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from harness.diagnosis.search.fit import Fit
from harness.effects import Dictionary
from harness.effects.effect import Placed
from harness.signals import FloatArray


class NoForm:
    """What a form tells of fits beyond their densities: how much changes, and how far two are apart."""

    laws = Dictionary.builtin()

    def __init__(self, change: float = np.inf, distance: float = np.inf, untried: Sequence[str] = ()) -> None:
        self.left_out = lambda: list(untried)
        self.change = lambda fit, placed: change
        self.distance = lambda fit, other: distance
        self.damping = lambda fit, at: None


FORM: Any = NoForm()


def a_fit(
    gains: Sequence[FloatArray] = (np.zeros(400), np.zeros(400)),
    effects: Sequence[Placed] = (),
    count: int = 3,
    **more: object,
) -> Fit:
    """Return a fit whose log-densities are -1 more than these gains."""
    values = {"a": 1.0, **{one.name(p): 0.5 for one in effects for p in one.effect.parameter_names}}
    fields: dict[str, object] = {
        "effects": tuple(effects), "system": None, "values": values, "free": tuple(values), "count": count,
        "terms": {"estimation": [gains[0] - 1.0], "validation": [gains[1] - 1.0]},
        "deviations": dict.fromkeys(values, 0.1), "logarithmic": frozenset(), "converged": True, "on_bound": (),
    }  # fmt: skip
    return Fit(**{**fields, **more})  # type: ignore[arg-type]
