"""How long to record: lengths that reach the accuracy, information beside Monte Carlo, amplitude, refusals."""

from __future__ import annotations

import numpy as np
import pytest

from harness import api
from harness.errors import InputError
from harness.models.spread import steps
from harness.registry import create
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory
from identifiers.linear.length.information import covariance_of_slopes, information_of_linear, variance_of
from identifiers.linear.length.quantities import Item, items_of_matrices, quantile_of_norm
from identifiers.linear.length.record_length import RecordLength, needed_length

SPEC = PlantSpec((Channel("u", "V"),), (Channel("y", "m"),), 0.1)
PLANT = (np.array([[0.8]]), np.array([[0.5]]), np.array([[1.0]]), np.zeros((1, 1)))


def record(samples, seed, noise=0.6, amplitude=1.0, process=0.0):
    rng = np.random.default_rng(seed)
    u, y, x = amplitude * rng.normal(size=(samples, 1)), np.zeros((samples, 1)), 0.0
    for k in range(samples):
        y[k] = x
        x = 0.8 * x + 0.5 * u[k, 0] + process * rng.normal()
    return Trajectory(np.arange(samples) * 0.1, u, y + noise * rng.normal(size=y.shape), SPEC)


def pilot(*records):
    return Dataset("pilot", tuple(Run(one) for one in records))


def asked(**options):
    return RecordLength(**{"options": {"order": 1}, **options})


@pytest.mark.slow
def test_a_record_of_the_predicted_length_keeps_the_accuracy():
    """Gain 2.5: 95 % of long records within 5 %, whatever pilot they were planned with."""
    kept = {"samples": 0, "safe": 0}
    for seed in range(25):
        row = asked().of(pilot(record(500, seed)), rng=np.random.default_rng(seed)).rows[0]
        for which in kept:
            model = create("identifiers", "n4sid", order=1).fit(
                [record(row[which], 1000 + seed)], rng=np.random.default_rng(0)
            )
            gain = items_of_matrices(model.matrices, SPEC, "gain")[0][0].value[0]
            kept[which] += abs(gain - 2.5) < 0.05 * 2.5
    assert kept["samples"] >= 21
    assert kept["safe"] >= 23


@pytest.mark.parametrize("process", [pytest.param(0.0, marks=pytest.mark.slow), 0.5])
def test_the_information_is_what_estimates_scatter_by(process):
    """Poles and gains of 40 fits of prediction-error, beside Cramer and Rao."""
    noise = 0.6 if not process else 1e-6
    structure = "oe" if not process else "armax"
    found = []
    for seed in range(40):
        model = create("identifiers", "prediction-error", order=1, structure=structure).fit(
            [record(800, seed, noise=noise, process=process)], rng=np.random.default_rng(0)
        )
        found.append([model.a_matrix[0, 0], items_of_matrices(model.matrices, SPEC, "gain")[0][0].value[0]])
    gain = np.array([[0.8 if process else 0.0]])  # of process noise the state is seen: the filter follows it wholly
    inputs = [record(800, 0).u]
    information = information_of_linear(
        PLANT, gain, np.eye(1) * (process or noise) ** 2, inputs, rng=np.random.default_rng(0)
    )
    pole = Item("pole", "1", lambda matrices: matrices[0][0], np.array([0.8]))
    static = items_of_matrices(PLANT, SPEC, "gain")[0][0]
    for item, scatter in zip((pole, static), np.std(found, axis=0), strict=True):
        least = np.sqrt(variance_of(item, PLANT, information, 1.0)[0, 0])
        assert 0.7 * least < scatter < 1.4 * least


def test_twice_the_amplitude_is_worth_four_times_the_length_against_noise_of_sensors_alone():
    row = asked(amplitudes=(0.5, 2.0)).of(pilot(record(800, 0)), rng=np.random.default_rng(0)).rows[0]
    assert row["at 2 x input"] == pytest.approx(row["samples"] / 4, rel=0.1)
    loud = asked(quantity="pole", amplitudes=(0.5,), identifier="prediction-error",
                 options={"order": 1, "structure": "armax"})  # fmt: skip
    row = loud.of(pilot(record(800, 0, noise=1e-3, process=0.5)), rng=np.random.default_rng(0)).rows[0]
    assert row["at 0.5 x input"] < 2.5 * row["samples"]  # the noise that the plant filters tells its pole as well


def test_a_plan_says_what_records_of_it_scatter_by():
    model = create("identifiers", "n4sid", order=1).fit([record(4000, 7)], rng=np.random.default_rng(0))
    plan = asked(scenario="prbs", scenario_options={"samples": 600, "amplitude": 1.0}, noise=0.6, quantity="response")
    found = plan.of(model, rng=np.random.default_rng(0))
    spread = []
    for seed in range(30):
        one = record(600, seed)
        again = create("identifiers", "prediction-error", order=1).fit([one], rng=np.random.default_rng(0))
        truth = steps(PLANT, 40, "impulse")
        spread.append(np.linalg.norm(steps(again.matrices, 40, "impulse") - truth) / np.linalg.norm(truth))
    assert found.rows[0]["now [%]"] / 100 == pytest.approx(np.quantile(spread, 0.95), rel=0.6)
    assert found.plot().axes


