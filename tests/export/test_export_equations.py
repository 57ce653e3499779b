"""The equations of a model as text, LaTeX, Python and C; what is printed to be run computes what the model does."""

from __future__ import annotations

import ctypes
import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import harness
from harness.api import equations
from harness.effects import builtin
from harness.effects.compose import compose
from harness.effects.effect import Placed
from harness.errors import InputError
from harness.export.equations import WrittenModel, written_model
from harness.fmi.build import compiler
from harness.physics.compiled.compilation import Compilation
from harness.physics.lumps.lumped_model import lumped
from harness.physics.models import load_model

MODELS = (
    "pendulum",
    "cart-pole",
    "double-pendulum",
    "acrobot",
    "drive",
    "planar-quadrotor",
    "two-tanks",
    "perching-glider",
)
URDF = """<robot name="two"><link name="rail"/>
<link name="cart"><inertial><mass value="1.2"/><inertia ixx="1" iyy="1" izz="1"/></inertial></link>
<link name="pole"><inertial><origin xyz="0 0.01 -0.4"/><mass value="0.3"/>
<inertia ixx="0.01" iyy="0.01" izz="0.002"/></inertial></link>
<joint name="slider" type="prismatic"><axis xyz="1 0 0"/><parent link="rail"/><child link="cart"/>
<limit lower="-2" upper="2" effort="50" velocity="5"/><dynamics damping="0.3" friction="0.1"/></joint>
<joint name="hinge" type="continuous"><axis xyz="0 1 0"/><parent link="cart"/><child link="pole"/></joint></robot>"""


def model(name: str) -> Any:
    """Return a model, or one with friction, an actuator lag and a dead zone built in."""
    if name != "repaired":
        return load_model(name)
    nominal = load_model("cart-pole")
    effects = [("stribeck_friction", "x"), ("actuator_lag", "u"), ("quadratic_drag", "theta")]
    return compose(nominal, [Placed(builtin()[effect], at) for effect, at in effects])


def columns(written: WrittenModel, rng: np.random.Generator) -> dict[str, np.ndarray]:
    system = written.system
    n = len(system.coordinates)
    sizes = {"x": system.nx, "u": system.nu, "t": 1, "q": n, "v": n, "a": n}
    found = {name: rng.uniform(0.1, 1.5, size) for name, size in sizes.items()}
    return found | {"p": np.array([written.values[name] for name in system.parameter_names])}


def in_python(written: WrittenModel) -> dict[str, Any]:
    space: dict[str, Any] = {}
    exec(compile(written.write("python"), "printed", "exec"), space)
    return space


@settings(max_examples=25, deadline=None)
@given(name=st.sampled_from((*MODELS, "repaired")), seed=st.integers(0, 10**6))
def test_the_printed_python_computes_what_the_model_does(name: str, seed: int) -> None:
    written = written_model(model(name))
    made, given_ = in_python(written), columns(written, np.random.default_rng(seed))
    for quantity in written.quantities:
        wanted = np.array(quantity.function(*(given_[name] for name in quantity.arguments))).ravel()
        passed = {name: float(given_[name][0]) if name == "t" else given_[name] for name in quantity.arguments}
        assert np.allclose(made[quantity.name](**passed), wanted, rtol=1e-12, atol=1e-12), quantity.name


@pytest.mark.skipif(compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("name", ["cart-pole", "acrobot", "two-tanks", "repaired"])
def test_the_printed_c_computes_what_the_model_does(name: str) -> None:
    written = written_model(model(name))
    library = Compilation(written.write("c")).library()
    own = columns(written, np.random.default_rng(1))
    prefix = written.system.name.replace("-", "_")
    for quantity in written.quantities:
        wanted = np.array(quantity.function(*(own[one] for one in quantity.arguments))).ravel()
        result = np.zeros(len(wanted))
        arguments = [np.ascontiguousarray(own[one]) for one in quantity.arguments]
        pointers = [ctypes.c_void_p(one.ctypes.data) for one in (*arguments, result)]
        getattr(library, f"{prefix}_{quantity.name}")(*pointers)
        assert np.allclose(result, wanted, rtol=1e-12, atol=1e-12), quantity.name


@settings(max_examples=15, deadline=None)
@given(name=st.sampled_from(("pendulum", "cart-pole", "double-pendulum", "acrobot")), seed=st.integers(0, 10**6))
def test_regressor_times_lumped_parameters_is_what_is_known(name: str, seed: int) -> None:
    """Along the motion that the printed derivative gives; energy only falls by friction."""
    written = written_model(model(name))
    made, own = in_python(written), columns(written, np.random.default_rng(seed))
    n = len(written.system.coordinates)
    rates = np.array(made["derivative"](own["x"], own["u"], 0.0))
    q, v, a = own["x"][:n], own["x"][n:], rates[n:]
    lumps = np.array(made["lumped"]())
    rows = np.array(made["regressor"](q, v, own["u"], 0.0, a)).reshape(n, -1)
    assert np.allclose(rows @ lumps, made["known"](q, v, own["u"], 0.0, a), atol=1e-9)
    assert rows == pytest.approx(lumped(written.system.mechanism).regressor(q[None], v[None], a[None], own["u"][None]))
    assert len(written.lumps) == len(lumps)


def test_a_urdf_and_a_repaired_model_are_written_in_symbols(tmp_path: Path) -> None:
    path = tmp_path / "two.urdf"
    path.write_text(URDF, encoding="utf-8")
    text = harness.equations(str(path))
    assert "m1 + m2 [kg]" in text
    assert "hx2 [kg m]" in text
    assert "regressor" in text
    repaired = equations(model("repaired"))
    assert "d(x_rate)/dt = " in repaired
    assert "stribeck_friction@x.Fc" in repaired
    assert "d(actuator_lag@u.z)/dt" in repaired or "actuator_lag" in repaired


def test_latex_has_every_symbol(tmp_path: Path) -> None:
    target = tmp_path / "model.tex"
    text = equations("cart-pole", form="latex", out=target)
    assert target.read_text(encoding="utf-8") == text
    assert r"\ddot{\theta}" in text
    assert r"l^{2} mp" in text
    with pytest.raises(InputError, match="exists"):
        equations("cart-pole", form="latex", out=target)


@pytest.mark.skipif(importlib.util.find_spec("pybullet_data") is None, reason="the iiwa comes with pybullet")
def test_a_large_arm_is_run_and_not_read() -> None:
    with pytest.raises(InputError, match="python or c"):
        equations("iiwa")
    assert "double *result" in equations("iiwa", form="c")


def test_what_has_no_equations_is_said() -> None:
    with pytest.raises(InputError, match="physical model"):
        equations(object())
