"""Derivatives of an FMU's free runs: what several parameters do together is the small difference of what each does."""

from __future__ import annotations

import numpy as np
import pytest

from harness.blackbox.reader import fmu_system
from harness.blackbox.runner import Runner
from harness.blackbox.simulator import FmuSimulator
from harness.signals import Channel, PlantSpec
from plants.mockups import mockup

DT = 0.02
SPEC = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"),), DT)


@pytest.mark.parametrize("seconds", [20, 80])
def test_parameters_that_scale_together_do_what_a_smaller_input_does(seconds: int) -> None:
    """J, b and mgl by one factor are the input over it; over a long swing each alone moves the phase by much more."""
    system = fmu_system(mockup("pendulum"), SPEC, {"J": 0.06, "b": 0.0005, "mgl": 1.1})
    simulator, p = FmuSimulator(system, Runner(system, DT)), system.vector()
    t = DT * np.arange(seconds / DT)
    u = np.sum([0.05 * np.sin(2 * np.pi * f * t) for f in (0.31, 0.55, 0.9)], axis=0)[:, None]
    x0 = np.array([0.2, 0.0])
    _, _, found = simulator.windows(p[None], x0[None], u[None], None, t[:1])
    assert found is not None
    together = sum(p[k] * found[0][..., k] for k, one in enumerate(system.parameters) if not one.fixed)
    above, below = (simulator.run(p, x0, (1 + part) * u)[1] for part in (-1e-5, 1e-5))
    wanted = (above - below) / 2e-5
    assert np.abs(together - wanted).max() < 0.02 * np.abs(wanted).max()
    assert np.abs(found[0][..., 0] * p[0]).max() > 10 * np.abs(wanted).max(), "as each by itself does"


def test_a_parameter_that_does_the_same_to_both_sides_has_a_derivative_of_nothing() -> None:
    """A difference of nothing over a bend is no step, and no warning."""

    class Even(FmuSimulator):
        def run(self, p, x0, u, t0=0.0, extra=None):  # type: ignore[no-untyped-def]
            return np.zeros((len(u), 2)), np.full((len(u), 1), p[2] ** 2)

    system = fmu_system(mockup("pendulum"), SPEC, {"J": 0.06, "b": 0.0005, "mgl": 1.1})
    simulator, p = Even(system, Runner(system, DT)), system.vector()
    p[2] = 0.0
    _, _, found = simulator.windows(p[None], np.zeros((1, 2)), np.zeros((1, 50, 1)), None, np.zeros(1))
    assert found is not None
    assert np.abs(found[0][..., 2]).max() < 0.01


def test_steps_that_a_wild_motion_shortened_are_long_again_where_it_is_calm() -> None:
    """Else the error of the solver is all that later differences see: a first fit may begin anywhere."""

    class Wild(FmuSimulator):
        def run(self, p, x0, u, t0=0.0, extra=None):  # type: ignore[no-untyped-def]
            rounded = np.round(np.sin(p[2] * (1e5 if x0[0] > 1.0 else 1.0)), 6)
            return np.zeros((len(u), 2)), np.full((len(u), 1), rounded)

    system = fmu_system(mockup("pendulum"), SPEC, {"J": 0.06, "b": 0.0005, "mgl": 1.1})
    p, u, found = system.vector(), np.zeros((50, 1)), []
    runner = Runner(system, DT)
    for angle in (2.0, 0.0, 0.0):
        _, _, slopes = Wild(system, runner).windows(p[None], np.array([[angle, 0.0]]), u[None], None, np.zeros(1))
        assert slopes is not None
        found.append(slopes[0][0, 0, 2])
    assert found[0] == pytest.approx(1e5 * np.cos(1e5 * p[2]), rel=0.05)
    assert found[2] == pytest.approx(np.cos(p[2]), rel=2e-3)
