"""Cart and soft wall: against the equations integrated by SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from harness.errors import InputError
from plants.pymunk.soft_wall import PymunkCartWall


def hit(**options) -> tuple[np.ndarray, np.ndarray]:
    plant = PymunkCartWall(**options)
    plant.reset(rng=np.random.default_rng(0), x0={"x_rate": 2.0})
    y = plant.rollout(np.full((100, 1), 1.0))[:, 0]

    def slope(t, x):
        return [x[1], 1.0 - x[1] - 4.0 * x[0] - 200.0 * max(x[0] - 0.2, 0.0)]

    exact = solve_ivp(slope, (0, 2), [0, 2.0], t_eval=0.02 * np.arange(1, 101), rtol=1e-9, atol=1e-11, max_step=2e-3)
    return y, exact.y[0]


def test_the_wall_pushes_as_its_spring_does_and_never_pulls():
    y, exact = hit()
    assert exact.max() > 0.3, "it went into the wall"
    assert y == pytest.approx(exact, abs=5e-4)
    finer, _ = hit(substeps=100)
    assert np.abs(finer - exact).max() < 0.3 * np.abs(y - exact).max(), "first order"


def test_a_negative_stiffness_is_refused():
    with pytest.raises(InputError, match="wall_stiffness"):
        PymunkCartWall(wall_stiffness=-1.0)
