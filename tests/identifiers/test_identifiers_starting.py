"""Where a record begins: what its first outputs do not show is where the estimation data usually had it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.mechanics.grey_box import GreyBoxModel, OutputError

SPEC = PlantSpec((Channel("u", "V"),), (Channel("y", "V"),), 0.1)
NOISE = 0.3


def record(seed: int, samples: int = 600, unit: float = 1.0) -> Trajectory:
    """Return the output of a lag behind a swing that nobody measures, with a noise of a third of its size."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.0, 1.0, samples // 20 + 1), 20)[:samples]
    x, y = np.zeros(3), np.empty(samples)
    for k in range(samples):
        y[k] = x[0]
        x = x + 0.1 * np.array([0.5 * (x[1] - x[0]), x[2], 4.0 * (u[k] - x[1]) - 0.5 * x[2]])
    y = unit * (y + NOISE * y.std() * rng.normal(size=samples))
    return Trajectory(0.1 * np.arange(samples), u[:, None], y[:, None], SPEC)


@pytest.fixture(scope="module")
def fitted() -> GreyBoxModel:
    learner = OutputError(model="linear", options={"order": 3}, horizon="record")
    return learner.fit([record(0)], rng=np.random.default_rng(0))


def errors(model: GreyBoxModel, seen: int) -> np.ndarray:
    """Return the rms of free runs of 5 s after so many samples were seen, from 30 places of another record."""
    whole, found = record(1), []
    for at in range(0, 510, 17):
        part = whole[at : at + seen + 50]
        run = model.free_run(model.initial_state(part[:seen])[None], part.u[None])[0]
        found.append(np.sqrt(np.mean((run - part.y)[seen:] ** 2)))
    return np.array(found) / whole.y.std()


def test_few_samples_and_a_belief_tell_more_than_few_samples(fitted: GreyBoxModel) -> None:
    alone = replace(fitted, belief=None)
    assert np.median(errors(fitted, 6)) < 0.5 * np.median(errors(alone, 6))
    assert errors(fitted, 6).max() < 1.0 < errors(alone, 6).max()  # none is further off than guessing
    assert np.median(errors(fitted, 40)) == pytest.approx(np.median(errors(alone, 40)), rel=0.05)


def test_the_belief_is_that_of_the_estimation_data_in_any_unit(fitted: GreyBoxModel) -> None:
    belief = fitted.belief
    assert belief is not None
    noise = NOISE * record(0).y.std()
    assert np.sqrt(belief.errors[0, 0]) == pytest.approx(noise, rel=0.2)
    assert np.abs(belief.errors[1:, 0]).max() < 0.25 * noise**2  # white: nothing hangs together
    learner = OutputError(model="linear", options={"order": 3}, horizon="record")
    other = learner.fit([record(0, unit=1e3)], rng=np.random.default_rng(0)).belief
    assert other is not None
    assert other.errors[0] == pytest.approx(1e6 * belief.errors[0], rel=1e-2)


def test_a_force_that_the_model_lacks_does_not_throw_a_hidden_state_off() -> None:
    """The bend that it gives the first samples is as large as if the lag of the actuator had begun far off."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1.0, 1.0, 100), 40)
    push = 2.0 * np.sin(0.2 * np.arange(4000))
    q, v, force, y = 0.0, 0.0, 0.0, np.empty(4000)
    for k in range(4000):
        y[k] = q
        q, v, force = q + 0.01 * v, v + 0.01 * (force + push[k] - v), force + 0.01 * (u[k] - force) / 0.5
    y += 1e-6 * rng.normal(size=4000)
    spec = PlantSpec((Channel("u", "N"),), (Channel("q", "m"),), 0.01)
    learner = OutputError(
        model="drive",
        effects=("actuator_lag@u",),
        horizon="record",
        start={"M": 1.0, "Fv": 1.0, "actuator_lag@u.tau": 0.5},
    )
    whole = Trajectory(0.01 * np.arange(4000), u[:, None], y[:, None], spec)
    model = learner.fit([whole], rng=rng)
    told, alone = [], []
    for at in range(0, 3500, 250):
        part = whole[at : at + 500]
        for one, found in ((model, told), (replace(model, belief=None), alone)):
            run = one.free_run(one.initial_state(part[:12])[None], part.u[None])[0]
            found.append(np.sqrt(np.mean((run - part.y) ** 2)))
    assert np.median(told) < 0.3 * np.median(alone)


def test_a_stored_model_begins_where_it_did(fitted: GreyBoxModel) -> None:
    read = GreyBoxModel.from_dict(json.loads(json.dumps(fitted.to_dict())))
    few = record(2)[:10]
    assert read.initial_state(few) == pytest.approx(fitted.initial_state(few), rel=1e-9, abs=1e-12)
    older = {name: value for name, value in fitted.to_dict().items() if name != "belief"}
    assert GreyBoxModel.from_dict(older).belief is None


def test_a_delay_of_the_input_does_not_hinder(fitted: GreyBoxModel) -> None:
    start = {**fitted.parameters, "input_delay@u.tau": 0.15}
    learner = OutputError(
        model="linear", options={"order": 3}, effects=("input_delay@u",), horizon="record", start=start
    )
    model = learner.fit([record(0)], rng=np.random.default_rng(0))
    assert np.median(errors(model, 10)) < 0.6


def test_both_signs_behind_a_sensor_that_hides_them_are_looked_for() -> None:
    learner = OutputError(
        model="linear", options={"order": 1}, effects=("sensor_rectification@y",), horizon="record",
        start={"a1_1": 1.0, "b1_1": 2.0, "offset_1": 0.0},
    )  # fmt: skip
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1.0, 1.0, 40), 15)[:600]
    x, y = 0.0, np.empty(600)
    for k in range(600):
        y[k] = abs(x)
        x += 0.1 * (2.0 * u[k] - x)
    whole = Trajectory(0.1 * np.arange(600), u[:, None], (y + 1e-3 * rng.normal(size=600))[:, None], SPEC)
    model = learner.fit([whole], rng=rng)
    for at in range(0, 560, 40):
        part = whole[at : at + 40]
        run = model.free_run(model.initial_state(part[:15])[None], part.u[None])[0]
        assert np.sqrt(np.mean((run - part.y) ** 2)) < 0.05


def test_records_of_other_lengths_count_as_far_as_they_go() -> None:
    """A run that is shorter than the longest by more than half of it was no fit at all."""
    learner = OutputError(model="linear", options={"order": 3}, horizon="record")
    whole, short = record(0), record(2, 80)
    belief = learner.fit([whole, short], rng=np.random.default_rng(0)).belief
    assert belief is not None
    assert len(belief.errors) == 500
    noise = NOISE * whole.y.std()
    assert np.sqrt(belief.errors[0, 0]) == pytest.approx(noise, rel=0.2)
    assert np.abs(belief.errors[100:, 0]).max() < 0.25 * noise**2
