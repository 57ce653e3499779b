"""Effects around any plant: the same as inside where they can be, refused where they cannot."""

from __future__ import annotations

import numpy as np
import pytest

from harness.effects import Placed, WrappedPlant, builtin, compose
from harness.errors import InputError
from harness.physics.models import cart_pole, pendulum
from harness.signals import Channel, PlantSpec

DT = 0.01
RNG = np.random.default_rng(0)


class Simulated:
    """A plant around a simulator, with snapshots and its true states."""

    def __init__(self, system, substeps=4):
        self.simulator = system.simulator(DT, backend="casadi", substeps=substeps)
        self.p, self.spec, self.x = system.vector(), self.simulator.spec, np.zeros(system.nx)
        self.abilities = frozenset({"snapshots", "truth", "batch"})

    def reset(self, *, rng, x0=None):
        names = [state.name for state in self.spec.states]
        self.x = np.zeros(len(names))
        for name, value in (x0 or {}).items():
            self.x[names.index(name)] = value
        return self.simulator.output(self.x, np.zeros(self.spec.nu), self.p)

    def step(self, u):
        self.x = self.simulator.step(self.x, u, self.p)
        return self.simulator.output(self.x, u, self.p)

    def truth(self):
        return self.x

    def get_state(self):
        return self.x.copy()

    def set_state(self, state):
        self.x = state.copy()

    def close(self):
        self.closed = True


def drive(plant, u, x0=None):
    y = [plant.reset(rng=RNG, x0=x0)]
    y += [plant.step(one) for one in u[:-1]]
    return np.array(y)


U = (np.sin(np.arange(400) * 0.05) + 0.5 * np.sin(np.arange(400) * 0.17))[:, None]


@pytest.mark.parametrize(
    ("name", "at", "values", "tolerance"),
    [
        ("input_delay", "u", {"tau": 0.034}, 5e-4),  # its mean over a sample goes in
        ("dead_zone", "u", {"width": 0.3}, 1e-12),
        ("saturation", "u", {"limit": 0.6}, 1e-12),
        ("input_gain", "u", {"gain": 0.7}, 1e-12),
        ("sensor_delay", "theta", {"tau": 0.025}, 5e-4),  # before the start: held here, continued in a fit
        ("sensor_offset", "theta", {"offset": 0.1}, 1e-12),
        ("sensor_gain", "theta", {"gain": 1.1}, 1e-12),
        ("sensor_cyclic_error", "theta", {"A": 0.02, "k": 2.0, "phi": 1.0}, 1e-12),
        ("sensor_nonlinearity", "theta", {"b": 0.1}, 1e-12),
        ("input_compression", "u", {"c": 0.1}, 1e-12),
        ("maxwell_element", "theta", {"k": 0.5, "tau": 0.2}, 0.02),
        ("drifting_damping", "theta", {"d": -0.3, "T": 4.0}, 0.02),
        ("sensor_drift", "theta", {"d": 0.2, "T": 4.0}, 1e-12),
        ("drifting_gain", "u", {"g": -0.3, "T": 4.0}, 2e-3),  # its change within a sample
        ("position_dependent_damping", "theta", {"c1": 0.1, "c2": 0.2}, 0.02),
        ("sensor_quantisation", "theta", {"step": 0.01}, 1e-12),
        ("sensor_rectification", "theta", {}, 1e-12),
        ("sensor_saturation", "theta", {"limit": 0.2}, 1e-12),
        ("actuator_lag", "u", {"tau": 0.05}, 5e-4),  # the lag's mean over a sample goes in
        ("rate_limit", "u", {"R": 2.0, "tau": 0.01}, 2e-4),
        ("force_bias", "theta", {"F0": 0.1}, 1e-12),
        ("periodic_disturbance", "theta", {"A": 0.2, "omega": 5.0}, 1e-4),
        ("coulomb_friction", "theta", {"Fc": 0.1, "w": 0.1}, 0.02),  # held over a sample
        ("cubic_spring", "theta", {"k3": 0.2}, 0.02),
        ("elasticity", "theta", {"k": 20.0, "Jm": 0.02, "d": 0.1}, 0.05),
    ],
)
def test_around_a_plant_is_as_good_as_inside(name, at, values, tolerance):
    system = pendulum().system()
    outside = drive(WrappedPlant(Simulated(system), [(name, at, values)]), U)
    composed = compose(system, [Placed(builtin()[name], at, values)], sizes={"": {"dt": DT}})
    simulator = composed.simulator(DT, backend="casadi", substeps=4)
    inside = simulator.rollout(composed.vector(), np.zeros(composed.nx), U)
    nominal = system.simulator(DT, backend="casadi", substeps=4).rollout(system.vector(), np.zeros(2), U)
    assert np.abs(inside - nominal).max() > 10 * np.abs(outside - inside).max()
    assert np.abs(outside - inside).max() <= tolerance


