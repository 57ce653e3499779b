"""An arm is a mechanism: in symbols where it is small, generated code where it is large; the same forms of both."""

import importlib.util

import numpy as np
import pytest

from harness.errors import InputError
from harness.models.estimate import estimate_of
from harness.physics import Mechanism, load_model, lumped
from harness.physics.arms.mechanism import arm_mechanism
from harness.physics.symbolic.lumping import split
from harness.signals import PlantSpec, Trajectory
from identifiers.mechanics.lumped import lumped_momentum

CART_POLE = """<robot name="cart-pole">
  <link name="rail"/>
  <link name="cart"><inertial><mass value="1.2"/><inertia ixx="1" iyy="1" izz="1"/></inertial></link>
  <link name="pole"><inertial><origin xyz="0 0 -0.4"/><mass value="0.3"/>
    <inertia ixx="0.01" iyy="0.012" izz="0.002"/></inertial></link>
  <joint name="slider" type="prismatic"><axis xyz="1 0 0"/><parent link="rail"/><child link="cart"/>
    <limit lower="-2" upper="2" effort="50" velocity="5"/></joint>
  <joint name="hinge" type="continuous"><axis xyz="0 1 0"/><parent link="cart"/><child link="pole"/>
    <dynamics damping="0.02"/></joint>
  {more}
</robot>"""
TRANSMISSION = '<transmission name="drive"><joint name="slider"/></transmission>'


@pytest.fixture
def cart_pole(tmp_path):
    path = tmp_path / "cart-pole.urdf"
    path.write_text(CART_POLE.format(more=TRANSMISSION))
    return str(path)


def models(path):
    yield arm_mechanism(path)
    if importlib.util.find_spec("pybullet_data"):
        yield arm_mechanism("iiwa")


def test_the_urdf_of_a_cart_pole_gives_lumps_in_symbols(cart_pole):
    mechanism = arm_mechanism(cart_pole)
    assert isinstance(mechanism, Mechanism)
    assert mechanism.symbolic
    names = lumped(mechanism).names
    assert set(names) == {"m1 + m2", "Iyy2", "hx2", "hz2", "damping1", "friction1", "damping2", "friction2"}
    assert str(load_model(cart_pole)) == "cart-pole: tau1 [N] -> q1 [m], q2 [rad]"


def test_a_joint_without_transmission_or_named_passive_has_no_motor(cart_pole, tmp_path):
    both = tmp_path / "both.urdf"
    both.write_text(CART_POLE.format(more=""))
    assert [c.name for c in load_model(str(both)).inputs] == ["tau1", "tau2"]
    assert [c.name for c in load_model(str(both), passive=["slider"]).inputs] == ["tau2"]
    with pytest.raises(InputError, match="passive joint"):
        load_model(str(both), passive=["elbow"])


def test_the_iiwa_has_43_base_parameters_and_is_not_written_out():
    pytest.importorskip("pybullet_data")
    mechanism = arm_mechanism("iiwa")
    assert len(lumped(mechanism).names) == 43 + 7 + 7  # base parameters, damping, dry friction
    with pytest.raises(InputError, match="generated code"):
        split(mechanism)


def test_regressor_times_lumps_is_the_inverse_dynamics(cart_pole):
    rng = np.random.default_rng(0)
    for mechanism in models(cart_pole):
        n = len(mechanism.q)
        q, v, a = rng.normal(size=(3, 40, n))
        u = rng.normal(size=(40, len(mechanism.u)))
        model, system = lumped(mechanism), mechanism.system()
        rest = model.regressor(q, v, a, u) @ model.values(system.values()) - model.target(q, v, a, u)
        push = np.zeros((40, n))
        push[:, : u.shape[1]] = u
        expected = mechanism.arm.torques(q, v, a) + mechanism.arm.damped(v) - push
        np.testing.assert_allclose(rest.reshape(40, n), expected, atol=1e-10 * np.abs(expected).max())
        x = np.concatenate([q[0], v[0]])
        found = system.simulator(0.01, backend="casadi").derivative(x, u[0], system.vector())[n:]
        torque = mechanism.arm.torques(q[:1], v[:1], found[None]) + mechanism.arm.damped(v[:1])
        np.testing.assert_allclose(torque[0], push[0], atol=1e-9)


def test_energy_and_momentum_balance_along_a_motion(cart_pole):
    for mechanism in models(cart_pole):
        n, system, model = len(mechanism.q), mechanism.system(), lumped(mechanism)
        t = np.arange(300) * 1e-3
        u = 3 * np.sin(2 * t[:, None] * np.arange(1, len(mechanism.u) + 1))
        x = system.simulator(1e-3, backend="casadi").states(system.vector(), np.full(2 * n, 0.1), u)
        values = model.values(system.values())
        for form in (model.energy_rows, model.momentum_rows):
            rows, target = form(t, x[:, :n], x[:, n:], u)
            assert np.abs(rows @ values - target).max() < 2e-3 * np.abs(target).max()


def test_known_parameters_move_to_the_known_side_in_both_kinds(cart_pole):
    rng = np.random.default_rng(1)
    for mechanism in models(cart_pole):
        n, values = len(mechanism.q), mechanism.system().values()
        known = {name: values[name] for name in ("damping1", "friction2", "m2", "Iyy2")}
        q, v, a = rng.normal(size=(3, 20, n))
        plain, fewer = lumped(mechanism), lumped(mechanism, known=known)
        assert len(fewer.names) < len(plain.names)
        for model in (plain, fewer):
            rest = model.regressor(q, v, a) @ model.values(values) - model.target(q, v, a)
            expected = mechanism.arm.torques(q, v, a) + mechanism.arm.damped(v)
            np.testing.assert_allclose(rest.reshape(20, n), expected, atol=1e-10 * np.abs(expected).max())


def test_identifiers_of_mechanisms_take_a_urdf(cart_pole):
    system = load_model(cart_pole)
    rng = np.random.default_rng(2)
    u = np.repeat(rng.normal(scale=4.0, size=(80, 1)), 25, axis=0)
    y = system.simulator(0.005, backend="casadi").rollout(system.vector(), [0.0, 0.3, 0.0, 0.0], u)
    record = Trajectory(np.arange(len(u)) * 0.005, u, y, PlantSpec(system.inputs, system.outputs, 0.005))
    model = lumped_momentum(model=cart_pole, known={"friction1": 0.0, "friction2": 0.0}).fit([record], rng=rng)
    found = lumped(arm_mechanism(cart_pole), known={"friction1": 0.0, "friction2": 0.0})
    true = dict(zip(found.names, found.values(system.values()), strict=True))
    fitted = dict(zip(found.names, found.values(model.parameters), strict=True))
    for name in ("m1 + m2", "Iyy2", "hz2", "damping2"):
        assert fitted[name] == pytest.approx(true[name], rel=0.02), name
    record_of_it = estimate_of(model)
    assert not record_of_it.rank.full  # m1 and m2 show their sum only
    assert {"m1", "m2"} <= set(record_of_it.rank.undetermined)
