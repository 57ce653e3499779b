"""Dry friction that grows with the torque in a gear: what it computes, of which forces, and where it is tried."""

from __future__ import annotations

from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from harness.diagnosis.arm.rotor import friction_of_the_load
from harness.effects import Placed, WrappedPlant, builtin, compose, place_all
from harness.effects.places import unforced
from harness.errors import InputError
from harness.physics import load_model
from harness.physics.models import pendulum

GEAR, STRIBECK = builtin()["gear_friction"], builtin()["gear_stribeck_friction"]


def _acceleration(
    law: str, values: dict[str, float], q: float, v: float, u: float, also: tuple[str, ...] = ()
) -> float:
    placed = [*(Placed(builtin()[name], "theta") for name in also), Placed(builtin()[law], "theta", values)]
    system = compose(pendulum().system(), placed)
    nominal = {"J": 0.1, "b": 0.3, "mgl": 2.0} | {f"{name}@theta.b": 0.0 for name in also}
    slope = ca.Function("f", [system.x, system.u, system.p, system.t], [system.f])
    return float(np.asarray(slope([q, v], [u], system.vector(nominal), 0.0)).ravel()[1])


@given(
    q=st.floats(-3, 3),
    v=st.floats(0.2, 5).flatmap(lambda size: st.sampled_from([size, -size])),
    u=st.floats(-5, 5),
    r=st.floats(0, 3),
    mu=st.floats(0, 0.5),
)
def test_the_gear_carries_the_drive_with_its_damping_against_the_load(q, v, u, r, mu):
    """J a = u - b v - mgl sin q - (Fc + mu |u - b v + r mgl sin q|) sgn v, written out."""
    level = 0.2 + mu * abs(u - 0.3 * v + r * 2.0 * np.sin(q))
    expected = (u - 0.3 * v - 2.0 * np.sin(q) - level * np.sign(v)) / 0.1
    found = _acceleration("gear_friction", {"Fc": 0.2, "mu": mu, "r": r, "w": 1e-3}, q, v, u)
    assert found == pytest.approx(expected, abs=1e-9)


def test_what_another_law_brakes_is_no_torque_of_the_drive():
    """A friction that is added does not change what the gear carries, whichever was named first."""
    values = {"Fc": 0.0, "mu": 0.4, "r": 1.0, "w": 1e-3}
    alone = _acceleration("gear_friction", values, 0.5, 2.0, 1.0)
    system = pendulum().system()
    pair = [Placed(GEAR, "theta", values), Placed(builtin()["viscous_friction"], "theta", {"b": 0.7})]
    for placed in (pair, pair[::-1]):
        made = compose(system, placed)
        slope = ca.Function("f", [made.x, made.u, made.p, made.t], [made.f])
        found = np.asarray(slope([0.5, 2.0], [1.0], made.vector({"J": 0.1, "b": 0.3, "mgl": 2.0}), 0.0)).ravel()[1]
        assert found == pytest.approx(alone - 0.7 * 2.0 / 0.1)


@given(v=st.floats(0.01, 10), b=st.floats(0, 1), vs=st.floats(0.1, 5))
def test_near_standstill_it_is_whole_and_at_speed_a_share_is_left(v, b, vs):
    p = SimpleNamespace(Fc=0.3, mu=0.2, r=1.0, w=1e-6, b=b, vs=vs)
    whole = GEAR.function(2.0, None, p, 0.0, v, damping=-0.5, pull=-1.0)
    assert whole == pytest.approx(-(0.3 + 0.2 * 2.5))
    found = STRIBECK.function(2.0, None, p, 0.0, v, damping=-0.5, pull=-1.0)
    assert found == pytest.approx(whole * (b + (1 - b) * np.exp(-((v / vs) ** 2))))


