"""Masses and lengths of another arm, from its log and the URDF of this one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from harness.diagnosis.arm.motion import ArmRun, arm_runs
from harness.diagnosis.arm.other_arm import runs_of_another_arm
from harness.diagnosis.arm.wide_regression import WideRegression
from harness.physics.arms.arm import ArmModel, load_arm
from harness.signals import Dataset, PlantSpec, Run, Trajectory

DT, N = 0.01, 1500
T = np.arange(N) * DT


def two_links(folder: Path, first: float, second: float, masses: tuple[float, float] = (2.0, 1.0)) -> ArmModel:
    """Return a level arm of two links with the second joint at `first` and the last mass at `second` [m]."""

    def link(number: int, mass: float, centre: float) -> str:
        return (
            f'<link name="l{number}"><inertial><origin xyz="{centre} 0 0"/><mass value="{mass}"/>'
            '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        )

    def joint(number: int, place: float) -> str:
        return (
            f'<joint name="j{number}" type="continuous"><parent link="l{number - 1}"/><child link="l{number}"/>'
            f'<origin xyz="{place} 0 0"/><axis xyz="0 1 0"/></joint>'
        )

    path = folder / f"arm-{first}-{second}.urdf"
    path.write_text(
        f'<robot name="two"><link name="l0"/>{link(1, masses[0], 0.2)}{link(2, masses[1], second)}'
        f"{joint(1, 0.0)}{joint(2, first)}</robot>"
    )
    return load_arm(path)


def log(arm: ArmModel) -> Dataset:
    spec = PlantSpec(arm.inputs, arm.outputs, DT)
    runs = []
    for seed, use in enumerate(("estimation", "validation")):
        rng = np.random.default_rng(seed)
        phases = rng.uniform(0, 6, (2, 2))
        angle = 2 * np.pi * T[:, None]
        q = 0.8 * np.sin(0.4 * angle * [1.0, 1.7] + phases[0]) + 0.4 * np.sin(1.1 * angle * [1.0, 0.6] + phases[1])
        v = np.gradient(q, DT, axis=0)
        u = arm.torques(q, v, np.gradient(v, DT, axis=0)) + 0.3 * v + 0.02 * rng.standard_normal(q.shape)
        runs.append(Run(Trajectory(T, u, q + 1e-5 * rng.standard_normal(q.shape), spec), use))  # type: ignore[arg-type]
    return Dataset("two", tuple(runs))


@pytest.mark.parametrize(("first", "second", "masses"), [(0.6, 0.3, (2.0, 1.0)), (0.25, 0.5, (1.0, 2.0))])
def test_the_torques_of_an_arm_with_other_lengths_and_masses_are_reached(
    tmp_path: Path, first: float, second: float, masses: tuple[float, float]
) -> None:
    other, file = two_links(tmp_path, first, second, masses), two_links(tmp_path, 0.4, 0.3)
    runs = arm_runs(file, log(other))
    own = WideRegression(file, runs, [0, 1]).equation(()).columns["estimation"]
    freed = runs_of_another_arm(file, runs, own, [0, 1])

    def left(runs: Mapping[str, Sequence[ArmRun]]) -> float:
        """Return what friction and rotors, fitted to the first record, leave of the torques of the second."""
        equation = WideRegression(file, runs, [0, 1]).equation(())
        columns, target = (
            {use: np.concatenate(parts) for use, parts in each.items() if parts}
            for each in (equation.columns, equation.target)
        )
        k = columns["estimation"].shape[2]
        p = np.linalg.lstsq(columns["estimation"].reshape(-1, k), target["estimation"].ravel(), rcond=None)[0]
        return float(np.sqrt(np.mean((columns["validation"] @ p - target["validation"]) ** 2)))

    assert left(runs) > 0.5
    assert left(freed) < 0.02
