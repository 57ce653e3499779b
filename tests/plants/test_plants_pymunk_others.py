"""Double cart-pole and ball-and-beam in pymunk: equations of motion, rolling, snapshots, golden records."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from harness.errors import InputError
from harness.protocols import Experiment
from harness.rollout import perform
from harness.signals import FloatArray
from plants.pymunk.ball_beam import PymunkBallBeam
from plants.pymunk.cart_pole import PymunkCartPole
from plants.pymunk.double_cart_pole import PymunkDoubleCartPole

RNG = np.random.default_rng


def push(n: int) -> FloatArray:
    t = np.arange(n) * 0.01
    return (2.0 * np.sin(4.0 * t))[:, None]


def reference(plant: PymunkDoubleCartPole, inputs: FloatArray, start: FloatArray) -> FloatArray:
    """Return x, theta1, theta2 (N, 3) of the equations of motion, derived by hand for absolute angles."""
    from scipy.integrate import solve_ivp

    mc, m1, m2, l1, l2, bx, b1, b2 = plant.true_parameters.values()

    def rate(_: float, z: FloatArray, u: float) -> FloatArray:
        a, b, v, w1, w2 = z[1:]
        s1, c1, s2, c2 = np.sin(a), np.cos(a), np.sin(b), np.cos(b)
        sd, cd = np.sin(a - b), np.cos(a - b)
        mass = [
            [mc + m1 + m2, (m1 + m2) * l1 * c1, m2 * l2 * c2],
            [(m1 + m2) * l1 * c1, (m1 + m2) * l1**2, m2 * l1 * l2 * cd],
            [m2 * l2 * c2, m2 * l1 * l2 * cd, m2 * l2**2],
        ]
        right = [
            u - bx * v + (m1 + m2) * l1 * s1 * w1**2 + m2 * l2 * s2 * w2**2,
            -b1 * w1 + b2 * (w2 - w1) - (m1 + m2) * 9.81 * l1 * s1 - m2 * l1 * l2 * sd * w2**2,
            -b2 * (w2 - w1) - m2 * 9.81 * l2 * s2 + m2 * l1 * l2 * sd * w1**2,
        ]
        return np.concatenate([z[3:], np.linalg.solve(mass, right)])

    z, out = np.concatenate([start, np.zeros(3)]), [start]
    for (u,) in inputs[:-1]:
        z = solve_ivp(partial(rate, u=u), (0, 0.01), z, rtol=1e-9, atol=1e-11).y[:, -1]
        out.append(z[:3])
    return np.array(out)


def test_double_cart_pole_converges_with_first_order() -> None:
    start = {"theta1": 0.5, "theta2": -0.4}
    errors = []
    for substeps in (5, 10, 20):
        with PymunkDoubleCartPole(substeps=substeps) as plant:
            log = perform(plant, Experiment(push(200), x0=start), rng=RNG(0))
            if not errors:
                truth = reference(plant, push(200), np.array([0.0, 0.5, -0.4]))
        errors.append(np.abs(log.y - truth).max())
    assert errors[-1] < 1e-2, errors
    assert np.log2(np.array(errors[:-1]) / errors[1:]).min() > 0.8, errors


@pytest.mark.parametrize("alpha", [0.1, -0.3])
def test_a_rolling_ball_accelerates_by_five_sevenths(alpha: float) -> None:
    errors = []
    for substeps in (10, 40):
        with PymunkBallBeam(inertia=1e6, substeps=substeps) as plant:
            plant.reset(rng=RNG(0), x0={"alpha": alpha, "r": 0.1})
            r = plant.rollout(np.zeros((30, 1)))[-1, 0]
        errors.append(abs(r - (0.1 - 9.81 * np.sin(alpha) * 5 / 7 * 0.3**2 / 2)))
    assert errors[1] < 2e-4, errors
    assert errors[0] > 3 * errors[1], errors


def test_a_ball_that_slips_accelerates_less_the_less_it_rolls() -> None:
    with PymunkBallBeam(inertia=1e6, friction=0.0) as plant:
        plant.reset(rng=RNG(0), x0={"alpha": 0.2, "r": 0.3})
        r = plant.rollout(np.zeros((30, 1)))[-1, 0]
    assert r == pytest.approx(0.3 - 9.81 * np.sin(0.2) * 0.3**2 / 2, abs=2e-3)


def test_the_beam_turns_under_torque_spring_and_the_balls_weight() -> None:
    with PymunkBallBeam(m=1e-6, b=0.0, inertia=0.02) as plant:
        plant.reset(rng=RNG(0))
        alpha = plant.rollout(np.full((50, 1), 0.01))[-1, 1]
    assert alpha == pytest.approx(0.01 / 0.02 * 0.5**2 / 2, rel=5e-3)
    with PymunkBallBeam(spring=1.0, b=0.1) as plant:
        plant.reset(rng=RNG(0), x0={"r": 0.3})
        tilt = plant.rollout(np.zeros((40, 1)))[-1, 1]
    assert tilt < -0.05, "the ball's weight at positive r turns the beam clockwise"


def test_dry_friction_of_the_beams_pin_holds_and_brakes() -> None:
    angles = []
    for torque in (0.009, 0.015):
        with PymunkBallBeam(m=1e-6, b=0.0, inertia=0.02, dry=0.01) as plant:
            plant.reset(rng=RNG(0))
            angles.append(plant.rollout(np.full((50, 1), torque))[-1, 1])
    assert abs(angles[0]) < 1e-6, "below the dry friction the beam stands"
    assert angles[1] == pytest.approx((0.015 - 0.01) / 0.02 * 0.5**2 / 2, rel=5e-3)


@pytest.mark.parametrize("joint", [1, 2])
def test_dry_friction_of_a_joint_stops_its_own_motion(joint: int) -> None:
    x0 = {"theta1": 0.5, "theta2": -0.4}
    relative = []
    for friction in (0.0, 5.0):
        options = {"bx": 0.0, "b1": 0.0, "b2": 0.0, f"friction_{joint}": friction, "outputs": ["theta1", "theta2"]}
        with PymunkDoubleCartPole(**options) as plant:
            plant.reset(rng=RNG(0), x0=x0)
            theta1, theta2 = plant.rollout(np.zeros((100, 1))).T
        relative.append(np.ptp(theta1 if joint == 1 else theta2 - theta1))
    assert relative[0] > 0.5
    assert relative[1] < 0.02, "a friction beyond the weight locks the joint"


@pytest.mark.parametrize("make", [PymunkCartPole, PymunkDoubleCartPole, PymunkBallBeam])
def test_rates_can_be_measured(make: type[PymunkCartPole]) -> None:
    with make() as usual:
        names = [channel.name for channel in usual.spec.states]
        positions = [channel.name for channel in usual.spec.outputs]
        assert positions == names[: len(positions)]
        usual.reset(rng=RNG(0))
        expected = usual.rollout(0.05 * push(60))
    with make(outputs=names[::-1]) as plant:
        assert [channel.name for channel in plant.spec.outputs] == names[::-1]
        assert plant.reset(rng=RNG(0), x0={names[-1]: 0.3})[0] == pytest.approx(0.3)
        plant.reset(rng=RNG(0))
        y = plant.rollout(0.05 * push(60))
        assert np.array_equal(y[:, ::-1][:, : len(positions)], expected)
        assert np.array_equal(y[-1], plant.truth()[::-1])
        plant.reset(rng=RNG(0))
        assert np.array_equal([plant.step(u) for u in 0.05 * push(60)], y)
    for wrong in (["speed"], [], [names[0], names[0]]):
        with pytest.raises(InputError, match="option outputs"):
            make(outputs=wrong)


def test_options_out_of_range_are_refused() -> None:
    for options in ({"mp1": 0.0}, {"b1": -1.0}, {"substeps": 0.5}):
        with pytest.raises(InputError):
            PymunkDoubleCartPole(**options)
    for options in ({"length": 0.05}, {"m": 0.0}, {"friction": -0.1}):
        with pytest.raises(InputError):
            PymunkBallBeam(**options)
