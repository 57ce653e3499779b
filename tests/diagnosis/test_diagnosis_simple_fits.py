"""Plain output error beside the likelihood: the nominal fit ends at its maximum, no answer loses to a simple fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.diagnosis import diagnose
from harness.diagnosis.contested import simple_fits_of, uncontested
from harness.diagnosis.dictionary import laws_of
from harness.diagnosis.forms.remembered import Remembered
from harness.diagnosis.kinds import EquationsKind
from harness.diagnosis.policy import POLICY
from harness.diagnosis.runs.simple_fits import SimpleFit, SimpleFits
from harness.diagnosis.search.compare import impossible
from harness.diagnosis.search.fit import Fit
from harness.diagnosis.search.outcome import Outcome
from harness.diagnosis.search.refusal import Kind, Refusal
from harness.diagnosis.search.scores import score_test
from harness.diagnosis.search.table import Accepted, Round
from harness.diagnosis.steps import beaten, candidates_of, form_of, lawful, nominal_fit, sizes_off
from harness.effects import builtin
from harness.effects.effect import Placed
from harness.physics import Ode, load_model
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory


def silent(what: str, part: float | None = None) -> None:
    """Tell nobody."""


def battery() -> Ode:
    """Series resistance, one RC pair, open-circuit voltage linear in the charge; time constant declared tenfold."""
    o = Ode(
        "cell", x="soc v1", u="i", p="R0 R1 C1 E0 E1 Q", units={"i": "A", "soc": "1", "v1": "V"},
        parameters={"R0": ("ohm", 0.05), "R1": ("ohm", 0.02), "C1": ("F", 1000.0), "E0": ("V", 3.6), "E1": ("V", 0.5),
                    "Q": ("A s", 1e4)},
    )  # fmt: skip
    (soc, v1), (i,), (R0, R1, C1, E0, E1, Q) = o.x, o.u, o.p
    o.rhs = [-i / Q, -v1 / (R1 * C1) + i / C1]
    o.outputs = {"v": (E0 + E1 * soc - v1 - R0 * i, "V")}
    return o


def discharged(seed: int, resistance: float, tau: float) -> Dataset:
    """Return pulses of that cell, by its exact recursion."""
    rng, h, n = np.random.default_rng(seed), 0.01, 450
    spec = PlantSpec((Channel("i", "A"),), (Channel("v", "V"),), h)
    soc, v1, runs = 0.5, 0.0, []
    for use in ("estimation", "validation"):
        i = np.where(np.arange(n) < 150, 4.2, 0.0)
        v = np.empty((n, 1))
        for k in range(n):
            v[k] = 3.6 + 0.5 * soc - v1 - 0.02 * i[k] + 3e-5 * rng.standard_normal()
            soc, v1 = soc - h * i[k] / 1e4, np.exp(-h / tau) * v1 + resistance * (1 - np.exp(-h / tau)) * i[k]
        runs.append(Run(Trajectory(np.arange(n) * h, i[:, None], v, spec), use))  # type: ignore[arg-type]
    return Dataset("cell", tuple(runs))


@pytest.mark.parametrize(("resistance", "tau"), [(0.0024, 2.0), (0.006, 1.0)])
def test_a_cell_of_the_models_own_structure_lacks_nothing(resistance: float, tau: float) -> None:
    """From its declared time constant of 20 s the fit went to R1 = 1e5 ohm, and the model did not fit."""
    found = diagnose(discharged(1, resistance, tau), battery().system())
    assert (found.verdict, found.grade) == ("nothing_missing", "explained")
    assert found.final.values["R0"] == pytest.approx(0.02, rel=0.02)
    for name, truth in (("R1", resistance), ("C1", tau / resistance)):
        assert found.final.values[name] == pytest.approx(truth, rel=0.12)


@pytest.fixture(scope="module")
def judged_by_hand(foreign_pendulum: Callable[..., Dataset]) -> Any:
    """Return the pieces of a diagnosis of a pendulum whose dry friction is most of what moves it."""
    system = load_model("pendulum")
    dataset = foreign_pendulum(3, lambda q, v, u, t: -0.25 * np.tanh(v / 0.01), n=700, amplitude=0.7)
    names = ("coulomb_friction", "quadratic_drag", "linear_spring", "force_bias")
    laws = laws_of([builtin()[name] for name in names])
    form, _ = form_of(EquationsKind(), system, dataset, POLICY, laws.dictionary)
    remembered = Remembered(form, None)
    nominal = nominal_fit(remembered, form, [])
    candidates, _ = candidates_of(form, laws)
    simple = simple_fits_of(EquationsKind(), form, nominal, candidates, silent)
    assert simple is not None
    return SimpleNamespace(form=form, remembered=remembered, nominal=nominal, candidates=candidates, simple=simple)


def test_the_nominal_model_at_its_nearest_is_no_further_than_the_likelihood_has_it(judged_by_hand: Any) -> None:
    simple: SimpleFits = judged_by_hand.simple
    beside = simple.seen(judged_by_hand.nominal)
    assert simple.nominal is not None
    assert beside is not None
    assert simple.nominal.error("estimation") <= np.mean(beside.estimation[0] ** 2) * (1 + 1e-9)


def test_free_runs_know_the_missing_law_and_propose_it(judged_by_hand: Any) -> None:
    simple: SimpleFits = judged_by_hand.simple
    assert str(simple.table[0].effects[0]) == "coulomb_friction@theta"
    assert simple.table[0].values["coulomb_friction@theta.Fc"] == pytest.approx(0.25, rel=0.05)
    proposed = [str(suspect.placed) for suspect in simple.proposals(POLICY)]
    assert proposed[0] == "coulomb_friction@theta"


def test_an_answer_gives_way_to_the_simple_fit_that_runs_nearer(judged_by_hand: Any) -> None:
    """What the search refused, for its promise say, stands in the end if free runs and the likelihood both want it."""
    made = judged_by_hand
    test = score_test(made.form, made.nominal, made.candidates, POLICY)
    nothing = Outcome(made.remembered, made.nominal, made.nominal, rounds=(Round(made.nominal, test, ()),))
    spring = [placed for placed in made.candidates if placed.effect.name == "linear_spring"]
    outcome, rival = uncontested(made.remembered, nothing, made.simple, spring, POLICY, silent, made.form.sizes)
    assert rival == ""
    assert [str(one.placed) for one in outcome.accepted][:1] == ["coulomb_friction@theta"]
    again, rival = uncontested(made.remembered, outcome, made.simple, spring, POLICY, silent, made.form.sizes)
    assert rival == ""
    assert again.accepted == outcome.accepted, "the right law loses to nothing"


def test_a_rival_that_the_likelihood_refuses_is_said(judged_by_hand: Any) -> None:
    made = judged_by_hand
    nothing = Outcome(made.remembered, made.nominal, made.nominal)
    strict = replace(POLICY, evidence=1e6)
    outcome, rival = uncontested(made.remembered, nothing, made.simple, [], strict, silent, made.form.sizes)
    assert rival == "coulomb_friction@theta"
    assert outcome is nothing
    assert [words for words in beaten(rival) if rival in words]
    assert beaten("") == []


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.floats(0.01, 10.0), min_size=3, max_size=3),
    st.floats(1e-3, 1e3),
)
def test_what_is_further_is_so_whatever_the_unit_and_never_both_ways(sizes: list[float], unit: float) -> None:
    def run(size: float) -> Any:
        parts = {"validation": (np.full((50, 1), size),), "estimation": (np.ones((5, 1)),)}
        return SimpleNamespace(finite=True, effects=(), **parts)

    def table(scale: float) -> tuple[SimpleFits, list[Any]]:
        fits = SimpleFits(cast(Any, None), {})
        nominal, first, second = (run(scale * size) for size in sizes)
        fits.__dict__["nominal"] = SimpleFit((), {}, nominal)
        return fits, [first, second]

    fits, (first, second) = table(1.0)
    others, (a, b) = table(unit)
    assert fits.further(first, second, POLICY) == others.further(a, b, POLICY)
    assert not (fits.further(first, second, POLICY) and fits.further(second, first, POLICY))
    assert fits.further(None, first, POLICY)
    assert not fits.further(first, None, POLICY)


@pytest.mark.parametrize(("effects", "lost"), [(0, False), (1, False), (2, True)])
def test_more_effects_than_a_simple_fit_has_must_not_run_further_than_it(effects: int, lost: bool) -> None:
    """A play beside bristles left twice what dry friction alone left of a drive's swings, 3.5 % of all there was."""

    def run(square: float, number: int) -> Any:
        return SimpleNamespace(finite=True, effects=range(number), validation=(np.full((9, 1), np.sqrt(square)),))

    fits = SimpleFits(cast(Any, None), {})
    fits.__dict__["nominal"] = SimpleFit((), {}, run(1.0, 0))
    assert fits.further(run(0.087, effects), run(0.052, 1), POLICY) == lost


