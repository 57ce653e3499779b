"""Bodies of an arm whose inertial parameters are free: whatever the log asks for, the answer is one mass can make."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from lever import lever_urdf

from harness.diagnosis.close import close_loop
from harness.physics.arms.arm import ArmModel, load_arm
from harness.physics.arms.inertia import is_consistent
from harness.signals import Dataset, FloatArray, PlantSpec, Run, Trajectory

pytestmark = pytest.mark.slow  # whole loops

pytest.importorskip("pybullet_data", reason="the URDF of the iiwa comes with PyBullet")

DT, NOISE = 0.01, 0.05
USES: tuple[Literal["estimation", "validation"], ...] = ("estimation", "validation")


@cache
def arm() -> ArmModel:
    return load_arm("iiwa", inertia="calibrated")


def motion(seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return joints that swing at several rates (N, 7), their rates and accelerations."""
    rng = np.random.default_rng(seed)
    t = np.arange(1500) * DT
    w = 2 * np.pi * np.arange(1, 6) / 7.5
    a, phase = rng.normal(size=(2, 5, 7)) * np.array([0.25, 1.0])[:, None, None]
    turn = w[:, None] * t[:, None, None] + 3 * phase
    q = np.sum(a * np.sin(turn), axis=1)
    return q, np.sum(a * w[:, None] * np.cos(turn), axis=1), np.sum(-a * w[:, None] ** 2 * np.sin(turn), axis=1)


def log(parameters: FloatArray) -> Dataset:
    """Return records of an arm with these bodies."""
    runs = []
    for seed, use in enumerate(USES):
        q, v, a = motion(seed)
        u = (
            arm().torques(q, v, a, parameters=parameters)
            + arm().damped(v)
            + NOISE * np.random.default_rng(10 + seed).normal(size=q.shape)
        )
        runs.append(Run(Trajectory(np.arange(len(q)) * DT, u, q, PlantSpec(arm().inputs, arm().positions, DT)), use))
    return Dataset("arm", tuple(runs), intersample="smooth")


def heavier() -> FloatArray:
    """Return the URDF's parameters, the fourth and sixth body 1.4 times as heavy."""
    table = arm().arm.parameters.reshape(-1, 10).copy()
    table[[arm().links[3], arm().links[5]]] *= 1.4
    return table.ravel()


def test_bodies_are_physical_where_free_directions_are_not(tmp_path: Path) -> None:
    data = log(heavier())
    q, v, a = motion(0)
    u = data.runs[0].trajectory.u
    rest = (u - arm().torques(q, v, a) - arm().damped(v)).ravel()
    free = arm().arm.parameters + np.linalg.lstsq(arm().arm.regressor(q, v, a), rest, rcond=1e-4)[0]
    assert not is_consistent(free.reshape(-1, 10)[list(arm().links)]), "the log is to ask for bodies that none is"
    report = close_loop(data, arm(), out=tmp_path, dictionary=[])
    assert report.verdict == "nothing_missing", report.data["summary"]
    bodies = report.data["inertial_parameters"]
    assert not bodies["impossible"]
    assert is_consistent(np.reshape(bodies["values"], (-1, 10)))
    assert bodies["names"][0].startswith("m")
    assert bodies["units"][:2] == ["kg", "kg m"]
    mended = load_arm(tmp_path / "repaired.urdf").arm.parameters
    assert is_consistent(mended.reshape(-1, 10)[list(arm().links)])
    q, v, a = motion(7)
    truth = arm().torques(q, v, a, parameters=heavier())
    missed = np.sqrt(np.mean((arm().torques(q, v, a, parameters=mended) - truth) ** 2))
    nominal = np.sqrt(np.mean((arm().torques(q, v, a) - truth) ** 2))
    assert missed < 0.3 * NOISE
    assert missed < 0.1 * nominal
    assert "bodies that were fitted" in (tmp_path / "report.html").read_text()


def test_a_torque_that_no_body_needs_is_not_hidden_in_one(tmp_path: Path) -> None:
    """An inertia below 0 at a single joint: free directions swallowed it, and nothing was missing."""
    path = tmp_path / "lever.urdf"
    path.write_text(lever_urdf())
    lever = load_arm(path, inertia="calibrated")
    runs = []
    for seed, use in enumerate(USES):
        q, v, a = (one[:, :1] for one in motion(seed))
        u = lever.torques(q, v, a) - 0.3 * a + NOISE * np.random.default_rng(seed).normal(size=q.shape)
        runs.append(Run(Trajectory(np.arange(len(q)) * DT, u, q, PlantSpec(lever.inputs, lever.positions, DT)), use))
    report = close_loop(Dataset("lever", tuple(runs), intersample="smooth"), lever, dictionary=[])
    assert report.verdict == "model_does_not_fit", report.data["summary"]  # no plant is like that
    assert "an inertia of -0.1" in report.data["summary"]
    assert report.data["inertial_parameters"] is None, "what imitates it is no body"
