"""Does an arm fit its log at all? Logs of an arm of known dynamics, with mistakes that people make."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from harness.diagnosis.arm import misfit
from harness.diagnosis.arm.motion import arm_runs
from harness.diagnosis.arm.other_arm import FreeBodies, other_arm_reasons
from harness.diagnosis.close import close_loop
from harness.diagnosis.policy import ARM_POLICY, POLICY
from harness.diagnosis.report.keys import blank
from harness.effects import builtin
from harness.physics.arms.arm import ArmModel, load_arm
from harness.physics.arms.urdf_write import urdf_with
from harness.signals import Dataset, FloatArray, PlantSpec, Run, Trajectory

pytest.importorskip(
    "pybullet_data", reason="the URDF of the iiwa comes with pybullet, which has wheels for CPython 3.10 and 3.11 only"
)

DT, N = 0.005, 2000
T = np.arange(N) * DT
Mistake = Callable[[ArmModel, FloatArray, FloatArray], tuple[FloatArray, FloatArray]]


def log(mistake: Mistake) -> tuple[Dataset, ArmModel]:
    """Return the log of an iiwa on two sines a joint, torques noisy, and the arm."""
    arm = load_arm("iiwa")
    spec = PlantSpec(arm.inputs, arm.outputs, DT)
    runs = []
    for seed, use in enumerate(("estimation", "validation")):
        rng = np.random.default_rng(seed)
        phases = rng.uniform(0, 6, 7)
        q = 0.5 * np.sin(2 * np.pi * np.linspace(0.3, 0.6, 7) * T[:, None] + phases)
        q += 0.2 * np.sin(2 * np.pi * np.linspace(0.5, 0.2, 7) * T[:, None] + 2 * phases)
        v = np.gradient(q, DT, axis=0)
        u = arm.torques(q, v, np.gradient(v, DT, axis=0)) + arm.damped(v)
        u, measured = mistake(arm, u, q)
        u = u + 0.05 * rng.standard_normal(u.shape)
        runs.append(Run(Trajectory(T, u, measured + 1e-5 * rng.standard_normal(q.shape), spec), use))  # type: ignore[arg-type]
    return Dataset("iiwa", tuple(runs)), arm


def flipped(values: FloatArray, joint: int) -> FloatArray:
    """Return values with the sign of one column wrong."""
    return values * np.where(np.arange(7) == joint, -1.0, 1.0)


def weightless(arm: ArmModel, u: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the torques that a controller adds to its compensation of gravity."""
    still = np.zeros_like(q)
    return u - arm.torques(q, still, still), q


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mistake", "words"),
    [
        (lambda arm, u, q: (flipped(u, 1), q), "check the sign of tau2:"),
        (lambda arm, u, q: (-u, q), "check the sign of all torques:"),
        (lambda arm, u, q: (u, flipped(q, 3)), "check the sign of q4:"),
        (lambda arm, u, q: (1000 * u, q), "in N mm and not N m:"),
        (lambda arm, u, q: (u, np.degrees(q)), "whether the positions are in degrees:"),
        (lambda arm, u, q: (u[:, [0, 3, 2, 1, 4, 5, 6]], q), "whether tau2 and tau4 are exchanged:"),
        (weightless, "beyond gravity's compensation:"),
        (lambda arm, u, q: (u / 4, q), "all torques are 0.25 times what they should be, or all masses 4 times:"),
    ],
    ids=[
        "sign of a torque",
        "sign of all",
        "sign of a position",
        "N mm",
        "degrees",
        "exchanged",
        "compensated",
        "factor",
    ],
)
def test_a_mistake_in_the_log_is_no_effect_and_is_named(mistake: Mistake, words: str) -> None:
    report = close_loop(*log(mistake), dictionary=[])
    assert report.verdict == "model_does_not_fit", report.data["summary"]
    assert report.data["adequacy"] == "does_not_fit"
    assert words in report.data["summary"]


def test_one_joint_that_nothing_explains_is_enough() -> None:
    """The median joint was asked: a repair could leave three of seven joints as wrong as they were."""
    data, arm = log(lambda arm, u, q: (u, q))
    runs = arm_runs(arm, data)["estimation"]
    right = [(one, one.motion.u) for one in runs]
    wrong = [(one, np.where(np.arange(7) == 4, one.motion.u[::-1], one.motion.u)) for one in runs]
    assert misfit._explained(right, range(7))[1] < 0.1
    assert misfit._explained(wrong, range(7))[1] > 0.25


