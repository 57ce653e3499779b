"""Bands of free runs: what held-out data made them, kept in files, and refused where nothing makes them."""

from __future__ import annotations

import importlib.util
import json

import numpy as np
import pytest

from harness.cli.app import run as run_command
from harness.errors import FitError, InputError
from harness.registry import create
from harness.rng import Streams
from harness.rollout import run
from harness.scoring.predictive import probability_score
from harness.signals import Channel, PlantSpec, Trajectory
from harness.supervision.interrupts import Interrupts
from identifiers.common.bands import Ahead, Bands, held_out_folds, held_out_runs, misses
from identifiers.learned.gaussian_process import GaussianProcess, GaussianProcessModel
from identifiers.learned.lagrangian import LagrangianModel, LagrangianNetwork
from identifiers.learned.neural_state import NeuralStateModel, NeuralStateSpace
from identifiers.learned.recurrent import NeuralOutputError
from identifiers.linear.least_squares import Arx

torch_needed = pytest.mark.skipif(
    importlib.util.find_spec("torch") is None, reason="torch is not installed: pip install 'sysid-harness[learned]'"
)
SPEC = PlantSpec((Channel("u"),), (Channel("y"),), 0.1)


def pendulum(records: int, samples: int = 200, outputs=(("theta", 0), ("theta", 1))) -> list[Trajectory]:
    plant = create("plants", "pendulum-ode", sample_time=0.05, outputs=[list(one) for one in outputs])
    scenario = create("scenarios", "multisine", samples=samples, amplitude=0.8, band=[0.1, 3.0], noise=0.003)
    streams = Streams("pendulum-ode", "bands", 0)
    return [run(plant, scenario, streams=streams, role=f"estimation/{k}").measured() for k in range(records)]


def walk(samples: int, seed: int, noise: float = 0.1) -> Trajectory:
    """A lag driven by noise that nobody sees: how far predictions are off is known."""
    rng = np.random.default_rng(seed)
    u, y = rng.normal(size=(samples, 1)), np.zeros((samples, 1))
    for k in range(samples - 1):
        y[k + 1] = 0.9 * y[k] + 0.3 * u[k] + noise * rng.normal()
    return Trajectory(0.1 * np.arange(samples), u, y, SPEC)


def test_the_spread_is_that_of_the_plant_so_many_steps_ahead():
    record = walk(6000, 0)
    model = Arx(order=1).fit([record], rng=np.random.default_rng(0))
    runs = held_out_runs(model, [record], [1000])
    bands = Bands.of(runs, [misses(model, one) for one in runs], "arx", least=np.zeros(1))
    theory = 0.1 * np.sqrt((1 - 0.81**bands.steps) / (1 - 0.81))
    assert bands.spread[:6, 0] == pytest.approx(theory[:6], rel=0.15)
    assert (bands.spread[:, 0] > 0.85 * theory).all()
    assert (bands.spread[:, 0] < 1.4 * theory).all(), "few long windows: their largest errors count"
    assert bands.longest >= 64
    beyond = bands.at(np.array([256.0, 1024.0]))[:, 0]
    assert beyond[0] >= bands.spread[-1, 0] - 1e-12
    assert np.isfinite(beyond).all()


def test_few_held_out_windows_end_the_ladder_and_lost_runs_are_refused():
    record = walk(400, 0)
    model = Arx(order=1).fit([record], rng=np.random.default_rng(0))
    assert [one.steps for one in held_out_runs(model, [record], [320])] == [1, 2, 4, 8]
    assert held_out_runs(model, [record], [395]) == []
    with pytest.raises(FitError, match="too little is held out"):
        Bands.of([], [], "a network", least=np.zeros(1))
    lost = np.where(np.arange(100)[:, None] < 10, np.nan, 1.0)
    one, two = (Ahead(k, 100, *np.zeros((3, 100, 1))) for k in (1, 2))
    with pytest.raises(FitError, match="diverge"):
        Bands.of([one], [lost], "a network", least=np.zeros(1))
    assert Bands.of([one, two], [np.ones((100, 1)), lost], "a network", least=np.zeros(1)).longest == 1


def test_bands_hold_90_percent_on_the_mean_of_many_fits_and_not_more():
    rng = np.random.default_rng(0)
    shares = []
    for _ in range(400):
        errors = rng.normal(size=(20, 1))
        bands = Bands.of([Ahead(1, 20, *np.zeros((3, 20, 1)))], [errors], "a network", least=np.zeros(1))
        shares.append(np.mean(np.abs(rng.normal(size=2000)) < 1.6449 * bands.spread[0, 0]))
    assert np.mean(shares) == pytest.approx(0.9, abs=0.012)


def test_the_scatter_between_records_is_told_and_kept():
    rng = np.random.default_rng(0)
    which = np.repeat(np.arange(40), 50)
    unlike = np.repeat(np.exp(rng.normal(size=40)), 50)[:, None] * rng.normal(size=(2000, 1))
    alike = rng.normal(size=(2000, 1))
    found = [
        Bands.of([Ahead(1, 2000, *np.zeros((3, 2000, 1)), which=which)], [one], "a network", least=np.zeros(1))
        for one in (alike, unlike)
    ]
    assert found[0].error < 0.01
    assert found[1].error > 2 * found[0].error
    assert "differ so much" in found[1].note(0.1)
    assert Bands.from_dict(json.loads(json.dumps(found[1].to_dict()))).error == found[1].error
    few = Bands.of([Ahead(1, 30, *np.zeros((3, 30, 1)))], [alike[:30]], "a network", least=np.zeros(1))
    assert np.isnan(Bands.from_dict(json.loads(json.dumps(few.to_dict()))).error)
    assert "differ" not in few.note(0.1)


