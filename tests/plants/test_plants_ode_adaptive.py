"""Adaptive integration, dense output, pickling, batches with the truth."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from harness.errors import InputError, PlantError
from harness.physics import Ode
from plants.equations.ode import OdePlant, cart_pole_ode, linear_ode, pendulum_ode

RNG = np.random.default_rng


def swing(plant, n=40):
    plant.reset(rng=RNG(0), x0={"theta": 1.0})
    return plant.rollout(np.full((n, 1), 0.3))


@pytest.mark.parametrize(("method", "error"), [("dop853", 1e-9), ("lsoda", 1e-7), ("bdf", 1e-6), ("radau", 1e-7)])
def test_adaptive_methods_agree_with_a_fine_fixed_step(method, error):
    reference = swing(cart_pole_ode(substeps=100))
    with cart_pole_ode(integrator=method, rtol=1e-9, atol=1e-11) as plant:
        rolled = swing(plant)
        plant.reset(rng=RNG(0), x0={"theta": 1.0})
        assert np.array_equal([plant.step(np.array([0.3])) for _ in range(40)], rolled)
    assert np.abs(rolled - reference).max() < error


def test_the_fixed_step_converges_with_order_four():
    reference = swing(cart_pole_ode(substeps=200))
    errors = [np.abs(swing(cart_pole_ode(substeps=n, sample_time=0.01)) - reference).max() for n in (1, 2, 4)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4.0, abs=0.4)
    assert np.log2(errors[1] / errors[2]) == pytest.approx(4.0, abs=0.4)


def test_the_error_follows_the_tolerance():
    reference = swing(cart_pole_ode(substeps=200, sample_time=0.1))
    loose, tight = (
        np.abs(swing(cart_pole_ode(integrator="lsoda", sample_time=0.1, rtol=r, atol=r)) - reference).max()
        for r in (1e-3, 1e-9)
    )
    assert tight < 1e-6 < loose


def test_dense_output_meets_the_samples_and_a_finer_run():
    with pendulum_ode(integrator="dop853", sample_time=0.1, rtol=1e-10, atol=1e-12) as plant:
        plant.reset(rng=RNG(0), x0={"theta": 1.0})
        start = plant.truth()
        plant.step(np.array([0.2]))
        inside = plant.between(np.linspace(0.0, 0.1, 11))
        assert inside[0] == pytest.approx(start)
        assert inside[-1] == pytest.approx(plant.truth(), abs=1e-12)
        with pytest.raises(InputError, match="within"):
            plant.between(np.array([0.2]))
    with pendulum_ode(sample_time=0.01) as fine:
        fine.reset(rng=RNG(0), x0={"theta": 1.0})
        assert fine.rollout_truth(np.full((10, 1), 0.2))[1] == pytest.approx(inside[1:], abs=1e-8)
        with pytest.raises(InputError, match="adaptive"):
            fine.between(np.zeros(1))


def test_a_motion_that_blows_up_is_said():

    model = Ode("burst", x="z", u="u")
    model.rhs = [model.x[0] ** 2 + model.u[0]]  # infinite at t = 1/z(0)
    with OdePlant(model=model, integrator="dop853", initial={"z": 1.0}, sample_time=0.6) as plant:
        plant.reset(rng=RNG(0))
        plant.step(np.zeros(1))
        with pytest.raises(PlantError, match="not finite"):
            plant.step(np.zeros(1))


@pytest.mark.parametrize("options", [{"integrator": "euler"}, {"integrator": "bdf", "substeps": 3}, {"rtol": 0.0}])
def test_options_that_do_not_fit_are_refused(options):
    with pytest.raises(InputError):
        pendulum_ode(**options)


KINDS = {
    "plain": lambda: cart_pole_ode(),
    "noisy": lambda: linear_ode(order=3, process_noise=0.1),
    "late": lambda: pendulum_ode(effects=[("sensor_delay", "theta", {"tau": 0.017})]),
    "adaptive": lambda: pendulum_ode(integrator="lsoda"),
    "dry": lambda: pendulum_ode(effects=[("coulomb_friction", "theta", {"Fc": 0.05})]),
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_pickled_plant_continues_where_it_was(kind):
    with KINDS[kind]() as plant:
        inputs = RNG(0).normal(size=(60, plant.spec.nu))
        plant.reset(rng=RNG(3))
        plant.rollout(inputs[:20])
        twin = pickle.loads(pickle.dumps(plant))
        assert np.array_equal(twin.truth(), plant.truth())
        assert np.array_equal(twin.rollout(inputs[20:]), plant.rollout(inputs[20:]))


def test_a_single_state_is_enough():
    with linear_ode(order=1) as plant:
        a, b, _ = plant.discrete()
        plant.reset(rng=RNG(0))
        assert plant.rollout_truth(np.ones((1, 1)))[1] == pytest.approx(b.T)
        assert 0 < a[0, 0] < 1


def test_the_simulator_behind_a_plant_travels_too():
    with cart_pole_ode() as plant:
        simulator = plant.system.simulator(0.01)
        twin = pickle.loads(pickle.dumps(simulator))
        p, x0, u = plant.system.vector(), np.full(4, 0.1), np.ones((20, 1))
        assert np.array_equal(twin.rollout(p, x0, u), simulator.rollout(p, x0, u))
