"""Columns in a wrong unit or order: the channel and what to do are said, the model does not fit, right records pass."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from harness.diagnosis.close import close_loop
from harness.diagnosis.records.columns_check import Doubt, check_columns, doubts, repairs
from harness.effects import builtin
from harness.physics import load_model
from harness.signals import Dataset, FloatArray, PlantSpec, Run, Trajectory

DT, N = 0.02, 400


def swinging_cart() -> Trajectory:
    """Return a cart with a hanging pole under a multisine: Heun's method on equations written by hand."""
    mc, mp, length, bx, btheta, g = 0.8, 0.3, 0.6, 0.3, 0.01, 9.81

    def slope(s: FloatArray, u: float) -> FloatArray:
        sin, cos = np.sin(s[1]), np.cos(s[1])
        mass = np.array([[mc + mp, mp * length * cos], [mp * length * cos, mp * length**2]])
        force = [u - bx * s[2] + mp * length * s[3] ** 2 * sin, -btheta * s[3] - mp * g * length * sin]
        return np.concatenate([s[2:], np.linalg.solve(mass, force)])

    system, rng = load_model("cart-pole"), np.random.default_rng(3)
    t = np.arange(N) * DT
    u = sum(0.8 * np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in (0.25, 0.5, 0.8, 1.3))
    state, y, h = np.array([0.0, 0.2, 0.0, 0.0]), np.empty((N, 2)), DT / 10
    for k in range(N):
        y[k] = state[:2]
        for _ in range(10):
            first = slope(state, u[k])
            state = state + 0.5 * h * (first + slope(state + h * first, u[k]))
    y += 1e-4 * rng.standard_normal(y.shape)
    return Trajectory(t, u[:, None], y, PlantSpec(system.inputs, system.outputs, DT))


@pytest.fixture(scope="module")
def cart() -> Trajectory:
    """The record, made once."""
    return swinging_cart()


def scaled(record: Trajectory, kind: str, column: int, factor: float) -> Trajectory:
    """Return the record with one column in another unit."""
    values = getattr(record, kind).copy()
    values[:, column] *= factor
    return replace(record, **{kind: values})


@pytest.mark.parametrize(
    ("kind", "column", "factor", "words"),
    [("u", 0, 1e3, "u is 1000 times too large for N"), ("y", 0, 1e-3, "x is 1000 times too small for m")],
)
def test_a_unit_wrong_by_1000_is_said_where_the_parameters_could_swallow_it(
    cart: Trajectory, kind: str, column: int, factor: float, words: str
) -> None:
    (doubt,) = doubts(load_model("cart-pole"), scaled(cart, kind, column, factor))
    assert words in doubt.words
    assert "check the units" in doubt.words
    assert "theta is" not in doubt.words
    assert "give the model such values" in doubt.words
    assert doubt.certain is (kind == "y"), "a force scales all parameters alike: the plant may be of that size"


def test_a_force_and_an_angle_that_cannot_be_told_apart_are_both_named(foreign_pendulum) -> None:
    record = foreign_pendulum(5, n=600, noise=1e-5, amplitude=0.02).estimation[0]  # too small for a sine to show
    (doubt,) = doubts(load_model("pendulum"), scaled(record, "y", 0, 1e-3))
    assert "u is 1000 times too large" in doubt.words
    assert "theta is 1000 times too small" in doubt.words


@pytest.mark.parametrize(
    ("factor", "words"),
    [(180 / np.pi, "theta is in degrees, not in radians"), (np.pi / 180, "theta is in radians, and read as degrees")],
)
def test_degrees_and_radians_are_told_from_a_factor_of_1000(foreign_pendulum, factor: float, words: str) -> None:
    """A thousandth of an angle in degrees left 14 % and was named; radians taken for degrees were a lack of cogging."""
    record = scaled(foreign_pendulum(5, n=600).estimation[0], "y", 0, factor)
    (doubt,) = doubts(load_model("pendulum"), record)
    assert words in doubt.words
    assert "1000" not in doubt.words
    assert doubt.certain


@pytest.mark.parametrize("turns", [-0.5, 0.5, 0.0])
def test_an_angle_from_the_upright_is_said_before_anything_is_named(foreign_pendulum, turns: float) -> None:
    """It was a payload that turns gravity round, of a pendulum without any."""
    record = foreign_pendulum(5, n=600).estimation[0]
    found = doubts(load_model("pendulum"), replace(record, y=record.y + 2 * np.pi * turns))
    assert len(found) == bool(turns)
    for doubt in found:
        assert "theta is half a turn off" in doubt.words
        assert "degrees" not in doubt.words
        assert doubt.certain


