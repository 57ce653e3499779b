"""Gravity of an arm from postures at rest, with static friction that hides it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from harness import api
from harness.errors import HarnessError
from harness.physics.arms.arm import ArmModel, load_arm
from harness.physics.arms.urdf_write import urdf_with
from harness.signals import Dataset, FloatArray, PlantSpec, Run, Trajectory
from identifiers.mechanics.arms.rest import GravityAtRest

pytest.importorskip("pybullet_data", reason="the URDF of the iiwa comes with pybullet")

DT = 0.02
HELD, MOVED = 25, 25  # samples


def postures(arm: ArmModel, seed: int, *, count: int = 40, friction: float = 0.0, noise: float = 0.02) -> Dataset:
    """Return a log of an arm that is brought to random postures and held there by its joints' friction as well."""
    rng = np.random.default_rng(seed)
    goals = rng.uniform(-1.2, 1.2, size=(count, arm.n))
    q, u = [], []
    at: FloatArray = np.zeros(arm.n)
    for goal in goals:
        way = np.linspace(0.0, 1.0, MOVED + 2)[1:-1, None]
        q.append(at + (goal - at) * way)
        u.append(np.full((MOVED, arm.n), np.nan))
        stays = np.tile(goal, (HELD, 1))
        still = np.zeros_like(stays)
        q.append(stays)
        u.append(arm.torques(stays, still, still) + friction * np.sign(goal - at))
        at = goal
    positions, torques = np.concatenate(q), np.nan_to_num(np.concatenate(u))
    spec = PlantSpec(arm.inputs, arm.outputs, DT)
    noisy = torques + noise * rng.standard_normal(torques.shape), positions + 1e-5 * rng.standard_normal(torques.shape)
    run = Run(Trajectory(DT * np.arange(len(positions), dtype=float), *noisy, spec), "estimation")
    return Dataset("held", (run,))


def wrong(folder: Path, factor: float) -> Path:
    arm = load_arm("iiwa")
    table = arm.arm.parameters.reshape(-1, 10).copy()
    table[3] *= factor
    path = folder / "wrong.urdf"
    path.write_text(urdf_with(arm, table.ravel()))
    return path


@pytest.mark.parametrize("friction", [0.0, 0.6])
def test_gravity_is_compensated_whatever_the_file_says_and_friction_is_told_apart(
    tmp_path: Path, friction: float
) -> None:
    arm = load_arm("iiwa")
    found = GravityAtRest(model=str(wrong(tmp_path, 1.6))).of(
        postures(arm, 0, friction=friction), rng=np.random.default_rng(0)
    )
    assert len(found.details["postures"]) == 40
    rows = {row["joint"]: row for row in found.rows}
    assert rows["q2"]["the file errs, rms"] > 1.0
    for row in found.rows:
        assert row["left, rms"] < 0.02  # noise of 0.02 N m over 25 samples is 0.004
        assert abs(row["static friction"] - friction) < max(row["+- (95 %)"], 0.004)
    q = np.random.default_rng(1).uniform(-1, 1, size=(50, 7))
    still = np.zeros_like(q)
    told = arm.torques(q, still, still, parameters=found.details["inertial"])
    np.testing.assert_allclose(told, arm.torques(q, still, still), atol=0.05)


def test_intervals_of_the_friction_cover() -> None:
    arm, held = load_arm("iiwa"), []
    for seed in range(40):
        found = GravityAtRest().of(postures(arm, 100 + seed, friction=0.3, noise=0.1), rng=np.random.default_rng(0))
        held += [abs(row["static friction"] - 0.3) < row["+- (95 %)"] for row in found.rows]
    assert 0.90 < np.mean(held) < 0.985


def test_a_log_without_rests_and_one_with_too_few_are_refused() -> None:
    arm = load_arm("iiwa")
    data = postures(arm, 0, count=3)
    with pytest.raises(HarnessError, match="more postures, or leave friction out"):
        GravityAtRest().of(data, rng=np.random.default_rng(0))
    one = data.runs[0].trajectory
    moving = Trajectory(one.t, one.u, one.y + 0.5 * one.t[:, None], one.spec)
    with pytest.raises(HarnessError, match="postures that are held"):
        GravityAtRest().of(Dataset("moving", (Run(moving, "estimation"),)), rng=np.random.default_rng(0))


def test_the_command_draws_and_says_where_friction_stays_hidden(tmp_path: Path) -> None:
    arm = load_arm("iiwa")
    one = postures(arm, 2).runs[0].trajectory
    y = one.y.copy()
    y[:, 6] = np.repeat(0.01 * np.arange(len(y) // 50), 50)[: len(y)]  # the last joint only ever comes from below
    titles = ["time [s]", *(f"tau{k} [N m]" for k in range(1, 8)), *(f"q{k} [rad]" for k in range(1, 8))]
    np.savetxt(tmp_path / "run.csv", np.column_stack([one.t, one.u, y]), delimiter=",", comments="",
               header=",".join(titles))  # fmt: skip
    found = api.analyse("gravity-at-rest", tmp_path / "run.csv", out=tmp_path / "gravity.svg")
    assert "<svg" in (tmp_path / "gravity.svg").read_text()
    assert any(text.startswith("q7 never came to rest from both sides") for text in found.words)
    assert found.rows[6]["static friction"] is None
