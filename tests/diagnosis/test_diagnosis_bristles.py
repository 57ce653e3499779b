"""Laws that refine another one: when they are tried, from where, and what records of bristles are called."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from sysid_lab.plan import Task
from sysid_lab.records import Records, make_records

from harness.diagnosis.algorithm import diagnose
from harness.diagnosis.diagnosis import Diagnosis
from harness.diagnosis.effort import EFFORT
from harness.diagnosis.policy import POLICY
from harness.diagnosis.records.prepare import sizes_of
from harness.diagnosis.runs.compare import seen
from harness.diagnosis.runs.form import FreeRunForm
from harness.diagnosis.search.compare import judged
from harness.diagnosis.search.fit import Begun, Fit
from harness.diagnosis.search.generalised import generalise, generalised, starts_of
from harness.diagnosis.search.refusal import Kind, Refusal
from harness.diagnosis.search.scores import ScoreTest
from harness.diagnosis.search.table import FitTable, Round
from harness.diagnosis.search.ties import held, tie_set
from harness.diagnosis.stand_in import stand_in_reasons
from harness.effects import Dictionary, builtin, compose
from harness.effects.effect import Placed
from harness.physics import load_model
from harness.signals import Dataset, PlantSpec, Run, Trajectory

USED = 240_000
"""The base of records that were looked at while this was written."""


def law(name: str) -> Placed:
    return Placed(builtin()[name], "theta")


def a_fit(effects: Sequence[Placed], log_likelihood: float, values: Mapping[str, float] | None = None) -> Fit:
    """Return a fit of 100 samples in each use with this log-likelihood."""
    known = {placed.name(name): value for placed in effects for name, value in placed.effect.complete({}, {}).items()}
    return Fit(
        effects=tuple(effects),
        system=None,  # type: ignore[arg-type]
        values=known | dict(values or {}),
        free=(),
        count=sum(not parameter.fixed for placed in effects for parameter in placed.effect.parameters),
        terms={use: [np.full(100, log_likelihood / 100)] for use in ("estimation", "validation")},
        deviations={},
        logarithmic=frozenset(),
        converged=True,
        on_bound=(),
    )


class Told:
    """A form whose fits end where they are told to; only what generalising asks of a form."""

    laws = Dictionary.builtin()

    def __init__(self, ends: Mapping[str, float], pace: float = 0.0) -> None:
        self.ends = ends
        self.pace = pace
        self.begun: list[str] = []
        self.starts: dict[str, list[dict[str, float]]] = {}
        self.least: dict[str, float] = {}

    def begin(
        self, effects: Sequence[Placed], starts: Sequence[dict[str, float]], base: Fit, hope: float = -np.inf
    ) -> Begun:
        name = effects[-1].effect.name
        self.begun.append(name)
        self.starts[name] = list(starts)
        return Begun(tuple(effects), self.ends.get(name, -1e9), dict(starts[0]), None, self.pace)

    def fit(self, effects: Sequence[Placed], starts: Sequence[dict[str, float]], base: Fit, rival: Fit) -> Fit:
        return self.finish(self.begin(effects, starts, base), base, rival)

    def left_out(self) -> list[str]:
        return []

    def limited(self) -> bool:
        return False

    def change(self, fit: Fit, placed: Placed) -> float:
        return np.inf

    def distance(self, fit: Fit, other: Fit) -> float:
        return np.inf

    def damping(self, fit: Fit, at: str) -> None:
        return None

    def finish(self, begun: Begun, base: Fit, rival: Fit | None = None, least: float = -np.inf) -> Fit:
        self.least[begun.effects[-1].effect.name] = least
        return a_fit(begun.effects, begun.log_likelihood + 100.0 * self.pace)


def table_of(form: Any, root: Fit, untried: Sequence[Placed]) -> FitTable:
    return FitTable(form, root, untried)


def grown(ends: Mapping[str, float], **simple: float) -> tuple[Told, dict[Placed, Fit | None]]:
    """Return what grows beside an empty base of log-likelihood 0."""
    form = Told(ends)
    fits: dict[Placed, Fit | None] = {law(name): a_fit([law(name)], value) for name, value in simple.items()}
    untried = [law(name) for name in builtin() if builtin()[name].kinds == ("coordinate",)]
    generalise(table_of(form, a_fit([], 0.0), untried), a_fit([], 0.0), fits, untried)
    return form, fits


def bristles(form: Told) -> list[str]:
    """Return what was begun that has bristles, in order."""
    return [name for name in form.begun if builtin()[name].grows == "bristles"]


ENDS = {"lugre_coulomb_friction": 120.0, "lugre_asymmetric_friction": 121.0, "lugre_friction": 119.0}


def test_what_refines_the_likeliest_lawful_law_goes_first_and_its_rivals_follow_where_it_helps() -> None:
    form, fits = grown(ENDS, asymmetric_friction=52.0, coulomb_friction=60.0)
    assert bristles(form) == ["lugre_coulomb_friction", "lugre_asymmetric_friction"]
    assert {str(placed) for placed, fit in fits.items() if fit is not None} == {
        "coulomb_friction@theta", "asymmetric_friction@theta",
        "lugre_coulomb_friction@theta", "lugre_asymmetric_friction@theta",
    }  # fmt: skip


@pytest.mark.parametrize("alone", [61.0, 120.0])
def test_a_likelier_law_that_its_physics_forbids_is_refined_too(alone: float) -> None:
    """It may be forbidden for want of bristles."""
    form = Told({**ENDS, "lugre_coulomb_friction": alone})
    backwards = a_fit([law("stribeck_friction")], 70.0, {"stribeck_friction@theta.Fs": -0.1})
    fits: dict[Placed, Fit | None] = {
        law("stribeck_friction"): backwards,
        law("coulomb_friction"): a_fit([law("coulomb_friction")], 60.0),
    }
    untried = [law("lugre_friction"), law("lugre_coulomb_friction")]
    generalise(table_of(form, a_fit([], 0.0), untried), a_fit([], 0.0), fits, untried)
    again = ["lugre_friction"] if alone > ENDS["lugre_friction"] else []  # its special case ended above it
    assert form.begun == ["lugre_coulomb_friction", "lugre_friction", *again]
    assert fits[law("lugre_friction")] is not None
    assert (fits.get(law("lugre_coulomb_friction")) is not None) is (alone > 100.0)


@pytest.mark.parametrize("gains", [-1.0, 4.0])
def test_where_bristles_do_not_help_nothing_else_is_refined(gains: float) -> None:
    form, fits = grown(
        {**ENDS, "lugre_coulomb_friction": 60.0 + gains}, asymmetric_friction=52.0, coulomb_friction=60.0
    )
    assert bristles(form) == ["lugre_coulomb_friction"]
    assert len(fits) == 2


def test_what_gains_so_much_with_every_step_that_it_may_come_to_it_is_finished() -> None:
    """Flanks that never pull began 300 below the play that they refine, and ended 1100 above it."""
    for pace, begins in ((10.0, 45.0), (10.0, -20.0), (10.0, -95.0)):
        form = Told({"lugre_coulomb_friction": begins}, pace)
        fits: dict[Placed, Fit | None] = {law("coulomb_friction"): a_fit([law("coulomb_friction")], 60.0)}
        untried = [law("lugre_coulomb_friction")]
        generalise(table_of(form, a_fit([], 0.0), untried), a_fit([], 0.0), fits, untried)
        assert (law("lugre_coulomb_friction") in fits) is (begins + EFFORT.onward * EFFORT.first_steps * pace > 60.0)


def test_a_refinement_that_cannot_come_near_the_law_that_it_refines_is_left_before_its_last_digits() -> None:
    """At steps as fine as stiff bristles ask for they cost as much as all the rest: 22 of 42 s in one record."""
    form, _ = grown(ENDS, coulomb_friction=60.0)
    free, before = (
        sum(not parameter.fixed for parameter in builtin()[name].parameters)
        for name in ("lugre_coulomb_friction", "coulomb_friction")
    )
    price = 0.5 * (free - before) * np.log(100)
    assert form.least["lugre_coulomb_friction"] == pytest.approx(60.0 + price - POLICY.evidence)


def test_what_refines_an_earlier_law_takes_its_place_beside_what_came_later() -> None:
    untried = [law(name) for name in builtin() if builtin()[name].kinds == ("coordinate",)]
    for later, expected in (("linear_spring", ["lugre_coulomb_friction@theta"]), ("lugre_friction", [])):
        form = Told(ENDS)
        model = a_fit([law("coulomb_friction"), law(later)], 60.0, {"coulomb_friction@theta.Fc": 0.3})
        found = generalised(table_of(form, a_fit([], 0.0), untried), model, law("coulomb_friction"))
        assert [str(rich) for rich, _ in found] == expected, "a joint has its bristles once"
        for rich, fit in found:
            assert fit.effects == (law(later), rich), "not beside the law that it refines"
            assert {start[rich.name("Fc")] for start in form.starts["lugre_coulomb_friction"]} == {0.3}


def test_what_adds_another_thing_is_another_question() -> None:
    """That bristles do not help says nothing of slip elements, nor a friction of a joint that stiffens."""
    ends = {"parallel_hysteresis": 80.0, "hardening_elasticity": 90.0, "unilateral_backlash": 70.0}
    simple = {"coulomb_friction": 60.0, "hysteresis": 58.0, "elasticity": 50.0, "backlash": 52.0}
    form, fits = grown(ends, **simple)
    assert set(form.begun) == {"lugre_coulomb_friction", "degressive_friction", *ends}
    assert {placed.effect.name for placed, fit in fits.items() if fit is not None} == {*simple, *ends}


def test_a_joint_has_its_bristles_once() -> None:
    form = Told({"lugre_coulomb_friction": 500.0, "parallel_hysteresis": 500.0})
    base = a_fit([law("lugre_friction")], 0.0)
    fits: dict[Placed, Fit | None] = {
        law(name): a_fit([*base.effects, law(name)], 60.0) for name in ("coulomb_friction", "hysteresis")
    }
    untried = [law("lugre_coulomb_friction"), law("parallel_hysteresis")]
    generalise(table_of(form, a_fit([], 0.0), untried), base, fits, untried)
    assert form.begun == ["parallel_hysteresis"]


def test_a_law_far_below_the_best_answer_and_one_that_says_nothing_are_not_refined() -> None:
    assert grown(ENDS, coulomb_friction=60.0, linear_spring=500.0)[0].begun == []
    assert grown(ENDS, coulomb_friction=3.0)[0].begun == []


@pytest.mark.parametrize(("gains", "refined"), [(6.0, False), (8.0, True)])
def test_a_law_that_does_not_pay_for_its_parameters_is_not_refined(gains: float, refined: bool) -> None:
    """The five parameters of a play cost 11.5 at 100 samples: what lacks more than the evidence is no law."""
    form, _ = grown({"unilateral_backlash": 50.0}, backlash=gains)
    assert (form.begun == ["unilateral_backlash"]) is refined


@pytest.mark.parametrize(("play", "tried"), [(60.0, True), (3.0, False)])
def test_what_the_likeliest_law_is_a_limit_of_is_tried_though_what_it_refines_is_not_likely(
    play: float, tried: bool
) -> None:
    """A joint that is soft at first is a rounded play, and no elasticity."""
    form, fits = grown({"hardening_elasticity": 80.0, "unilateral_backlash": 50.0}, backlash=play, elasticity=2.0)
    assert ("hardening_elasticity" in form.begun) is tried
    assert any(placed.effect.name == "hardening_elasticity" for placed in fits) is tried


def test_flanks_that_only_push_start_from_softer_ones_with_more_damping_too() -> None:
    simple, rich = law("backlash"), law("unilateral_backlash")
    values = {"gap": 0.05, "k": 1800.0, "Jm": 0.1, "d": 18.0, "c": 0.01}
    fit = a_fit([simple], 60.0, {simple.name(name): value for name, value in values.items()})
    starts = starts_of(rich, simple, fit, {}, {})
    pairs = {(start[rich.name("k")], round(start[rich.name("d")], 9)) for start in starts}
    assert pairs == {(1800.0, 18.0), (1080.0, 18.0), (1800.0, 23.4), (1080.0, 23.4)}
    assert {start[rich.name("gap")] for start in starts} == {0.05}


def test_it_starts_from_the_law_it_refines_and_from_what_others_know() -> None:
    simple, rich = law("coulomb_friction"), law("lugre_coulomb_friction")
    fit = a_fit([simple], 60.0, {"coulomb_friction@theta.Fc": 0.7, "J": 2.0})
    starts = starts_of(rich, simple, fit, {"xs": (0.02,)}, {"q": 1.0, "dt": 0.01})
    assert {start["lugre_coulomb_friction@theta.Fc"] for start in starts} == {0.7}
    assert {start["J"] for start in starts} == {2.0}
    lengths = [start["lugre_coulomb_friction@theta.xs"] for start in starts]
    assert lengths == pytest.approx([0.02, 0.003, 0.0009, 0.009])
    (short,) = (parameter for parameter in rich.effect.parameters if parameter.name == "xs")
    assert short.lowest({"a": 10.0, "dt": 0.01}, np.inf) == pytest.approx(0.5 * 10.0 * 0.01**2), "the way in a sample"
    form, _ = grown(ENDS, coulomb_friction=60.0, hysteresis=58.0)
    known = builtin()["hysteresis"].parameter("xs").start({})
    assert form.starts["lugre_coulomb_friction"][0]["lugre_coulomb_friction@theta.xs"] == known


class Typical(Told):
    """A form that says how likely a law is with the exponent at its usual value."""

    def __init__(self, usual: float) -> None:
        super().__init__({})
        self.usual = usual
        self.asked: list[tuple[Placed, dict[str, float]]] = []

    def fit(self, effects: Sequence[Placed], starts: Sequence[dict[str, float]], *more: Fit | None) -> Fit:
        self.asked.append((effects[-1], dict(starts[0])))
        return a_fit(effects, self.usual)


@pytest.mark.parametrize(("usual", "tie"), [(99.0, True), (90.0, False)])
def test_a_law_that_is_as_likely_on_a_bound_only_is_compared_where_it_is_typical(usual: float, tie: bool) -> None:
    """On its bound a friction with an exponent is dry friction itself, and tells nothing of the law."""
    base = a_fit([], 0.0)
    form: Any = Typical(usual)
    best = judged(form, [law("coulomb_friction")], a_fit([law("coulomb_friction")], 100.0), base, base)
    power = a_fit([law("sublinear_friction")], 100.0, {"sublinear_friction@theta.a": 0.05})
    rival = judged(
        form, [law("sublinear_friction")],
        replace(power, free=tuple(power.values), on_bound=("sublinear_friction@theta.a",)), base, base,
    )  # fmt: skip
    assert Refusal(Kind.BOUND, "a", (0.05,)) in rival.refusals
    table, past = table_of(form, base, []), Round(base, ScoreTest([], []), (best, rival))
    (typical,) = held(table, best, past)
    ((asked, start),) = form.asked
    assert asked.effect.parameter("a").fixed
    assert start["sublinear_friction@theta.a"] == 0.5
    assert typical.fit is not None
    assert typical.fit.count == power.count - 1
    names = {str(placed) for (placed,) in tie_set(form, best, [best, rival, typical])}
    assert names == ({"coulomb_friction@theta", "sublinear_friction@theta"} if tie else {"coulomb_friction@theta"})
    away = replace(rival, refusals=(*rival.refusals, Refusal(Kind.SIGN, "Fr", (-1.0,))))
    assert held(table, best, replace(past, candidates=(away,))) == []


@pytest.mark.parametrize(("free", "asked"), [(99.0, True), (99.9, False), (90.0, False)])
def test_a_law_that_loses_by_the_price_of_its_exponent_is_compared_where_it_is_typical(
    free: float, asked: bool
) -> None:
    """Coulomb friction with a wide rounding was named without a rival where the truth was sub-linear, 3 of 133."""
    base = a_fit([], 0.0)
    form: Any = Typical(99.0)
    best = judged(form, [law("coulomb_friction")], a_fit([law("coulomb_friction")], 100.0), base, base)
    power = a_fit([law("sublinear_friction")], free, {"sublinear_friction@theta.a": 0.3})
    rival = judged(form, [law("sublinear_friction")], power, base, base)
    assert rival.passed
    held_there = held(table_of(form, base, []), best, Round(base, ScoreTest([], []), (best, rival)))
    assert [placed.effect.parameter("a").fixed for row in held_there for placed in row.added] == [True] * asked
    names = {str(placed) for (placed,) in tie_set(form, best, [best, rival, *held_there])}
    assert ("sublinear_friction@theta" in names) is (free > 90.0)


def test_a_sum_of_two_dry_laws_is_neither_though_one_is_of_bristles() -> None:
    (reason,) = stand_in_reasons([law("lugre_coulomb_friction"), law("hysteresis")], None)
    assert "imitate it" in reason
    for names in (("hysteresis", "lugre_load_dependent_friction"), ("parallel_hysteresis", "coulomb_friction")):
        assert stand_in_reasons([law(name) for name in names], None) != (), "a joint has one presliding"
    assert stand_in_reasons([law("lugre_friction"), law("quadratic_drag")], None) == ()
    assert stand_in_reasons([law("hardening_elasticity"), law("coulomb_friction")], None) == ()


def closed(key: str, *names: str, shape: str = "gauss-markov") -> tuple[Records, Diagnosis]:
    """Return a record of the study and its diagnosis with some effects of the dictionary."""
    study, plant, engine, effect, level, noise, disturbance, index = key.split("|")
    task = Task(study, plant, engine, (effect,), level, noise, float(disturbance), int(index), USED, shape=shape)
    records = make_records(task)
    dictionary = [builtin()[name] for name in names] or None
    return records, diagnose(records.dataset, load_model(plant), dictionary=dictionary)


@pytest.mark.slow
def test_stribeck_friction_of_bristles_is_named_with_its_parameters() -> None:
    """A truth in C. Without laws of bristles it was Coulomb friction and drag, which stood in for it."""
    records, found = closed(
        "confusion|pendulum|hardware|stribeck_friction@theta|quarter|high|0|0",
        "coulomb_friction", "stribeck_friction", "quadratic_drag", "lugre_friction", "lugre_coulomb_friction",
    )  # fmt: skip
    assert [str(effect.placed) for effect in found.outcome.accepted] == ["lugre_friction@theta"]
    assert (found.grade, found.stand_in) == ("explained", ())
    (truth,) = (hidden.named for hidden in records.hidden)
    for name in ("Fs", "Fc", "vs", "xs"):
        low, high = found.final.interval(f"lugre_friction@theta.{name}")
        assert low < truth[name] < high
        assert high < 2.0 * low
    after = np.concatenate(found.runs.after.validation)
    assert np.sqrt(np.mean(after**2)) < 1.02  # the sensor noise


@pytest.mark.slow
def test_friction_of_another_engine_without_bristles_is_not_refined() -> None:
    """Bullet's joint friction is an impulse."""
    _, found = closed(
        "confusion|pendulum|bullet|coulomb_friction@theta|nominal|high|0|0",
        "coulomb_friction",
        "lugre_coulomb_friction",
    )
    assert [str(effect.placed) for effect in found.outcome.accepted] == ["coulomb_friction@theta"]


