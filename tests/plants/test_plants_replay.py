"""Replay: a recording answers only to its own inputs, and ends."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import plants
from harness import registry
from harness.data import write_trajectory
from harness.errors import InputError, PlantError
from harness.protocols import Experiment
from harness.rollout import perform
from harness.signals import Channel, PlantSpec, Trajectory
from plants.replay import ReplayPlant

RNG = np.random.default_rng


def recording(*, feedthrough: bool = False) -> Trajectory:
    """Return a record with two inputs, two outputs, two states."""
    spec = PlantSpec(
        (Channel("u1", "N"), Channel("u2", "N m")),
        (Channel("q", "m"), Channel("a", "m/s^2")),
        0.01,
        (Channel("q", "m"), Channel("v", "m/s")),
        feedthrough,
    )
    rng = RNG(0)
    return Trajectory(
        np.arange(50) * 0.01, rng.normal(size=(50, 2)), rng.normal(size=(50, 2)), spec, rng.normal(size=(50, 2))
    )


@pytest.mark.parametrize("feedthrough", [False, True])
def test_a_replayed_record_is_the_record(feedthrough: bool) -> None:
    record = recording(feedthrough=feedthrough)
    again = perform(ReplayPlant(record), Experiment(record.u), rng=RNG(0))
    assert np.array_equal(again.y, record.y)
    assert np.array_equal(again.u, record.u)
    assert again.x is not None
    assert record.x is not None
    assert np.array_equal(again.x, record.x)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_it_plays_what_sysid_simulate_wrote(tmp_path: Path, suffix: str) -> None:
    record = recording()
    file = write_trajectory(record, tmp_path / f"run{suffix}")
    options = {"inputs": "u1, u2"} if suffix == ".csv" else {}
    plant = registry.create("plants", "replay", file=str(file), **options)
    assert [str(channel) for channel in plant.spec.outputs] == ["q [m]", "a [m/s^2]"]
    again = perform(plant, Experiment(record.u), rng=RNG(0))
    assert np.array_equal(again.y, record.y)


def test_other_inputs_are_refused_or_warned_about_once() -> None:
    record = recording()
    other = record.u.copy()
    other[7, 1] += 0.5
    plant = ReplayPlant(record)
    plant.reset(rng=RNG(0))
    with pytest.raises(InputError, match=r"'u2' differs .* t = 0.07 s"):
        plant.rollout(other[:-1])
    lenient = ReplayPlant(record, mismatch="warn")
    with pytest.warns(UserWarning, match="u2") as caught:
        log = perform(lenient, Experiment(other), rng=RNG(0))
    assert len(caught) == 1
    assert np.array_equal(log.y, record.y)
    nearly = record.u * (1 + 1e-12)
    assert np.array_equal(perform(ReplayPlant(record), Experiment(nearly), rng=RNG(0)).y, record.y)


def test_the_record_ends_with_a_status() -> None:
    record = recording()
    plant = ReplayPlant(record)
    plant.reset(rng=RNG(0))
    plant.rollout(record.u[:-1])
    with pytest.raises(PlantError, match="ends after 50 samples") as caught:
        plant.step(record.u[-1])
    assert caught.value.status == "terminated"


def test_snapshots_go_back() -> None:
    record = recording()
    plant = ReplayPlant(record)
    plant.reset(rng=RNG(0))
    plant.rollout(record.u[:20])
    state = plant.get_state()
    once = plant.rollout(record.u[20:30])
    plant.set_state(state)
    assert np.array_equal(plant.rollout(record.u[20:30]), once)


def test_a_record_without_input_is_played_too() -> None:
    spec = PlantSpec((), (Channel("theta", "rad"),), 0.1)
    record = Trajectory(np.arange(5) * 0.1, np.zeros((5, 0)), np.arange(5.0)[:, None], spec)
    log = perform(ReplayPlant(record), Experiment(np.zeros((5, 0))), rng=RNG(0))
    assert log.y[:, 0].tolist() == [0, 1, 2, 3, 4]


def test_a_data_set_is_played_run_by_run(tmp_path: Path) -> None:
    record = recording()
    write_trajectory(record, tmp_path / "one.csv")
    signals = "".join(
        f'[signals.{name}]\nrole = "{role}"\nunit = "{unit}"\n'
        for name, role, unit in (("u1", "input", "N"), ("u2", "input", "N m"), ("q", "output", "m"))
    )
    (tmp_path / "dataset.toml").write_text(
        f'name = "two"\nsample_time = 0.01\n[nominal]\nmodel = "linear"\n{signals}'
        '[[runs]]\nfile = "one.csv"\nuse = "estimation"\nrows = [0, 30]\n'
        '[[runs]]\nfile = "one.csv"\nuse = "validation"\nrows = [30, 50]\n'
    )
    plant = ReplayPlant(file=tmp_path / "dataset.toml", run=1)
    assert plant.reset(rng=RNG(0)).tolist() == record.y[30, :1].tolist()
    with pytest.raises(InputError, match="no such run"):
        ReplayPlant(file=tmp_path / "dataset.toml", run=2)


def test_bad_options_are_refused(tmp_path: Path) -> None:
    record = recording()
    with pytest.raises(InputError, match="needs one recording"):
        ReplayPlant()
    with pytest.raises(InputError, match="no such recording"):
        ReplayPlant(file=tmp_path / "none.csv")
    with pytest.raises(InputError, match="one of refuse, warn"):
        ReplayPlant(record, mismatch="ignore")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="unknown initial state"):
        ReplayPlant(record).reset(rng=RNG(0), x0={"q": 1.0})
    file = write_trajectory(record, tmp_path / "run.csv")
    assert ReplayPlant(file=file).spec.inputs == record.spec.inputs  # what was written with the record says it
    (tmp_path / "run.csv-metadata.json").unlink()
    with pytest.raises(InputError, match="nothing says which columns are inputs"):
        ReplayPlant(file=file)


def test_the_golden_record_of_the_cart_pole_plays() -> None:
    plant = ReplayPlant(file=Path(plants.__file__).parent / "golden" / "cart-pole-pymunk.csv", inputs="u")
    log = perform(plant, Experiment(plant.trajectory.u), rng=RNG(0))
    assert [str(channel) for channel in plant.spec.outputs] == ["x [m]", "theta [rad]"]
    assert log.y[0].tolist() == [0.0, 0.5]
    assert np.array_equal(log.y, plant.trajectory.y)
