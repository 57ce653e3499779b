"""Friction of a geared joint: a torque that is all friction explains nothing by itself, and pauses are no refusal."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from lever import lever_urdf

from harness.diagnosis.arm.joint import JointRegression, joint_dictionary
from harness.diagnosis.arm.motion import arm_runs
from harness.diagnosis.arm.regression import RegressionForm
from harness.diagnosis.arm.wide_regression import WideRegression
from harness.diagnosis.close import close_loop
from harness.diagnosis.search.compare import compared
from harness.physics.arms.arm import ArmModel, load_arm
from harness.signals import Dataset, FloatArray, PlantSpec, Run, Trajectory

DT = 0.01
USES: tuple[Literal["estimation", "validation"], ...] = ("estimation", "validation")


@pytest.fixture(scope="module")
def levers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, ArmModel]:
    """Return a light lever, which needs next to no torque, and a heavy one."""
    folder: Path = tmp_path_factory.mktemp("levers")
    made = {}
    for name, mass in (("light", 1e-3), ("heavy", 2.0)):
        path = folder / f"{name}.urdf"
        path.write_text(lever_urdf(mass, 0.02 * mass))
        made[name] = load_arm(path)
    return made


@cache
def motion(seed: int, pause: float = 0.0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a joint that swings (N, 1) between two pauses of this share of the record, its rate, acceleration."""
    phase = np.random.default_rng(seed).uniform(0, 6, 5)
    t = np.arange(2000) * DT
    runs = np.clip((t / t[-1] - 0.5 * pause) / (1 - pause), 0.0, 1.0)  # a clock that stands still in the pauses
    inside = (runs > 0) & (runs < 1)
    w, size = 2 * np.pi * np.array([1, 2, 3, 4, 5]), np.array([0.5, 0.3, 0.3, 0.2, 0.1])
    fade = np.sin(np.pi * runs) ** 2  # comes to rest at both ends
    q = fade * np.sum(size * np.sin(np.outer(runs, w) * 2 + phase), axis=1) * inside
    v = np.gradient(q, DT)
    return q[:, None], v[:, None], np.gradient(v, DT)[:, None]


def records(lever: ArmModel, friction: object, pause: float = 0.0) -> Dataset:
    """Return two logs of a lever, its torque noisy by 0.01 N m, with friction(v, torque needed)."""
    runs = []
    for seed, use in enumerate(USES):
        q, v, a = (np.asarray(one, dtype=np.float64) for one in motion(seed, pause))
        needed = lever.torques(q, v, a)
        u = needed + friction(v, needed) + 0.01 * np.random.default_rng(seed).normal(size=q.shape)  # type: ignore[operator]
        runs.append(
            Run(
                Trajectory(
                    np.asarray(np.arange(len(q)) * DT, dtype=np.float64),
                    u,
                    q,
                    PlantSpec(lever.inputs, lever.positions, DT),
                ),
                use,
            )
        )
    return Dataset("lever", tuple(runs), intersample="smooth")


def regression_of(lever: ArmModel, data: Dataset) -> JointRegression:
    runs = arm_runs(lever, data)
    known = {use: [run.rigid[:, 0] for run in parts] for use, parts in runs.items()}
    return JointRegression(lever, 0, runs, known)


@pytest.mark.parametrize("mu", [0.2, 0.4, 0.6])
def test_a_torque_that_is_all_friction_does_not_explain_itself(levers: dict[str, ArmModel], mu: float) -> None:
    """It is its own size times the sign of the speed: two wrists of a UR10e were "explained" so, with mu = 1.0."""
    data = records(levers["light"], lambda v, _: (1.0 + 0.3 * np.abs(v)) * np.tanh(v / 1e-3))
    regression = regression_of(levers["light"], data)
    (load,) = [one for one in joint_dictionary(levers["light"], 0, regression) if "load" in one.effect.name]
    assert load.effect.parameter("mu").maximum < 1.0, "what lets nothing pass is another gear"
    equation = regression.equation([load])
    values = {**equation.system.values(), load.name("mu"): mu, load.name("w"): 1e-2}
    p = np.array([values[name] for name in equation.system.parameter_names])
    residual = np.concatenate([r for r, _ in equation.residual(p, "estimation")])
    assert np.sqrt(np.mean(residual**2)) > 0.9 * float(np.ravel(regression.size)[0])


@pytest.mark.slow
def test_friction_in_proportion_to_the_load_is_found_with_its_size(levers: dict[str, ArmModel]) -> None:
    """Of the torque u the part (1 - mu sgn(u) sgn(v)) u passes."""
    data = records(levers["heavy"], lambda v, need: need * (1 / (1 - 0.15 * np.sign(need) * np.tanh(v / 1e-2)) - 1))
    report = close_loop(data, levers["heavy"])
    (effect,) = report.data["effects"]
    assert effect["name"] == "load_dependent_friction", report.data["summary"]
    assert effect["parameters"]["mu"]["value"] == pytest.approx(0.15, rel=0.1)


@pytest.mark.slow
def test_a_joint_that_pauses_for_half_of_the_time_is_judged(levers: dict[str, ArmModel]) -> None:
    data = records(levers["heavy"], lambda v, _: 0.8 * np.tanh(v / 1e-3) + 0.5 * v, pause=0.45)
    report = close_loop(data, levers["heavy"])
    (joint,) = report.data["joints"]
    assert joint["judged"]
    assert 0.4 < joint["standstill"] < 0.66
    names = {one["name"]: one["parameters"] for one in report.data["effects"]}
    assert set(names) == {"coulomb_friction", "viscous_friction"}, report.data["summary"]
    assert names["coulomb_friction"]["Fc"]["value"] == pytest.approx(0.8, rel=0.05)


def test_a_link_is_judged_beside_what_its_joint_brakes_on_that_day(levers: dict[str, ArmModel]) -> None:
    """Dry friction is three times as large in the validation record; that speaks neither for nor against a mass."""
    lever, mass = levers["heavy"], 0.3
    days = [
        records(lever, lambda v, needed, level=level: mass * needed + level * np.sign(v)).runs for level in (0.5, 1.5)
    ]
    data = Dataset("two days", (days[0][0], days[1][1]), intersample="smooth")
    regression = WideRegression(lever, arm_runs(lever, data), [0])
    form = RegressionForm(regression)
    link = next(effect.placed for effect in regression.effects.values() if effect.placed.effect.name == "link_mass")
    without, fit = form.fit((), [{}], None), form.fit([link], [{}], None)
    assert without is not None
    assert fit is not None
    assert fit.values[link.name("scale")] == pytest.approx(mass, abs=0.02)
    found = compared(fit, without)
    assert found.validation > max(0.5 * found.evidence, 3 * found.error)
    assert fit.own["q1 dry"] == pytest.approx(1.5, rel=0.05)
