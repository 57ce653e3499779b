"""Equations typed as text: the same model as in Python, and nothing but equations."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.errors import InputError
from harness.physics import load_model
from harness.physics.symbolic.typed import read_equations

PENDULUM = """
# a pendulum, hanging down
input u [N m]
state theta [rad], w [rad/s]
motion theta: w, J
J = 0.05 kg m^2 >= 0
b = 0.02 N m s/rad   # viscous
mgl = 1 N m
theta' = w
w' = (u - b*w - mgl*sin(theta)) / J
output theta
output energy = J*w^2/2 - mgl*cos(theta) [J]
"""


def test_a_typed_pendulum_is_the_one_of_the_catalogue(tmp_path: Path) -> None:
    file = tmp_path / "swing.eqs"
    file.write_text(PENDULUM, encoding="utf-8")
    typed, known = load_model(str(file)), load_model("pendulum")
    assert str(typed) == "swing: u [N m] -> theta [rad], energy [J]"
    first = typed.parameters[0]
    assert (first.unit, first.value, first.minimum) == ("kg m^2", 0.05, 0.0)
    p, x0, u = np.array([0.05, 0.02, 1.0]), np.array([0.3, 0.0]), np.sin(np.arange(50.0))[:, None]
    ours = typed.simulator(0.01, backend="casadi").states(p, x0, u)
    assert np.allclose(ours, known.simulator(0.01, backend="casadi").states(p, x0, u), rtol=1e-12, atol=1e-14)
    assert [port.name for port in typed.ports if port.kind == "coordinate"] == ["theta"]


NUMBERS = st.floats(0.1, 9.0).map(lambda value: f"{value:.3f}")
TEXTS = st.recursive(
    st.one_of(NUMBERS, st.sampled_from(["x", "k", "u"])),
    lambda inner: st.one_of(
        st.tuples(inner, st.sampled_from(["+", "-", "*"]), inner).map(lambda two: f"({two[0]} {two[1]} {two[2]})"),
        st.tuples(st.sampled_from(["sin", "cos", "tanh", "abs"]), inner).map(lambda two: f"{two[0]}({two[1]})"),
        inner.map(lambda text: f"-{text}"),
        inner.map(lambda text: f"({text})^2"),
    ),
    max_leaves=8,
)


@settings(max_examples=60, deadline=None)
@given(TEXTS, st.floats(-2.0, 2.0), st.floats(-2.0, 2.0))
def test_text_means_what_it_says(text: str, x: float, u: float) -> None:
    """Beside Python's own arithmetic with the same text."""
    system = read_equations(f"input u\nk = 1.5\nx' = {text}").system()
    found = ca.Function("f", [system.x, system.u, system.p, system.t], [system.f])(x, u, 1.5, 0.0)
    names = {"x": x, "u": u, "k": 1.5, "sin": np.sin, "cos": np.cos, "tanh": np.tanh, "abs": abs}
    wanted = eval(text.replace("^", "**"), {"__builtins__": {}}, names)
    assert float(found) == pytest.approx(float(wanted), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("x' = __import__('os').system('true')", "line 2"),
        ("x' = (lambda: 1)()", "line 2"),
        ("x' = x.real", "Attribute"),
        ("x' = [x]", "List"),
        ("x' = 9^9^9^9", "too large"),
        ("x' = 2x", "products"),
        ("x' = y", "unknown name y"),
        ("x' = sin(x, x, x)", "expression"),
        ("x' = 1/0", "line 2"),
        ("x' = x\nx' = u", "twice"),
        ("x' = x\nk = 1 furlongs_of_mine", "unknown unit"),
        ("x' = x\nstate x [m", "no part of a model"),
        ("x' = x\nlevel h [m]", "state without an equation"),
        ("x' = x\nmotion phi: w, k", "state without an equation"),
        ("something else", "no part of a model"),
        ("k = 2", "at least|a line x'"),
        ("x' = " + "(" * 3000 + "x" + ")" * 3000, "line 2"),
    ],
)
def test_what_is_no_equation_is_refused_with_its_line(line: str, words: str) -> None:
    with pytest.raises(InputError, match=words) as refusal:
        read_equations(f"input u\n{line}").system()
    assert "; remedy: " in str(refusal.value)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file of equations"):
        load_model(str(tmp_path / "none.eqs"))


CART_POLE = """
input f [N]
state x [m], theta [rad], v [m/s], w [rad/s]
motion x: v
motion theta: w
M = 1.2 kg >= 0
C = 0.1 kg m >= 0
J = 0.06 kg m^2 >= 0
b = 0.3 N s/m >= 0
x' = v
theta' = w
x: M*v' + C*cos(theta)*w' = f - b*v + C*sin(theta)*w^2
theta: C*cos(theta)*v' + J*w' = -9.81*C*sin(theta)
"""