@pytest.mark.slow
def test_an_arm_that_does_not_fit_gets_no_green_badge_and_no_urdf(tmp_path: Path) -> None:
    """The torques have nothing to do with the motion: the residual was 1600 % of the torque, and nothing missing."""

    def unrelated(arm: ArmModel, u: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        return np.roll(u[::-1], 700, axis=0) / 16, q

    report = close_loop(*log(unrelated), out=tmp_path / "out")
    assert report.verdict == "model_does_not_fit", report.data["summary"]
    assert any("% as large as all that the torque does" in text for text in report.data["misfit"])
    page = (tmp_path / "out" / "report.html").read_text()
    assert 'class="badge model_does_not_fit"' in page
    assert 'class="badge explained"' not in page
    assert not (tmp_path / "out" / "repaired.urdf").exists()


@pytest.mark.slow
def test_the_right_log_fits_and_says_how_much_is_explained() -> None:
    report = close_loop(*log(lambda arm, u, q: (u, q)), dictionary=[])
    assert report.verdict == "nothing_missing", report.data["summary"]
    assert report.data["misfit"] == []
    assert "% of the variance of every joint's torque is explained" in report.data["summary"]
    assert report.data["policy"]["policy"]["order"]["reason"]
    assert set(report.data) == set(blank())
    assert {key: type(one) for key, one in report.data.items() if one is not None} == {
        key: type(one if key != "explained_share" else 1.0)
        for key, one in blank().items()
        if key != "inertial_parameters"
    }


@pytest.mark.slow
def test_friction_is_found_beside_inertia_that_is_calibrated_on_few_rows() -> None:
    """Forty inertial parameters on a hundred rows predict no other record: validation must not judge them."""

    def sticky(arm: ArmModel, u: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        return u + 2.0 * np.tanh(np.gradient(q, DT, axis=0) / 0.01) * (np.arange(7) == 3), q

    data, _ = log(sticky)
    report = close_loop(data, load_arm("iiwa", inertia="calibrated"), dictionary=[builtin()["coulomb_friction"]])
    assert [(one["name"], one["at"]) for one in report.data["effects"]] == [("coulomb_friction", "q4")]
    assert report.data["effects"][0]["parameters"]["Fc"]["value"] == pytest.approx(2.0, rel=0.03)


@pytest.mark.slow
def test_several_wrong_links_are_named_and_the_reader_is_told_to_check_the_urdf(tmp_path: Path) -> None:
    data, arm = log(lambda arm, u, q: (u, q))
    bodies = arm.arm.parameters.reshape(-1, 10).copy()
    bodies[[3, 5]] *= 0.5
    path = tmp_path / "light.urdf"
    path.write_text(urdf_with(arm, bodies.ravel()))
    report = close_loop(data, load_arm(path))
    assert {effect["name"] for effect in report.data["effects"]} == {"link_mass"}
    assert any("a URDF with other masses or lengths can look like that" in text for text in report.data["warnings"])


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.7, 1.3])
def test_a_urdf_with_other_lengths_is_said_to_be_another_arms(tmp_path: Path, factor: float) -> None:
    """A link and gains of two or three torques explained 96 to 99 % of it, under a green grade."""
    data, arm = log(lambda arm, u, q: (u, q))
    tree = ElementTree.fromstring(urdf_with(arm, arm.arm.parameters))
    for origin in tree.iterfind("joint/origin"):
        origin.set("xyz", " ".join(str(factor * float(x)) for x in origin.get("xyz", "0 0 0").split()))
    path = tmp_path / "other.urdf"
    path.write_text(ElementTree.tostring(tree, encoding="unicode"))
    report = close_loop(data, load_arm(path))
    assert report.verdict == "model_does_not_fit", report.data["summary"]
    assert "this URDF does not describe this arm: masses or lengths" in report.data["summary"]


def test_joints_that_bodies_tell_say_that_the_urdf_is_another_arms_whatever_wrists_do() -> None:
    """A geared six-axis arm whose wrist has friction that no body explains; all masses halved, then its own file."""
    arm, joints = load_arm("iiwa"), range(6)
    share = np.array([0.996, 0.997, 0.997, 0.995, -1.07, 0.58])
    beside = np.array([1.17, 0.86, 1.06, 0.99, 0.98, 1.06])
    halved = FreeBodies(0.91, share, beside, np.array([0.43, 0.46, 0.23, 0.99, 0.98, 1.05]), 1.93, 3.3)
    alike = ["payload@flange", "link_mass@link of joint_3"]
    (said, _) = other_arm_reasons(halved, arm, joints, alike, POLICY, ARM_POLICY)
    assert "masses or lengths of what q1, q2, q3 carry" in said
    assert "1.9 times all masses of the URDF" in said
    assert not other_arm_reasons(replace(halved, distance=0.12), arm, joints, alike, POLICY, ARM_POLICY)
    assert not other_arm_reasons(halved, arm, joints, alike[:1], POLICY, ARM_POLICY), "one name is the shorter answer"
    assert not other_arm_reasons(replace(halved, factor=1.2), arm, joints, alike, POLICY, ARM_POLICY), "drives do that"