@pytest.mark.slow
def test_a_width_that_the_samples_do_not_show_is_no_parameter() -> None:
    """Faint friction under an unknown torque: a width that the samples do not show was asked 4 in log-likelihood."""
    _, found = closed("confusion|pendulum|laws|load_dependent_friction@theta|quarter|high|0.02|0", shape="wheel")
    (row,) = (row for row in found.outcome.rounds[0].candidates if row.name == "load_dependent_friction@theta")
    assert row.fit is not None
    assert row.fit.deviations["load_dependent_friction@theta.w"] > 1.0, "of its logarithm"
    assert row.fit.count == found.outcome.nominal.count + 1
    assert [str(effect.placed) for effect in found.outcome.accepted] == ["load_dependent_friction@theta"]


def test_a_run_from_a_measured_state_starts_with_bristles_as_the_motion_bent_them() -> None:
    """At rest in mid-motion they carried nothing at first: a true model erred more, one step ahead, than none."""
    nominal, dt = load_model("drive"), 1e-3
    friction = Placed(builtin()["lugre_coulomb_friction"], "q")
    plant = compose(nominal, [friction])
    known = {"M": 95.0, "Fv": 200.0, "offset": -3.0}
    named = {friction.name(name): value for name, value in {"Fc": 20.0, "xs": 2e-5, "tau": 1e-3, "T": 2e-4}.items()}
    t = np.arange(2000) * dt
    u = 60.0 * np.sin(2 * np.pi * 0.5 * t)[:, None] + 25.0 * np.sin(2 * np.pi * 1.3 * t)[:, None]
    p = plant.vector({**known, **named})
    x = plant.simulator(dt, substeps=16).states(p, np.zeros(3), u)
    y = x[:, :1] + 2e-8 * np.random.default_rng(0).standard_normal((len(t), 1))
    record = Trajectory(t, u, y, PlantSpec(nominal.inputs, nominal.outputs, dt))
    data = Dataset("drive", (Run(record, "estimation"), Run(record, "validation")))
    form = FreeRunForm(nominal, data, sizes=sizes_of(nominal, known, data), horizon=0.5, weights=np.array([2e-8]))
    fitted = seen(form, SimpleNamespace(effects=(friction,), values={**known, **named}, own={}, day={}, converged=True))  # type: ignore[arg-type]
    assert fitted is not None
    errors, states, _ = form.simulated(fitted, "validation", 2 * dt, start="data")
    assert np.sqrt(np.mean(errors[0][101::2] ** 2)) < 5e-8, "two noises of the sensor and a smoothed speed"
    assert np.abs(states[0][100::2, 2] - x[100::2, 2]).max() < 0.1 * np.abs(x[:, 2]).max()
    far, _, _ = form.simulated(fitted, "validation", 0.5, start="data")
    assert np.sqrt(np.mean(far[0] ** 2)) < 5e-6, "of 0.1 m; 2.5e-5 with bristles at rest"
