"""Adaptive control: errors of tracking vanish whatever is believed, those of parameters under a rich reference."""

import json

import numpy as np
import pytest

from harness.errors import InputError
from harness.physics import load_model, lumped
from harness.rng import Streams
from harness.rollout import perform
from plants.equations.ode_plant import OdePlant
from scenarios.adaptive import AdaptiveControl, _Adaptive


def carried_out(model, outputs, **options):
    plant = OdePlant(model=model, outputs=outputs, sample_time=0.005)
    scenario = AdaptiveControl(mechanism=model, **options)
    streams = Streams("ode", "adaptive-control", seed=0)
    experiment = scenario.prepare(plant.spec, streams=streams, role="estimation/0")
    record = perform(plant, experiment, rng=streams("estimation/0/plant"))
    reference = np.column_stack(list(experiment.controller.references.values()))
    truth = experiment.controller.tracking.law.regression.values(plant.system.values())
    return record.y[:, : reference.shape[1]] - reference, experiment.controller.estimates / truth - 1


PENDULUM = ["theta", ("theta", 1)]


def test_a_set_point_is_reached_with_parameters_eighty_percent_off():
    error, parameters = carried_out(
        "pendulum", PENDULUM, duration=20.0, amplitude=0.0, move={"theta": 1.0}, adaptation=100.0
    )
    assert abs(error[-1, 0]) < 1e-10
    assert np.abs(parameters[0]).max() == pytest.approx(0.8)
    assert np.abs(parameters[-1]).max() > 0.1  # a set point does not tell all parameters


def test_a_rich_reference_tells_the_parameters():
    error, parameters = carried_out(
        "pendulum", PENDULUM, duration=60.0, amplitude=1.0, band=(0.1, 1.0), lines=6, adaptation=100.0
    )
    assert np.abs(parameters[-1]).max() < 0.15
    assert np.std(error[-2000:]) < 0.1 * np.std(error[:1000])


def test_an_identifier_in_the_loop_learns_faster():
    error, parameters = carried_out(
        "pendulum", PENDULUM, duration=10.0, amplitude=1.0, band=(0.1, 1.0), lines=6, method="identifier"
    )
    assert np.abs(parameters[-1]).max() < 1e-3
    assert np.abs(error[-500:]).max() < 0.01


@pytest.mark.parametrize("rates", [False, True])
def test_an_identifier_learns_a_double_pendulum_from_a_fifth_of_six_parameters(rates):
    names = ["theta1", "theta2"]
    error, parameters = carried_out(
        "double-pendulum", [*names, *((n, 1) for n in names if rates)], duration=12.0, amplitude=1.0, band=(0.1, 1.0),
        lines=6, method="identifier",
    )  # fmt: skip
    assert np.abs(parameters[0]).max() > 0.8
    assert np.abs(parameters[-1]).max() < 0.02
    assert np.abs(error[-500:]).max() < 0.02


def test_the_law_gives_the_acceleration_that_is_asked_for_where_masses_are_known():
    system = load_model("double-pendulum")
    law = _Adaptive(AdaptiveControl(mechanism="double-pendulum", believed=1.0), OdePlant(model="double-pendulum").spec)
    q, v, a = np.array([0.3, -0.7]), np.array([0.5, 1.2]), np.array([2.0, -3.0])
    torque = law._torque(law._rows(q, v, a))
    rate = system.simulator(0.01).functions.derivative(np.r_[q, v], torque, system.vector(), 0.0).full().ravel()
    np.testing.assert_allclose(rate[2:], a, atol=1e-9)


def test_two_coupled_joints_reach_their_set_point():
    names = ["theta1", "theta2"]
    error, _ = carried_out(
        "double-pendulum", [*names, *((n, 1) for n in names)], duration=12.0, amplitude=0.0, adaptation=1000.0,
        move=dict.fromkeys(names, 0.7),
    )  # fmt: skip
    assert np.abs(error[-1]).max() < 1e-4
    assert np.abs(error[-1]).max() < 0.02 * np.abs(error).max()


