"""Where an unmeasured force would do most of what moves a mass, its model is judged by free runs instead."""

from __future__ import annotations

import numpy as np
import pytest

from harness.diagnosis.algorithm import diagnose
from harness.diagnosis.diagnosis import Diagnosis
from harness.effects import builtin
from harness.physics import load_model
from harness.physics.compiled.system import System
from harness.signals import Dataset, PlantSpec, Run, Trajectory

DT = 0.002


def shaken(model: System, seed: int, sign: float) -> Trajectory:
    """Return 6 s of a slow motion that a force five times as large as the motor's shakes at about 25 Hz."""
    rng, t = np.random.default_rng(seed), np.linspace(0.0, 2999 * DT, 3000)
    phases = rng.uniform(0, 2 * np.pi, 3)
    motor = np.sin(2 * np.pi * np.outer(t, (0.4, 0.9, 1.6)) + phases).sum(axis=1)
    pole, shake = 0.995, np.zeros(len(t))
    for k, noise in enumerate(rng.normal(size=len(t))):
        if k > 1:
            shake[k] = 2 * pole * np.cos(2 * np.pi * 25 * DT) * shake[k - 1] - pole**2 * shake[k - 2] + noise
    shake *= 5 * np.std(motor) / np.std(shake)
    y = model.simulator(DT, substeps=4).rollout(model.vector(), np.zeros(model.nx), (motor + shake)[:, None])
    spec = PlantSpec(model.inputs, model.outputs, DT)
    noise = 1e-6 * rng.normal(size=y.shape)
    return Trajectory(t, sign * motor[:, None], y + noise, spec)


def diagnosed(sign: float) -> Diagnosis:
    """Return what is found of the shaken drive with two laws in the dictionary."""
    model = load_model("drive")
    runs = (Run(shaken(model, 1, sign), "estimation"), Run(shaken(model, 2, sign), "validation"))
    laws = [builtin()[name] for name in ("coulomb_friction", "quadratic_drag")]
    return diagnose(Dataset("shaken", runs, intersample="zoh"), model, dictionary=laws)


def test_a_plant_that_is_shaken_faster_than_it_moves_is_judged_by_its_free_runs() -> None:
    found = diagnosed(1.0)
    assert found.verdict == "nothing_missing"
    assert found.final.values["M"] == pytest.approx(1.0, rel=0.03)
    assert found.final.values["Fv"] == pytest.approx(1.0, rel=0.15)
    (said,) = [words for words in found.warnings if "judged by its free runs" in words]
    assert "of what moves q" in said


@pytest.mark.slow
def test_free_runs_that_do_not_follow_either_leave_the_verdict_as_it_was() -> None:
    found = diagnosed(-1.0)  # the motor pushes the other way
    assert found.verdict == "model_does_not_fit"
    assert any("of what moves q" in reason for reason in found.misfit)
