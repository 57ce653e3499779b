"""How far a refit is begun: what may still come to the hope goes on, what may not is left after two looks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from harness.diagnosis.forms.likelihood_form import LikelihoodForm
from harness.diagnosis.policy import EFFORT


@dataclass
class Valley:
    """A point on a way down, of which each step gains as much as ``gains`` says."""

    nll: float
    gains: tuple[float, ...]
    converged: bool = False
    pace: float = 0.0


class Slope:
    """A likelihood that is followed step by step."""

    def __init__(self) -> None:
        self.steps = 0

    def maximise(self, start: Valley, *, most: int, **_: Any) -> Valley:
        """Return where so many steps lead."""
        taken, left = start.gains[:most], start.gains[most:]
        self.steps += len(taken)
        return Valley(start.nll - sum(taken), left, not left, taken[-1] if taken else 0.0)


@pytest.mark.parametrize(
    ("gains", "steps", "reached"),
    [
        # 116 below the base, and 68 with every step, as an end stop was: it goes on until it is above the hope
        ((68.0,) * 30, EFFORT.first_steps, 116.0 - 5 * 68.0),
        ((22.0,) * 30, 2 * EFFORT.first_steps, 116.0 - 10 * 22.0),
        # what would not come near by as many steps again is left
        ((1.0,) * 30, EFFORT.looks, 114.0),
        # and what slows down on its way is left there
        ((40.0, 40.0, 20.0, 5.0, 0.5) + (0.01,) * 30, EFFORT.first_steps, 10.5),
    ],
)
def test_a_start_from_afar_goes_on_while_each_step_gains(gains: tuple[float, ...], steps: int, reached: float) -> None:
    slope = Slope()
    first = LikelihoodForm._looked(LikelihoodForm, slope, [Valley(116.0, gains)], hope=10.0)[0]  # type: ignore[arg-type, type-var, misc]
    assert slope.steps == steps
    assert first.nll == pytest.approx(reached)


def test_without_a_hope_every_start_takes_its_first_steps_and_no_more() -> None:
    slope = Slope()
    LikelihoodForm._looked(LikelihoodForm, slope, [Valley(116.0, (68.0,) * 30)], hope=-np.inf)  # type: ignore[arg-type, type-var, misc]
    assert slope.steps == EFFORT.first_steps
