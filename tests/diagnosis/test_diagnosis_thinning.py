"""Records without input at a lower sample rate: nothing that matters is lost."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from harness import api
from harness.diagnosis import close_loop
from harness.diagnosis.records.thinning import thinned_dataset, white_keeping_filter
from harness.diagnosis.runs.residual_tests import max_autocorrelation
from harness.effects import builtin
from harness.parts.files import make_plant
from harness.physics import Parameter
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory

pytestmark = pytest.mark.slow  # whole loops

SPEC = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"),), 0.001)


def swing(noise: float, *, moving: bool = False) -> Dataset:
    runs = []
    for role, use in enumerate(("estimation", "validation")):
        t = np.arange(12000) * 0.001
        rng = np.random.default_rng(role)
        y = np.exp(-0.1 * t) * np.cos(8 * t) + noise * rng.standard_normal(t.size)
        u = rng.standard_normal((t.size, 1)) if moving else np.zeros((t.size, 1))
        runs.append(Run(Trajectory(t, u, y[:, None], SPEC), use))  # type: ignore[arg-type]
    return Dataset("swing", tuple(runs), noise={"theta": noise} if noise else {})


def test_a_free_swing_keeps_its_shape_and_says_what_was_done() -> None:
    thin = thinned_dataset(swing(0.0))
    run = thin.estimation[0]
    assert 0.005 <= thin.spec.sample_time <= 0.03
    np.testing.assert_allclose(run.y[:, 0], np.exp(-0.1 * run.t) * np.cos(8 * run.t), atol=2e-4)
    assert any("1000 Hz" in text for text in thin.warnings)


def test_the_repaired_model_of_a_thinned_record_runs_at_the_rate_of_the_record(tmp_path: Path) -> None:
    data = swing(1e-3)
    known = {"J": Parameter("J", "kg m^2", 0.1, fixed=True), "mgl": 6.4}
    drag = [builtin()["quadratic_drag"]]
    report = close_loop(data, "pendulum", parameters=known, dictionary=drag, out=tmp_path / "out")
    assert any("instead of 1000 Hz" in text for text in report.data["warnings"])
    assert json.loads((tmp_path / "out" / "model.json").read_text())["spec"]["sample_time"] == 0.001
    target = api.export(tmp_path / "out", out=tmp_path / "repaired.fmu")[0]
    system, n = report.model, 3000
    own = system.simulator(0.001).rollout(system.vector(), np.array([0.9, 0.0]), np.zeros((n, 1)))
    with make_plant(str(target), {}) as plant:
        assert plant.spec.sample_time == 0.001
        y = [plant.reset(rng=np.random.default_rng(0), x0={"state.theta": 0.9})]
        y += [plant.step(np.zeros(1)) for _ in range(n - 1)]
    np.testing.assert_allclose(np.array(y), own, rtol=0, atol=1e-9)


def test_white_noise_stays_white_and_its_declared_level_follows() -> None:
    thin = thinned_dataset(swing(0.01))
    run = thin.estimation[0]
    rest = run.y[:, 0] - np.exp(-0.1 * run.t) * np.cos(8 * run.t)
    assert np.std(rest) == pytest.approx(thin.noise["theta"], rel=0.08)
    assert thin.noise["theta"] < 0.005
    assert max_autocorrelation(rest) < 4 / np.sqrt(rest.size)


def test_records_with_a_moving_input_stay_as_they_are() -> None:
    data = swing(0.01, moving=True)
    assert thinned_dataset(data) is data


@pytest.mark.parametrize("factor", [2, 7, 14])
def test_the_filter_leaves_every_kept_sample_of_white_noise_independent(factor: int) -> None:
    taps = white_keeping_filter(factor)
    full = np.convolve(taps, taps[::-1])
    kept = full[len(taps) - 1 :: factor] / full[len(taps) - 1]
    assert np.abs(kept[1:]).max() < 0.01
