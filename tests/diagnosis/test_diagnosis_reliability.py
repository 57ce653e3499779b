"""What a user may rely on: no answer without convergence, bias of feedback said, ties that an experiment breaks."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from harness import api, registry
from harness.diagnosis import close_loop
from harness.diagnosis.records.prepare import sizes_of
from harness.diagnosis.runs.closed_loop_bias import BiasTest, closed_loop_bias
from harness.diagnosis.runs.compare import seen
from harness.diagnosis.runs.form import FreeRunForm
from harness.effects import Placed, builtin
from harness.physics import Ode, fit_output_error, load_model
from harness.physics.fitting.likelihood import Likelihood
from harness.rng import Streams
from harness.rollout import perform
from harness.signals import Dataset, PlantSpec, Run, Trajectory

# ---- convergence --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_what_does_not_converge_is_shown_and_never_an_answer(foreign_pendulum, tmp_path, monkeypatch) -> None:
    one_step = Likelihood.maximise
    monkeypatch.setattr(Likelihood, "maximise", lambda self, start, **how: one_step(self, start, **{**how, "most": 1}))
    data = foreign_pendulum(1, lambda q, v, u, t: -0.05 * np.tanh(v / 0.002), n=300)
    names = ("coulomb_friction",)
    report = close_loop(data, "pendulum", out=tmp_path, dictionary=[builtin()[name] for name in names])
    stopped = [row for row in report.data["candidates"] if row["refitted"] and not row["converged"]]
    assert stopped, "one iteration is not enough for anything"
    assert not any(row["accepted"] for row in stopped)
    assert all("did not converge" in row["reason"] or "fail" in row["reason"] for row in stopped)
    assert report.data["effects"] == []
    page = (tmp_path / "report.html").read_text()
    assert "did not converge" in page


# ---- data of a closed loop ----------------------------------------------------------------------------------------


def bias_of(plant_id: str, model: str, scenario: str, seed: int, *, dither: float = 0.0, **options: float) -> BiasTest:
    """Return the bias test of the nominal fit; ``dither`` is a recorded part of the input that is no instrument."""
    plant = registry.create("plants", plant_id, sample_time=0.02)
    planned = registry.create("scenarios", scenario, noise=1e-3, **options)
    streams = Streams(plant_id, scenario, seed)
    experiment = planned.prepare(plant.spec, streams=streams, role="estimation/0")
    outside = experiment.excitation[:, 0].copy()
    if dither:
        experiment.excitation[:, 0] += dither * np.random.default_rng([seed, 7]).standard_normal(len(outside))
    record = perform(plant, experiment, rng=streams("estimation/0/plant")).measured()
    data = Dataset("made", (Run(record, "estimation"), Run(record[: len(record) // 2], "validation")))
    system = load_model(model)
    values = {name: plant.true_parameters[name] for name in system.parameter_names}
    horizon = 1.0 if model == "cart-pole" else None
    sizes, weights = sizes_of(system, values, data), np.full(system.ny, 1e-3)
    form = FreeRunForm(system, data, sizes=sizes, horizon=horizon, weights=weights)
    found = fit_output_error(system, list(data.estimation), start=values, horizon=horizon or 20.0, continuation=())
    fitted = seen(form, SimpleNamespace(effects=(), values=dict(found.parameters), own={}, day={}, converged=True))
    assert fitted is not None
    return closed_loop_bias(form, fitted, list(data.estimation), [{"excitation": outside}])


def test_the_bias_of_feedback_is_found_on_a_balanced_cart_pole() -> None:
    test = bias_of("cart-pole-ode", "cart-pole", "cart-pole-lqr", 2, duration=40.0, process_noise=0.3)
    assert test.p < 0.01
    assert test.largest > 1
    assert test.biased is True
    assert set(test.shifts) == {"mc", "mp", "l", "bx", "btheta"}
    written = test.to_dict({"mc": "kg"})
    json.dumps(written, allow_nan=False)
    assert "biases the parameters" in written["text"]
    assert written["parameters"]["mc"]["unit"] == "kg"


@pytest.mark.parametrize("seed", [0, 1, 3])
def test_no_bias_is_found_in_open_loop(seed: int) -> None:
    options = {"duration": 20.0, "amplitude": 0.5, "process_noise": 0.03, "process_noise_bandwidth": 2.0}
    test = bias_of("pendulum-ode", "pendulum", "multisine", seed, dither=0.05, **options)
    assert test.reason == ""
    assert test.p > 0.01
    assert test.biased is False


@pytest.mark.slow
def test_without_an_instrument_the_test_says_so(foreign_pendulum) -> None:
    data = foreign_pendulum(2, n=400)
    drag = [builtin()["quadratic_drag"]]
    report = close_loop(data, "pendulum", dictionary=drag)
    assert report.data["closed_loop_bias"]["biased"] is None
    assert "no reference or excitation from outside the loop" in report.data["closed_loop_bias"]["text"]
    assert report.data["closed_loop"]["u"]["p"] is not None, "the correlation test is made all the same"
    signals = [{"r": run.u[:, 0].copy()} for run in (*data.estimation, *data.validation)]
    again = close_loop(data, "pendulum", dictionary=drag, references=signals)
    assert "open loop" in again.data["closed_loop_bias"]["text"]


def test_a_simulated_closed_loop_records_what_came_from_outside(tmp_path) -> None:
    from harness.data import load_dataset

    out = tmp_path / "run.csv"
    api.simulate("cart-pole-ode", scenario="cart-pole-lqr", scenario_options={"duration": 4.0}, out=out)
    assert "reference:u [N]" in out.read_text().splitlines()[0]
    loaded = load_dataset(out, model="cart-pole")
    assert [set(one) for one in loaded.references] == [{"reference:u"}, {"reference:u"}]
    assert [channel.name for channel in loaded.dataset.spec.outputs] == ["x", "theta"]


# ---- ties and the experiments that break them ---------------------------------------------------------------------

STRIBECK = ("stribeck_friction", "theta", {"Fs": 0.063, "Fc": 0.05, "vs": 0.15, "w": 0.01})
LAG = ("actuator_lag", "u", {"tau": 0.01})


def records(hidden, scenario: str, options: dict, noise: float, seed: int, dt: float = 0.01) -> Dataset:
    runs = []
    for use in ("estimation", "validation"):
        record = api.simulate(
            "pendulum-ode",
            scenario=scenario,
            seed=seed,
            options={"sample_time": dt},
            scenario_options={"noise": noise, **options},
            hide=[hidden],
            role=f"{use}/0",
        )
        runs.append(Run(record.measured(), use))
    return Dataset("hidden", tuple(runs))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hidden", "rival", "first", "noise", "seed", "scenario", "dt"),
    [
        (STRIBECK, "coulomb_friction", {"amplitude": 1.6, "band": (0.2, 1.2)}, 4e-3, 4, "triangle", 0.02),
        (LAG, "input_delay", {"amplitude": 0.4, "band": (0.1, 0.5)}, 3e-3, 1, "chirp", 0.01),
    ],
)
def test_the_experiment_of_the_report_breaks_the_tie(hidden, rival, first, noise, seed, scenario, dt) -> None:
    dictionary = [builtin()[rival], builtin()[hidden[0]]]
    before = close_loop(
        records(hidden, "multisine", {"duration": 15.0, **first}, noise, seed, dt),
        "pendulum",
        dictionary=dictionary,
    )
    assert {one["name"] for one in before.data["tie_sets"][0]} == {hidden[0], rival}
    (plan,) = before.data["separate_with"][0]
    assert plan["scenario"] == scenario
    assert set(plan["separates"]) == {hidden[0], rival}
    # the command line says the same as the options
    words = shlex.split(plan["command"])
    assert words[:5] == ["sysid", "simulate", "PLANT", "--scenario", scenario]
    assert f"amplitude={plan['options']['amplitude']:g}" in words
    better = records(hidden, plan["scenario"], plan["options"], noise, 2, dt)
    after = close_loop(better, "pendulum", dictionary=dictionary)
    assert [one["name"] for one in after.data["effects"]] == [hidden[0]]
    assert after.data["tie_sets"] == [[{"name": hidden[0], "at": hidden[1]}]]


def test_a_tilt_is_an_instruction_and_no_input() -> None:
    from harness.diagnosis.report.experiments import Bench, separate_with

    data = records(("sensor_offset", "theta", {"offset": 0.05}), "multisine", {"duration": 5.0}, 1e-3, 1)
    system = load_model("pendulum")
    tie = [(Placed(builtin()[name], at),) for name, at in
           (("gravity_tilt", "base"), ("sensor_offset", "theta"), ("force_bias", "theta"))]  # fmt: skip
    base, swing = separate_with(Bench(system, system, system.values(), data), tie)
    assert base["scenario"] is None
    assert "turn the base" in base["instruction"]
    assert swing["scenario"] == "chirp"
    reached = api.simulate("pendulum-ode", scenario="chirp", scenario_options=swing["options"])
    assert np.degrees(np.abs(reached.y).max()) > 60
    assert separate_with(Bench(system, system, system.values(), data), tie[:1]) == []


@pytest.mark.parametrize("held", [("J", "b", "mgl"), ("J", "mgl")])
def test_a_model_of_which_nothing_is_fitted_is_said(held: tuple[str, ...]) -> None:
    data = records(("sensor_offset", "theta", {"offset": 0.05}), "multisine", {"duration": 5.0}, 1e-3, 1)
    parameters = {name: replace(load_model("pendulum").parameter(name), fixed=True) for name in held}
    found = close_loop(data, "pendulum", parameters=parameters, dictionary=[builtin()["sensor_offset"]])
    said = [one for one in found.data["warnings"] if "J, b, mgl" in one]
    assert len(said) == (len(held) == 3)
    assert [one["name"] for one in found.data["effects"]] == ["sensor_offset"]


@pytest.mark.parametrize(("constant", "least", "most"), [(0.5, 20.0, 60.0), (400.0, 2000.0, 6000.0)])
def test_an_experiment_lasts_until_the_plant_has_answered(constant: float, least: float, most: float) -> None:
    from harness.diagnosis.report.experiments import Bench, separate_with

    oven = Ode("oven", x="T", u="P", p="tau", units={"T": "K", "P": "W", "tau": "s"})
    oven.rhs = [(oven.u[0] - oven.x[0]) / oven.p[0]]
    system = oven.system().with_parameters({"tau": constant})
    t = np.arange(600) * 0.002 * constant
    u = np.sign(np.sin(0.8 * t / constant))[:, None]
    spec = PlantSpec(system.inputs, system.outputs, 0.002 * constant)
    data = Dataset("oven", (Run(Trajectory(t, u, 0.5 * u, spec), "estimation"),))
    tie = [(Placed(builtin()[name], "P"),) for name in ("input_delay", "actuator_lag")]
    (plan,) = separate_with(Bench(system, system, system.values(), data), tie)
    assert least <= plan["options"]["duration"] <= most


# ---- before the data ----------------------------------------------------------------------------------------------


def test_what_an_experiment_can_tell_apart_is_known_before_it(capsys) -> None:
    from harness.command import main

    with pytest.raises(SystemExit) as done:
        main(
            ["isolability", "pendulum", "--scenario", "multisine", "-S", "duration=8", "-S", "amplitude=0.4", "--json"]
        )
    assert done.value.code == 0
    found = json.loads(capsys.readouterr().out)
    alike = {frozenset(pair[:2]) for pair in found["alike"]}
    assert frozenset({"gravity_tilt@base", "sensor_offset@theta"}) in alike
    assert frozenset({"coulomb_friction@theta", "cubic_spring@theta"}) not in alike
    assert {"input_gain"} <= {row["name"] for row in found["not_visible"]}
    cosine = np.array(found["cosine"])
    assert cosine.shape == (len(found["effects"]),) * 2
    assert np.allclose(np.diag(cosine), 1)


def test_a_plant_without_equations_cannot_be_asked(capsys) -> None:
    from harness.command import main

    with pytest.raises(SystemExit) as done:
        main(["isolability", "arm-bullet", "--scenario", "multisine"])
    assert done.value.code == 2
    assert "has no equations" in capsys.readouterr().err
