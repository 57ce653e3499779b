"""Verdict, grade, misfit, horizon, errors and the memory of refits, each from what it is made of."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from harness.diagnosis.algorithm import diagnose
from harness.diagnosis.close import close_loop
from harness.diagnosis.diagnosis import Diagnosis
from harness.diagnosis.forms.apart import Apart
from harness.diagnosis.forms.fit_records import LikelihoodDetail
from harness.diagnosis.kinds import EquationsKind
from harness.diagnosis.misfit import _shifted, misfit_reasons, mistakes
from harness.diagnosis.policy import POLICY
from harness.diagnosis.records.horizon import Horizon, choose_horizon
from harness.diagnosis.runs.compare import FreeRuns
from harness.diagnosis.runs.errors import figures
from harness.diagnosis.store import CandidateStore, data_fingerprint
from harness.effects import builtin
from harness.effects.effect import Placed
from harness.errors import InputError
from harness.physics import load_model
from harness.physics.symbolic.typed import read_equations
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory


def kept(points: Any, passes: Any = None, best: Any = None) -> LikelihoodDetail:
    """Return what a fit of the likelihood keeps, as far as it is asked for here."""
    return LikelihoodDetail(points, passes, best, best)


DRAG = Placed(builtin()["quadratic_drag"], "theta")


def diagnosis(
    *,
    accepted: bool = False,
    left_over: bool = False,
    latent: float = 0.0,
    white: float = 0.0,
    left: float = 0.01,
    beyond_start: float | None = None,
    misfit: tuple[str, ...] = (),
    imitated: bool = False,
    withdrawn: bool = False,
    rival: str = "",
    worse: bool = False,
    apart: float = 0.0,
    promised: str = "",
    force: bool = True,
    further: float = 1.0,
    to_the_noise: bool = False,
    untried: tuple[str, ...] = (),
) -> Diagnosis:
    """Return a diagnosis with what verdict and grade look at; the typical force is 2."""
    noise = SimpleNamespace(s=np.array([2 * latent]), w=np.array([2 * white]))
    model = SimpleNamespace(effects=(), detail=kept({"estimation": SimpleNamespace(noise=noise)}))
    outcome: Any = SimpleNamespace(
        accepted=[SimpleNamespace(placed=DRAG)] if accepted else [],
        model=model,
        withdrawn=[SimpleNamespace(placed=DRAG)] if withdrawn else [],
        unlawful=lambda policy: SimpleNamespace(name=rival) if rival else None,
        denied=lambda policy: (),
        promised=lambda policy: SimpleNamespace(name=promised) if promised else None,
    )
    best = SimpleNamespace(name="theta over theta_rate") if left_over else None
    scale = SimpleNamespace(force_scale=np.array([2.0]))
    form: Any = SimpleNamespace(noise_model=scale, latent=force, jumps=lambda fit: [], left_out=lambda: list(untried))
    rest: dict[str, Any] = {
        "leftover": SimpleNamespace(best=best, missing=None if imitated else best),
        "runs": SimpleNamespace(
            left=left,
            beyond_start=left if beyond_start is None else beyond_start,
            further=further,
            worse=lambda policy: worse,
            to_the_noise=lambda policy: to_the_noise,
        ),
    }
    nothing: Any = None
    plant: Any = SimpleNamespace(coordinates=("theta",) if force else ())
    made = Diagnosis(nothing, plant, form, outcome, rest["leftover"], rest["runs"], misfit, POLICY)
    made.apart = Apart(apart, [np.full(1000, apart / 1000)], "J", 0.05)
    return made


def test_what_is_left_of_a_found_law_is_missed_only_where_free_runs_leave_more_than_noise() -> None:
    """An end stop's corner is rounder than the dictionary's: an exact sensor sees that, and nobody misses it."""
    for to_the_noise, grade in ((True, "explained"), (False, "proxy_or_incomplete")):
        found = diagnosis(accepted=True, left_over=True, to_the_noise=to_the_noise)
        assert found.grade == grade
        assert bool(found.stand_in) is not to_the_noise
    assert diagnosis(left_over=True, to_the_noise=True).verdict == "unexplained", "where nothing has a name it is said"


def test_what_was_not_tried_leaves_open_whether_something_is_missing() -> None:
    assert diagnosis().verdict == "nothing_missing"
    assert diagnosis(untried=("backlash@theta",)).verdict == "unexplained"
    assert not diagnosis(untried=("backlash@theta",)).lacking
    assert diagnosis(accepted=True).grade == "explained"
    assert diagnosis(accepted=True, untried=("backlash@theta",)).grade == "mostly_explained"


@pytest.mark.parametrize(("size", "expected"), [(1.0, True), (1.06, False), (np.nan, False)])
def test_free_runs_leave_no_more_than_noise_only_if_every_output_does(size: float, expected: bool) -> None:
    noise = np.array([0.1, 2.0])
    errors = np.where(np.arange(400)[:, None] % 2, 1.0, -1.0) * np.array([1.0, size])  # over their weights
    after: Any = SimpleNamespace(finite=bool(np.isfinite(errors).all()), validation=[errors])
    output: Any = SimpleNamespace(weights=noise)
    runs = FreeRuns(None, output, None, after, 0.0, 0.0, np.ones(2), noise**2, 0)  # type: ignore[arg-type]
    assert runs.to_the_noise(POLICY) is expected
    assert not replace(runs, after=None).to_the_noise(POLICY)


def test_the_verdict_asks_first_whether_the_model_fits() -> None:
    assert diagnosis().verdict == "nothing_missing"
    assert diagnosis(accepted=True).verdict == "effects_found"
    assert diagnosis(left_over=True).verdict == "unexplained"
    assert diagnosis(left_over=True, imitated=True).verdict == "nothing_missing"
    assert diagnosis(latent=0.25).verdict == "unexplained"
    assert diagnosis(latent=0.15).verdict == "nothing_missing"
    assert diagnosis(latent=0.15, white=0.15).verdict == "unexplained"
    assert diagnosis(left=0.06, force=False).verdict == "unexplained", "of a process no force takes up what is left"
    assert diagnosis(left=0.04, force=False).verdict == diagnosis(left=0.06).verdict == "nothing_missing"
    assert diagnosis(left=0.06, force=False, accepted=True).verdict == "effects_found"
    assert diagnosis(left=0.5).verdict == "nothing_missing", "a small force takes it away"
    assert diagnosis(left=0.5, beyond_start=0.1).verdict == "unexplained", "a line is as near"
    assert diagnosis(left=0.5, beyond_start=0.1, accepted=True).verdict == "effects_found"
    assert diagnosis(withdrawn=True).verdict == "unexplained"
    assert diagnosis(apart=200.0).verdict == "unexplained"
    assert diagnosis(apart=20.0).verdict == "nothing_missing"
    assert diagnosis(promised="backlash@theta").verdict == "unexplained"
    assert diagnosis(further=6.0).verdict == "unexplained"
    assert diagnosis(further=3.0).verdict == "nothing_missing"
    assert diagnosis(accepted=True, further=6.0).verdict == "effects_found"
    assert diagnosis(accepted=True, promised="backlash@theta").grade == "explained", "an answer has rivals"
    assert diagnosis(accepted=True, misfit=("it does not",)).verdict == "model_does_not_fit"


def test_explained_is_said_of_a_model_that_leaves_little_and_nothing_to_predict() -> None:
    assert diagnosis().grade == "explained"
    assert diagnosis(left=0.04).grade == "explained"
    assert diagnosis(left=0.06).grade == "mostly_explained"
    assert diagnosis(left=0.04, force=False).grade == "mostly_explained", "nothing took up a fifth of the motion"
    assert diagnosis(left=0.002, force=False).grade == "explained"
    assert diagnosis(latent=0.06).grade == "mostly_explained"
    assert diagnosis(accepted=True, worse=True).grade == "mostly_explained"
    assert diagnosis(accepted=True, rival="coulomb_friction@theta").grade == "mostly_explained", "a stand-in"
    assert diagnosis(accepted=True, apart=200.0).grade == "proxy_or_incomplete"
    assert diagnosis(latent=0.25).grade == "proxy_or_incomplete"
    assert diagnosis(left_over=True).grade == "proxy_or_incomplete"
    assert diagnosis(withdrawn=True).grade == "proxy_or_incomplete"
    assert diagnosis(misfit=("it does not",)).grade == "does_not_fit"


def test_effects_beside_which_something_can_be_predicted_are_stand_ins() -> None:
    assert diagnosis(accepted=True).stand_in == ()
    (reason,) = diagnosis(accepted=True, rival="coulomb_friction@theta").stand_in
    assert "coulomb_friction@theta" in reason
    assert diagnosis(rival="coulomb_friction@theta").stand_in == (), "nothing was named"
    assert diagnosis(accepted=True, left_over=True).stand_in
    assert diagnosis(accepted=True, left_over=True, imitated=True).stand_in, "an effect may follow what drifts"
    assert diagnosis(left_over=True).stand_in == ()


# ---- does the model fit at all ---------------------------------------------------------------------------------------


def doubted(
    left: float,
    force: float,
    *,
    on_bound: tuple[str, ...] = (),
    repaired: float | dict[str, float] = 0.0,
    doubts: tuple[str, ...] = (),
    noise: float = 0.0,
    further: float = 1.0,
    untried: tuple[str, ...] = (),
) -> tuple[str, ...]:
    """Return the reasons for a model that leaves a share of the variance and needs a force of this share.

    ``further``: times as far as on the estimation records that it errs.
    ``noise``: share of the readings' variance that the sensor makes; the readings are as white as noise here.
    ``repaired``: what every repair gains, or those of some columns (their first values are negative in ``dataset``).
    """
    y = dataset().validation[0].y
    noises = SimpleNamespace(s=np.array([2 * force]), w=np.zeros(1), r=np.sqrt(noise * y.var(axis=0)))
    forces = (SimpleNamespace(port="theta"),)
    points = {"estimation": SimpleNamespace(noise=noises)}
    final: Any = SimpleNamespace(
        detail=kept(points, SimpleNamespace(forces=forces)),
        on_bound=on_bound,
        values={"J": 1.0},
        log_likelihood=lambda use: 100.0,
    )
    plain = dataset().estimation[0]

    def other(data: Dataset) -> SimpleNamespace:
        run = data.estimation[0]
        flipped = [name for name in ("u", "y") if np.array_equal(getattr(run, name), -getattr(plain, name))]
        gain = repaired if isinstance(repaired, float) else sum(repaired[name] for name in flipped)
        return SimpleNamespace(
            first_starts=list,
            begin=lambda effects, starts, base, hope=0.0: SimpleNamespace(log_likelihood=100.0 + gain),
            finish=lambda begun, base, least: SimpleNamespace(log_likelihood=lambda use: begun.log_likelihood),
        )

    form: Any = SimpleNamespace(
        dataset=dataset(),
        records={"estimation": dataset().estimation},
        on=other,
        noise_model=SimpleNamespace(force_scale=np.array([2.0])),
        latent=False,
        left_out=lambda: list(untried),
    )
    deviation = np.maximum(noises.r, 1e-3)
    error = np.sqrt(left * y.var(axis=0)) / deviation * np.ones((len(y), 1))
    after: Any = SimpleNamespace(validation=(error,), estimation=(error / further,), finite=bool(np.isfinite(left)))
    output: Any = SimpleNamespace(
        weights=deviation,
        records={use: dataset().using(use) for use in ("estimation", "validation")},
        nominal=SimpleNamespace(h=None),
        columns=[("theta", "rad")],
    )
    runs = FreeRuns.of(Horizon(None, "whole records"), output, None, after)
    return misfit_reasons(form, final, final, runs, POLICY, doubts)


def dataset(n: int = 200, **more: Any) -> Dataset:
    """Return two records of a torque and an angle."""
    spec = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"),), 0.01)
    rng = np.random.default_rng(0)
    runs = tuple(
        Run(Trajectory(np.arange(n) * 0.01, rng.normal(size=(n, 1)), rng.normal(size=(n, 1)), spec), use)  # type: ignore[arg-type]
        for use in ("estimation", "validation")
    )
    return Dataset("x", runs, **more)


def test_a_model_fits_that_predicts_most_of_the_motion_without_a_force_from_nowhere() -> None:
    assert doubted(0.2, 0.6) == ()
    assert doubted(0.2, 0.0, on_bound=("J",)) == (), "a bound alone is no misfit"
    assert "60 % of the motion" in doubted(0.36, 0.0)[0]
    assert "diverges" in doubted(np.inf, 0.0)[0]
    assert "diverges" in doubted(np.nan, 0.0)[0]
    assert "80 % of what moves theta" in doubted(0.0, 0.8)[0]
    assert any("J ended on a bound" in text for text in doubted(0.5, 0.0, on_bound=("J", "s@theta")))
    assert doubted(0.5, 0.8, untried=("coulomb_friction@theta",)) == (), "it may be all that the model lacks"


def test_records_of_another_machine_are_told_from_a_wrong_model() -> None:
    assert not any("another machine" in text for text in doubted(0.5, 0.0, further=3.0))
    assert any("8 times that on the estimation records: another machine" in text
               for text in doubted(0.5, 0.0, further=8.0))  # fmt: skip


def test_a_mistake_is_named_only_if_its_repair_makes_the_model_far_likelier() -> None:
    assert not any("check" in text for text in doubted(0.5, 0.0, repaired=40.0))
    assert any("check the sign of u" in text for text in doubted(0.5, 0.0, repaired=60.0))


def test_repairs_that_do_as_well_are_named_together() -> None:
    """A position of the wrong sign was "check the sign of u": for a plant that is odd both are the same."""
    assert any(
        "check the sign of u or the sign of theta:" in text
        for text in doubted(0.5, 0.0, repaired={"u": 900.0, "y": 870.0})
    )
    assert any("check the sign of theta:" in text for text in doubted(0.5, 0.0, repaired={"u": 700.0, "y": 870.0}))


def test_noise_of_the_sensor_is_no_misfit() -> None:
    """Readings that are all noise were "leaves 100 % of the motion"."""
    assert doubted(0.5, 0.0, noise=0.4) == ()
    assert "leaves 71 % of the motion" in doubted(0.7, 0.0, noise=0.4)[0]
    (reason,) = doubted(1.0, 0.0, noise=0.7, repaired=900.0)
    assert "the readings of theta are mostly noise (70 % of the variance)" in reason


@pytest.mark.slow  # a whole loop
def test_nothing_is_looked_for_in_readings_that_are_noise(foreign_pendulum) -> None:
    good = foreign_pendulum(3, n=300)
    rng = np.random.default_rng(0)
    runs = tuple(replace(run, trajectory=replace(run.trajectory, y=rng.standard_normal((300, 1)))) for run in good)
    report = close_loop(replace(good, runs=runs), "pendulum")
    assert report.verdict == "model_does_not_fit"
    assert report.data["effects"] == []
    assert not any(one["refitted"] for one in report.data["candidates"])
    assert "they show nothing" in report.data["misfit"][-1]
    assert "leaves" not in report.data["summary"]


def test_columns_in_doubt_are_reason_enough() -> None:
    assert doubted(0.01, 0.0, doubts=("check the units",)) == ("check the units",)
    assert doubted(0.5, 0.0, doubts=("check the units",), repaired=900.0) == ("check the units",)


@pytest.mark.parametrize(("late", "words"), [(8, "about 8 samples late"), (-3, "about 3 samples early"), (0, "")])
def test_an_input_that_is_late_or_early_is_named_with_the_samples(foreign_pendulum, late: int, words: str) -> None:
    """Five samples late were tried, and nothing else."""
    good = foreign_pendulum(3, n=400)

    def moved(record: Trajectory) -> Trajectory:
        u = np.roll(record.u, late, axis=0)
        return replace(record, u=u)[20:-20]

    runs = tuple(replace(run, trajectory=moved(run.trajectory)) for run in good)
    found = list(_shifted(EquationsKind().form(load_model("pendulum"), replace(good, runs=runs)), 1))
    assert len(found) == bool(words)
    for text, repaired, _ in found:
        assert words in text
        rows = slice(10, -10)
        np.testing.assert_array_equal(repaired.estimation[0].u[rows], good.estimation[0].u[20:-20][rows])


@pytest.mark.slow  # a whole loop
def test_an_input_that_is_late_is_named_where_the_model_fits_after_a_fashion(foreign_pendulum) -> None:
    """No effect answers before its cause: the record was unexplained, by a force that changes with time."""
    good = foreign_pendulum(3, n=1000)
    runs = tuple(
        replace(run, trajectory=replace(run.trajectory, u=np.roll(run.trajectory.u, 3, axis=0))[20:-20]) for run in good
    )
    found = diagnose(replace(good, runs=runs), load_model("pendulum"))
    assert found.verdict == "unexplained" or found.stand_in, found.outcome.accepted  # what imitates it is no answer
    assert found.grade != "explained"
    assert any("whether u is recorded about 3 samples late" in warning for warning in found.warnings)


def test_likely_mistakes_are_signs_and_degrees() -> None:
    data = dataset()
    made = {text: (changed, scale) for text, changed, scale in mistakes(data)}
    u, y = data.estimation[0].u, data.estimation[0].y
    changed = {text: one.estimation[0] for text, (one, _) in made.items()}
    np.testing.assert_array_equal(changed["the sign of u"].u, -u)
    np.testing.assert_array_equal(changed["the sign of theta"].y, -y)
    np.testing.assert_allclose(changed["whether theta is in degrees"].y, y * np.pi / 180)
    # a density over smaller numbers is larger by the factor, for every sample
    assert made["whether theta is in degrees"][1] == pytest.approx(200 * np.log(np.pi / 180))
    np.testing.assert_array_equal(made["the sign of u"][0].validation[0].u, -data.validation[0].u)


# ---- memory ----------------------------------------------------------------------------------------------------------


def test_everything_that_decides_a_refit_is_in_its_fingerprint() -> None:
    data = dataset()
    first = data_fingerprint(data)
    assert first == data_fingerprint(dataset())

    def moved(name: str) -> Dataset:
        run = data.runs[1]
        values = getattr(run.trajectory, name) + 1e-9
        return replace(data, runs=(data.runs[0], replace(run, trajectory=replace(run.trajectory, **{name: values}))))

    others = [moved(name) for name in ("t", "u", "y")]
    others.append(replace(data, runs=tuple(replace(run, use="validation") for run in data.runs)))
    others.append(replace(data, noise={"theta": 1e-3}))
    others.append(replace(data, intersample="foh"))
    prints = [data_fingerprint(one) for one in others]
    assert len({first, *prints}) == len(prints) + 1


def test_refits_of_other_data_are_not_seen(tmp_path: Path) -> None:
    CandidateStore(tmp_path, "a").put("drag#1", {"value": 1.0})
    assert CandidateStore(tmp_path, "a").get("drag#1") == {"value": 1.0}
    assert CandidateStore(tmp_path, "b").get("drag#1") is None
    assert CandidateStore(tmp_path, "a").get("drag#2") is None
    (path,) = (tmp_path / "candidates").glob("*.json")
    path.write_text("{half")
    assert CandidateStore(tmp_path, "a").get("drag#1") is None, "a broken file counts as absent"


# ---- horizon and errors ----------------------------------------------------------------------------------------------


SPEED = PlantSpec((Channel("u", "N m"),), (Channel("w", "rad/s"),), 0.01)


def swing(n: int, start: float = 0.0, *, model: str = "pendulum") -> Dataset:
    """Return slow, small motion about a position in the channels of a model."""
    system = load_model(model)
    spec = PlantSpec(system.inputs, system.outputs, 0.01)
    t = np.arange(n) * 0.01
    y = np.column_stack([start * (k == 0) + 0.01 * np.sin(t) for k in range(spec.ny)])
    runs = tuple(Run(Trajectory(t, np.zeros((n, 1)), y, spec), use) for use in ("estimation", "validation"))  # type: ignore[arg-type]
    return Dataset("x", runs)


def test_a_hanging_pendulum_is_simulated_whole_and_an_inverted_one_as_long_as_an_error_grows_twenty_times() -> None:
    system = load_model("pendulum")
    values = {"J": 0.1, "b": 0.05, "mgl": 1.0}
    assert choose_horizon(system, values, swing(3000)).seconds is None
    pole = -0.25 + np.sqrt(0.25**2 + 10.0)
    seconds = choose_horizon(system, values, swing(3000, np.pi)).seconds
    assert seconds is not None
    assert 0.4 * np.log(20) / pole <= seconds <= 1.1 * np.log(20) / pole


def test_an_integrating_plant_is_judged_over_four_of_its_slowest_time_constants() -> None:
    system = load_model("pendulum")
    values = {"J": 0.1, "b": 0.2, "mgl": 0.0}
    seconds = choose_horizon(replace_gravity(system), values, swing(4000)).seconds
    assert seconds == 2.0  # 4 J / b


def test_turns_that_nobody_reads_do_not_shorten_the_free_run_of_a_motor_whose_speed_is_read() -> None:
    text = ["input u [N m]", "state w [rad/s]", "motion shaft: w, J", "J = 1e-4 kg m^2", "b = 1e-3 N m s/rad"]
    run = Run(Trajectory(np.arange(4000) * 0.01, np.ones((4000, 1)), np.ones((4000, 1)), SPEED))
    for law, whole in (("u - b*w", True), ("u", False)):  # without damping the speed itself is an integral
        system = read_equations("\n".join([*text, f"w' = ({law})/J", "output w"])).system()
        assert (choose_horizon(system, system.values(), Dataset("x", (run,))).seconds is None) == whole


def replace_gravity(system: Any) -> Any:
    """Return a pendulum declared without gravity."""
    parts = tuple(replace(one, value=0.0) if one.name == "mgl" else one for one in system.parameters)
    return replace(system, parameters=parts)


def test_errors_are_rms_and_over_the_spread_of_the_measurement() -> None:
    y = np.array([[0.0, 1.0], [2.0, 1.0]])
    error = np.array([[0.5, 1.0], [-0.5, -1.0]])
    found = figures([error], [y], [("a", "m"), ("b", "V")])
    assert found["a"] == {"rms": 0.5, "nrmse": 0.5, "unit": "m"}
    assert found["b"] == {"rms": 1.0, "nrmse": None, "unit": "V"}
    assert figures([error * np.nan], [y], [("a", "m")])["a"]["rms"] is None
    assert figures([], [], [("a", "m")]) == {}
    constant = np.full((300, 1), 0.1)  # whose mean is off by rounding
    assert constant.std() > 0
    assert figures([0.1 * constant], [constant], [("a", "m")])["a"]["nrmse"] is None, "4.44e+15 % was said"


def test_records_that_cannot_be_judged_are_refused_with_the_reason() -> None:
    from harness.diagnosis.records.prepare import checked

    system = load_model("pendulum")
    good = swing(200, 0.5)
    assert checked(good, system) is not None
    for runs, words in (
        (good.runs[:1], "no validation run"),
        (tuple(replace(run, trajectory=run.trajectory[:60]) for run in good.runs), "too short"),
        (tuple(replace(run, trajectory=replace(run.trajectory, y=0 * run.trajectory.y)) for run in good.runs), "never"),
    ):
        with pytest.raises(InputError, match=words):
            checked(replace(good, runs=runs), system)


@pytest.mark.parametrize(("output", "fits"), [("v", True), ("x", False)])
def test_a_model_of_a_car_that_rolls_out_fits_though_a_line_is_nearer_to_its_speed(output: str, fits: bool) -> None:
    """Its speed falls along a line: that says nothing of why. A place that goes on along one needs no force at all."""
    text = f"state x [m], v [m/s]\nmotion x: v, m\nm = 1 kg fixed\nb = 1 N s/m\nx' = v\nv' = -b*v/m\noutput {output}"
    system = read_equations(text).system()
    t = np.arange(100.0)
    y = 10.0 - 0.1 * t + 0.01 * np.random.default_rng(0).standard_normal(100)
    record = Trajectory(t, np.zeros((100, 0)), y[:, None], PlantSpec(system.inputs, system.outputs, 1.0))
    after: Any = SimpleNamespace(validation=[np.full((100, 1), 20.0)], finite=True)
    runs: Any = SimpleNamespace(
        weights=np.array([0.01]), records={"estimation": [record], "validation": [record]}, nominal=system
    )
    found = FreeRuns.of(Horizon(None, "whole records"), runs, None, after)
    assert found.left > 1.0
    assert (found.beyond_start < 0.01) is fits
    assert fits or found.beyond_start == found.left