def test_several_effects_act_in_order_and_a_snapshot_repeats_bit_for_bit():
    effects = [
        ("actuator_lag", "u", {"tau": 0.03}),
        ("input_delay", "u", {"tau": 0.025}),
        ("coulomb_friction", "theta", {"Fc": 0.05}),
        ("sensor_delay", "theta", {"tau": 0.015}),
        ("sensor_quantisation", "theta", {"step": 1e-3}),
    ]
    plant = WrappedPlant(Simulated(pendulum().system()), effects)
    assert plant.abilities == {"snapshots", "truth"}
    drive(plant, U[:100], x0={"theta": 0.5})
    state = plant.get_state()
    first = [plant.step(u) for u in U[100:200]]
    plant.set_state(state)
    again = [plant.step(u) for u in U[100:200]]
    assert np.array_equal(first, again)
    assert np.array_equal(drive(plant, U), drive(plant, U))  # a reset forgets everything
    with plant:
        pass
    assert plant.plant.closed


def test_the_rate_comes_from_differences_where_nobody_tells_it():
    blind = Simulated(pendulum().system())
    blind.abilities = frozenset()
    told = drive(WrappedPlant(Simulated(pendulum().system()), [("viscous_friction", "theta", {"b": 0.05})]), U)
    guessed = drive(WrappedPlant(blind, [("viscous_friction", "theta", {"b": 0.05})]), U)
    assert 0 < np.abs(told - guessed).max() < 0.01


def test_a_third_party_block_with_a_state_filters_an_output():
    from harness.effects import effect

    @effect("output", dict(tau="s"), states="z", initial={"z": "signal"})
    def sensor_lag(y, s, p, q, v):
        return s.z, [(y - s.z) / p.tau]

    system = pendulum().system()
    plant = WrappedPlant(Simulated(system), [(sensor_lag, "theta", {"tau": 0.05})])
    slow = drive(plant, U, x0={"theta": 0.3})
    composed = compose(system, [Placed(sensor_lag, "theta", {"tau": 0.05})])
    simulator = composed.simulator(DT, backend="casadi", substeps=4)
    inside = simulator.rollout(composed.vector(), [0.3, 0.0, 0.3], U)
    assert np.abs(slow - inside).max() < 2e-4


def test_what_cannot_be_reached_from_outside_is_refused_with_what_can():
    pole = Simulated(cart_pole().system())
    WrappedPlant(pole, [("coulomb_friction", "x", {"Fc": 0.1})])
    with pytest.raises(InputError, match="expected one of x, got 'theta'"):
        WrappedPlant(pole, [("coulomb_friction", "theta", {"Fc": 0.1})])
    with pytest.raises(InputError, match="takes effects inside"):
        WrappedPlant(pole, [("gravity_tilt", "base", {"alpha": 0.1})])
    with pytest.raises(InputError, match="takes effects inside"):
        WrappedPlant(pole, [("load_dependent_friction", "x", {"mu": 0.1})])
    with pytest.raises(InputError, match="give width"):
        WrappedPlant(pole, [("dead_zone", "u", {})])
    with pytest.raises(InputError, match="unknown effect"):
        WrappedPlant(pole, [("dead_zones", "u", {})])


def test_joints_find_their_own_motors():
    class Arm(Simulated):
        def __init__(self):
            self.spec = PlantSpec(
                (Channel("tau1", "N m"), Channel("tau2", "N m")),
                (Channel("q1", "rad"), Channel("q2", "rad"), Channel("q1_rate", "rad/s"), Channel("q2_rate", "rad/s")),
                DT,
            )
            self.abilities = frozenset()
            self.seen = []

        def reset(self, *, rng, x0=None):
            return np.array([0.0, 0.0, 1.0, -2.0])

        def step(self, u):
            self.seen.append(u.copy())
            return np.array([0.0, 0.0, 1.0, -2.0])

    arm = Arm()
    plant = WrappedPlant(arm, [("viscous_friction", "q2", {"b": 3.0})])
    plant.reset(rng=RNG)
    plant.step(np.array([1.0, 1.0]))
    assert arm.seen[0].tolist() == [1.0, 7.0]
