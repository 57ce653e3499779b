"""Lagrangian networks: energy balance by construction, the pendulum's inertia and damping found, contract of files."""

from __future__ import annotations

import importlib.util
import json

import numpy as np
import pytest

from harness.errors import FitError
from harness.registry import create
from harness.rng import Streams
from harness.rollout import run
from harness.scoring import simulation_error
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.learned.lagrangian import LagrangianForm, LagrangianModel, LagrangianNetwork
from identifiers.linear.least_squares import Arx

torch_needed = pytest.mark.skipif(
    importlib.util.find_spec("torch") is None, reason="torch is not installed: pip install 'sysid-harness[learned]'"
)


def drawn(n: int, seed: int, damping: float) -> LagrangianModel:
    """Return a model of random energies, inputs on every coordinate."""
    rng, h, m = np.random.default_rng(seed), 6, n * (n + 1) // 2
    names = tuple(f"q{i}" for i in range(n))
    form = LagrangianForm(names, (True,) * n, (1.0,) * n, tuple(range(n)), (0.5,) * n)
    tables = {
        "mass_in": rng.normal(size=(2 * n, h)),
        "mass_bias": rng.normal(size=h),
        "mass_out": 0.1 * rng.normal(size=(h, m)),
        "mass_at": np.array([float(i == j) for i in range(n) for j in range(i + 1)]),
        "well_in": rng.normal(size=(2 * n, h)),
        "well_bias": rng.normal(size=h),
        "well_out": rng.normal(size=(h, 1)),
        "damping": np.full(n, damping),
    }
    inputs = tuple(Channel(f"u{i}", "N m") for i in range(n))
    outputs = tuple(Channel(name, "rad", period=2 * np.pi) for name in names)
    spec = PlantSpec(inputs, outputs, 1e-3)
    return LagrangianModel(spec, form, tables, tuple(range(n)), np.ones(2 * n), np.zeros((2 * n, n)))


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize("damping", [0.0, 0.4])
def test_whatever_is_learned_power_goes_where_it_must(n, damping):
    model, rng = drawn(n, n, damping), np.random.default_rng(5)
    x, u = rng.normal(size=(20, 2 * n)), rng.normal(size=(20, n))
    q, v = x[:, :n], x[:, n:]
    mass, slopes, _, pull = model.form.energies(np, model.tables, q)
    a = model.form.accelerations(np, model.tables, q, v, u)
    kinetic = np.einsum("ki,kij,kj->k", v, mass, a) + 0.5 * np.einsum("ki,kijl,kl,kj->k", v, slopes, v, v)
    power = np.sum(u * v, axis=1) - damping**2 * np.sum(v**2, axis=1)
    assert kinetic + np.sum(pull * v, axis=1) == pytest.approx(power, abs=1e-9)
    ahead = 1e-6 * v
    moved = model.energy(np.hstack([q + ahead, v]))[0] - model.energy(x)[0]
    assert moved == pytest.approx(0.5e-6 * np.einsum("ki,kijl,kl,kj->k", v, slopes, v, v), rel=1e-3, abs=1e-10)
    assert (np.linalg.eigvalsh(model.mass_matrix(x[:, :n])) > 0).all()


def test_a_model_comes_back_from_its_file():
    model = drawn(2, 0, 0.1)
    read = LagrangianModel.from_dict(json.loads(json.dumps(model.to_dict())))
    x, u = np.random.default_rng(0).normal(size=(5, 4)), np.zeros((5, 2))
    assert np.array_equal(read.step(x, u), model.step(x, u))


@torch_needed
def test_it_finds_inertia_and_damping_of_a_pendulum_from_the_angle_alone():
    plant = create("plants", "pendulum-ode", sample_time=0.05)
    scenario = create("scenarios", "multisine", samples=500, amplitude=0.8, band=[0.05, 3.0], noise=0.002)
    streams = Streams("pendulum-ode", "multisine", 0)
    learn, held = (run(plant, scenario, streams=streams, role=f"{role}/0").measured() for role in ("e", "v"))
    options = dict(hidden=8, steps=250, batch=96, rate=2e-2)
    model = LagrangianNetwork(**options).fit([learn], rng=np.random.default_rng(0))
    angles = np.array([[-0.6], [0.0], [0.6]])
    assert model.mass_matrix(angles)[:, 0, 0] == pytest.approx(0.1, rel=0.1)  # kg m^2, which nobody told it
    assert model.tables["damping"] ** 2 == pytest.approx(0.05, rel=0.15)
    potential = model.energy(np.column_stack([angles, 0 * angles]))[1]
    assert potential[0] - potential[1] == pytest.approx(1.0 - np.cos(0.6), rel=0.15)
    arx = Arx(order=3).fit([learn], rng=np.random.default_rng(0))
    assert simulation_error(model, held).nrmse[0] < 0.7 * simulation_error(arx, held).nrmse[0]


def test_inputs_without_a_coordinate_are_refused():
    spec = PlantSpec((Channel("u", "N"),), (Channel("x", "m"), Channel("x_rate", "m/s")), 0.1)
    rng = np.random.default_rng(0)
    data = Trajectory(np.arange(80) * 0.1, rng.normal(size=(80, 1)), rng.normal(size=(80, 2)), spec)
    with pytest.raises(FitError, match="a coordinate among x"):
        LagrangianNetwork(actuated=("y",)).fit([data], rng=rng)