@given(
    state=st.lists(st.floats(-2, 2), min_size=4, max_size=4),
    f=st.floats(-5, 5),
    dry=st.floats(0, 2),
)
@settings(max_examples=30, deadline=None)
def test_joints_that_accelerate_each_other_do_so_with_what_is_found_there(
    state: list[float], f: float, dry: float
) -> None:
    """A friction at the cart moves the pole too, as M a = forces has it; beside an inertia each it would not."""
    from harness.effects import Placed, builtin, compose

    friction = Placed(builtin()["coulomb_friction"], "x", {"Fc": dry, "w": 0.1})
    system = compose(read_equations(CART_POLE).system(), [friction])
    slope = ca.Function("f", [system.x, system.u, system.p, system.t], [system.f])
    found = np.asarray(slope(state, [f], system.vector(None), 0.0)).ravel()
    _, theta, v, w = state
    matrix = np.array([[1.2, 0.1 * np.cos(theta)], [0.1 * np.cos(theta), 0.06]])
    forces = [f - 0.3 * v + 0.1 * np.sin(theta) * w**2 - dry * np.tanh(v / 0.1), -9.81 * 0.1 * np.sin(theta)]
    assert found[:2] == pytest.approx([v, w])
    assert found[2:] == pytest.approx(np.linalg.solve(matrix, forces))


def test_terms_of_a_row_may_stand_on_either_side() -> None:
    moved = CART_POLE.replace(
        "C*cos(theta)*v' + J*w' = -9.81*C*sin(theta)", "J*w' = -9.81*C*sin(theta) - v'*C*cos(theta)"
    )
    assert moved != CART_POLE
    one, other = (read_equations(text).system() for text in (CART_POLE, moved))
    for system in (one, other):
        assert [str(port.name) for port in system.ports if port.kind == "coordinate"] == ["x", "theta"]
    slopes = [
        ca.Function("f", [m.x, m.u, m.p, m.t], [m.f])([0.1, 0.7, 1.0, -2.0], [0.5], m.vector(None), 0.0).full()
        for m in (one, other)
    ]
    assert np.allclose(*slopes, rtol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("motion x: v\n", "", "motion x: SPEED"),
        ("motion x: v\n", "motion x: v, M\n", "motion x: v alone"),
        ("x: M*v'", "v' = f\nx: M*v'", "motion x: v alone"),
        ("theta: C*cos(theta)*v' + J*w'", "theta: 2*C*cos(theta)*v' + J*w'", "symmetric"),
        ("J*w' =", "J*w'^2 =", "first power"),
        ("J*w' =", "J*w'*v' =", "first power"),
        ("theta: C*cos(theta)*v' + J*w' = -9.81*C*sin(theta)", "w' = 0", "motion theta has no inertia"),
        ("J*w' =", "J*w' + K*i' =", "unknown name"),
    ],
)
def test_a_row_that_is_no_balance_is_refused(old: str, new: str, words: str) -> None:
    text = CART_POLE.replace(old, new)
    assert text != CART_POLE
    with pytest.raises(InputError, match=words):
        read_equations(text).system()


def test_rows_are_written_as_they_were_typed() -> None:
    from harness.physics.symbolic.equation_text import equations

    lines = equations(read_equations(CART_POLE))
    assert lines[:2] == ["x' = v", "theta' = w"]
    assert lines[2] == "C*w'*cos(theta) + M*v' = C*w**2*sin(theta) - b*v + f"


def test_one_input_at_two_joints_with_an_inertia_each_is_asked_about() -> None:
    """A crane solved for its accelerations by hand: a friction of the trolley then left the load alone, unsaid."""
    by_hand = """
    input F [N]
    state s [m], a [rad], v [m/s], w [rad/s]
    motion s: v, M
    motion a: w, J
    M = 2 kg
    J = 0.18 kg m^2
    s' = v
    a' = w
    v' = F/M + 2*sin(a)
    w' = -F*cos(a)/J - 9*sin(a)
    """
    (remark,) = read_equations(by_hand).system().remarks
    assert "F accelerates s and a" in remark
    assert "s: M*v' + C*w' = ..." in remark
    assert read_equations(CART_POLE).system().remarks == ()
    assert read_equations(PENDULUM).system().remarks == ()


@pytest.mark.parametrize(
    ("line", "unit", "low", "fixed"),
    [
        ("k = 2.5 N/m", "N/m", -np.inf, False),
        ("k = 2.5 N/m >= 0", "N/m", 0.0, False),
        ("k = 2.5 N/m fixed", "N/m", -np.inf, True),
        ("k = 2.5 [N/m] >= 0 fixed", "N/m", 0.0, True),
        ("k = 2.5 fixed", "1", -np.inf, True),
    ],
)
def test_a_parameter_may_be_bounded_and_known(line: str, unit: str, low: float, fixed: bool) -> None:
    (parameter,) = read_equations(f"input u\n{line}\nx' = u - k*x").system().parameters
    assert (parameter.unit, parameter.value, parameter.minimum, parameter.fixed) == (unit, 2.5, low, fixed)
