"""A learned residual force: it lowers the validation error of a law without a name, knows its hull, and exports."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from harness.errors import InputError
from harness.export.fmu import export, write_fmu
from harness.physics.fitting.output_error import fit_output_error
from harness.physics.fitting.residual_force import LABEL, Hull, ResidualForce
from harness.physics.fitting.residual_learning import learn_residual_force
from harness.physics.models import pendulum
from harness.registry import create
from harness.rng import Streams
from harness.rollout import run
from harness.signals import PlantSpec, Trajectory

DT = 0.05


def law(theta: float, rate: float) -> float:
    """Return a force that no effect of the dictionary is: friction of a cable that winds up."""
    return -0.12 * np.tanh(4.0 * rate) * (1.0 + 0.6 * np.sin(2.0 * theta))


def record(seed: int, samples: int = 400) -> Trajectory:
    """Return a pendulum that SciPy integrates, with a force that nobody told the model of."""
    system, rng = pendulum().system(), np.random.default_rng(seed)
    p, t = system.values(), np.arange(samples) * DT
    phases = rng.uniform(0, 2 * np.pi, 6)
    u = 0.17 * sum(np.sin(2 * np.pi * f * t + a) for f, a in zip((0.1, 0.23, 0.41, 0.7, 1.1, 1.6), phases, strict=True))
    x, y = np.array([0.3, 0.0]), np.empty((samples, 1))
    for k in range(samples):
        y[k] = x[0]

        def rates(_: float, s: np.ndarray, torque: float = float(u[k])) -> list[float]:
            return [s[1], (torque - p["mgl"] * np.sin(s[0]) - p["b"] * s[1] + law(s[0], s[1])) / p["J"]]

        x = solve_ivp(rates, (0.0, DT), x, rtol=1e-7, atol=1e-8).y[:, -1]
    y += 1e-3 * rng.normal(size=y.shape)
    return Trajectory(t, u[:, None], y, PlantSpec(system.inputs, system.outputs, DT))


@pytest.fixture(scope="module")
def learned():
    system = pendulum().system()
    rng = np.random.default_rng(0)
    return learn_residual_force(
        system,
        system.values(),
        [record(0)],
        [record(1)],
        horizon=2.0,
        sizes=(8, 16),
        arguments=["theta", "theta_rate"],
        rng=rng,
    )


def test_the_validation_error_falls_and_the_force_is_the_hidden_one(learned):
    assert learned.helps
    assert learned.after[0] < 0.4 * learned.before[0]
    assert learned.outside < 0.2
    grid = np.random.default_rng(1).uniform(learned.force.hull.low, learned.force.hull.high, (4000, 2))
    inside = grid[learned.force.hull.contains(1.3 * grid)]  # not at the edge
    true = law(inside[:, 0], inside[:, 1])
    assert np.sqrt(np.mean((learned.force(inside) - true) ** 2)) < 0.5 * np.sqrt(np.mean(true**2))


def test_it_says_that_it_is_not_physical_and_where_it_is_known(learned):
    assert LABEL in str(learned.force)
    assert learned.force.to_dict()["label"] == LABEL
    far = np.array([[50.0, 0.0], [0.0, 500.0]])
    assert not learned.force.hull.contains(far).any()
    assert np.abs(learned.force(far)).max() < 1e-6, "far from the data nothing is added"


def test_it_comes_back_from_its_file_and_is_the_same_force_in_the_equations(learned):
    read = ResidualForce.from_dict(json.loads(json.dumps(learned.force.to_dict())))
    rows = np.random.default_rng(2).normal(size=(20, 2))
    assert np.array_equal(read(rows), learned.force(rows))
    plain, system = pendulum().system(), read.attach(pendulum().system())
    start, u = np.array([0.4, -0.7]), np.zeros((3, 1))
    short = 1e-4
    runs = [s.simulator(short, backend="casadi").rollout(s.vector({}), start, u) for s in (plain, system)]
    moved = [run[1, 0] for run in runs]
    expected = 0.5 * short**2 * read(start[None])[0] / plain.values()["J"]
    assert moved[1] - moved[0] == pytest.approx(expected, rel=0.02)


def test_it_exports_into_the_same_fmu(learned, tmp_path):
    from plants.fmu.plant import FmuPlant

    system = learned.system
    simulator = system.simulator(DT)
    path = write_fmu(simulator, system.values(), tmp_path / "repaired.fmu", x0={"theta": 0.3})
    held = record(1)
    expected = simulator.rollout(system.vector({}), [0.3, 0.0], held.u[:60])
    with FmuPlant(path, sample_time=DT) as plant:
        found = [plant.reset(rng=np.random.default_rng(0))]
        found += [plant.step(u) for u in held.u[:59]]
    assert np.array(found) == pytest.approx(expected, abs=1e-9)


def test_the_stored_model_of_the_loop_keeps_the_force_and_exports(learned, tmp_path):
    from identifiers.mechanics.grey_box import GreyBoxModel
    from identifiers.mechanics.physical import recipe_for

    spec = record(1).spec
    recipe = recipe_for(spec, "test", model="pendulum").with_unnamed([learned.force])
    model = GreyBoxModel(spec, recipe, learned.system.values())
    read = GreyBoxModel.from_dict(json.loads(json.dumps(model.to_dict())))
    assert read.system().values() == learned.system.values()
    stored = tmp_path / "model.json"
    stored.write_text(json.dumps(model.to_dict()), encoding="utf-8")
    (written,) = export(stored, out=tmp_path / "model.fmu", fmi="2")
    assert written.is_file()


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 5), st.integers(0, 1000))
def test_a_hull_holds_its_data_and_nothing_far_away(dimensions, seed):
    rows = np.random.default_rng(seed).normal(size=(60, dimensions)) * 10.0 ** np.arange(-2, dimensions - 2)
    hull = Hull.of(rows)
    assert hull.contains(rows).all()
    assert hull.contains(rows.mean(axis=0)[None]).all()
    assert not hull.contains(rows.mean(axis=0) + 20 * rows.std(axis=0)[None]).any()
    assert hull.convex == (2 <= dimensions <= 4)


def test_the_friction_of_another_engine_is_learned_without_its_name():
    arm = create("plants", "arm-bullet", joint_friction=0.15, sample_time=0.02)  # Bullet's own, in N m
    scenario = create("scenarios", "multisine", duration=12.0, amplitude=2.0, band=[0.05, 2.0], noise=0.001)
    streams = Streams("arm-bullet", "multisine", 0)
    estimation, validation = (run(arm, scenario, streams=streams, role=f"{role}/0").measured() for role in ("e", "v"))
    system = pendulum().system()
    named = fit_output_error(system, [estimation], horizon=1.0).parameters
    options = dict(horizon=1.0, sizes=(12,), arguments=["theta_rate"], rng=np.random.default_rng(0))
    learned = learn_residual_force(system, named, [estimation], [validation], refit=True, **options)
    assert learned.after[0] < 0.5 * learned.before[0]
    rates = np.linspace(0.5, 2.0, 16)[:, None]
    assert learned.force(-rates).mean() == pytest.approx(0.15, rel=0.2)
    assert learned.force(rates).mean() == pytest.approx(-0.15, rel=0.2)


def test_unknown_names_are_refused():
    system, data = pendulum().system(), [record(0, 60)]
    rng = np.random.default_rng(0)
    with pytest.raises(InputError, match="one of theta"):
        learn_residual_force(system, {}, data, data, coordinate="x", rng=rng)
    with pytest.raises(InputError, match="names among theta"):
        learn_residual_force(system, {}, data, data, arguments=["wind"], rng=rng)
    with pytest.raises(InputError, match="validation"):
        learn_residual_force(system, {}, data, [], rng=rng)