def swinging(seed: int, friction: float) -> Dataset:
    """Return the halves of a free swing of a mass on a spring, pushed a little by what nobody measured."""
    rng, h, k, amplitude = np.random.default_rng(seed), 0.0005, 370.0, 0.015
    x, v, push, y = amplitude, 0.0, 0.0, []
    for step in range(290 * 50):
        if step % 50 == 0:
            y.append(x + 4e-5 * rng.standard_normal())
        push += -h * push / 0.05 + 0.011 * k * amplitude * np.sqrt(2 * h / 0.05) * rng.standard_normal()
        pull = push - k * x - 0.3 * v
        after = v + h * (pull - friction * np.sign(v if v else pull))
        v = 0.0 if (v == 0.0 and abs(pull) < friction) or after * v < 0.0 else after
        x += h * v
    spec, parts = PlantSpec((), (Channel("x", "m"),), 0.025), (np.array(y[:140]), np.array(y[140:]))
    records = [Trajectory(np.arange(len(y)) * 0.025, np.zeros((len(y), 0)), y[:, None], spec) for y in parts]
    return Dataset("swing", (Run(records[0]), Run(records[1], "validation")))


HANGING = """
state  x [m], v [m/s]
motion x: v, m
m = 1 kg fixed
b = 0.4 N s/m >= 0
k = 300 N/m >= 0
x' = v
v' = (-k*x - b*v)/m
output x
"""


