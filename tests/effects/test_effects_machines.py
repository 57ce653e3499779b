"""Laws of gears, drives, springs over levers, bases and temperatures: what they compute, and where they fit."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.effects import Placed, WrappedPlant, builtin, compose, effect, obstacle, place_all
from harness.effects.along import Signals
from harness.effects.columns import column_blocks
from harness.errors import InputError
from harness.physics import load_model
from harness.physics.models import pendulum
from harness.physics.symbolic.mechanism import Mechanism
from harness.physics.symbolic.typed import read_equations

GEAR, RIPPLE, SPRING, BASE = (
    builtin()[name] for name in ("gear_loss", "torque_ripple", "counterbalance", "wobbling_base")
)

SERVO = """input T [N m]
state q [rad], w [rad/s]
motion q: w, J
J = 0.02 kg m^2 >= 0
b = 0 N m s/rad >= 0
q' = w
w' = (T - b*w)/J
"""


def gear(f: float, v: float, c: float = 0.1, r: float = 1.0) -> float:
    return float(GEAR.function(f, None, SimpleNamespace(c=c, r=r, w=1e-6), 0.0, v))


@given(f=st.floats(-50, 50), v=st.floats(0.1, 5), c=st.floats(0.0, 0.5), r=st.floats(0.0, 3.0))
def test_a_gear_brakes_by_its_share_of_what_it_passes_on(f: float, v: float, c: float, r: float) -> None:
    driven = c if f > 0 else c * r
    assert gear(f, v, c, r) == pytest.approx(-driven * abs(f), abs=1e-9)
    assert gear(-f, -v, c, r) == pytest.approx(-gear(f, v, c, r), abs=1e-9), "either way round"


def test_efficiencies_are_what_the_formula_says() -> None:
    """Forwards a part 1 - c of the motor's force arrives; backwards the load has to give 1 + c r times the motor's."""
    assert 2.0 + gear(2.0, 1.0, c=0.2) == pytest.approx(2.0 * (1 - 0.2))
    assert abs(-2.0 + gear(-2.0, 1.0, c=0.2, r=1.5)) == pytest.approx(2.0 * (1 + 0.2 * 1.5))


@given(
    k=st.floats(10, 1e4),
    free=st.floats(0.01, 0.2),
    arm=st.floats(0.02, 0.1),
    anchor=st.floats(0.12, 0.4),
    alpha=st.floats(-3, 3),
)
def test_a_counterbalance_is_a_spring_less_what_gravity_takes_up(
    k: float, free: float, arm: float, anchor: float, alpha: float
) -> None:
    """The torque of a spring by its energy, less the law, is a sine and a cosine of the angle, whatever the spring."""
    q = np.linspace(-3, 3, 25)

    def energy(angle: np.ndarray) -> np.ndarray:
        length = np.sqrt(arm**2 + anchor**2 - 2 * arm * anchor * np.cos(angle - alpha))
        return 0.5 * k * (length - free) ** 2

    torque = -(energy(q + 1e-6) - energy(q - 1e-6)) / 2e-6
    far = math.hypot(arm, anchor)
    rho = 2 * arm * anchor / far**2
    p = SimpleNamespace(A=k * free * arm * anchor / far * rho / 4, alpha=alpha, rho=rho, E=0.0)
    left = torque - SPRING.function(0.0, None, p, q, 0.0)
    turning = np.column_stack([np.sin(q), np.cos(q)])
    rest = left - turning @ np.linalg.lstsq(turning, left, rcond=None)[0]
    assert np.abs(rest).max() < 1e-5 * max(1.0, float(np.abs(torque).max()))


def test_an_anchor_on_the_other_side_is_the_same_law_with_a_negative_ratio() -> None:
    q = np.linspace(-3, 3, 25)
    above = SPRING.function(0.0, None, SimpleNamespace(A=0.3, alpha=0.4 + math.pi, rho=0.7, E=0.1), q, 0.0)
    below = SPRING.function(0.0, None, SimpleNamespace(A=0.3, alpha=0.4, rho=-0.7, E=0.1), q, 0.0)
    assert above == pytest.approx(below)
    flat = SPRING.function(0.0, None, SimpleNamespace(A=0.3, alpha=0.4, rho=0.0, E=0.0), q, 0.0)
    assert flat == pytest.approx(0.3 * np.sin(2 * (q - 0.4)))


def test_a_base_that_wobbles_moves_as_two_bodies_do() -> None:
    """Against the equations of a link on a sliding frame, written out."""
    m, length, frame, k, d, torque = 1.0, 0.3, 6.0, 4000.0, 8.0, 0.7
    inertia, ml, whole = m * length**2, m * length, frame + m
    mu, omega = ml**2 / whole, math.sqrt(k / whole)
    zeta = d / (2 * omega * whole)
    system = compose(pendulum().system(), [Placed(BASE, "theta", {"mu": mu, "omega": omega, "zeta": zeta})])
    values = {"J": inertia, "b": 0.0, "mgl": ml * 9.81}
    q, v, x, w = 0.6, 1.3, 0.004, -0.05
    # state of the law: z = m l x, y = m l x' + mu cos(q) v
    state = np.array([q, v, ml * x, ml * w + mu * math.cos(q) * v])
    import casadi as ca

    slope = ca.Function("f", [system.x, system.u, system.p, system.t], [system.f])
    found = np.asarray(slope(state, [torque], system.vector(values), 0.0)).ravel()
    matrix = np.array([[inertia, ml * math.cos(q)], [ml * math.cos(q), whole]])
    right = [torque - ml * 9.81 * math.sin(q), ml * math.sin(q) * v**2 - k * x - d * w]
    a, base = np.linalg.solve(matrix, right)
    assert found[1] == pytest.approx(a)
    assert found[2] == pytest.approx(ml * w)
    assert found[3] == pytest.approx(ml * base + mu * (math.cos(q) * a - math.sin(q) * v**2))


def test_they_are_tried_where_they_make_sense() -> None:
    def there(system: object) -> set[str]:
        return {str(placed) for placed in place_all(system)}  # type: ignore[arg-type]

    single, cart = there(load_model("pendulum")), there(load_model("cart-pole"))
    assert {"gear_loss@theta", "torque_ripple@theta", "wobbling_base@theta", "counterbalance@theta"} <= single
    assert {"gear_loss@x", "torque_ripple@x"} <= cart
    assert not {name for name in cart if name.startswith(("gear", "torque")) and name.endswith("theta")}
    assert not {name for name in cart if name.startswith("wobbling")}, "the pole moves as well"
    assert not {name for name in single | cart if name.startswith("thermal")}, "no temperature is measured"
    level = load_model("oscillator")
    assert not {name for name in there(level) if name.startswith(("counterbalance", "wobbling"))}
    two = load_model("double-pendulum")
    port = next(port for port in two.ports if port.kind == "coordinate")
    assert obstacle(two, BASE, port) == "other coordinates move with it"


def test_a_load_beside_the_axis_is_one_law_where_the_model_knows_no_force_at_rest() -> None:
    """With gravity or a spring of its own the model has a part of that law, and `eccentric_load` is the other."""
    servo = read_equations(SERVO, "servo").system()
    held = read_equations(SERVO.replace("- b*w)", "- b*w - k*q)") + "k = 1 N m/rad >= 0\n", "held").system()
    assert "unbalanced_load@q" in {str(placed) for placed in place_all(servo)}
    for other in (held, load_model("pendulum"), load_model("cart-pole")):
        assert not {str(placed) for placed in place_all(other) if placed.effect.name == "unbalanced_load"}
    law = Placed(builtin()["unbalanced_load"], "q")
    loaded = compose(servo, [law]).with_parameters({"unbalanced_load@q.A": 0.6, "unbalanced_load@q.phi": 0.2})
    rate = loaded.simulator(0.01, backend="casadi").functions.derivative([0.5, 0.0], [0.0], loaded.vector(), 0.0)
    assert float(rate[1]) == pytest.approx(-0.6 * math.sin(0.7) / 0.02)


@pytest.mark.parametrize(("unit", "reading"), [("K", 313.15), ("degC", 40.0)])
def test_a_temperature_is_an_input_in_kelvin_or_degrees(unit: str, reading: float) -> None:
    m = Mechanism("warm", q="theta", u="u T", p="J", units={"u": "N m", "T": unit})
    m.body(m.p[0], (0, 0), 1, m.q[0])
    m.T, m.Q = m.p[0] * m.v[0] ** 2 / 2, [m.u[0]]
    m.parameters(J=("kg m^2", 1.0))
    system = m.system()
    names = {str(placed) for placed in place_all(system) if placed.effect.name.startswith("thermal")}
    assert names == {"thermal_damping@theta", "thermal_friction@theta", "thermal_gain@u"}
    warm = compose(system, [Placed(builtin()["thermal_gain"], "u", {"g": -0.01}),
                            Placed(builtin()["thermal_damping"], "theta", {"d": 0.02})])  # fmt: skip
    import casadi as ca

    slope = ca.Function("f", [warm.x, warm.u, warm.p], [warm.f])
    # over the inertia of mass 1 at the axis, and its own: 20 K above T0
    rest = float(slope([0.0, 0.0], [1.0, reading], warm.vector())[1])
    moving = float(slope([0.0, 1.0], [1.0, reading], warm.vector())[1])
    assert moving / rest == pytest.approx((1 - 0.2 - 0.4) / (1 - 0.2))


def test_what_is_known_inside_alone_is_refused_around_a_plant() -> None:
    from harness import registry

    with registry.create("plants", "pendulum-ode") as plant, pytest.raises(InputError, match="does not fit"):
        WrappedPlant(plant, [("thermal_gain", "u", {"g": 0.01})])


def test_needs_are_named_from_a_list() -> None:
    with pytest.raises(InputError, match="needs of an effect"):
        effect("coordinate", {"b": "F/v"}, needs=("wings",))


@pytest.mark.parametrize("law", ["gear_loss", "torque_ripple", "counterbalance", "coulomb_friction", "input_gain"])
def test_a_column_is_what_the_law_adds_at_one_less_at_nothing(law: str) -> None:
    """Where a law is not there at nothing its force is not asked for: the columns stay what they are."""
    system = load_model("pendulum")
    t = np.arange(60) * 0.02
    q = np.sin(3 * t)[:, None]
    v, a = 3 * np.cos(3 * t)[:, None], -9 * np.sin(3 * t)[:, None]
    signals = Signals(t, 0.5 + np.sin(2 * t)[:, None], q, v, a)
    placed = next(one for one in place_all(system, [builtin()[law]]))
    from harness.effects.claimed import ClaimedForce
    from harness.effects.columns import motion_sizes

    sizes = motion_sizes(system, signals)
    claimed = ClaimedForce(system, placed, sizes[placed.at])
    for block in column_blocks(system, placed, signals)[:3]:
        nothing = {**block.given, **dict.fromkeys(block.names, 0.0)}
        for number, name in enumerate(block.names):
            whole = claimed(signals, {**nothing, name: 1.0}) - claimed(signals, nothing)
            assert block.columns[..., number] == pytest.approx(whole, abs=1e-12)


@given(above=st.floats(0.0, 600.0), area=st.floats(1e-3, 1.0), capacity=st.floats(10.0, 1e4))
def test_a_wall_radiates_by_the_law_of_stefan_and_boltzmann(above: float, area: float, capacity: float) -> None:
    sigma, ambient = 5.670374e-8, 293.0
    first = 4.0 * sigma * area * ambient**3 / capacity
    rate = builtin()["radiation"].function(0.0, None, SimpleNamespace(h=first, T0=ambient), above, None)
    assert rate == pytest.approx(-sigma * area * ((ambient + above) ** 4 - ambient**4) / capacity, rel=1e-9, abs=1e-15)


def test_temperatures_radiate_and_levels_do_not() -> None:
    text = "input P [{0}]\nlevel x [{1}]\nC = 800 {0} s/{1} >= 0\nx' = P/C\n"
    hot, full = (read_equations(text.format(*units), "one").system() for units in (("W", "K"), ("l/s", "m")))
    assert "radiation@x" in {str(placed) for placed in place_all(hot)}
    assert "radiation@x" not in {str(placed) for placed in place_all(full)}
