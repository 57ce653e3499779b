"""What repeats along a coordinate is found however often it is passed, and a sign may be as sharp as it is."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from harness.diagnosis.algorithm import diagnose
from harness.effects import builtin
from harness.physics import load_model
from harness.signals import Dataset

pytestmark = pytest.mark.slow  # whole loops

FRICTIONS = ("coulomb_friction", "stribeck_friction", "asymmetric_friction", "position_dependent_friction")


@pytest.mark.parametrize("teeth", [20.0, 60.0])
def test_teeth_are_found_that_are_passed_many_times(foreign_pendulum: Callable[..., Dataset], teeth: float) -> None:
    """Wave numbers were tried one by one, up to twelve waves over the travel."""
    data = foreign_pendulum(3, lambda q, v, u, t: 0.15 * np.sin(teeth * q + 1.0), noise=2e-4)
    found = diagnose(data, load_model("pendulum"), dictionary=[builtin()["cogging"], builtin()["cubic_spring"]])
    assert [str(accepted.placed) for accepted in found.outcome.accepted] == ["cogging@theta"]
    assert found.final.values["cogging@theta.k"] == pytest.approx(teeth, rel=2e-3)
    assert found.final.values["cogging@theta.A"] == pytest.approx(0.15, rel=0.1)
    assert not found.stand_in


@pytest.mark.parametrize("seed", [5, 6])
def test_dry_friction_that_sticks_is_not_called_another_law_s_stand_in(
    foreign_pendulum: Callable[..., Dataset], seed: int
) -> None:
    """What sticks creeps over the width of its sign: a floor of it let a forbidden Stribeck friction fit better."""
    data = foreign_pendulum(seed, lambda q, v, u, t: -0.12 * np.tanh(v / 1e-3), noise=5e-4)
    found = diagnose(data, load_model("pendulum"), dictionary=[builtin()[name] for name in FRICTIONS])
    assert [str(accepted.placed) for accepted in found.outcome.accepted] == ["coulomb_friction@theta"]
    assert found.stand_in == ()
    assert found.final.values["coulomb_friction@theta.Fc"] == pytest.approx(0.12, rel=0.02)
    assert found.final.values["coulomb_friction@theta.w"] < 4e-3
