"""No reading is more exact than its resolution, also of a plant that rests for most of its record."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.diagnosis.kinds import Equations
from harness.diagnosis.policy import POLICY
from harness.diagnosis.records.prepare import checked
from harness.diagnosis.records.thinning import thinned_by
from harness.diagnosis.runs.compare import FreeRuns
from harness.diagnosis.search.outcome import Outcome
from harness.diagnosis.search.table import Accepted
from harness.diagnosis.steps import what_free_runs_say
from harness.diagnosis.store import data_fingerprint
from harness.effects import builtin
from harness.effects.effect import Placed
from harness.physics import load_model
from harness.resolution import resolution
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory

DT, STEP = 0.01, 0.02


def resting(seed: int) -> Trajectory:
    """Return a pendulum that swings for a second of every six, read by an encoder of 0.02 rad."""
    plant, n = load_model("pendulum"), 1200
    t = np.arange(n) * DT
    u = np.where(t % 6 < 1, 0.5 * np.sin(2 * np.pi * t + seed), 0.0)[:, None]
    p = plant.vector({"J": 0.1, "b": 0.6, "mgl": 1.0})
    y = plant.simulator(DT, substeps=4).rollout(p, [0.0, 0.0], u)
    spec = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"),), DT)
    return Trajectory(t, u, np.round(y / STEP) * STEP, spec)


DATA = Dataset("resting", (Run(resting(0), "estimation"), Run(resting(1), "validation")))


def test_the_noise_of_an_encoder_is_no_less_than_its_step_says() -> None:
    plant = load_model("pendulum")
    data = checked(DATA, plant)
    assert data.resolution == {"theta": pytest.approx(STEP)}
    form = Equations().form(plant, data)
    fit = form.fit((), form.first_starts(), None)
    assert fit is not None
    assert fit.detail.points["estimation"].noise.r[0] >= STEP / np.sqrt(12) * (1 - 1e-9)
    assert fit.values["mgl"] == pytest.approx(1.0, rel=0.2)
    half = thinned_by(data, 2)
    assert half.dataset.resolution["theta"] == pytest.approx(STEP * half.noise[0])


def test_a_resolution_and_missing_readings_are_part_of_what_a_fit_is_known_by() -> None:
    fine = Dataset("resting", DATA.runs, resolution={"theta": 1e-3})
    record = DATA.runs[0].trajectory
    gone = Trajectory(record.t, record.u, record.y, record.spec, missing=np.arange(len(record))[:, None] % 7 == 0)
    holed = Dataset("resting", (Run(gone, "estimation"), DATA.runs[1]))
    assert len({data_fingerprint(one) for one in (DATA, fine, holed)}) == 3


@settings(max_examples=40, deadline=None)
@given(st.floats(1e-4, 1e-1), st.integers(0, 10**6))
def test_a_grid_is_found_where_there_is_one_and_nowhere_else(step: float, seed: int) -> None:
    read = np.cumsum(np.random.default_rng(seed).normal(size=3000)) * 3 * step
    assert resolution([np.round(read / step) * step]) == pytest.approx(step, rel=1e-6)
    assert resolution([read]) == 0.0
    assert resolution([np.round(read / step) * step, read]) == 0.0


@pytest.mark.parametrize(("name", "stands"), [("sensor_quantisation", True), ("sensor_gain", False)])
def test_free_runs_deny_no_rounding(name: str, stands: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A rounded prediction errs by its own rounding: only what changes the motion or the reading is taken back."""
    calm = SimpleNamespace(finite=True, validation=(np.ones((1000, 1)),))
    worse = SimpleNamespace(finite=True, validation=(1.3 * np.ones((1000, 1)),))
    runs = FreeRuns(cast(Any, None), cast(Any, None), cast(Any, calm), cast(Any, worse), 0.0, np.ones(1))
    monkeypatch.setattr("harness.diagnosis.steps.free_runs", lambda *args: runs)
    monkeypatch.setattr("harness.diagnosis.steps.left_over", lambda *args: SimpleNamespace(best="left"))
    monkeypatch.setattr("harness.diagnosis.steps.reading_noise", lambda fit: np.ones(1))
    fit = SimpleNamespace(values={})
    accepted = (Accepted(Placed(builtin()[name], "theta"), (), 9.0, 9.0),)
    outcome = Outcome(cast(Any, None), cast(Any, fit), cast(Any, SimpleNamespace(values={})), accepted, ())
    kind: Any = SimpleNamespace(horizon=lambda *args: None, runs=lambda *args: None)
    form: Any = SimpleNamespace(nominal=None, latent=True)
    found, *_ = what_free_runs_say(
        kind, form, outcome, cast(Any, None), POLICY, lambda what, part=None: None, share=np.ones(1)
    )
    assert bool(found.accepted) is stands
    assert bool(found.withdrawn) is not stands
