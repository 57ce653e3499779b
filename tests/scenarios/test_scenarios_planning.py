"""Acting on models: a learned model swings a pendulum up in another engine, a wrong one does worse."""

from __future__ import annotations

import json

import numpy as np
import pytest

from harness.errors import InputError
from harness.registry import create
from harness.rng import Streams
from harness.rollout import run
from identifiers.learned.gaussian_process import GaussianProcess
from identifiers.linear.least_squares import Arx
from scenarios.planning import PredictiveControl

OPTIONS = dict(horizon=12, plans=80, hold=2, spread=0.5, duration=5.0)


def plant():
    outputs = [["theta", 0], ["theta", 1]]
    return create("plants", "pendulum-ode", sample_time=0.1, outputs=outputs, u_limit=2.0)


def learned(identifier, samples: int = 300):
    scenario = create("scenarios", "steps", samples=samples, amplitude=1.5, dwell=0.4)
    data = run(plant(), scenario, streams=Streams("p", "steps", 0))
    return identifier.fit([data.measured()], rng=np.random.default_rng(0))


def held_at(model, angle: float, **options) -> float:
    """Return the mean distance from an angle over the last third of a run."""
    name = plant().spec.outputs[0].name
    scenario = PredictiveControl(model=model, target={name: angle}, **{**OPTIONS, **options})
    data = run(plant(), scenario, streams=Streams("p", "act", 0))
    assert np.abs(data.u).max() <= 2.0 + 1e-9
    return float(np.abs(data.y[-15:, 0] - angle).mean())


@pytest.mark.parametrize("method", ["mppi", "cem"])
def test_a_learned_model_brings_the_pendulum_where_it_should(method):
    assert held_at(learned(GaussianProcess(exact=100, affine=True)), 1.0, method=method) < 0.15


def test_the_model_may_be_a_file_and_the_run_repeats(tmp_path):
    model = learned(Arx(order=1))
    file = tmp_path / "model.json"
    file.write_text(json.dumps(model.to_dict()), encoding="utf-8")
    assert held_at(model, 0.3, duration=3.0) == held_at(str(file), 0.3, duration=3.0)


def test_what_does_not_fit_is_refused(tmp_path):
    model = learned(Arx(order=1))
    streams = Streams("p", "act", 0)
    for options, words in (
        (dict(model=model, target={"nobody": 1.0}), "option target"),
        (dict(model=tmp_path / "none.json", target={"theta": 1.0}), "identify a model first"),
        (
            dict(model=model, target={plant().spec.outputs[0].name: 1.0}, method="guess"),
            "method: option of predictive-control: expected one of mppi, cem",
        ),
    ):
        scenario = PredictiveControl(**options)
        with pytest.raises(InputError, match=words):
            scenario.prepare(plant().spec, streams=streams, role="estimation/0")
    scenario = PredictiveControl(model=model, target={"x": 0.0})
    with pytest.raises(InputError, match="model of predictive-control"):
        scenario.prepare(create("plants", "cart-pole-ode").spec, streams=streams, role="estimation/0")