def test_the_command_says_how_far_ahead_the_bands_are_vouched_for(tmp_path, capsys):
    record, table = walk(300, 0), tmp_path / "walk.csv"
    np.savetxt(table, np.column_stack([record.t, record.u, record.y]), delimiter=",", header="t,u,y", comments="")
    words = f"identify {table} --input u --output y --identifier gaussian-process -O exact=60 -O inducing=30"
    assert run_command(words.split(), Interrupts()) == 0
    assert "Bands were made to hold on held-out data up to" in capsys.readouterr().out


def test_every_sample_but_the_first_ones_is_held_out_once():
    for lengths, folds in (([300, 200], 4), ([100] * 7, 5), ([150], 5)):
        count = [np.zeros(length, dtype=int) for length in lengths]
        for held in held_out_folds(lengths, folds):
            for number, begin, first, end in held:
                assert begin <= first < end
                count[number][begin:end] += 1
        assert all((one == 1).all() for one in count)


def test_one_short_record_vouches_further_ahead_by_all_its_parts():
    model = GaussianProcess(exact=100, inducing=40).fit([walk(250, 0)], rng=np.random.default_rng(0))
    assert model.bands is not None
    assert model.bands.longest >= 16, "a fifth of it alone holds nine windows of 5 samples"
    inside = probability_score(model, walk(2000, 1), horizon=10).coverage[2, 0]
    assert 0.8 < inside < 0.97


@pytest.mark.parametrize("identifier", [NeuralOutputError, NeuralStateSpace, LagrangianNetwork])
def test_a_share_that_leaves_nothing_is_refused(identifier):
    for share in (0.0, 1.0, -0.1):
        with pytest.raises(InputError, match="held_out"):
            identifier(held_out=share).fit([walk(100, 0)], rng=np.random.default_rng(0))


def test_a_gaussian_process_holds_what_it_promises_ten_and_thirty_steps_ahead():
    records = pendulum(16)
    model = GaussianProcess(exact=150, inducing=80).fit(records[:12], rng=np.random.default_rng(0))
    for steps in (1, 10, 30):
        inside = np.mean([probability_score(model, one, horizon=steps).coverage[2].mean() for one in records[12:]])
        assert 0.8 < inside < 0.97, steps
    read = GaussianProcessModel.from_dict(json.loads(json.dumps(model.to_dict())))
    assert np.array_equal(
        probability_score(read, records[-1], horizon=10).log_score,
        probability_score(model, records[-1], horizon=10).log_score,
    )
    assert "steps" in model.notes["bands"]


def test_a_recurrent_network_counts_the_steps_and_widens():
    records = [walk(400, seed, noise=0.05) for seed in range(4)]
    options = dict(order=1, hidden=2, outside=1, starts=2, members=2, iterations=20)
    model = NeuralOutputError(**options).fit(records[:3], rng=np.random.default_rng(0))
    x = model.correct(model.initial_state(records[3]), records[3].u[0], records[3].y[0])
    widths = []
    for k in range(20):
        x = model.step(x, records[3].u[k])
        widths.append(float(model.predictive(x, records[3].u[k + 1]).std[0]))
    assert widths[-1] > 1.3 * widths[0]
    assert 0.8 < probability_score(model, records[3], horizon=10).coverage[2, 0] < 0.98


@torch_needed
@pytest.mark.slow
@pytest.mark.parametrize(
    ("identifier", "reader", "options"),
    [
        (NeuralStateSpace, NeuralStateModel, {"order": 2, "hidden": 8, "window": 20, "steps": 60, "batch": 32}),
        (LagrangianNetwork, LagrangianModel, {"hidden": 6, "window": 4, "steps": 60, "batch": 32}),
    ],
)
def test_networks_that_said_nothing_of_their_errors_have_bands_that_hold(identifier, reader, options):
    records = pendulum(10, outputs=(("theta", 0),))
    model = identifier(**options).fit(records[:8], rng=np.random.default_rng(0))
    for steps in (1, 10):
        inside = np.mean([probability_score(model, one, horizon=steps).coverage[2, 0] for one in records[8:]])
        assert 0.8 < inside <= 0.99, steps
    read = reader.from_dict(json.loads(json.dumps(model.to_dict())))
    assert np.array_equal(
        probability_score(read, records[-1]).log_score, probability_score(model, records[-1]).log_score
    )
    stripped = reader.from_dict({**model.to_dict(), "bands": None})
    with pytest.raises(InputError, match="without bands"):
        probability_score(stripped, records[-1])


@torch_needed
def test_a_plant_that_is_no_mechanism_is_refused_by_the_lagrangian_network():
    rng = np.random.default_rng(0)
    spec = PlantSpec((Channel("u", "N"),), (Channel("q", "m"),), 0.1)
    data = [
        Trajectory(0.1 * np.arange(300), rng.normal(size=(300, 1)), rng.normal(size=(300, 1)), spec) for _ in range(2)
    ]
    with pytest.raises(FitError, match="does not describe these data"):
        LagrangianNetwork(hidden=4, window=4, steps=20, batch=16).fit(data, rng=rng)
