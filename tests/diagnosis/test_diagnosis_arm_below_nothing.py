"""An inertia below nothing is refused by name: a name for what imitates it would be a wrong one."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from lever import lever_urdf

from harness.diagnosis.arm.misfit import apparent_inertia, inertia_below_nothing
from harness.diagnosis.arm.motion import arm_runs
from harness.diagnosis.close import close_loop
from harness.physics.arms.arm import ArmModel, load_arm
from harness.signals import Dataset, PlantSpec, Run, Trajectory

DT, NOISE = 0.01, 0.05
USES: tuple[Literal["estimation", "validation"], ...] = ("estimation", "validation")
INERTIA = 0.02 + 1.0 * 0.3**2


@cache
def lever(folder: Path, inertia: str) -> ArmModel:
    path = folder / f"{inertia}.urdf"
    path.write_text(lever_urdf())
    return load_arm(path, inertia=inertia)


def log(arm: ArmModel, less: float, friction: float = 0.0) -> Dataset:
    """Return records of a lever with less inertia than its URDF says, and dry friction."""
    runs = []
    for seed, use in enumerate(USES):
        rng = np.random.default_rng(seed)
        t, w = np.arange(1500) * DT, 2 * np.pi * np.arange(1, 6) / 7.5
        a, phase = rng.normal(size=(2, 5)) * np.array([0.25, 3.0])[:, None]
        turn = w * t[:, None] + phase
        q, v, acceleration = (
            (a * shape).sum(axis=1)[:, None] for shape in (np.sin(turn), w * np.cos(turn), -(w**2) * np.sin(turn))
        )
        u = arm.torques(q, v, acceleration) - less * acceleration + friction * np.sign(v)
        u = u + NOISE * rng.normal(size=q.shape)
        runs.append(Run(Trajectory(t, u, q, PlantSpec(arm.inputs, arm.positions, DT)), use))
    return Dataset("lever", tuple(runs), intersample="smooth")


@pytest.mark.slow
@pytest.mark.parametrize("inertia", ["fixed", "calibrated"])
def test_an_inertia_below_nothing_is_refused_by_name(tmp_path: Path, inertia: str) -> None:
    arm = lever(tmp_path, inertia)
    report = close_loop(log(arm, INERTIA + 0.19), arm)
    assert report.verdict == "model_does_not_fit", report.data["summary"]
    said = " ".join(map(str, report.data["misfit"])) if "misfit" in report.data else str(report.data)
    assert "below nothing" in said
    assert "at q1" in said


def test_a_light_lever_with_friction_is_no_such_thing(tmp_path: Path) -> None:
    """A tenth of the URDF's inertia is left: little, but something."""
    arm = lever(tmp_path, "fixed")
    runs = arm_runs(arm, log(arm, 0.9 * INERTIA, friction=0.5))
    assert inertia_below_nothing(arm, runs, [0]) == ()
    value, deviation = apparent_inertia(arm, runs["estimation"], 0)
    assert value == pytest.approx(0.1 * INERTIA, abs=5 * deviation + 0.1 * INERTIA)


@pytest.mark.parametrize(("less", "refused"), [(INERTIA - 0.04, False), (INERTIA + 0.04, True)])
def test_both_uses_have_to_ask_for_it_beyond_their_errors(tmp_path: Path, less: float, refused: bool) -> None:
    arm = lever(tmp_path, "fixed")
    assert bool(inertia_below_nothing(arm, arm_runs(arm, log(arm, less)), [0])) == refused