def test_the_bilinear_form_is_linear_in_the_virtual_rate_and_agrees_with_the_regressor():
    spec = OdePlant(model="double-pendulum", sample_time=0.01).spec
    law = _Adaptive(AdaptiveControl(mechanism="double-pendulum"), spec)
    rng = np.random.default_rng(0)
    q, v, one, two, a = rng.normal(size=(5, 2))
    same = law._bilinear(q, v, v, a) - law._rows(q, v, a)
    np.testing.assert_allclose(same, 0.0, atol=1e-12)
    rest = law._bilinear(q, v, 0 * v, 0 * a)
    parts = law._bilinear(q, v, one, 0 * a) + law._bilinear(q, v, two, 0 * a) - 2 * rest
    np.testing.assert_allclose(law._bilinear(q, v, one + two, 0 * a) - rest, parts, atol=1e-12)


def test_the_rate_of_the_mass_matrix_is_twice_coriolis_but_for_a_skew_part():
    # what makes adaptation stable: s'(M' - 2 C)s = 0 with the polarised (Christoffel) form
    law = _Adaptive(AdaptiveControl(mechanism="double-pendulum"), OdePlant(model="double-pendulum").spec)
    model = lumped(load_model("double-pendulum").mechanism, known={"m1": 1.0, "m2": 1.0, "l1": 1.0})
    theta = np.append(law.theta * (np.array([not name.startswith("b") for name in law.regression.names])), 1.0)
    assert law.regression.names == model.names
    rng = np.random.default_rng(1)
    q, v, s = rng.normal(size=(3, 2))
    zero, step = np.zeros(2), 1e-6

    def mass(at):
        weight = law._rows(at, zero, zero) @ theta
        return np.column_stack([law._rows(at, zero, unit) @ theta - weight for unit in np.eye(2)])

    rate = (mass(q + step * v) - mass(q - step * v)) / (2 * step)
    coriolis = law._bilinear(q, v, s, zero) @ theta - law._bilinear(q, v, zero, zero) @ theta
    assert s @ rate @ s == pytest.approx(2 * s @ coriolis, rel=1e-6)


def test_what_does_not_fit_is_refused():
    plant = OdePlant(model="cart-pole", outputs=["x", "theta"], sample_time=0.01)
    with pytest.raises(InputError):
        AdaptiveControl(mechanism="cart-pole").prepare(plant.spec, streams=Streams("a", "b", seed=0), role="r")
    pendulum = OdePlant(model="pendulum", sample_time=0.01)
    for options, words in (
        ({"mechanism": "cart-pole"}, "each with a motor"),
        ({"move": {"elbow": 1.0}}, "option move"),
        ({"method": "guess"}, "option of adaptive-control"),
        ({"method": "identifier", "identifier": "no-such"}, "option identifier"),
    ):
        with pytest.raises(InputError, match=words):
            AdaptiveControl(**options).prepare(pendulum.spec, streams=Streams("a", "b", seed=0), role="r")


def test_a_command_tells_what_was_tracked_and_what_was_learned(tmp_path, sysid):
    given = 'scenario={duration=6, amplitude=1.0, band=[0.1, 1.0], lines=4, method="identifier"}'
    asked = ["analyse", "adaptive-tracking", "pendulum-ode", "-P", "sample_time=0.02", "-O", given, "--json"]
    found = json.loads(sysid(*asked, "-o", tmp_path / "learned.svg").out)
    assert found["parameters off"][0] == pytest.approx(0.8)
    assert found["parameters off"][1] < 0.02
    assert max(found["rms"]) < 0.05
    assert {row["lumped parameter"]: row["true"] for row in found["rows"]} == {"mgl": 1.0, "J": 0.1, "b": 0.05}
    assert (tmp_path / "learned.svg").stat().st_size > 5000
