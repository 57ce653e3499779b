"""ODE plants: steps and batches alike, snapshots, hidden effects, noise, the golden records."""

from __future__ import annotations

import numpy as np
import pytest

from harness.errors import InputError, PlantError
from plants.equations.ode import OdePlant, cart_pole_ode, linear_ode, pendulum_ode

RNG = np.random.default_rng


def push(plant, count, seed=0):
    return RNG(seed).normal(size=(count, plant.spec.nu)) * 0.5


def test_without_a_compiler_the_bits_are_the_same(monkeypatch):
    def run():
        with cart_pole_ode() as plant:
            plant.reset(rng=RNG(0), x0={"theta": 0.4})
            return plant.rollout(push(plant, 50))

    compiled = run()
    monkeypatch.setenv("SYSID_HARNESS_NO_COMPILER", "1")
    assert np.array_equal(run(), compiled)


def test_a_hidden_effect_acts_and_the_nominal_model_stays_clean():
    dry = pendulum_ode(parameters={"b": 0.0}, effects=[("coulomb_friction", "theta", {"Fc": 0.02, "w": 0.01})])
    free = pendulum_ode(parameters={"b": 0.0})
    swings = []
    for plant in (dry, free):
        plant.reset(rng=RNG(0), x0={"theta": 0.5})
        y = plant.rollout(np.zeros((1000, 1)))[:, 0]
        swings.append(np.abs(y[-200:]).max())
    assert swings[1] == pytest.approx(0.5, rel=1e-3)
    assert swings[0] < 0.25
    assert dry.true_parameters["coulomb_friction@theta.Fc"] == 0.02
    assert dry.nominal.parameter_names == ("J", "b", "mgl")


def test_process_noise_depends_on_the_stream_only():
    with cart_pole_ode(process_noise=1.0) as plant:
        found = []
        for seed in (0, 0, 1):
            plant.reset(rng=RNG(seed))
            found.append(plant.rollout(np.zeros((100, 1))))
    assert np.array_equal(found[0], found[1])
    assert not np.array_equal(found[0], found[2])


@pytest.mark.parametrize("seed", range(5))
def test_a_linear_plant_is_its_matrices_and_is_stable(seed):
    plant = linear_ode(order=4, inputs=2, outputs=2, seed=seed)
    a, b, c = plant.discrete()
    assert np.abs(np.linalg.eigvals(a)).max() < 1
    reach = np.hstack([np.linalg.matrix_power(a, k) @ b for k in range(4)])
    see = np.vstack([c @ np.linalg.matrix_power(a, k) for k in range(4)])
    assert np.linalg.matrix_rank(reach) == np.linalg.matrix_rank(see) == 4
    inputs = push(plant, 60, seed)
    plant.reset(rng=RNG(0))
    outputs = plant.rollout(inputs)
    x = np.zeros(4)
    for u, y in zip(inputs, outputs, strict=True):
        x = a @ x + b @ u
        assert c @ x == pytest.approx(y, abs=1e-12)


def test_feedthrough_is_declared_and_answers_at_once():
    plant = pendulum_ode(outputs=[("theta", 2, "acceleration")])
    assert plant.spec.feedthrough
    assert "feedthrough" in plant.abilities
    plant.reset(rng=RNG(0))
    assert plant.output(np.array([0.2])) == pytest.approx([2.0])
    assert plant.truth().tolist() == [0.0, 0.0]


def _many(plant, count):
    for _ in range(count):
        plant.step(np.zeros(1))


def test_a_motion_that_diverges_is_said():
    from harness.physics import models

    m = models.oscillator()
    m.parameters(c=("N s/m", -500.0, -np.inf), k=("N/m", 1.0), m=("kg", 1.0))
    with OdePlant(model=m, initial={"q": 1.0}, substeps=1) as plant:
        plant.reset(rng=RNG(0))
        assert np.isnan(plant.rollout(np.zeros((500, 1)))[-1, 0])
        plant.reset(rng=RNG(0))
        with pytest.raises(PlantError, match="not finite") as caught:
            _many(plant, 500)
        assert caught.value.status == "diverged"


@pytest.mark.parametrize(
    "options",
    [
        {"model": "pendolum"},
        {"model": 3},
        {"parameters": {"mass": 1.0}},
        {"initial": {"angle": 1.0}},
        {"sample_time": 0.0},
        {"substeps": 0},
        {"process_noise": -1.0},
        {"effects": [("coulomb", "theta", {"Fc": 0.1})]},
        {"effects": [("coulomb_friction", "y", {"Fc": 0.1})]},
        {"effects": [("coulomb_friction", "theta")]},
        {"outputs": ["phi"]},
    ],
)
def test_options_that_cannot_be_are_refused(options):
    with pytest.raises(InputError):
        OdePlant(**options)
    with pytest.raises(InputError):
        pendulum_ode(length=3.0)


# Another processor or mathematical library may round sin and cos otherwise in the last bit.
