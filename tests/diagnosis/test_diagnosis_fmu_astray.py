"""An FMU whose free run goes quite another way than its plant: laws are looked for along what was measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from linear_form import ALL, LinearForm, linear_records

from harness import registry
from harness.blackbox.reader import fmu_system
from harness.blackbox.runner import Runner
from harness.blackbox.simulator import FmuSimulator
from harness.diagnosis import close_loop
from harness.diagnosis.effort import EFFORT
from harness.diagnosis.fmu import form as fmu
from harness.diagnosis.fmu.form import FmuForm
from harness.diagnosis.fmu.prepare import measured_states, nominal_fmu, restarts
from harness.diagnosis.fmu.pushes import as_measured
from harness.diagnosis.forms import likelihood_form as forms
from harness.diagnosis.search.fit import Begun
from harness.diagnosis.search.scores import score_test
from harness.diagnosis.search.search import search
from harness.diagnosis.steps import nominal_fit
from harness.effects import builtin
from harness.effects.effect import Placed
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory
from plants.mockups import mockup

DT = 0.02
FORCE = Channel("u", "N m")
FRICTION = Placed(builtin()["coulomb_friction"], "theta")
RIVALS = ("input_delay@u", "actuator_lag@u", "sensor_delay@theta", "rate_limit@u", "saturation@u")


def swung(n: int = 600, **parameters: float) -> Dataset:
    """Return records of the pendulum FMU that is driven near its resonance, its angle measured."""
    runs = []
    for seed, use in enumerate(("estimation", "validation")):
        rng = np.random.default_rng(seed)
        t = np.arange(n) * DT
        u = sum(0.2 * np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in (0.31, 0.55, 0.72, 1.4))[:, None]
        given = {"J": 0.06, "b": 0.0, "mgl": 1.1, **parameters}
        with registry.create("plants", "fmu", path=mockup("pendulum"), sample_time=DT, outputs=["theta"],
                             parameters=given) as plant:  # fmt: skip
            y = np.vstack([plant.reset(rng=rng, x0={"theta": 0.2}), plant.rollout(u[:-1])])
            spec = PlantSpec(plant.spec.inputs, plant.spec.outputs, DT)
        runs.append(Run(Trajectory(t, u, y + rng.normal(0, 1e-3, y.shape), spec), use))  # type: ignore[arg-type]
    return Dataset("pendulum", tuple(runs), noise={"theta": 1e-3})


@pytest.mark.parametrize("seen", ["theta", "omega"])
def test_laws_act_along_the_measured_motion_and_along_the_free_run_where_it_is_right(seen: str) -> None:
    spec = PlantSpec((FORCE,), (Channel(seen, "rad" if seen == "theta" else "rad/s"),), DT)
    system = fmu_system(mockup("pendulum"), spec)
    t = np.asarray(DT * np.arange(500), dtype=np.float64)
    q, v = np.sin(2 * t)[:, None], 2 * np.cos(2 * t)[:, None]
    true = q if seen == "theta" else v
    record = Trajectory(t, np.zeros((500, 1)), true + np.random.default_rng(0).normal(0, 1e-3, true.shape), spec)
    still = np.zeros_like(q)
    for free_q, free_v, free_y in ((still, still, still), (q, v, true)):
        led_q, led_v = as_measured(system, record, free_q, free_v, free_y)
        assert np.std(led_v - v) < 0.02 * np.std(v)
        assert np.std(led_q - q) < 0.2 * np.std(q), "an integral is told but for a line"


def test_short_windows_are_asked_for_only_where_an_fmu_can_begin_anew() -> None:
    record = swung().estimation[0].measured()
    system = fmu_system(mockup("pendulum"), record.spec)
    simulator = FmuSimulator(system, Runner(system, DT))
    states = measured_states(system, simulator, record, system.vector())[0]
    assert restarts(simulator, record, system.vector(), states)
    rates = [k for k, state in enumerate(system.inner_states) if state.name == "omega"]
    less = replace(system, inner_states=tuple(system.inner_states[k] for k in rates))
    assert not restarts(FmuSimulator(less, Runner(less, DT)), record, less.vector(), states[:, rates])


def test_friction_that_a_model_without_damping_cannot_follow_is_promised_from_what_is_declared() -> None:
    data = swung(400, Fc=0.12)
    known = {"J": 0.05, "mgl": 1.0, "b": {"value": 0.0, "fixed": True}}
    form = FmuForm(nominal_fmu(mockup("pendulum"), data, known), data, {})
    nominal = nominal_fit(form, form, [])  # type: ignore[arg-type]
    declared = form.without_memory(nominal)
    assert declared is not None
    assert [declared.values[name] for name in ("J", "mgl")] == pytest.approx([0.05, 1.0])
    rivals = [Placed(builtin()[one.split("@")[0]], one.split("@")[1]) for one in RIVALS]
    leads = score_test(form, declared, [FRICTION, *rivals]).leads
    promised = {str(lead.placed): lead.gain for lead in leads}
    assert promised[str(FRICTION)] > 0.9 * max(promised.values())
    right = swung(300)
    follows = FmuForm(nominal_fmu(mockup("pendulum"), right, known), right, {})
    assert follows.without_memory(nominal_fit(follows, follows, [])) is None  # type: ignore[arg-type]


def test_a_search_that_costs_too_much_ends_and_says_what_it_did_not_try(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forms, "EFFORT", replace(EFFORT, seconds=0.0))
    data = swung(300, Fc=0.05, b=0.04)
    report = close_loop(data, mockup("pendulum"), parameters={"J": 0.05, "b": 0.04, "mgl": 1.0},
                        dictionary=[builtin()["coulomb_friction"]])  # fmt: skip
    assert report.data["effects"] == []
    (said,) = [words for words in report.data["warnings"] if "not tried to the end" in words]
    assert "coulomb_friction@theta" in said
    assert report.data["verdict"] == "unexplained"
    assert report.data["summary"].startswith("something is missing in Pendulum")
    assert report.data["summary"].endswith("1 effect was not tried to the end")
    (row,) = report.data["candidates"]
    assert "the search had reached its cost limit" in row["reason"]


@pytest.mark.parametrize("limited", [True, False])
def test_where_a_search_may_end_early_what_promises_most_is_begun_first(limited: bool) -> None:
    """A column that the nominal parameters take up nearly whole makes a promise uncertain, and not small."""
    records = linear_records(5, {"cubic_spring": 40.0, "linear_spring": 0.5}, absorbed={"cubic_spring": 0.05})
    begun: list[str] = []

    class Form(LinearForm):
        def limited(self) -> bool:
            return limited

        def begin(self, effects: Sequence[Placed], *more: Any) -> Begun:
            begun.extend(one.effect.name for one in effects[-1:])
            return super().begin(effects, *more)

    form = Form(records)
    search(form, form.fit((), [], None), ALL)
    assert (begun[0] == "cubic_spring") == limited


def test_what_was_begun_is_finished_where_nothing_more_is_begun(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (forms, fmu):
        monkeypatch.setattr(module, "EFFORT", replace(EFFORT, seconds=1.0, ending=2.0))
    data = swung(200)
    form = FmuForm(nominal_fmu(mockup("pendulum"), data, {"J": 0.05, "b": 0.04, "mgl": 1.0}), data, {})
    beside = form.on(data)
    spent = 0.0
    monkeypatch.setattr(type(form.runner), "seconds", property(lambda runner: spent))
    nominal = nominal_fit(form, form, [])  # type: ignore[arg-type]
    begun = form.begin([FRICTION], [{}], nominal)
    assert begun is not None
    spent = 1.5
    assert form.begin([FRICTION], [{}], nominal) is None
    finished = form.finish(begun, nominal)
    assert finished is not None
    assert finished.converged
    assert form.begin([FRICTION], [{}], nominal) is not None, "what was finished may be asked for again"
    assert beside.begin([], beside.first_starts(), None) is None, "other data are part of the same search"
    spent = 2.5
    assert form.finish(begun, nominal) is None
    assert form.left_out() == [str(FRICTION)]
    assert form.begin([], form.first_starts(), None) is not None, "the nominal model is fitted whatever it costs"


def test_a_new_delay_starts_from_an_input_before_the_record_that_the_record_tells() -> None:
    """The motor got nothing until the record began, and what it gets comes three samples late."""
    rng, true = np.random.default_rng(0), {"J": 0.06, "b": 0.04, "mgl": 1.1}
    u = 0.7 + 0.2 * np.sin(np.arange(200) * DT * 3.0)[:, None]
    with registry.create("plants", "fmu", path=mockup("pendulum"), sample_time=DT, outputs=["theta"],
                         parameters=true) as plant:  # fmt: skip
        arrived = np.vstack([np.zeros((3, 1)), u])[:-4]
        y = np.vstack([plant.reset(rng=rng, x0={"theta": 0.0}), plant.rollout(arrived)])
        spec = PlantSpec(plant.spec.inputs, plant.spec.outputs, DT)
    record = Trajectory(DT * np.arange(200), u, y + rng.normal(0, 1e-4, y.shape), spec)
    data = Dataset("late", (Run(record, "estimation"), Run(record, "validation")))
    form = FmuForm(nominal_fmu(mockup("pendulum"), data, true), data, {})
    delayed = form.composed([Placed(builtin()["input_delay"], "u", {"tau": 3 * DT})])
    for use in ("estimation", "validation"):
        (start,) = form._starts(delayed, form.passes(delayed, 1), delayed.vector(), use, None)
        assert start[-1] == pytest.approx(-0.7, abs=0.1)
    gone = delayed.vector({"input_delay@u.tau": 0.0})
    assert form._starts(delayed, form.passes(delayed, 1), gone, "estimation", None)[0][-1] == 0.0
