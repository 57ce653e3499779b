"""Networks without a name on public recordings: at least as good as asked of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from harness import registry
from harness.data import load_dataset
from harness.scoring import simulation_error
from harness.scoring.predictive import probability_score
from harness.signals import Trajectory

pytestmark = pytest.mark.slow


def test_the_tanks_are_learned_from_the_whole_first_part_of_the_benchmark(recordings_folder: Path) -> None:
    data = load_dataset(registry.dataset_path("cascaded-tanks")).dataset
    first, rest = data.estimation[0].measured(), data.validation[0].measured()
    u, y = np.vstack([first.u, rest.u]), np.vstack([first.y, rest.y])
    part = Trajectory(np.arange(len(u)) * first.spec.sample_time, u, y, first.spec)
    model = registry.create("identifiers", "neural-output-error").fit([part], rng=np.random.default_rng(0))
    (test,) = data.test
    assert simulation_error(model, test).rms[0] < 0.396  # V, the figure that is published for networks
    assert 0.8 < probability_score(model, test).coverage[2, 0] < 0.97  # of the 90 % bands


def test_silverbox_beyond_its_amplitudes_too(recordings_folder: Path) -> None:
    data = load_dataset(registry.dataset_path("silverbox")).dataset
    options = {"order": 2, "hidden": 8, "outside": 2, "ridge": 1e-3, "starts": 2, "members": 1, "iterations": 40}
    learn = [one.measured()[:20_000] for one in data.estimation]
    identifier = registry.create("identifiers", "neural-output-error", direct=True, **options)
    model = identifier.fit(learn, rng=np.random.default_rng(0))
    errors = {run.label: simulation_error(model, run.trajectory).rms[0] for run in data if run.use == "test"}
    assert max(errors.values()) < 1.49e-3  # V, for each of the three test runs
