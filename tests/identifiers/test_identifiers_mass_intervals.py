"""Intervals of the masses of an arm: what a record alone tells, and what physics, shapes and the file add."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from harness import api
from harness.errors import HarnessError
from harness.models.analysis import Findings
from harness.physics.arms.arm import ArmModel, load_arm
from harness.signals import Dataset, FloatArray, PlantSpec, Run, Trajectory
from identifiers.mechanics.arms.mass_intervals import KINDS, MassIntervals

pytest.importorskip("cvxpy", reason="semidefinite programs need cvxpy: pip install 'sysid-harness[inertial]'")

DT, N = 0.01, 1200
MASSES = (2.0, 1.2)


def arm_file(folder: Path, *, shapes: bool, masses: tuple[float, float] = MASSES) -> Path:
    """Write a level arm of two links, the second half a metre out."""

    def link(number: int) -> str:
        shape = '<collision><origin xyz="0.25 0 0"/><geometry><box size="0.5 0.1 0.1"/></geometry></collision>'
        return (
            f'<link name="l{number}"><inertial><origin xyz="0.25 0 0"/><mass value="{masses[number - 1]}"/>'
            '<inertia ixx="0.003" iyy="0.03" izz="0.03" ixy="0" ixz="0" iyz="0"/></inertial>'
            f"{shape if shapes else ''}</link>"
        )

    def joint(number: int, place: float) -> str:
        return (
            f'<joint name="j{number}" type="continuous"><parent link="l{number - 1}"/><child link="l{number}"/>'
            f'<origin xyz="{place} 0 0"/><axis xyz="0 1 0"/></joint>'
        )

    path = folder / f"arm-{shapes}-{masses[0]}.urdf"
    path.write_text(f'<robot name="two"><link name="l0"/>{link(1)}{link(2)}{joint(1, 0.0)}{joint(2, 0.5)}</robot>')
    return path


def log(arm: ArmModel, seed: int, *, memory: float = 0.0) -> Dataset:
    """Return a record of the arm; the noise of its torques remembers so much of itself from row to row."""
    rng = np.random.default_rng(seed)
    t: FloatArray = DT * np.arange(N, dtype=float)
    phases = rng.uniform(0, 6, (2, 2))
    q, v, a = (np.zeros((N, 2)) for _ in range(3))
    for size, pace, phase in ((0.8, [2.5, 4.3], phases[0]), (0.4, [6.9, 4.1], phases[1])):  # pace in rad/s
        angle, w = t[:, None] * pace + phase, np.array(pace)
        q, v, a = q + size * np.sin(angle), v + size * w * np.cos(angle), a - size * w**2 * np.sin(angle)
    noise = 0.05 * rng.standard_normal(q.shape)
    for k in range(1, N):
        noise[k] += memory * noise[k - 1]
    u = arm.torques(q, v, a) + 0.3 * v + noise
    spec = PlantSpec(arm.inputs, arm.outputs, DT)
    run = Run(Trajectory(t, u, q + 1e-5 * rng.standard_normal(q.shape), spec), "estimation")
    return Dataset("two", (run,), intersample="smooth")


def ends(found: Findings, body: int, kind: int) -> tuple[float, float]:
    """Return an interval of a mass, its ends infinite where it has none."""
    low, high = found.details["intervals"][body][kind]
    return (-np.inf if low is None else low), (np.inf if high is None else high)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_every_interval_holds_the_mass_and_knowing_more_leaves_less_open(tmp_path: Path, seed: int) -> None:
    path = arm_file(tmp_path, shapes=True)
    found = MassIntervals(model=str(path)).of(log(load_arm(path), seed), rng=np.random.default_rng(0))
    for body, mass in enumerate(MASSES):
        widths = []
        for kind in range(4):
            low, high = ends(found, body, kind)
            assert low < mass < high
            widths.append(high - low)
        assert widths[0] == np.inf  # a motion in a plane shows sums
        assert 1.001 * widths[1] >= widths[2]
        assert widths[2] > widths[3] > 0
    assert found.plot().axes[0].get_yticklabels()[1].get_text() == "j2"


def test_without_shapes_there_is_no_such_interval_and_the_words_say_so(tmp_path: Path) -> None:
    path = arm_file(tmp_path, shapes=False)
    found = MassIntervals(model=str(path), free=["j2"]).of(log(load_arm(path), 0), rng=np.random.default_rng(0))
    (row,) = found.rows
    assert row[f"{KINDS[2]} [kg]"] is None
    assert any("states no shapes" in text for text in found.words)
    low, high = ends(found, 0, 0)  # with the first link known the second one's mass is told
    assert low < MASSES[1] < high < np.inf


def test_errors_that_last_make_the_intervals_wider(tmp_path: Path) -> None:
    path = arm_file(tmp_path, shapes=False)
    arm = load_arm(path)
    found = [
        MassIntervals(model=str(path), free=["j2"]).of(log(arm, 1, memory=memory), rng=np.random.default_rng(0))
        for memory in (0.0, 0.9)
    ]
    white, lasting = (one.details["colour"] for one in found)
    assert white < 3.0
    assert lasting > 3 * white
    low, high = ends(found[0], 0, 0)
    lower, higher = ends(found[1], 0, 0)
    assert higher - lower > high - low


def test_records_of_another_arm_are_refused_by_name(tmp_path: Path) -> None:
    path = arm_file(tmp_path, shapes=False)
    data = log(load_arm(path), 0).runs[0].trajectory
    spec = PlantSpec(data.spec.inputs[:1], data.spec.outputs, DT)
    other = Dataset("one", (Run(Trajectory(data.t, data.u[:, :1], data.y, spec), "estimation"),))
    with pytest.raises(HarnessError, match=r"expected tau1, tau2 -> q1, q2"):
        MassIntervals(model=str(path)).of(other, rng=np.random.default_rng(0))


def test_the_command_finds_the_columns_and_draws(tmp_path: Path) -> None:
    path = arm_file(tmp_path, shapes=True)
    data = log(load_arm(path), 0).runs[0].trajectory
    table = np.column_stack([data.t, data.u, data.y])
    np.savetxt(tmp_path / "run.csv", table, delimiter=",", comments="",
               header="time [s],tau1 [N m],tau2 [N m],q1 [rad],q2 [rad]")  # fmt: skip
    found = api.analyse("mass-intervals", str(tmp_path / "run.csv"), options={"model": str(path)},
                        out=tmp_path / "masses.svg")  # fmt: skip
    assert [row["body"] for row in found.rows] == ["j1", "j2"]
    assert json.loads(json.dumps(found.to_dict(), allow_nan=False))["intervals"][0][0] == [None, None]
    assert "<svg" in (tmp_path / "masses.svg").read_text()
