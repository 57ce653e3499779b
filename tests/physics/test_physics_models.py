"""Models: the derived equations against equations written by hand, energy, and how models are found."""

from __future__ import annotations

import pickle
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
import sympy as sp
from hypothesis import given
from hypothesis import strategies as st

from harness.errors import InputError
from harness.physics import Mechanism, Ode, Parameter, equations, load_model, models
from harness.physics.symbolic.convert import to_casadi

G = 9.81
small = st.floats(-3, 3)


def motion(system, x, u, p):
    """Return dx/dt of a system as an array."""
    f = ca.Function("f", [system.x, system.u, system.p, system.t], [system.f])
    return f(x, u, p, 0.0).full()[:, 0]


@given(q=small, v=small, u=small)
def test_pendulum_is_the_equation_written_by_hand(q, v, u):
    J, b, mgl = 0.13, 0.07, 1.9
    rate = motion(models.pendulum().system(), [q, v], [u], [J, b, mgl])
    assert rate == pytest.approx([v, (u - b * v - mgl * np.sin(q)) / J], abs=1e-13)


@given(th=small, xd=small, thd=small, u=small)
def test_cart_pole_is_the_equation_written_by_hand(th, xd, thd, u):
    mc, mp, length, bx, bt = 1.3, 0.4, 0.6, 0.3, 0.02
    rate = motion(models.cart_pole().system(), [0.2, th, xd, thd], [u], [mc, mp, length, bx, bt])
    s, c = np.sin(th), np.cos(th)
    matrix = np.array([[mc + mp, mp * length * c], [mp * length * c, mp * length**2]])
    right = np.array([u - bx * xd + mp * length * s * thd**2, -bt * thd - mp * G * length * s])
    assert rate == pytest.approx([xd, thd, *np.linalg.solve(matrix, right)], abs=1e-11)


@given(q1=small, q2=small, v1=small, v2=small, u=small)
def test_acrobot_is_the_equation_of_the_textbook(q1, q2, v1, v2, u):
    m1, m2, l1, lc1, lc2, I1, I2, b1, b2 = p = (1.1, 0.9, 1.0, 0.5, 1.0, 0.083, 0.33, 0.1, 0.2)
    rate = motion(models.acrobot().system(), [q1, q2, v1, v2], [u], p)
    # Tedrake, Underactuated Robotics, eqs. (3.3) to (3.5); I1, I2 there are about the joints.
    about1, about2 = I1 + m1 * lc1**2, I2 + m2 * lc2**2
    c2, s1, s2, s12 = np.cos(q2), np.sin(q1), np.sin(q2), np.sin(q1 + q2)
    cross = about2 + m2 * l1 * lc2 * c2
    matrix = np.array([[about1 + about2 + m2 * l1**2 + 2 * m2 * l1 * lc2 * c2, cross], [cross, about2]])
    coriolis = m2 * l1 * lc2 * s2 * np.array([-2 * v1 * v2 - v2**2, v1**2])
    gravity = -G * np.array([m1 * lc1 * s1 + m2 * (l1 * s1 + lc2 * s12), m2 * lc2 * s12])
    right = np.array([-b1 * v1, u - b2 * v2]) - coriolis + gravity
    assert rate == pytest.approx([v1, v2, *np.linalg.solve(matrix, right)], abs=1e-10)


def test_built_in_models_have_the_promised_ports_and_parameters():
    promised = {
        "pendulum": ("u", "theta", "J b mgl"),
        "cart-pole": ("u", "x theta", "mc mp l bx btheta"),
        "double-pendulum": ("u1 u2", "theta1 theta2", None),
        "acrobot": ("u", "theta1 theta2", None),
        "drive": ("u", "q", "M Fv offset"),
        "oscillator": ("u", "q", "m c k"),
        "two-tanks": ("u", "y", None),
    }
    for name, (inputs, outputs, parameters) in promised.items():
        system = load_model(name)
        assert " ".join(one.name for one in system.inputs) == inputs
        assert " ".join(one.name for one in system.outputs) == outputs
        if parameters is not None:
            assert " ".join(system.parameter_names) == parameters
    assert load_model("linear", order=4, inputs="a b", outputs="c d").np == 4 * (2 + 2) + 2