@pytest.mark.parametrize("friction", [0.05, 0.0])
def test_a_small_force_that_hides_a_friction_of_a_swing_that_dies_is_held_against_free_runs(
    friction: float, tmp_path: Path
) -> None:
    """Nothing was missing beside 3 % of the force, though a free run with dry friction left a tenth of the error."""
    laws = [builtin()[name] for name in ("coulomb_friction", "quadratic_drag", "linear_spring")]
    (tmp_path / "hanging.eqs").write_text(HANGING)
    found = diagnose(swinging(3, friction), load_model(str(tmp_path / "hanging.eqs")), dictionary=laws)
    names = [str(one.placed) for one in found.outcome.accepted]
    assert (found.verdict, names) == (
        ("effects_found", ["coulomb_friction@x"]) if friction else ("nothing_missing", [])
    )


def test_an_effect_that_ends_where_its_law_does_goes_and_what_stood_on_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """A play at the largest gap that the data may show, and soft as nothing, stood in for a lag, bristles beside it."""
    play, bristles, spring = (Placed(builtin()[n], "theta") for n in ("backlash", "lugre_friction", "linear_spring"))

    def fit(effects: tuple[Placed, ...]) -> Any:
        return SimpleNamespace(effects=effects, values={})

    def broken(form: Any, placed: Placed, fit: Any) -> list[Refusal]:
        kind = {play: Kind.BOUND, spring: Kind.UNDETERMINED}.get(placed)
        return [Refusal(kind, "gap", (0.8,))] if kind else []

    def judged(form: Any, added: Any, fit: Any, *rest: Any) -> Any:
        return SimpleNamespace(passed=added != [bristles], refusals=(Refusal(Kind.EVIDENCE),))

    monkeypatch.setattr("harness.diagnosis.steps.impossible", broken)
    monkeypatch.setattr("harness.diagnosis.steps.judged", judged)
    remembered: Any = SimpleNamespace(form=None, fit=lambda effects, starts, near: fit(tuple(effects)))
    for effects, left in (((play, bristles, spring), (spring,)), ((bristles, spring), (bristles, spring)), ((), ())):
        accepted = tuple(Accepted(one, ((one,),), 9.0, 9.0) for one in effects)
        outcome = lawful(remembered, Outcome(remembered, fit(()), fit(effects), accepted), POLICY)
        assert tuple(one.placed for one in outcome.accepted) == outcome.model.effects == left


