"""Pairs of effects: which exclude each other, and which a screen finds worth refitting."""

from __future__ import annotations

import numpy as np
import pytest

from harness.diagnosis.pairs import compatible
from harness.diagnosis.screens import Probe, Screen
from harness.effects import builtin
from harness.effects.effect import Placed


def put(name: str, at: str) -> Placed:
    return Placed(builtin()[name], at)


def test_one_transmission_lies_between_an_input_and_a_coordinate() -> None:
    gear, shaft, rub = put("backlash", "theta"), put("elasticity", "theta"), put("coulomb_friction", "theta")
    assert compatible([gear, rub])
    assert not compatible([gear, rub, shaft])


def test_a_screen_tells_what_two_effects_explain_together() -> None:
    rng = np.random.default_rng(0)
    base, _ = np.linalg.qr(rng.standard_normal((50, 4)))
    residual = 3.0 * base[:, 0] + 4.0 * base[:, 1] + 12.0 * base[:, 2]

    def probe(name: str, column: int) -> Probe:
        direction = base[:, column]
        return Probe(put(name, "theta"), ({},), 0.0, 1, 1.0, 0.0, direction[:, None], direction)

    a, b, c = probe("coulomb_friction", 0), probe("quadratic_drag", 1), probe("cogging", 3)
    screen = Screen((a, b, c), base[:, :0], {}, residual)
    assert screen.share(a.placed) == pytest.approx(9 / 169)
    assert screen.share(a.placed, b.placed) == pytest.approx(25 / 169)
    assert screen.share(b.placed, c.placed) == pytest.approx(16 / 169)
    assert screen.share(put("end_stop", "theta")) == 0.0