@pytest.mark.parametrize("substeps", [1, 2])
def test_energy_is_kept_to_the_order_of_the_method(substeps):
    system = models.double_pendulum().system()
    p = system.vector({"b1": 0.0, "b2": 0.0})
    m1, m2, l1, lc1, lc2, I1, I2 = p[:7]

    def energy(x):
        q1, q2, v1, v2 = x.T
        vx = l1 * np.cos(q1) * v1 + lc2 * np.cos(q1 + q2) * (v1 + v2)
        vy = l1 * np.sin(q1) * v1 + lc2 * np.sin(q1 + q2) * (v1 + v2)
        kinetic = 0.5 * (m1 * lc1**2 + I1) * v1**2 + 0.5 * I2 * (v1 + v2) ** 2 + 0.5 * m2 * (vx**2 + vy**2)
        height = -m1 * lc1 * np.cos(q1) - m2 * (l1 * np.cos(q1) + lc2 * np.cos(q1 + q2))
        return kinetic + G * height

    def drift(dt):
        simulator = system.simulator(dt, substeps=substeps, backend="casadi")
        x = simulator.states(p, [1.5, 0.5, 0.0, 0.0], np.zeros((round(2.0 / dt), 2)))
        return np.abs(energy(x) - energy(x[:1])).max()

    assert drift(0.02) / drift(0.01) > 13  # order 4: 16 in the limit
    assert drift(0.01) < 1e-4


def test_a_system_survives_pickling():
    system = models.cart_pole().system()
    again = pickle.loads(pickle.dumps(system))
    x, u, p = np.array([0.1, 0.4, -0.3, 0.9]), np.array([0.7]), system.vector()
    assert motion(again, x, u, p).tolist() == motion(system, x, u, p).tolist()
    assert again.parameters == system.parameters
    assert again.ports == system.ports


def test_measured_rates_and_accelerations_are_outputs():
    system = models.pendulum().system().with_outputs(["theta", ("theta", 1, "omega"), ("theta", 2)])
    assert [str(one) for one in system.outputs] == ["theta [rad]", "omega [rad/s]", "theta_acceleration [rad/s^2]"]
    assert system.feedthrough
    y = system.simulator(0.01).output([0.3, 0.7], [0.2], [0.5, 0.1, 2.0])
    assert y == pytest.approx([0.3, 0.7, (0.2 - 0.07 - 2.0 * np.sin(0.3)) / 0.5])
    with pytest.raises(InputError, match="speed"):
        system.with_outputs(["speed"])


def test_loads_are_what_the_guide_carries():
    cart = models.cart_pole().system()
    load = ca.Function("load", [cart.x, cart.p, cart.gravity], [cart.loads])
    held = load([0, 0.4, 0, 2.0], [1.0, 0.2, 0.5, 0, 0], [0, -1]).full()[:, 0]
    # The rail carries all weight and the pole's centripetal force upwards; the pin that along the rod, times l.
    assert held[0] == pytest.approx(1.2 * G + 0.2 * 0.5 * 4.0 * np.cos(0.4))
    assert held[1] == pytest.approx(0.5 * (0.2 * G * np.cos(0.4) + 0.2 * 0.5 * 4.0))


def test_gravity_can_be_turned_and_parameters_replaced():
    pendulum = models.pendulum().system()
    tilted = pendulum.rebuild(gravity=(np.sin(0.3), -np.cos(0.3)))
    assert motion(tilted, [0.3, 0.0], [0.0], [0.1, 0.0, 1.0])[1] == pytest.approx(0.0, abs=1e-15)
    later = pendulum.rebuild(parameters_as={"J": pendulum.p[0] * ca.if_else(pendulum.t >= 1.0, 2.0, 1.0)})
    f = ca.Function("f", [later.x, later.u, later.p, later.t], [later.f])
    rates = [float(f([0, 0], [1.0], [0.1, 0, 1], t)[1]) for t in (0.5, 1.5)]
    assert rates == pytest.approx([10.0, 5.0])


