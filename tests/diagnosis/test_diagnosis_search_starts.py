"""Where fits of the search start, what is fitted again, what is given, and what is taken back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from linear_form import (
    ALL,
    USES,
    LinearForm,
    accepted,
    answer_of,
    found_in,
    linear_records,
    main,
    mixed,
    placed,
    table_of,
)
from made_fits import NoForm, a_fit

from harness.diagnosis.effort import EFFORT
from harness.diagnosis.policy import POLICY
from harness.diagnosis.search.compare import FitComparison, Judged
from harness.diagnosis.search.fit import Begun, Column, Fit, Linearised
from harness.diagnosis.search.generalised import generalise, starts_of
from harness.diagnosis.search.leftover import left_over
from harness.diagnosis.search.moves import best_of, pair, preferred
from harness.diagnosis.search.outcome import Outcome
from harness.diagnosis.search.race import _best, _Race, _remembered
from harness.diagnosis.search.refusal import Kind, Refusal
from harness.diagnosis.search.scores import ScoreTest, score_test
from harness.diagnosis.search.search import search
from harness.diagnosis.search.table import Accepted, Answer, Round, value
from harness.diagnosis.search.ties import _typical, _usual, alike, refines, tie_set
from harness.diagnosis.search.warm import as_good, polished, share_ends
from harness.effects import builtin
from harness.effects.effect import Placed
from harness.effects.parameter import par
from harness.errors import FitError
from harness.physics import Parameter

# ---- from where ------------------------------------------------------------------------------------------------------


def started(law: Placed, given: Mapping[str, float], names: Sequence[str], hidden: Sequence[float], **kind: Any) -> Any:
    """Return the start of a law whose columns the records hold with these coefficients."""

    class Form(LinearForm):
        def columns(self, fit: Fit, candidates: Sequence[Placed]) -> list[Column]:
            x = [-np.column_stack([self.records.x[use][name] for name in list(columns)]) for use in USES]
            return [Column(law, dict(given), tuple(names), *x, **kind)]

    columns = dict(zip(("linear_spring", "cubic_spring"), hidden, strict=False))
    form = Form(linear_records(3, columns, n=4000))
    (lead,) = score_test(form, form.fit((), [], None), [law]).leads
    assert lead.gain - lead.penalised == pytest.approx(
        0.5 * np.log(4000) * sum(not one.fixed for one in law.effect.parameters)
    )
    return lead.starts[0]


def test_a_wave_starts_with_the_amplitude_and_phase_of_its_two_columns() -> None:
    law = Placed(builtin()["periodic_disturbance"], "theta")
    start = started(law, {"omega": 3.0}, ("in phase", "quarter turn"), (-0.8, 0.6), kind="wave")
    assert start[law.name("omega")] == 3.0
    assert start[law.name("A")] == pytest.approx(1.0, abs=0.05)
    assert start[law.name("phi")] % (2 * np.pi) == pytest.approx(np.arctan2(0.6, -0.8), abs=0.05)


@pytest.mark.parametrize(("share", "times"), [(0.5, 0.5), (10.0, 3.0), (-1.0, 0.1)])
def test_a_whole_effect_that_counts_some_times_starts_as_many_times_as_large(share: float, times: float) -> None:
    """A lag of no time is none; beyond a factor of three the first order says nothing more."""
    lag = Placed(builtin()["actuator_lag"], "u")
    start = started(lag, {"tau": 0.02}, ("effect",), (share,))
    assert start[lag.name("tau")] == pytest.approx(times * 0.02, rel=0.1 if times == share else 1e-9)


def test_an_effect_that_is_there_or_not_starts_as_it_is_and_one_without_a_column_promises_nothing() -> None:
    """Rectification has no parameter; of a lag whose column says no value, none starts."""
    for law in (Placed(builtin()["sensor_rectification"], "theta"), Placed(builtin()["actuator_lag"], "u")):
        start = started(law, {}, ("effect",), (0.5,))
        assert not any(name.startswith(str(law)) for name in start)

    class Idle(LinearForm):
        def columns(self, fit: Fit, candidates: Sequence[Placed]) -> list[Column]:
            return [replace(one, estimation=0.0 * one.estimation) for one in super().columns(fit, candidates)]

    form = Idle(linear_records(3, {"cubic_spring": 0.4}))
    test = score_test(form, form.fit((), [], None), ALL)
    assert not test.leads
    assert {(lead.gain, lead.share) for lead in test.hidden} == {(0.0, 0.0)}


def test_a_law_starts_from_the_one_that_it_refines_and_from_what_its_place_knows() -> None:
    simple, rich = placed("linear_spring"), placed("cubic_spring")
    (k,) = simple.effect.parameters
    (k3,) = rich.effect.parameters
    effect = replace(
        rich.effect, parameters=(replace(k, refined=(1.0, 2.0)), replace(k3, scale="0.5", grid=(1.0, 4.0)))
    )
    fit = a_fit(values={"a": 1.0, simple.name(k.name): 3.0})
    starts = starts_of(Placed(effect, "theta"), simple, fit, {k3.name: (7.0,)}, {})
    rich = Placed(effect, "theta")
    found = [(start[rich.name(k.name)], start[rich.name(k3.name)]) for start in starts]
    assert found == [(size, new) for size in (3.0, 6.0) for new in (7.0, 0.5, 2.0)]
    assert all(start["a"] == 1.0 for start in starts)


def test_what_was_shown_by_a_fit_is_hidden_no_more() -> None:
    form = LinearForm(linear_records(4, {}, absorbed={"cubic_spring": 0.001, "quadratic_drag": 0.001}))
    test = score_test(form, form.fit((), [], None), ALL)
    names = [[str(lead.placed) for lead in leads] for leads in (test.leads, test.hidden)]
    shown = test.with_shown({"quadratic_drag@theta"})
    assert [str(lead.placed) for lead in shown.leads] == [*names[0], "quadratic_drag@theta"]
    assert [str(lead.placed) for lead in shown.hidden] == ["cubic_spring@theta"]


@pytest.mark.parametrize("forgets", [False, True])
def test_what_a_force_that_remembers_has_taken_up_is_asked_beside_one_that_forgets(forgets: bool) -> None:
    form: Any = LinearForm(linear_records(2, {"cubic_spring": 0.4, "quadratic_drag": 0.3}))
    base = form.fit((), [], None)
    quick = replace(base, values={**base.values, "a": base.values["a"] + 0.01})
    form.without_memory = lambda fit: quick if forgets else None
    seen = score_test(form, quick, ALL)
    (drag,) = [lead for lead in seen.leads if lead.placed == placed("quadratic_drag")]
    table, nothing = table_of(form, base), ScoreTest([], [])
    names = [str(lead.placed) for lead in _remembered(table, base, nothing, ALL)]
    assert names == (["cubic_spring@theta", "quadratic_drag@theta"] if forgets else [])
    known = ScoreTest([drag], []), ScoreTest([], [drag]), ScoreTest([replace(drag, gain=POLICY.lead - 0.1)], [])
    told = [[str(lead.placed) for lead in _remembered(table, base, test, ALL)] for test in known]
    assert told == ([names[:1], names[:1], names] if forgets else [[], [], []]), "what promises enough is begun anyway"


def test_a_refit_hopes_for_a_share_of_the_best_one_and_ends_where_it_cannot_pay() -> None:
    hopes: dict[str, float] = {}
    least: dict[str, float] = {}

    class Form(LinearForm):
        def begin(self, effects: Any, starts: Any, base: Fit | None, hope: float = -np.inf) -> Begun:
            hopes.setdefault("+".join(map(str, effects)), hope)
            return super().begin(effects, starts, base, hope)

        def finish(self, begun: Begun, base: Fit | None, rival: Fit | None = None, worth: float = -np.inf) -> Fit:
            least.setdefault("+".join(map(str, begun.effects)), worth)
            return super().finish(begun, base, rival, worth)

    form = Form(linear_records(3, {"cubic_spring": 0.4, "quadratic_drag": 0.3}))
    nominal = form.fit((), [], None)
    outcome = search(form, nominal, ALL)
    before = nominal.log_likelihood("estimation")
    gain = form.fit([placed("cubic_spring")], [], nominal).log_likelihood("estimation") - before
    assert hopes["cubic_spring@theta"] == pytest.approx(before + POLICY.lead), "nothing was begun before it"
    assert hopes["quadratic_drag@theta"] == pytest.approx(before + POLICY.reach * gain)
    assert least["cubic_spring@theta"] == pytest.approx(before + 0.5 * np.log(1000) - POLICY.evidence)
    second = outcome.rounds[1].base.log_likelihood("estimation")
    assert least["cubic_spring@theta+quadratic_drag@theta"] == pytest.approx(
        second + 0.5 * np.log(1000) - POLICY.evidence
    )


def test_what_is_exactly_the_same_as_the_likeliest_is_finished_however_it_began() -> None:
    """A bias of the sensor of an angle is a tilt of gravity: neither may lose by its first steps."""
    form = LinearForm(linear_records(3, {}))
    nominal = form.fit((), [], None)
    tilt, offset, spring = placed("gravity_tilt"), placed("sensor_offset"), placed("linear_spring")
    race = _Race(nominal, 0.0, POLICY, form.laws)
    for law, gain in ((offset, 0.5), (spring, 20.0), (tilt, 50.0)):
        race.begun[law] = Begun((law,), nominal.log_likelihood("estimation") + gain, {}, None)
    assert race.next([]) == [tilt, spring, offset]
    assert race.next([tilt]) == [spring], "the likeliest of those that are left has no twin"
    assert race.next([offset]) == [tilt, spring], "once"
    race.begun[offset] = Begun((offset,), nominal.log_likelihood("estimation") + 40.0, {}, None)
    assert race.next([]) == [tilt, offset, spring], "in its own place"
    race.begun[offset] = None
    assert race.next([]) == [tilt, spring], "it cannot be simulated"
    race.begun[tilt] = Begun((tilt,), nominal.log_likelihood("estimation") + 100.0, {}, None)
    assert race.next([]) == [tilt], "the other lost by its first steps"


@pytest.mark.parametrize(
    ("contains", "estimation", "validation", "good"),
    [
        (False, 0.6, 0.3, True),
        (False, 0.6, 0.5, False),
        (True, 0.9, 0.0, True),
        (True, 1.1, 0.0, False),
        (True, 0.0, EFFORT.close - 0.1, True),
        (True, 0.0, EFFORT.close + 0.1, False),
    ],
)
def test_an_end_is_as_good_as_another_within_one_of_the_likelihood(
    contains: bool, estimation: float, validation: float, good: bool
) -> None:
    """A law that contains the other may lose more of it, of the validation records alone."""
    other = a_fit((np.full(400, estimation / 400), np.full(400, validation / 400)))
    assert as_good(a_fit(), other, contains=contains) is good


@pytest.mark.parametrize(("behind", "upward", "again"), [(5.0, False, True), (0.5, False, False), (5.0, True, False)])
def test_a_law_that_ended_badly_is_fitted_again_from_the_end_of_what_it_is_a_case_of(
    behind: float, upward: bool, again: bool
) -> None:
    form = LinearForm(linear_records(3, {"linear_spring": 0.4}, alike={"cubic_spring": "linear_spring"}))
    base, simple = form.fit((), [], None), placed("linear_spring")
    rich = Placed(replace(placed("cubic_spring").effect, nests=("linear_spring",)), "theta")
    good = form.fit([rich], [], base)
    whole = form.fit([simple], [], base)
    off = (behind + value(whole) - value(good)) / 2000
    stuck = replace(whole, terms={use: [each - off for each in whole.terms[use]] for use in USES})
    fits: dict[Placed, Fit | None] = {rich: good, simple: stuck}
    share_ends(table_of(form, base), base, fits, lambda placed: None, upward=upward)
    assert fits[rich] is good, "it contains the other, and is no worse"
    assert (fits[simple] is not stuck) is again
    lost: dict[Placed, Fit | None] = {rich: good, simple: None}
    share_ends(table_of(form, base), base, lost, lambda placed: None, upward=upward)
    assert (lost[simple] is not None) is not upward


def test_a_pair_refines_no_law_and_a_richer_law_does() -> None:
    laws = LinearForm(linear_records(3, {})).laws
    coulomb, stribeck = placed("coulomb_friction"), placed("stribeck_friction")
    assert refines([stribeck], coulomb, laws)
    assert not refines([coulomb], stribeck, laws)
    assert not refines([stribeck, placed("linear_spring")], coulomb, laws)
    assert not refines([replace(stribeck, at="x")], coulomb, laws)


def test_the_rival_that_ends_a_fit_is_another_one_that_passes() -> None:
    one, other, third = (placed(name) for name in ("linear_spring", "cubic_spring", "quadratic_drag"))
    fits: dict[Placed, Fit | None] = {
        law: a_fit((np.full(400, gain / 400), np.zeros(400)))
        for law, gain in ((one, 30.0), (other, 20.0), (third, 10.0))
    }
    fits[placed("force_bias")] = None
    assert _best(fits, one, lambda placed, fit: True) is fits[other]
    assert _best(fits, other, lambda placed, fit: True) is fits[one]
    assert _best(fits, other, lambda placed, fit: placed != one) is fits[third], "what is refused ends nothing"
    assert _best({one: fits[one]}, one, lambda placed, fit: True) is None


def test_what_may_be_tied_with_an_effect_is_like_it_at_its_place_and_was_refitted() -> None:
    form = LinearForm(linear_records(3, {}))
    nominal = form.fit((), [], None)
    laws = placed("coulomb_friction"), placed("stribeck_friction"), placed("viscous_friction"), placed("cubic_spring")
    elsewhere = replace(laws[1], at="x")
    rows = [Judged((law,), nominal, None, ()) for law in (*laws, elsewhere)]
    rows += [Judged((placed("asymmetric_friction"),), nominal, None, (Refusal(Kind.SIGN, "Fp", (-0.1,)),))]
    past = Round(nominal, ScoreTest([], []), tuple(rows))
    near = form.laws.family(laws[0].effect).near
    wanted = [(law,) for law in laws[1:] if law.effect.name in near]
    assert alike(laws[0], past, form.laws) == wanted
    assert (laws[1],) in wanted
    assert (laws[3],) not in wanted


def test_what_moves_nothing_in_these_records_changes_no_promise() -> None:
    class Form(LinearForm):
        def linearised(self, fit: Fit) -> Linearised:
            whole = super().linearised(fit)
            more = {use: np.column_stack([part, np.zeros(len(part))]) for use, part in whole.nuisance.items()}
            return replace(whole, nuisance=more, states={"x0": 0.0})

    records = linear_records(3, {"cubic_spring": 0.4})
    plain, idle = LinearForm(records), Form(records)
    fit = plain.fit((), [], None)
    promises = [
        [(str(lead.placed), lead.gain, lead.share) for lead in score_test(form, fit, ALL).leads]
        for form in (plain, idle)
    ]
    for one, other in zip(*promises, strict=True):
        assert one == (other[0], *map(pytest.approx, other[1:]))


# ---- again -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("behind", "again"), [(0.4, False), (0.6, True), (EFFORT.margin + 10.0, True)])
def test_a_base_is_fitted_again_from_where_its_rival_ended(behind: float, again: bool) -> None:
    form = LinearForm(linear_records(3, {"linear_spring": 0.4, "quadratic_drag": 0.4}))
    nominal, drag = form.fit((), [], None), placed("quadratic_drag")
    whole = form.fit([drag], [], nominal)
    terms = {use: [each - behind / len(each) for each in whole.terms[use]] for use in USES}
    base = replace(whole, terms=terms)
    better = form.fit([drag, placed("linear_spring")], [], base)
    found = polished(table_of(form, nominal), base, [better])
    assert (found.penalised == pytest.approx(whole.penalised)) if again else found is base
    assert polished(table_of(form, nominal), base, []) is base
    assert polished(table_of(form, nominal), base, [nominal]) is base, "no rival is better"
    if again:
        for short, goes_on in ((EFFORT.margin - 1.0, True), (EFFORT.margin + 1.0, False)):
            first = Begun((drag,), base.log_likelihood("estimation") - short, {}, whole)
            form.begin = lambda *given, first=first: first  # type: ignore[method-assign]
            assert (polished(table_of(form, nominal), base, [better]) is whole) is goes_on, "its first steps fell short"
        form.begin = lambda *given: None  # type: ignore[method-assign, return-value, assignment]
        assert polished(table_of(form, nominal), base, [better]) is base, "it cannot be simulated from there"
        del form.begin
    stuck = replace(whole, converged=False)
    form.finish = lambda *given: stuck  # type: ignore[method-assign]
    assert polished(table_of(form, nominal), base, [better]) is base, "what came to its end stays"
    if again:
        unfinished = replace(base, converged=False)
        assert polished(table_of(form, nominal), unfinished, [better]) is stuck
    lawless = replace(whole, values={**whole.values, main("quadratic_drag"): -0.4})
    form.finish = lambda *given: lawless  # type: ignore[method-assign]
    assert polished(table_of(form, nominal), base, [better]) is base, "it was accepted as a law"


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_rival_that_was_left_on_its_way_is_an_answer_where_its_end_passes(sign: float) -> None:
    form = LinearForm(linear_records(9, {"quadratic_drag": 0.4 * sign}))
    nominal, drag = form.fit((), [], None), placed("quadratic_drag")
    fit = replace(form.fit([drag], [], nominal), converged=False, beyond=True)
    row = Judged((drag,), fit, FitComparison(60.0, 60.0, 5.0, 5.0), (Refusal(Kind.STOPPED),))
    past = Round(nominal, score_test(form, nominal, ALL), (row,))
    found = [accepted(one) for one in pair(table_of(form, nominal, past), Answer(nominal))]
    assert ({"quadratic_drag"} in found) is (sign > 0), "of the wrong sign it is no law"


@pytest.mark.parametrize("ahead", [-1.0, 4.5, 5.5])
def test_rivals_of_a_law_are_refined_where_that_helps_the_law_itself(ahead: float) -> None:
    """By what is asked of an effect; of a rival it is then not asked any more."""
    helps = ahead > POLICY.evidence
    worth: dict[str, float] = {}
    records = linear_records(23, {"linear_spring": 1.0, "quadratic_drag": 0.5}, alike={"cubic_spring": "linear_spring"})
    for refined, law in (("quadratic_spring", "linear_spring"), ("force_bias", "cubic_spring")):
        mixed(records, refined, **{law: 1.0, "quadratic_drag": 0.5})

    class Form(LinearForm):
        def finish(self, begun: Begun, base: Fit | None, rival: Fit | None = None, least: float = -np.inf) -> Fit:
            fit = super().finish(begun, base)
            assert base is not None
            worth[begun.effects[-1].effect.name] = least - base.log_likelihood("estimation")
            first = begun.effects[-1].effect.name == "quadratic_spring"
            more = base.penalised + (ahead if first else 1.0) - fit.penalised
            terms = {"estimation": [each + more / len(each) for each in fit.terms["estimation"]]}
            every = {one.name(name): 1.0 for one in begun.effects for name in one.effect.parameter_names}
            return replace(fit, terms={**fit.terms, **terms}, values={**every, **fit.values})

    form = Form(records)
    base = form.fit((), [], None)
    laws = [placed("linear_spring"), placed("cubic_spring")]
    rich = []
    for name, law in zip(("quadratic_spring", "force_bias"), laws, strict=True):
        effect = placed(name).effect
        more = {"nests": (law.effect.name,), "grows": "drag", "parameters": (*effect.parameters, par("tau"))}
        rich.append(Placed(replace(effect, **more), "theta"))
    fits: dict[Placed, Fit | None] = {law: form.fit([law], [], base) for law in laws}
    generalise(table_of(form, base), base, fits, [*laws, *rich])
    assert set(fits) == {*laws, *(rich if helps else ())}
    assert worth["quadratic_spring"] == pytest.approx(0.5 * np.log(1000) - POLICY.evidence), "what its parameter costs"


# ---- what is preferred ----------------------------------------------------------------------------------------------


def worth(ahead: float, names: Sequence[str], count: int) -> Answer:
    """Return an answer whose value lies so far ahead of a model with none of its parameters."""
    laws = [placed(name) for name in names]
    gain = np.full(400, (ahead + 0.5 * count * np.log(400)) / 400)
    return answer_of(a_fit((np.zeros(400), gain), laws, count=count), *laws)


TIE, MORE = POLICY.tie, 2 * POLICY.evidence


@pytest.mark.parametrize(
    ("old", "new", "counts", "asked"),
    [
        ("linear_spring", "linear_spring quadratic_drag", (4, 5), MORE),
        ("linear_spring", "linear_spring quadratic_drag force_bias", (4, 6), 2 * MORE),
        ("linear_spring", "quadratic_drag", (4, 7), TIE),
        ("linear_spring quadratic_drag", "linear_spring", (5, 4), -TIE),
        # what stood in for two: its special case and another law, with no more parameters
        ("stribeck_friction", "coulomb_friction quadratic_drag", (6, 6), TIE),
        ("stribeck_friction", "coulomb_friction quadratic_drag", (6, 7), MORE),
        ("stribeck_friction", "viscous_friction quadratic_drag", (6, 6), MORE),
    ],
)
@pytest.mark.parametrize("off", [-0.1, 0.1])
def test_an_answer_takes_the_place_of_another_by_what_is_asked_of_its_effects(
    old: str, new: str, counts: tuple[int, int], asked: float, off: float
) -> None:
    table = table_of(NoForm(), a_fit(count=0))  # type: ignore[arg-type]
    before, after = worth(200.0, old.split(), counts[0]), worth(200.0 + asked + off, new.split(), counts[1])
    assert preferred(table, after, before) is (off > 0)


@pytest.mark.parametrize(("whole", "asked"), [(50.0, -TIE), (1000.0, -1000.0 * POLICY.second_share)])
@pytest.mark.parametrize("off", [-0.1, 0.1])
def test_a_special_case_may_lose_a_share_of_what_all_effects_bring(whole: float, asked: float, off: float) -> None:
    table = table_of(NoForm(), a_fit(count=0))  # type: ignore[arg-type]
    rich, simple = worth(whole, ["stribeck_friction"], 6), worth(whole + asked + off, ["coulomb_friction"], 4)
    assert preferred(table, simple, rich, simpler=True) is (off > 0)
    assert best_of(table, rich, [simple], simpler=True) is (simple if off > 0 else None)


def test_of_answers_that_stand_the_likeliest_is_taken() -> None:
    table = table_of(NoForm(), a_fit(count=0))  # type: ignore[arg-type]
    old = worth(100.0, ["linear_spring"], 4)
    trials = [worth(ahead, ["quadratic_drag"], 4) for ahead in (101.0, 110.0, 120.0, 115.0)]
    assert best_of(table, old, trials) is trials[2]
    assert best_of(table, old, trials[:1]) is None


# ---- what is left, and what is typical -------------------------------------------------------------------------------


def test_an_initial_state_of_the_validation_records_takes_nothing_from_a_free_force() -> None:
    """It belongs to the record: the force is judged by what no such state can do."""
    found = []
    for shift in (0.0, 40.0):
        records = linear_records(6, {"cubic_spring": 0.3})
        records.y["validation"] += shift * records.x["validation"]["b"]

        class Form(LinearForm):
            def linearised(self, fit: Fit) -> Linearised:
                whole = super().linearised(fit)
                return replace(whole, names=("a",), states={"b": 0.0})

        form = Form(records)
        axis = left_over(form, form.fit((), [], None)).best
        assert axis is not None
        found.append((axis.name, axis.validation, axis.error))
    assert found[0] == (found[1][0], *map(pytest.approx, found[1][1:]))


def test_a_function_that_the_motion_never_reaches_changes_no_free_force() -> None:
    class Form(LinearForm):
        def test_functions(self, fit: Fit) -> list[Column]:
            return [
                replace(one, estimation=np.column_stack([one.estimation, np.zeros(1000)]), names=(*one.names, "far"),
                        validation=np.column_stack([one.validation, np.ones(1000)]))
                for one in super().test_functions(fit)
            ]  # fmt: skip

    records = linear_records(6, {"cubic_spring": 0.3})
    plain, wider = (left_over(form, form.fit((), [], None)).best for form in (LinearForm(records), Form(records)))
    assert plain is not None
    assert wider is not None
    assert (wider.name, wider.evidence, wider.validation) == (
        plain.name, pytest.approx(plain.evidence), pytest.approx(plain.validation),
    )  # fmt: skip
    assert wider.values.tolist() == [pytest.approx(plain.values[0]), 0.0]


@pytest.mark.parametrize(("evidence", "validation", "ties"), [(0.5, 0.0, True), (-0.5, 2.0, False), (0.5, -1.0, False)])
def test_a_rival_is_tied_where_it_pays_for_itself_and_helps(evidence: float, validation: float, ties: bool) -> None:
    answer, rival = placed("linear_spring"), placed("quadratic_drag")
    gains = np.full(400, 0.0)
    best = Judged((answer,), a_fit((gains, gains), [answer]), FitComparison(1.0, 1.0, 1.0, 1.0), ())
    row = Judged((rival,), a_fit((gains, gains), [rival]), FitComparison(evidence, validation, 1.0, 1.0), ())
    found = tie_set(NoForm(), best, [best, row])  # type: ignore[arg-type]
    assert found == ((answer,), *[(rival,)] * ties)


def law_on_bound(bounds: Sequence[str], *, gap: float = 0.0, more: int = 0, **fields: Any) -> tuple[Fit, Judged]:
    """Return an answer and a friction with an exponent, of which these parameters lie on their bounds."""
    law = placed("sublinear_friction")
    answer = a_fit(effects=[placed("coulomb_friction")])
    gains = (np.full(400, -gap / 800), np.full(400, -gap / 800))
    fit = a_fit(gains, [law], count=answer.count + more, **fields)
    refusals = tuple(Refusal(Kind.BOUND, name, (0.05,)) for name in bounds)
    return answer, Judged((law,), fit, FitComparison(50.0, 50.0, 5.0, 5.0), refusals)


def test_a_law_on_a_bound_of_its_exponent_is_asked_with_a_usual_one() -> None:
    answer, row = law_on_bound(["a"])
    typical = _typical(answer, row, POLICY)
    assert typical is not None
    assert [known.name for known in typical.effect.parameters if known.fixed] == ["a"]
    values = _usual(row, typical)
    assert (values[typical.name("a")], values[typical.name("Fr")]) == (0.5, 0.5), "usual, and as it was fitted"
    assert row.fit is not None
    moved = replace(row.fit, values={**row.fit.values, typical.name("a"): 0.05, typical.name("Fr"): 0.3})
    values = _usual(replace(row, fit=moved), typical)
    assert (values[typical.name("a")], values[typical.name("Fr")]) == (0.5, 0.3)


@pytest.mark.parametrize(
    ("bounds", "fields"),
    [
        ([], {}),
        (["Fr"], {}),  # a force has no usual value
        (["a", "Fr"], {}),
        (["a"], {"beyond": True}),
        (["a"], {"gap": 2 * POLICY.tie}),
    ],
)
def test_no_other_law_has_a_usual_value(bounds: Sequence[str], fields: Mapping[str, Any]) -> None:
    answer, row = law_on_bound(bounds, **fields)
    assert _typical(answer, row, POLICY) is None
    answer, row = law_on_bound(["a"])
    refused = replace(row, refusals=(*row.refusals, Refusal(Kind.SIGN, "Fr", (-0.1,))))
    assert _typical(answer, refused, POLICY) is None, "of the wrong sign it is none at any exponent"
    assert _typical(answer, replace(row, added=(*row.added, placed("force_bias"))), POLICY) is None
    assert _typical(answer, replace(row, fit=None), POLICY) is None


@pytest.mark.parametrize(("more", "asked"), [(0, False), (1, False), (2, True)])
def test_a_law_whose_exponent_costs_more_than_it_tells_is_asked_with_a_usual_one(more: int, asked: bool) -> None:
    """A parameter costs 3 of 400 samples: one ties even so, two do not."""
    answer, row = law_on_bound([], more=more)
    typical = _typical(answer, row, POLICY)
    assert (typical is not None) is asked


# ---- given, far off, taken back --------------------------------------------------------------------------------------


def test_what_is_given_stays_whatever_its_evidence_and_counts_for_nothing() -> None:
    form = LinearForm(linear_records(3, {"cubic_spring": 0.4, "quadratic_drag": 0.3, "force_bias": 0.3}))
    nominal = form.fit((), [], None)
    spring = placed("linear_spring")
    outcome = search(form, nominal, ALL, given=[spring])
    assert [one.given for one in outcome.accepted] == [True, False, False, False], "as many are found beside it"
    assert outcome.accepted[0].placed == spring
    assert outcome.accepted[0].evidence < POLICY.evidence
    only = table_of(form, nominal).given([spring, placed("cubic_spring")])
    assert [one.beside for one in only.accepted] == [{"cubic_spring@theta"}, {"linear_spring@theta"}]
    whole = form.fit([spring, placed("cubic_spring")], [], nominal)
    assert sum(one.evidence for one in only.accepted) == pytest.approx(whole.penalised - nominal.penalised)

    class Diverges(LinearForm):
        def begin(self, effects: Any, starts: Any, base: Fit | None, hope: float = -np.inf) -> Begun:
            return None  # type: ignore[return-value]

    with pytest.raises(FitError, match="linear_spring"):
        table_of(Diverges(form.records), nominal).given([spring])


def test_what_lies_on_a_bound_or_is_not_told_is_not_far_off_what_was_declared() -> None:
    declared = [Parameter("a", "kg", 1e-3)]
    fit = a_fit()  # a is 1.0 within 0.1
    assert [one.name for one in fit.far_off(declared)] == ["a"]
    assert fit.far_off(declared, factor=1e4) == ()
    assert a_fit(on_bound=("a",)).far_off(declared) == ()
    assert a_fit(deviations={"a": 1.0}).far_off(declared) == (), "its interval has the declared value in it"


@pytest.mark.parametrize(("promised", "told"), [(0.9, False), (1.1, True)])
def test_what_was_promised_of_the_validation_records_must_be_evidence_to_be_denied(promised: float, told: bool) -> None:
    spring, law = placed("linear_spring"), np.ones(400) * np.sqrt(promised * 2 * POLICY.evidence / 200)
    base, fit = (
        a_fit(innovations={use: [(part[:, None], np.ones((400, 1)))] for use in USES}) for part in (law, 0.0 * law)
    )
    row = Judged((spring,), fit, FitComparison(50.0, -5.0, 0.5, 1.0), ())
    one = Accepted(spring, ((spring,),), 50.0, -5.0)
    nothing: Any = None
    outcome = Outcome(nothing, base, fit, (one,), (Round(base, nothing, (row,)),))
    expected = promised * 2 * POLICY.evidence
    assert dict(outcome.denied()) == ({str(spring): pytest.approx(0.5 * (1 - 5.0 / expected))} if told else {})
    assert replace(outcome, accepted=()).denied() == (), "it is no part of the answer"


@pytest.mark.parametrize("share", [0.9, 1.1])
def test_what_is_taken_back_was_something_where_it_gained_as_much_as_is_asked(share: float) -> None:
    found = found_in({"linear_spring": 0.4}, 9)
    whole = sum(found.model.log_likelihood(use) - found.nominal.log_likelihood(use) for use in USES)
    back = found.taken_back(share * whole)
    assert back.model is found.nominal
    assert back.accepted == ()
    assert back.withdrawn == (found.accepted if share < 1.0 else ())
    for past, before in zip(back.rounds, found.rounds, strict=True):
        for row, old in zip(past.candidates, before.candidates, strict=True):
            gone = Refusal(Kind.WITHDRAWN) in row.refusals
            assert gone is (row.name == "linear_spring@theta" and old.passed)
            assert row.refusals[: len(old.refusals)] == old.refusals
    assert found.taken_back().withdrawn == found.accepted