def test_forces_of_the_nominal_model_are_told_apart():
    system = load_model("cart-pole")
    damping, pull = unforced(system, "theta")
    assert not ca.depends_on(pull, system.u)
    assert not ca.depends_on(damping, system.u)
    speeds = ca.vertcat(*(system.x[one.v] for one in system.coordinates))
    assert not ca.depends_on(pull, speeds)
    part = ca.Function("d", [system.x, system.p, system.gravity], [damping])
    assert float(part([0.3, 0.9, 0.0, 0.0], system.vector(None), [0.0, -9.81])) == 0.0
    assert float(part([0.3, 0.9, 1.0, 2.0], system.vector(None), [0.0, -9.81])) != 0.0


def test_it_is_tried_where_something_drives_and_nowhere_from_outside():
    found = {str(placed) for placed in place_all(load_model("cart-pole"))}
    assert "gear_friction@x" in found
    assert "gear_friction@theta" not in found
    from plants.equations.ode_plant import OdePlant

    with pytest.raises(InputError, match="does not fit 'theta' from outside this plant"):
        WrappedPlant(OdePlant(model="pendulum"), [(GEAR, "theta", {"mu": 0.1})])


@given(v=st.floats(-5, 5), b=st.floats(0.1, 2), c=st.floats(-2, 2))
def test_a_damper_brakes_more_one_way_and_never_drives(v, b, c):
    law = builtin()["asymmetric_damping"]
    force = -b * v + law.function(0.0, None, SimpleNamespace(c=c), 0.0, v)
    assert force == pytest.approx(-(b + c) * v if v > 0 else -(b - c) * v)
    q, damping = np.linspace(-1, 1, 5), np.array([b + c, b - c])
    assume(abs(b - 0.95 * abs(c)) > 1e-9)
    assert bool(law.violations_along({"c": c}, q, damping)) == (b < 0.95 * abs(c))


@pytest.mark.parametrize("force", [0.0, 3.0])
def test_a_load_behind_a_spring_is_a_second_mass_that_gravity_pulls(force: float) -> None:
    """J1 a = u - b v - passed, J2 w' = passed - mgl sin q, written out: motor and load meet in the spring."""
    placed = Placed(builtin()["elastic_load"], "theta", {"k": 400.0, "J": 0.2, "d": 0.3})
    system = compose(pendulum().system(), [placed])
    slope = ca.Function("f", [system.x, system.u, system.p, system.t], [system.f])
    q, v, e, w = 0.7, 1.5, 0.004, 1.2
    x = [{"theta": q, "theta_rate": v}.get(one.name, e if one.name.endswith("e") else w) for one in system.states]
    rates = np.asarray(slope(x, [force], system.vector({"J": 0.1, "b": 0.3, "mgl": 2.0}), 0.0)).ravel()
    passed, pull = 400.0 * e + 0.3 * (v - w), -2.0 * np.sin(q)
    wanted = [v, (force - 0.3 * v - passed) / 0.1, v - w, (passed + pull) / 0.2]
    assert rates == pytest.approx(wanted, rel=1e-9)


@given(load=st.floats(-9, 9), mu=st.floats(0, 0.5), r=st.floats(0, 1), v=st.sampled_from([-2.0, 2.0]))
def test_what_a_gear_takes_of_the_load_may_be_either_sides(load: float, mu: float, r: float, v: float) -> None:
    """A share of the load's torque (r = 0), and of the motor's (r near 1), is what the motor has to give besides."""
    assume(abs(load) > 1e-3)
    law = friction_of_the_load(builtin()["load_dependent_friction"], 0.6, told=True)
    sign = np.sign(load * v)
    motor = load * (1 + mu * sign + r * mu**2)
    p = SimpleNamespace(mu=mu, r=r, w=1e-9)
    assert motor + law.function(motor, None, p, 0.0, v) == pytest.approx(load)
    if r == 0:
        assert motor == pytest.approx(load + mu * abs(load) * np.sign(v))
    assert abs(load * (1 + mu * sign + mu**2) - load / (1 - mu * sign)) <= abs(load) * mu**3 / (1 - mu) + 1e-12
