"""What is said of sizes that may be nothing, and of levels that drain."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from harness.diagnosis.records.horizon import Horizon
from harness.diagnosis.records.prepare import sizes_of
from harness.diagnosis.runs.compare import FreeRuns
from harness.diagnosis.runs.form import FreeRunForm
from harness.diagnosis.search.fit import of_nothing
from harness.diagnosis.stand_in import traded
from harness.diagnosis.steps import over_nothing
from harness.effects import builtin
from harness.effects.effect import Placed
from harness.physics.symbolic.typed import read_equations
from harness.signals import Dataset, PlantSpec, Run, Trajectory

FRICTION = Placed(builtin()["coulomb_friction"], "x")


@pytest.mark.parametrize(
    ("half", "bound", "told"), [(0.3, False, True), (0.1, False, False), (np.inf, False, False), (0.3, True, False)]
)
def test_a_size_that_may_be_nothing_by_all_readings_is_said(half: float, bound: bool, told: bool) -> None:
    name = FRICTION.name("Fc")
    fit: Any = SimpleNamespace(
        effects=(FRICTION,), free=(name,), on_bound=(name,) if bound else (), deviations={name: half / 1.96},
        interval=lambda asked: (0.166 - half, 0.166 + half),
    )  # fmt: skip
    warnings = over_nothing(fit)
    assert bool(warnings) == told
    assert all("x.Fc" in words and "coulomb friction may not be there" in words for words in warnings)
    assert traded([one for one, _ in of_nothing(fit)]) is None


def test_effects_of_which_none_is_told_stand_in_for_another_law() -> None:
    """A stop at one side was a quadratic spring of 240 +- 5000, a wave of 64 +- 1400 and an error of the sensor."""
    both = (FRICTION, Placed(builtin()["linear_spring"], "x"))
    names = tuple(one.name(main.name) for one in both if (main := one.effect.main) is not None)

    def fit(*halves: float) -> Any:
        ends = {name: (0.5 - half, 0.5 + half) for name, half in zip(names, halves, strict=True)}
        return SimpleNamespace(effects=both, free=names, on_bound=(), deviations=dict.fromkeys(names, 1.0),
                               interval=ends.__getitem__)  # fmt: skip

    def told(*halves: float) -> str | None:
        return traded([one for one, _ in of_nothing(fit(*halves))])

    assert told(0.6, 0.4) is None
    assert told(0.6, 9.0) == (
        "each of coulomb friction, linear spring may be nothing by all readings: they trade with each other"
    )


def test_the_motion_of_a_level_is_about_where_it_stood() -> None:
    """A tank that drains evenly was "mostly noise": a straight line leaves nothing else of its fall of 15 cm."""
    level = read_equations(
        "level h [m]\nc = 0.01 m^0.5/s >= 0\nh' = -c*sqrt(max(h, 0))\noutput h\n", "tank.eqs"
    ).system()
    t = 0.1 * np.arange(400.0)
    y = (0.33 - 0.15 * t / t[-1] + 2e-3 * np.random.default_rng(0).standard_normal(len(t)))[:, None]
    record = Trajectory(t, np.zeros((len(t), 0)), y, PlantSpec((), level.outputs, 0.1))
    data = Dataset("drain", (Run(record), Run(record, "validation")))
    sizes = sizes_of(level, level.values(), data)
    form = FreeRunForm(level, data, sizes=sizes, horizon=None, weights=np.array([2e-3]))
    runs = FreeRuns.of(Horizon(None, "whole records"), form, None, None)
    assert runs.noise[0] == pytest.approx(4e-6, rel=0.3)
    assert runs.motion[0] == pytest.approx(0.15**2 / 12, rel=0.05)