@pytest.mark.parametrize(
    ("name", "main", "logarithmic", "deviation", "named"),
    [
        ("cogging", "A", False, 0.6, False),  # a wave far longer than the travel: three values tell a straight line
        ("cogging", "A", False, 0.1, True),
        ("rate_limit", "R", True, 1.2, False),  # a rate that nothing reaches: a lag
        ("rate_limit", "R", True, 0.1, True),
        ("linear_spring", "k", False, float("inf"), False),
    ],
)
def test_a_main_parameter_that_is_not_determined_names_nothing(
    name: str, main: str, logarithmic: bool, deviation: float, named: bool
) -> None:
    placed = Placed(builtin()[name], "theta")
    values = {placed.name(p.name): p.start({}) for p in placed.effect.parameters} | {placed.name(main): 0.5}
    deviations = dict.fromkeys(values, 0.01) | {placed.name(main): deviation}
    free, logs = tuple(values), frozenset({placed.name(main)} if logarithmic else ())
    fit = Fit((placed,), cast(Any, None), values, free, 3, {}, deviations, logs, True, ())
    form: Any = SimpleNamespace(damping=lambda fit, at: None)
    assert (Kind.UNDETERMINED in {refusal.kind for refusal in impossible(form, placed, fit)}) == (not named)


@pytest.mark.parametrize(("inertia", "deviation", "told"), [(1e5, 0.01, True), (0.3, 0.01, False), (1e5, 8.0, False)])
def test_a_parameter_far_from_its_declared_value_is_told_where_the_data_determine_it(
    inertia: float, deviation: float, told: bool
) -> None:
    """A time column in ms read as s: everything fits, and J is a million times what was declared."""
    system = load_model("pendulum")
    names = tuple(parameter.name for parameter in system.parameters)
    values, logs = {**system.values(), "J": inertia}, frozenset(names)
    fit = Fit((), system, values, names, 3, {}, dict.fromkeys(names, deviation), logs, True, ())
    assert ["J = " in text for text in sizes_off(system, fit)] == ([True] if told else [])


def test_errors_of_free_runs_are_told_in_units_of_the_outputs_and_not_of_runs_that_diverge(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    nominal = SimpleNamespace(parameter_names=("a",))
    fits: Any = SimpleNamespace(_form=SimpleNamespace(nominal=nominal, weights=np.array([2.0, 10.0])))
    parts = np.array([[3.0, 1.0], [4.0, -1.0]]), np.array([[0.0, 1.0], [0.0, 1.0]])
    for shown in (None, SimpleNamespace(finite=False), SimpleNamespace(finite=True, estimation=parts)):
        monkeypatch.setattr("harness.diagnosis.runs.simple_fits.seen_values", lambda *_, shown=shown: shown)
        found = SimpleFits.errors(fits, {"a": 1.0, "of an effect": 2.0})
        if shown is None or not shown.finite:
            assert found is None
        else:
            assert found == pytest.approx([2.5 * 2.0, 10.0])
