"""Torque logs of an arm: what no joint did is said by joint and run, and good logs with friction and noise pass."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from harness.diagnosis.arm.checks import check_torques
from harness.diagnosis.close import close_loop
from harness.physics.arms.arm import load_arm
from harness.signals import Channel, Dataset, FloatArray, PlantSpec, Run, Trajectory

DT, N = 0.005, 2000
T = np.arange(N) * DT
SPEC = PlantSpec(tuple(Channel(f"tau{k}", "N m") for k in (1, 2)), tuple(Channel(f"q{k}", "rad") for k in (1, 2)), DT)


def runs(change: Callable[[FloatArray], FloatArray] = lambda u: u) -> list[Run]:
    """Return two runs of two joints with gravity, inertia, friction and sensor noise; the second torque is changed."""
    made = []
    for seed, use in enumerate(("estimation", "validation")):
        rng = np.random.default_rng(seed)
        q = np.stack([0.5 * np.sin(2 * np.pi * f * T + rng.uniform(0, 6)) for f in (0.4, 0.9)], axis=1)
        v = np.gradient(q, DT, axis=0)
        u = 20 * np.sin(q) + 2 * np.gradient(v, DT, axis=0) + 3 * np.sign(v) + rng.normal(0, 0.3, q.shape)
        u[:, 1] = change(u[:, 1])
        made.append(Run(Trajectory(T, u, q + rng.normal(0, 1e-4, q.shape), SPEC), use))  # type: ignore[arg-type]
    return made


def stuck(u: FloatArray) -> FloatArray:
    """Return a log whose sensor hung for a second and a half."""
    held = u.copy()
    held[700:1000] = u[700]
    return held


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (stuck, "torque tau2 stands still at"),
        (lambda u: np.clip(u, -8, 8), "torque tau2 rests at its largest value 8 N m"),
        (lambda u: np.full_like(u, 1.5), "torque tau2 is constant (1.5 N m)"),
        (lambda u: u + 5 * np.sign(np.sin(2 * np.pi * 41 * T)), "torque tau2 chatters for"),
    ],
    ids=["stuck", "saturated", "constant", "chattering"],
)
def test_a_broken_torque_is_said_with_joint_and_run(change: Callable[[FloatArray], FloatArray], words: str) -> None:
    notes = check_torques(runs(change))
    for start in ("run 0 (estimation): ", "run 1 (validation): "):
        assert sum(note.startswith(start + words) for note in notes) == 1, notes
    assert not any("tau1" in note for note in notes)


def test_noise_from_feedback_and_steps_of_friction_are_no_fault() -> None:
    assert check_torques(runs()) == []
    assert check_torques(runs(lambda u: u + np.random.default_rng(9).normal(0, 5, N))) == []


@pytest.mark.slow
def test_the_report_of_an_arm_says_it() -> None:
    arm = load_arm("iiwa")
    spec = PlantSpec(arm.inputs, arm.outputs, DT)
    made = []
    for seed, use in enumerate(("estimation", "validation")):
        rng = np.random.default_rng(seed)
        phases = rng.uniform(0, 6, 7)
        q = 0.3 * np.sin(2 * np.pi * np.linspace(0.3, 0.6, 7) * T[:, None] + phases)
        v = np.gradient(q, DT, axis=0)
        u = arm.torques(q, v, np.gradient(v, DT, axis=0)) + rng.normal(0, 0.05, q.shape)
        u[:, 0] += 3 * np.sign(np.sin(2 * np.pi * 41 * T))
        made.append(Run(Trajectory(T, u, q, spec), use))  # type: ignore[arg-type]
    report = close_loop(Dataset("chattering", tuple(made)), arm, dictionary=[])
    assert any("torque tau1 chatters" in text for text in report.data["warnings"])
