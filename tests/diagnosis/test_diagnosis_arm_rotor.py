"""Rotors behind gears: torques by Bullet's inverse dynamics plus J a at a joint, which no URDF has (nor Bullet)."""

from __future__ import annotations

from functools import cache
from typing import Any, Literal

import numpy as np
import pytest

from harness.diagnosis.arm.motion import arm_runs
from harness.diagnosis.arm.rotor import in_the_bodies
from harness.diagnosis.close import close_loop
from harness.physics.arms.arm import ArmModel, load_arm
from harness.signals import Dataset, FloatArray, PlantSpec, Run, Trajectory

pytest.importorskip("pybullet", reason="pybullet has wheels for CPython 3.10 and 3.11 only")

DT = 0.01
USES: tuple[Literal["estimation", "validation"], ...] = ("estimation", "validation")


@cache
def arm(inertia: str = "fixed") -> ArmModel:
    return load_arm("iiwa", inertia=inertia)


@cache
def motion(seed: int, sines: int = 5) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return joints that swing at several rates (N, 7), their rates and accelerations."""
    rng = np.random.default_rng(seed)
    t = np.arange(1500) * DT
    w = 2 * np.pi * np.arange(1, sines + 1) / 7.5
    a, phase = rng.normal(size=(2, sines, 7)) * np.array([0.25, 1.0])[:, None, None]
    turn = w[:, None] * t[:, None, None] + 3 * phase
    q = np.sum(a * np.sin(turn), axis=1)
    return q, np.sum(a * w[:, None] * np.cos(turn), axis=1), np.sum(-a * w[:, None] ** 2 * np.sin(turn), axis=1)


@cache
def by_bullet(seed: int, sines: int) -> FloatArray:
    """Return the torques (N, 7) that Bullet's inverse dynamics asks for along a motion."""
    import pybullet

    client = pybullet.connect(pybullet.DIRECT)
    try:
        pybullet.setGravity(0, 0, -9.81, physicsClientId=client)
        flags = pybullet.URDF_USE_INERTIA_FROM_FILE
        robot = pybullet.loadURDF(str(arm().path), useFixedBase=True, flags=flags, physicsClientId=client)
        rows = [map(list, row) for row in zip(*motion(seed, sines), strict=True)]
        return np.array([pybullet.calculateInverseDynamics(robot, *row, physicsClientId=client) for row in rows])
    finally:
        pybullet.disconnect(client)


def log(rotors: tuple[float, ...], sines: int = 5) -> Dataset:
    """Return records of an arm with these rotors [kg m^2], torques noisy by 0.05 N m and positions by 0.1 mrad."""
    runs = []
    for seed, use in enumerate(USES):
        q, v, a = motion(seed, sines)
        rng = np.random.default_rng(10 + seed)
        u = by_bullet(seed, sines) + arm().damped(v) + np.array(rotors) * a + 0.05 * rng.normal(size=q.shape)
        y = q + 1e-4 * rng.normal(size=q.shape)
        runs.append(Run(Trajectory(np.arange(len(q)) * DT, u, y, PlantSpec(arm().inputs, arm().positions, DT)), use))
    return Dataset("arm", tuple(runs), intersample="smooth")


def rotors(data: dict[str, Any]) -> dict[str, float]:
    """Return what was found, by ``name@at``, with its first value."""
    return {f"{one['name']}@{one['at']}": one["parameters"]["J"]["value"] for one in data["effects"]}


@pytest.mark.slow
def test_a_rotor_is_named_at_its_joint_and_nothing_else_is() -> None:
    report = close_loop(log((0, 0, 0, 0.5, 0, 0, 0)), arm())
    assert rotors(report.data) == {"rotor_inertia@q4": pytest.approx(0.5, rel=0.02)}, report.data["summary"]
    assert report.data["effects"][0]["parameters"]["J"]["unit"] in ("N m s^2/rad", "N m/(rad/s^2)")
    assert len(report.data["tie_sets"][0]) == 1, "bodies cannot do it"


@pytest.mark.slow
def test_rotors_of_all_joints_are_named_and_no_link_is_heavy() -> None:
    true = (0.8, 0.8, 0.4, 0.4, 0.2, 0.1, 0.1)
    report = close_loop(log(true), arm())
    assert report.verdict == "effects_found", report.data["summary"]
    assert rotors(report.data) == {
        f"rotor_inertia@q{k + 1}": pytest.approx(value, rel=0.04) for k, value in enumerate(true)
    }
    said = [any(member["name"] == "parameter" for member in tie) for tie in report.data["tie_sets"]]
    assert said == [True, True, False, False, False, False, False], "links 1 and 2 turn with their joints alone"


@pytest.mark.slow
def test_rotors_are_named_where_the_motion_is_two_slow_sines() -> None:
    """What they leave then is two sines, which an autoregressive error of four coefficients predicts.

    So little is told of a wrist's rotor that its interval is a fifth of it wide: the intervals hold what is true.
    """
    true = (0.8, 0.8, 0.4, 0.4, 0.2, 0.1, 0.1)
    report = close_loop(log(true, sines=2), arm())
    assert report.verdict == "effects_found", report.data["summary"]
    assert set(rotors(report.data)) >= {"rotor_inertia@q1", "rotor_inertia@q3", "rotor_inertia@q5"}
    for one in report.data["effects"]:
        assert one["name"] == "rotor_inertia"
        inertia = one["parameters"]["J"]
        assert inertia["high"] - inertia["low"] < 0.5 * inertia["value"]
        three = 1.5 * (inertia["high"] - inertia["low"]) / 2
        assert inertia["value"] == pytest.approx(true[int(one["at"][1]) - 1], abs=three)


@pytest.mark.slow
def test_where_bodies_are_free_masses_stay_within_reason_beside_a_rotor() -> None:
    """Its neighbours became three times as heavy, and no body that mass can make explained the log."""
    report = close_loop(log((0, 0, 0, 0.5, 0, 0, 0)), arm("calibrated"))
    assert rotors(report.data) == {"rotor_inertia@q4": pytest.approx(0.5, rel=0.1)}, report.data["summary"]
    assert report.data["adequacy"] == "explained"
    masses = np.reshape(report.data["inertial_parameters"]["values"], (-1, 10))[:, 0]
    urdf = arm().arm.parameters.reshape(-1, 10)[list(arm().links), 0]
    assert np.abs(masses / urdf - 1).max() < 0.2


def test_the_first_two_joints_of_a_spherical_shoulder_hide_their_rotors_in_the_bodies() -> None:
    runs = arm_runs(arm(), log((0.0,) * 7))
    assert [in_the_bodies(arm(), runs, k) for k in range(7)] == [True, True, False, False, False, False, False]