def planned_pendulum(noise):
    plan = {"quantity": "parameter", "scenario": "multisine", "scenario_options": {"duration": 20.0}, "noise": noise}
    return api.analyse("record-length", "pendulum", options={**plan, "sample_time": 0.05}).rows


def test_a_plan_for_a_pendulum_counts_noise_and_amplitude():
    quiet, loud = planned_pendulum(0.1), planned_pendulum(0.2)
    assert [row["what"] for row in quiet] == ["J", "b", "mgl"]
    for one, other in zip(quiet, loud, strict=True):
        assert other["now [%]"] == pytest.approx(2 * one["now [%]"], rel=0.01)
        assert other["at 0.5 x input"] > 2 * other["samples"]


@pytest.mark.slow
def test_a_fit_to_a_pendulum_scatters_by_what_its_pilot_says():
    from harness.physics.models import pendulum

    system, found, said = pendulum().system(), [], []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        u = 0.3 * np.repeat(rng.normal(size=(30, 1)), 10, axis=0)
        y = system.simulator(0.05).rollout([0.1, 0.05, 1.0], [0.3, 0.0], u)
        one = Trajectory(np.arange(300) * 0.05, u, y + 0.2 * rng.normal(size=y.shape), PlantSpec(
            system.inputs, system.outputs, 0.05))  # fmt: skip
        made = RecordLength(quantity="parameter", identifier="output-error", options={"model": "pendulum"})
        row = next(row for row in made.of(pilot(one), rng=rng).rows if row["what"] == "mgl")
        said.append(row["now [%]"] / 100 / 1.96)
        found.append(float(row["value"]))
    assert np.std(found) == pytest.approx(np.median(said), rel=0.5)


def test_uncertainty_of_the_pilot_and_of_the_value_widen_the_range():
    item = Item("gain", "1", None, np.array([2.0]))
    rng = np.random.default_rng(0)
    from identifiers.linear.length.pilot import PilotEntry

    sure = needed_length(PilotEntry(item, np.array([[0.01]]), 1e6, {}), 100, 0.05, 0.9, rng)
    few = needed_length(PilotEntry(item, np.array([[0.01]]), 19.0, {}), 100, 0.05, 0.9, rng)
    assert few.samples == pytest.approx(sure.samples)
    assert few.high / few.low > 2 * sure.high / sure.low
    assert few.now > sure.now  # Student's quantile
    nothing = needed_length(PilotEntry(item, np.array([[np.inf]]), 19.0, {}), 100, 0.05, 0.9, rng)
    assert np.isinf(nothing.samples)


def test_what_no_length_mends_is_said():
    found = asked(identifier="arx", quantity="gain").of(pilot(record(800, 0)), rng=np.random.default_rng(0))
    assert any("does not mend" in text and "correlated" in text for text in found.words)
    fading = record(800, 0)
    u = fading.u * np.exp(-np.arange(800) / 60)[:, None]
    y = np.zeros((800, 1))
    for k in range(799):
        y[k + 1] = 0.8 * y[k] + 0.5 * u[k]
    y += 0.05 * np.random.default_rng(0).normal(size=y.shape)
    found = asked().of(pilot(Trajectory(fading.t, u, y, SPEC)), rng=np.random.default_rng(0))
    assert any("first half tells" in text for text in found.words)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"accuracy": "much"}, "accuracy such as 5%"),
        ({"accuracy": 0.0}, "accuracy such as 5%"),
        ({"quantity": "colour"}, "quantity gain"),
        ({"scenario": "prbs"}, "leave scenario out"),
        ({"identifier": "nobody"}, "sysid list identifiers"),
        ({"amplitudes": (0.0,)}, "amplitudes"),
    ],
)
def test_what_means_nothing_is_refused(options, said):
    with pytest.raises(InputError, match=said):
        asked(**options).of(pilot(record(300, 0)), rng=np.random.default_rng(0))


def test_a_model_without_a_plan_or_a_noise_is_refused():
    model = create("identifiers", "n4sid", order=1).fit([record(500, 0)], rng=np.random.default_rng(0))
    with pytest.raises(InputError, match="scenario"):
        asked().of(model, rng=np.random.default_rng(0))
    with pytest.raises(InputError, match="noise"):
        asked(scenario="prbs", scenario_options={"samples": 300}).of(model, rng=np.random.default_rng(0))


def test_a_direction_without_information_is_infinite_and_norms_have_their_quantiles():
    assert np.isinf(covariance_of_slopes(np.eye(2), np.diag([1.0, 0.0]))[1, 1])
    rng = np.random.default_rng(0)
    draws = np.linalg.norm(rng.multivariate_normal(np.zeros(3), np.diag([4.0, 1.0, 0.25]), 20_000), axis=1)
    found = quantile_of_norm(np.diag([4.0, 1.0, 0.25]), np.inf, rng)
    assert found == pytest.approx(np.quantile(draws, 0.95), rel=0.04)
