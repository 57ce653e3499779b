"""The loop on an arm: truth is Bullet with its own friction and payload, the nominal model its URDF."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from harness.command import main
from harness.diagnosis.arm.motion import arm_runs
from harness.diagnosis.arm.wide import wide_search
from harness.diagnosis.close import close_loop, close_loop_file
from harness.errors import InputError
from harness.physics.arms.arm import ArmModel, load_arm
from harness.signals import Dataset, FloatArray, PlantSpec, Run, Trajectory

pytest.importorskip("pybullet", reason="pybullet has wheels for CPython 3.10 and 3.11 only")

SECONDS = 10.0
USES: tuple[Literal["estimation", "validation"], ...] = ("estimation", "validation")


@cache
def arm() -> ArmModel:
    return load_arm("iiwa")


@cache
def record(seed: int, gains: tuple[float, ...] = (1.0,) * 7, *, seconds: float = SECONDS, **options: Any) -> Dataset:
    """Return a log of a Bullet iiwa that tracks a multisine: noisy torques and positions, nothing else."""
    from harness.rng import Streams
    from harness.rollout import run
    from plants.bullet.robots import iiwa
    from scenarios.closed_loop import ArmComputedTorque

    runs: list[Run] = []
    for use in USES:
        with iiwa(outputs=("q",), **options) as plant:
            scenario = ArmComputedTorque(duration=seconds, amplitude=0.4, noise=1e-4)
            log = run(plant, scenario, streams=Streams("iiwa", "tracking", seed), role=f"{use}/0")
        rng = np.random.default_rng(seed + len(runs))
        u = log.u / np.asarray(gains) + 0.05 * rng.standard_normal(log.u.shape)
        spec = PlantSpec(arm().inputs, arm().outputs, log.spec.sample_time)
        runs.append(Run(Trajectory(log.t, u, log.y, spec), use))
    return Dataset("arm", tuple(runs))


def found(data: dict[str, Any]) -> dict[str, dict[str, float]]:
    """Return the effects by ``name@at`` with their values."""
    return {
        f"{one['name']}@{one['at']}": {name: each["value"] for name, each in one["parameters"].items()}
        for one in data["effects"]
    }


@pytest.mark.slow
def test_nothing_is_missing_in_the_right_urdf() -> None:
    report = close_loop(record(11), arm())
    assert report.verdict == "nothing_missing", report.data["summary"]
    assert all(one["after"]["validation"] < 0.06 for one in report.data["joints"])
    json.dumps(report.data, allow_nan=False)


@pytest.mark.slow
def test_friction_larger_than_all_else_that_a_joint_does_is_named_though_the_joint_sticks() -> None:
    """While a joint stands still its friction is anything; a filter carried that into the rows where it moves."""
    report = close_loop(record(22, joint_friction=(0, 0, 1.0, 0, 0, 0, 0)), arm())
    effects = found(report.data)
    assert set(effects) == {"coulomb_friction@q3"}, report.data["summary"]
    assert effects["coulomb_friction@q3"]["Fc"] == pytest.approx(1.0, rel=0.03)
    assert report.data["joints"][2]["after"]["validation"] < 0.03
    assert any("no elastic joint was looked for" in text for text in report.data["warnings"]), "it rings as it starts"


@pytest.mark.slow
def test_friction_of_one_joint_and_gain_of_another_are_named_there_and_nowhere_else(tmp_path: Path) -> None:
    data = record(12, (1.0, 1.05, 1.0, 1.0, 1.0, 1.0, 1.0), joint_friction=(0, 0, 0, 2.0, 0, 0, 0))
    report = close_loop(data, arm(), out=tmp_path / "out")
    effects = found(report.data)
    assert set(effects) == {"coulomb_friction@q4", "input_gain@tau2"}, report.data["summary"]
    assert effects["coulomb_friction@q4"]["Fc"] == pytest.approx(2.0, rel=0.05)
    assert effects["input_gain@tau2"]["gain"] == pytest.approx(1.05, abs=0.005)
    urdf = (tmp_path / "out" / "repaired.urdf").read_text()
    assert "input_gain at tau2" in urdf
    assert load_arm(tmp_path / "out" / "repaired.urdf").friction[3] == pytest.approx(2.0, rel=0.05)
    page = (tmp_path / "out" / "report.html").read_text()
    assert "lbr_iiwa_joint_7" in page
    assert "coulomb friction" in page


@pytest.mark.slow
def test_payload_is_named_with_its_mass_from_bare_files(tmp_path: Path) -> None:
    data = record(13, payload=2.0)
    titles = ["t [s]", *(f"tau_{k} [N m]" for k in range(1, 8)), *(f"q_{k} [rad]" for k in range(1, 8))]
    for one in data.runs:
        log = one.trajectory
        table = np.column_stack([log.t, log.u, log.y])
        np.savetxt(tmp_path / f"{one.use}.csv", table, delimiter=",", header=",".join(titles), comments="", fmt="%.9g")
    report = close_loop_file(
        tmp_path / "estimation.csv", validation=tmp_path / "validation.csv", model="iiwa", out=tmp_path / "out"
    )
    effects = found(report.data)
    assert set(effects) == {"payload@flange"}, report.data["summary"]
    assert effects["payload@flange"]["m"] == pytest.approx(2.0, rel=0.02)
    masses = [joint.mass for joint in load_arm(tmp_path / "out" / "repaired.urdf").arm.joints]
    assert masses[-1] == pytest.approx(2.0, rel=0.02)


@pytest.mark.slow
def test_a_simulated_arm_goes_into_the_loop_with_its_rates(tmp_path: Path) -> None:
    """``sysid simulate iiwa-bullet``, then ``sysid close-loop``: rates beside the angles were refused."""
    options = ["--scenario", "arm-computed-torque", "-S", "noise=1e-4", "-S", "duration=10"]
    files = {"estimation/0": tmp_path / "run.csv", "validation/0": tmp_path / "val.csv"}
    for role, path in files.items():
        with pytest.raises(SystemExit) as ended:
            main(["simulate", "iiwa-bullet", *options, "--role", role, "-o", str(path)])
        assert ended.value.code == 0
    run, val = files.values()
    assert "q7_rate [rad/s]" in run.read_text().partition("\n")[0]
    report = close_loop_file(run, validation=val, model="iiwa", out=tmp_path / "out")
    assert report.data["adequacy"] == "explained"
    assert report.verdict == "nothing_missing", report.data["summary"]
    assert not any("swapped" in one for one in report.data["warnings"])


@pytest.mark.slow
def test_one_file_of_a_simulated_arm_lacks_nothing(tmp_path: Path) -> None:
    """The engine's own steps looked like a viscous friction of a thousandth of a joint's torque."""
    path = tmp_path / "run.csv"
    with pytest.raises(SystemExit):
        main(["simulate", "iiwa-bullet", "--scenario", "arm-computed-torque", "-S", "noise=1e-4", "-o", str(path)])
    report = close_loop_file(path, model="iiwa", out=tmp_path / "out")
    assert report.verdict == "nothing_missing", report.data["summary"]
    assert report.data["adequacy"] == "explained"


@pytest.mark.slow
def test_a_flexible_joint_is_named_with_its_compliance() -> None:
    # the motor of a flexible joint stands at the link's position plus torque over stiffness
    stiff = record(11, seconds=2.5 * SECONDS)  # an elastic joint is looked for in 100 rows of clear motion and more
    runs = []
    for one in stiff.runs:
        log = one.trajectory
        y = log.y.copy()
        y[:, 1] += log.u[:, 1] / 3000.0
        runs.append(Run(Trajectory(log.t, log.u, y, log.spec), one.use))
    result = wide_search(arm(), arm_runs(arm(), Dataset("flexible", tuple(runs))), range(7))
    assert [str(one.placed) for one in result.accepted] == ["joint_elasticity@q2"]
    assert result.fit.values["joint_elasticity@q2.compliance"] == pytest.approx(1 / 3000.0, rel=0.15)


def test_an_arm_that_stands_still_is_refused() -> None:
    spec = PlantSpec(arm().inputs, arm().outputs, 0.004)
    t: FloatArray = np.arange(1000, dtype=np.float64) * np.float64(0.004)
    q: FloatArray = np.where(t[:, None] < 0.3, np.sin(20 * t)[:, None], np.sin(6.0)) * np.ones(7)
    u = np.random.default_rng(0).standard_normal((1000, 7))
    runs = tuple(Run(Trajectory(t, u, q, spec), use) for use in USES)
    with pytest.raises(InputError, match="no joint"):
        close_loop(Dataset("still", runs), arm())