def test_degrees_are_told_where_declared_values_are_placeholders(foreign_pendulum) -> None:
    small = load_model("pendulum")
    small = small.with_parameters({one.name: one.value / 80 for one in small.parameters})
    (doubt,) = doubts(small, scaled(foreign_pendulum(5, n=600).estimation[0], "y", 0, 180 / np.pi))
    assert "theta is in degrees, not in radians" in doubt.words
    assert doubt.certain


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (180 / np.pi, "q is in degrees, not in radians"),
        (np.pi / 180, "q is in radians, and read as degrees"),
        (1.0, ""),
    ],
)
def test_degrees_show_in_the_parameters_of_a_linear_model(factor: float, words: str) -> None:
    """It follows the record either way, with inertia, damping and stiffness 57 times what was declared."""
    assert words in " ".join(one.words for one in linear_doubts(factor, 1.0))
    assert len(linear_doubts(factor, 1.0)) == bool(words)
    assert linear_doubts(factor, 1.6) == [], "a plant of another size than declared: degrees do not explain it"


def linear_doubts(factor: float, size: float) -> list[Doubt]:
    """Return what is doubted of a torsional oscillator's record, times a factor, of a plant so many times as large."""
    from harness.physics.models import oscillator

    system = oscillator().system()
    system = replace(system, outputs=tuple(replace(one, unit="rad") for one in system.outputs))
    system = system.with_parameters({"m": 1.0, "c": 0.4, "k": 9.0})
    rng, t = np.random.default_rng(0), np.arange(800) * DT
    u = sum(0.4 * np.cos(2 * np.pi * f * t + rng.uniform(0, 6)) for f in np.linspace(0.1, 2, 12))[:, None]
    y = system.simulator(DT).rollout(size * np.array([1.0, 0.4, 9.0]), [0.1, 0.0], u)
    y = factor * (y + 0.01 * y.std() * rng.standard_normal(y.shape))
    found = doubts(system, Trajectory(t, u, y, PlantSpec(system.inputs, system.outputs, DT)))
    assert not any(one.certain for one in found), "the plant may be of that size"
    return found


def test_all_angles_of_a_record_may_be_in_degrees(cart: Trajectory) -> None:
    system = load_model("cart-pole")
    spec = PlantSpec(system.inputs, tuple(replace(one, unit="rad") for one in system.outputs), DT)
    words = [one.words for one in repairs(replace(cart, spec=spec))]
    assert "x and theta are in degrees, not in radians" in words
    assert "u is in degrees, not in radians" not in words


def test_columns_in_doubt_are_a_model_that_does_not_fit_with_a_report(foreign_pendulum, tmp_path: Path) -> None:
    """Exchanged columns were refused without a report."""
    good = foreign_pendulum(8, n=600)
    records = [replace(run.trajectory, u=run.trajectory.y.copy(), y=run.trajectory.u.copy()) for run in good]
    runs = tuple(replace(run, trajectory=record) for run, record in zip(good, records, strict=True))
    report = close_loop(replace(good, runs=runs), "pendulum", out=tmp_path / "out")
    assert report.verdict == "model_does_not_fit", report.data["summary"]
    assert report.data["adequacy"] == "does_not_fit"
    assert report.data["effects"] == []
    assert "check the units and the order of the columns" in report.data["misfit"][-1]
    page = (tmp_path / "out" / "report.html").read_text()
    assert 'class="badge model_does_not_fit"' in page
    assert 'class="badge explained"' not in page
    assert 'class="badge nothing_missing"' not in page


@pytest.mark.parametrize("factor", [0.1, 10.0])
@pytest.mark.parametrize("name", ["J", "b", "mgl"])
def test_a_declared_parameter_wrong_by_ten_says_nothing_about_units(foreign_pendulum, name: str, factor: float) -> None:
    system = load_model("pendulum")
    wrong = system.with_parameters({name: factor * system.parameter(name).value})
    assert check_columns(wrong, foreign_pendulum(6, n=600)) == []


def test_placeholders_and_a_plant_a_hundred_times_as_large_are_no_doubt(foreign_pendulum) -> None:
    system = load_model("pendulum")
    small = system.with_parameters({one.name: one.value / 80 for one in system.parameters})
    assert check_columns(small, foreign_pendulum(7, n=600)) == []


def test_a_right_cart_with_values_far_off_passes(cart: Trajectory) -> None:
    system = load_model("cart-pole").with_parameters({"mc": 8.0, "mp": 0.03, "btheta": 1.0})
    assert check_columns(system, Dataset("cart", (Run(cart, "estimation"),))) == []


def test_a_plant_of_another_size_is_judged_but_nothing_is_green_beside_the_doubt(foreign_pendulum) -> None:
    """A force in N mm, or a pendulum a thousand times as heavy: the record cannot tell, the declared values can."""
    good = foreign_pendulum(8, n=600)
    runs = tuple(replace(run, trajectory=scaled(run.trajectory, "u", 0, 1e3)) for run in good)
    report = close_loop(replace(good, runs=runs), "pendulum", dictionary=[builtin()["quadratic_drag"]])
    assert report.verdict == "nothing_missing"
    assert report.data["adequacy"] == "mostly_explained"
    assert "check the units and the order of the columns" in report.data["warnings"][0]
    assert {one["name"]: round(one["ratio"], -2) for one in report.data["far_from_declared"]}["mgl"] == 1000
    assert "times its declared size" in report.data["summary"], "the verdict says it"