def test_conversion_keeps_the_value_of_any_expression():
    x, y = sp.symbols("S N", real=True)  # names that sympify would take for something else
    expression = (
        sp.sin(x) * sp.exp(-y) / (1 + x**2) + sp.Piecewise((x, x > y), (y**3, True)) + sp.Max(x, y, 0) + sp.pi
        + sp.sqrt(sp.Abs(x)) + sp.atan2(y, x) + sp.tanh(x) ** -3 + sp.Heaviside(x - 2) + x**sp.Rational(7, 3)
    )  # fmt: skip
    a, b = ca.SX.sym("a"), ca.SX.sym("b")
    function = ca.Function("f", [a, b], [to_casadi(expression, {x: a, y: b})])
    for first, second in ((0.7, 0.2), (2.5, 3.5)):
        wanted = float(expression.subs({x: first, y: second}).evalf())
        assert float(function(first, second)) == pytest.approx(wanted, rel=1e-13)


def test_what_a_model_cannot_be_is_refused():
    m = Mechanism("m", q="a", u="f", p="k")
    m.T = m.v[0] ** 2 / 2
    m.Q = [m.u[0] - sp.Symbol("unknown")]
    with pytest.raises(InputError, match="unknown"):
        m.system()
    m.Q = [m.u[0] - sp.gamma(m.q[0])]
    with pytest.raises(InputError, match="gamma"):
        m.system()
    m.Q = []
    with pytest.raises(InputError, match="one for each of a"):
        m.system()
    for names in ({"q": "a a"}, {"q": ""}, {"q": "a", "u": "a"}, {"q": "2a"}, {"q": "t"}):
        with pytest.raises(InputError):
            Mechanism("m", **names)
    with pytest.raises(InputError, match="mass"):
        m.parameters(mass=1.0)
    with pytest.raises(InputError):
        Parameter("a", value=np.nan)
    with pytest.raises(InputError):
        Ode("o", x="a", process="b")


def test_equations_read_as_one_would_write_them():
    assert equations(models.drive()) == ["Fv*q' + M*q'' + offset = u"]
    x, theta = equations(models.cart_pole())
    assert x == "bx*x' - l*mp*theta'**2*sin(theta) + l*mp*theta''*cos(theta) + x''*(mc + mp) = u"
    assert theta == "btheta*theta' + l**2*mp*theta'' + l*mp*x''*cos(theta) + 9.81*l*mp*sin(theta) = 0"
    assert equations(models.two_tanks())[-1] == "y = lower"
    assert r"\ddot{\theta}" in equations(models.pendulum(), "latex")[0]


MINE = """
from sympy import cos, sin
from harness.physics import Mechanism

def cart_pole():
    m = Mechanism("cart-pole", q="x theta", u="f", p="mc mp l bx bt")
    (x, th), (xd, thd), (f,), (mc, mp, l, bx, bt) = m.q, m.v, m.u, m.p
    m.body(mc, (x, 0))
    m.body(mp, (x + l*sin(th), -l*cos(th)))
    m.Q = [f - bx*xd, -bt*thd]
    return m

def broken():
    return 1 / 0

def nothing():
    return 3
"""


def test_a_user_writes_a_model_in_a_file(tmp_path: Path):
    file = tmp_path / "my.py"
    file.write_text(MINE)
    system = load_model(f"{file}:cart_pole")
    assert str(system) == "cart-pole: f [N] -> x [m], theta [rad]"
    ours = models.cart_pole().system()
    x, p = [0.1, 0.7, 0.3, -0.5], [1.0, 0.3, 0.4, 0.1, 0.02]
    assert motion(system, x, [0.4], p) == pytest.approx(motion(ours, x, [0.4], p), abs=1e-14)
    # An undeclared parameter of a mechanism is a positive quantity.
    assert all(one.positive for one in system.parameters)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("pendolum", "pendulum"),
        ("missing.py:model", "no such file"),
        ("my.py:absent", "cart_pole, broken, nothing"),
        ("my.py:broken", "ZeroDivisionError"),
        ("my.py:nothing", "int"),
        ("bad.py:model", "SyntaxError"),
    ],
)
def test_models_that_cannot_be_loaded_are_named(tmp_path: Path, monkeypatch, name, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my.py").write_text(MINE)
    (tmp_path / "bad.py").write_text("def model(:\n")
    with pytest.raises(InputError, match=words) as caught:
        load_model(name)
    assert "\n" not in str(caught.value)
