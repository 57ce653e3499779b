"""The moves of the search on a form whose answers are known: pairs, stand-ins, what is dropped, followed, refined."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from linear_form import (
    ALL,
    NAMES,
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

from harness.diagnosis.effort import EFFORT
from harness.diagnosis.policy import POLICY
from harness.diagnosis.search import moves
from harness.diagnosis.search.compare import FitComparison, Judged, compared, judged
from harness.diagnosis.search.fit import Begun, Fit, Suspect
from harness.diagnosis.search.generalised import refined_twice
from harness.diagnosis.search.moves import best_of, climbed, drop, exchange, exchange_contradicted, pair
from harness.diagnosis.search.outcome import Outcome
from harness.diagnosis.search.refusal import Kind, Refusal
from harness.diagnosis.search.scores import score_test
from harness.diagnosis.search.search import _step, search
from harness.diagnosis.search.table import Answer, FitTable, Round, value
from harness.diagnosis.search.ties import total, unknown_parts
from harness.diagnosis.search.warm import as_good
from harness.effects.effect import Placed


def pair_instead(table: FitTable, answer: Answer) -> Answer | None:
    return best_of(table, answer, pair(table, answer))


def test_a_law_that_stood_in_for_two_is_taken_back() -> None:
    records = linear_records(9, {"linear_spring": 0.4, "quadratic_drag": 0.4})
    for use in ("estimation", "validation"):  # nearly the sum of both: found first, and wrong
        own = records.x[use]
        own["cubic_spring"] = own["linear_spring"] + own["quadratic_drag"] + 0.6 * own["cubic_spring"]
    form = LinearForm(records)
    nominal = form.fit((), [], None)
    outcome = search(form, nominal, ALL)
    assert accepted(outcome) == {"linear_spring", "quadratic_drag"}
    whole = compared(outcome.model, nominal)
    assert sum(one.evidence for one in outcome.accepted) == pytest.approx(whole.evidence), "shared, and not twice"
    assert sum(one.validation for one in outcome.accepted) == pytest.approx(whole.validation)


@given(
    seed=st.integers(0, 10_000),
    hidden=st.dictionaries(st.sampled_from(NAMES), st.sampled_from([0.15, 0.3, 0.6]), max_size=3),
    mixture=st.tuples(st.sampled_from(NAMES), st.sampled_from(NAMES), st.sampled_from(NAMES)),
    order=st.permutations(NAMES),
)
@settings(max_examples=60, deadline=None)
def test_the_order_of_the_dictionary_changes_no_answer(
    seed: int, hidden: dict[str, float], mixture: tuple[str, str, str], order: list[str]
) -> None:
    records = linear_records(seed, hidden)
    if len({*mixture}) == 3:  # one law that may stand in for two
        mixed(records, mixture[0], **{mixture[1]: 0.7, mixture[2]: 0.7, mixture[0]: 0.3})
    found = []
    for names in (NAMES, order):
        form = LinearForm(records)
        outcome = search(form, form.fit((), [], None), [placed(name) for name in names])
        ties = {str(one.placed): {frozenset(map(str, member)) for member in one.tie} for one in outcome.accepted}
        found.append((ties, value(outcome.model)))
    assert found[0][0] == found[1][0]
    assert found[0][1] == pytest.approx(found[1][1], rel=1e-9)


def test_on_a_model_that_says_nothing_no_second_effect_is_built() -> None:
    form = LinearForm(linear_records(9, {"linear_spring": 0.4, "quadratic_drag": 0.4}))
    nominal = form.fit((), [], None)
    whole, ended = (search(form, nominal, ALL, lost=lambda fit, lost=lost: lost) for lost in (False, True))
    assert accepted(whole) == {"linear_spring", "quadratic_drag"}
    assert len(ended.accepted) == len(ended.rounds) == 1
    assert accepted(ended) < accepted(whole)
    assert ended.model.effects == tuple(one.placed for one in ended.accepted)


@pytest.mark.parametrize(
    ("special", "ahead", "taken"), [(False, 4.0, False), (False, 6.0, True), (True, 1.0, False), (True, 4.0, True)]
)
def test_a_pair_in_the_place_of_one_law_brings_what_is_asked_of_an_effect(
    special: bool, ahead: float, taken: bool
) -> None:
    """A bent scale with an offset was as likely as a cyclic error, and took its place for a parameter less.

    A Stribeck friction whose likelier special case beside a drag has no more parameters goes for more than a tie.
    """
    form = LinearForm(linear_records(9, {"linear_spring": 0.4, "quadratic_drag": 0.4}))
    nominal = form.fit((), [], None)
    spring, drag, one = placed("linear_spring"), placed("quadratic_drag"), placed("cubic_spring")
    if special:
        one = replace(one, effect=replace(one.effect, nests=(spring.effect.name,)))
    alone, both = form.fit([spring], [], nominal), form.fit([spring, drag], [], nominal)
    terms = {use: [values - ahead / len(values) for values in both.terms[use]] for use in USES}
    answer = replace(form.fit([one], [], nominal), terms=terms, count=both.count)
    past = Round(nominal, score_test(form, nominal, ALL), (judged(form, [spring], alone, nominal, nominal),))
    found = pair_instead(table_of(form, nominal, past), answer_of(answer, one))
    assert (found is not None and accepted(found) == {"linear_spring", "quadratic_drag"}) == taken


def test_a_pair_has_no_member_that_would_not_pass_beside_the_other() -> None:
    """A spring of the estimation records alone is chance, also where it is found first and the drag beside it."""
    records = linear_records(4, {"quadratic_drag": 0.3})
    own = records.x["estimation"]
    records.y["estimation"] += 0.2 * own["linear_spring"]
    form = LinearForm(records)
    nominal = form.fit((), [], None)
    spring, drag = placed("linear_spring"), placed("quadratic_drag")
    alone, both = form.fit([spring], [], nominal), form.fit([spring, drag], [], nominal)
    assert judged(form, [drag], both, alone, nominal).passed, "the drag counts beside the spring"
    first = Round(nominal, score_test(form, nominal, ALL), (judged(form, [spring], alone, nominal, nominal),))
    assert pair_instead(table_of(form, nominal, first), Answer(nominal)) is None


@pytest.mark.parametrize("beyond", [False, True])
def test_a_second_effect_beside_a_rival_may_bring_some_times_what_its_column_promises(beyond: bool) -> None:
    """The validation records may show more of it than the estimation records, by which it is promised."""
    records = linear_records(4, {"cubic_spring": 0.5, "quadratic_drag": 0.15})
    records.y["validation"] += 0.5 * records.x["validation"]["quadratic_drag"]
    form = LinearForm(records)
    nominal = form.fit((), [], None)
    spring, drag, general = placed("cubic_spring"), placed("quadratic_drag"), placed("quadratic_spring")
    alone, both = form.fit([spring], [], nominal), form.fit([spring, drag], [], nominal)
    first = judged(form, [spring], alone, nominal, nominal)
    (lead,) = [lead for lead in score_test(form, alone, [drag]).leads if lead.placed == drag]
    most = 2 * lead.penalised / POLICY.reach
    ahead = (most - 2 * POLICY.evidence) / 2 + (1.0 if beyond else -1.0)  # of the answer so far over the rival
    terms = {use: [values + ahead / len(values) for values in alone.terms[use]] for use in USES}
    answer = replace(form.fit([general], [], nominal), terms=terms)
    gained = total(judged(form, [spring, drag], both, nominal, nominal)) - total(
        judged(form, [general], answer, nominal, nominal)
    )
    assert gained > 2 * POLICY.evidence, "the pair is likelier than the answer so far"
    past = Round(nominal, score_test(form, nominal, ALL), (first,))
    found = pair_instead(table_of(form, nominal, past), answer_of(answer, general))
    assert found is None if beyond else found is not None and accepted(found) == {"cubic_spring", "quadratic_drag"}


def test_a_joint_has_its_bristles_once() -> None:
    bristles, other = placed("lugre_coulomb_friction"), placed("lugre_friction")
    assert refined_twice([bristles, placed("linear_spring"), other])
    assert not refined_twice([bristles, Placed(other.effect, "x")])
    assert not refined_twice([bristles, placed("coulomb_friction")])
    tried: list[Sequence[Placed]] = []

    class Form(LinearForm):
        def begin(self, effects: Any, given: Any, base: Fit | None, hope: float = -np.inf) -> Begun:
            tried.append(effects)
            return replace(super().begin(effects, given, base, hope), log_likelihood=-np.inf)

    form = Form(linear_records(4, {}))
    for own in form.records.x.values():
        own["lugre_coulomb_friction"], own["lugre_friction"] = own["quadratic_drag"], own["linear_spring"]
    nominal = form.fit((), [], None)
    rival = Judged((other,), form.fit([other], [], nominal), FitComparison(50.0, 50.0, 5.0, 5.0), ())
    past = Round(nominal, score_test(form, nominal, ALL), (rival,))
    for later, begun in ((bristles, 0), (placed("quadratic_drag"), 1)):
        chosen = [placed("cubic_spring"), later]
        answer = answer_of(form.fit(chosen, [], nominal), *chosen)
        assert climbed(table_of(form, nominal, past, past), answer, exchange) is answer
        assert len(tried) == begun


def test_an_effect_that_later_ones_make_needless_is_dropped_and_one_that_counts_stays() -> None:
    form = LinearForm(linear_records(12, {"linear_spring": 0.4, "quadratic_drag": 0.4}))
    nominal = form.fit((), [], None)
    for earlier, stays in (("cubic_spring", False), ("linear_spring", True)):
        chosen = [placed(earlier), placed("quadratic_drag")]
        found = climbed(table_of(form, nominal), answer_of(form.fit(chosen, [], nominal), *chosen), drop)
        assert accepted(found) == ({earlier, "quadratic_drag"} if stays else {"quadratic_drag"})
        assert len(found.model.effects) == len(found.accepted)


@pytest.mark.parametrize("faint", [0.15, 0.6])
def test_what_explains_less_than_what_is_left_may_be_a_part_of_it(faint: float) -> None:
    """An unknown force is larger than the spring, whose fit keeps it; the drag is surer than all that is left."""
    form = LinearForm(linear_records(3, {"quadratic_drag": 1.0, "linear_spring": faint, "cubic_spring": 0.3}))
    nominal = form.fit((), [], None)
    chosen = [placed("quadratic_drag"), placed("linear_spring")]
    table = table_of(form, nominal)
    found = unknown_parts(table, answer_of(form.fit(chosen, [], nominal), *chosen))
    left = "theta over cubic_spring"
    assert [one.part_of for one in found.accepted] == (["", left] if faint < 0.3 else ["", ""])
    assert [str(one) for one in found.model.effects] == [str(one) for one in chosen]
    alone = unknown_parts(table, answer_of(form.fit(chosen[1:], [], nominal), chosen[1]))
    assert alone.accepted[0].part_of == ""


def test_no_effect_is_a_part_of_something_unknown_where_nothing_is_left() -> None:
    outcome = found_in({"quadratic_drag": 1.0, "linear_spring": 0.4})
    assert accepted(outcome) == {"quadratic_drag", "linear_spring"}
    assert not any(one.part_of for one in outcome.accepted)


def test_what_was_refused_does_not_say_how_little_an_answer_may_gain() -> None:
    """A line that does not repeat explains most; the spring gains less than a quarter of it, and is the answer."""

    class Form(LinearForm):
        def finish(self, begun: Begun, base: Fit | None, rival: Fit | None = None, least: float = -np.inf) -> Fit:
            lines = {str(one): (1.0,) for one in begun.effects if one.effect.name == "cubic_spring"}
            return replace(super().finish(begun, base, rival, least), line_rivals=lines)

    form = Form(linear_records(4, {"cubic_spring": 1.0, "linear_spring": 0.3}))
    outcome = search(form, form.fit((), [], None), ALL)
    gains = {row.name: row.comparison.evidence for row in outcome.rounds[0].candidates if row.comparison}
    assert gains["linear_spring@theta"] < POLICY.reach * gains["cubic_spring@theta"]
    assert "linear_spring" in accepted(outcome)


@pytest.mark.parametrize("size", [-20.0, 20.0])
def test_a_law_of_the_wrong_sign_that_explains_more_makes_the_answer_a_stand_in(size: float) -> None:
    """A drag that pushes is no drag, and a spring that looks like it is not the answer either."""
    form = LinearForm(linear_records(5, {"quadratic_drag": size}, alike={"cubic_spring": "quadratic_drag"}))
    found = search(form, form.fit((), [], None), ALL)
    names = {one.placed.effect.name for one in found.accepted}
    better = found.unlawful()
    if size > 0:
        assert (names, better) == ({"quadratic_drag"}, None)
    else:
        assert "cubic_spring" in names
        assert better is not None
        assert "quadratic_drag" in better.name


@pytest.mark.parametrize("size", [-0.4, -0.02, 0.4])
def test_a_further_law_of_the_wrong_sign_makes_the_answer_a_stand_in(size: float) -> None:
    """A drag beside which the data ask for a friction that drives is a part of some other law."""
    form = LinearForm(linear_records(5, {"quadratic_drag": 0.6, "viscous_friction": size}))
    found = search(form, form.fit((), [], None), ALL)
    better = found.unlawful()
    if size > 0:
        assert (accepted(found), better) == ({"quadratic_drag", "viscous_friction"}, None)
    else:
        assert accepted(found) == {"quadratic_drag"}
        assert (better is not None) is (size < -0.1), "what is within chance is not asked for"
        assert better is None or better.name == "viscous_friction@theta"


def test_a_forbidden_further_law_counts_before_its_fit_has_come_to_its_end() -> None:
    """It is as likely as it is at least; one that was left on its way says nothing."""
    form = LinearForm(linear_records(5, {"quadratic_drag": 0.6, "viscous_friction": -0.4}))
    found = search(form, form.fit((), [], None), ALL)
    for kind, counts in ((Kind.UNCONVERGED, True), (Kind.STOPPED, False)):
        rounds = tuple(
            replace(past, candidates=tuple(
                replace(row, refusals=(*row.refusals, Refusal(kind))) if row.name == "viscous_friction@theta" else row
                for row in past.candidates
            )) for past in found.rounds
        )  # fmt: skip
        better = replace(found, rounds=rounds).unlawful()
        assert (better is not None and better.name == "viscous_friction@theta") is counts


def test_what_was_begun_and_left_is_told_from_what_was_never_begun() -> None:
    """The next round finds it; the report of the first one said that the score test promised less."""
    form = LinearForm(linear_records(5, {"quadratic_drag": 0.8, "linear_spring": 0.15}))
    found = search(form, form.fit((), [], None), ALL)
    assert accepted(found) == {"quadratic_drag", "linear_spring"}
    first = found.rounds[0]
    assert "linear_spring@theta" in first.left
    assert not first.left & {row.name for row in first.candidates}


@pytest.mark.parametrize(("distance", "counts"), [(0.002, False), (0.004, True)])
def test_a_forbidden_further_law_must_do_more_than_round_the_corners(distance: float, counts: bool) -> None:
    """Exact sensors are sure of the step of an engine: what changes 2 % of what the answer changes is none."""

    class Form(LinearForm):
        def change(self, fit: Fit, placed: Placed) -> float:
            return 0.1

        def distance(self, fit: Fit, other: Fit) -> float:
            return distance

    form = Form(linear_records(5, {"quadratic_drag": 0.6, "viscous_friction": -0.4}))
    found = search(form, form.fit((), [], None), ALL)
    assert (found.unlawful() is not None) is counts


def test_an_effect_whose_own_law_forbids_what_is_left_of_it_is_not_left_alone() -> None:
    """Without the drag, the spring would be negative and explain as much: the drag is not needless then."""
    records = linear_records(14, {"quadratic_drag": 0.4})
    for use in USES:
        own = records.x[use]
        own["viscous_friction"] = -own["quadratic_drag"] + 0.02 * own["viscous_friction"]
    form = LinearForm(records)
    nominal = form.fit((), [], None)
    chosen = [placed("quadratic_drag"), placed("viscous_friction")]
    answer = answer_of(form.fit(chosen, [], nominal), *chosen)
    alone = form.fit(chosen[1:], [], nominal)
    assert alone.values[main("viscous_friction")] < 0, "its sign is forbidden"
    assert compared(alone, answer.model).total > -POLICY.tie, "and it explains as much"
    assert accepted(climbed(table_of(form, nominal), answer, drop)) == {"quadratic_drag", "viscous_friction"}


def test_what_no_score_test_sees_takes_its_first_steps_in_full() -> None:
    """Its starts lie far from the base: that two steps come short of it tells nothing."""
    hopes: dict[str, float] = {}

    class Form(LinearForm):
        def begin(self, effects: Any, starts: Any, base: Fit | None, hope: float = -np.inf) -> Begun:
            for one in effects[-1:]:
                hopes.setdefault(one.effect.name, hope)
            return super().begin(effects, starts, base)

        def suspects(self, base: Fit, rival: Begun | None, candidates: Sequence[Placed]) -> list[Suspect]:
            return [Suspect(one, ({},)) for one in candidates if one.effect.name == "quadratic_drag"]

    form = Form(linear_records(2, {"cubic_spring": 0.4}))
    search(form, form.fit((), [], None), ALL)
    assert hopes["quadratic_drag"] == -np.inf
    assert hopes["cubic_spring"] > -np.inf


def test_what_was_left_on_its_way_is_said_to_be_and_not_that_it_did_not_converge() -> None:
    form = LinearForm(linear_records(15, {"linear_spring": 0.4}))
    nominal = form.fit((), [], None)
    behind = replace(form.fit([placed("quadratic_drag")], [], nominal), converged=False, beyond=True)
    stuck = replace(behind, beyond=False)
    (first, *_), (second, *_) = (judged(form, one.effects, one, nominal, nominal).refusals for one in (behind, stuck))
    assert (first.kind, second.kind) == (Kind.STOPPED, Kind.UNCONVERGED)


def test_what_no_law_allows_does_not_keep_a_smaller_effect_from_its_fit() -> None:
    """A friction that drives explains ten times as much as the drag, and is no answer: the drag is one."""
    form = LinearForm(linear_records(5, {"viscous_friction": -1.0, "quadratic_drag": 0.3}))
    assert accepted(search(form, form.fit((), [], None), ALL)) == {"quadratic_drag"}


def test_what_the_validation_records_refuse_puts_no_end_to_the_fit_of_another() -> None:
    """A spring of the estimation records alone is chance; beside what was found before, it explained most there."""
    ended: set[str] = set()

    class Form(LinearForm):
        def finish(self, begun: Begun, base: Fit | None, rival: Fit | None = None, least: float = -np.inf) -> Fit:
            fit: Fit = begun.detail
            ended.update(one.effect.name for one in (rival.effects if rival else ()))
            behind = rival is not None and begun.log_likelihood < rival.log_likelihood("estimation") - EFFORT.margin
            return replace(fit, beyond=behind, converged=not behind)

    records = linear_records(8, {"force_bias": 2.0, "quadratic_drag": 1.0, "linear_spring": 0.4})
    for use, sign in (("estimation", 1.0), ("validation", -1.0)):
        records.y[use] += sign * 0.7 * records.x[use]["cubic_spring"]
    form = Form(records)
    outcome = search(form, form.fit((), [], None), ALL)
    assert accepted(outcome) == {"force_bias", "quadratic_drag", "linear_spring"}
    assert not any(row.fit is not None and row.fit.beyond for row in outcome.rounds[-1].candidates)
    assert "cubic_spring" not in ended


def left_on_its_way(form: LinearForm, name: str, nominal: Fit) -> Judged:
    """Return a candidate whose fit was left on its way."""
    fit = replace(form.fit([placed(name)], [], nominal), converged=False, beyond=True)
    return judged(form, fit.effects, fit, nominal, nominal)


@pytest.mark.parametrize(("behind", "followed"), [("linear_spring", True), ("quadratic_drag", False)])
def test_what_was_left_on_its_way_is_followed_if_both_uses_make_it_a_rival(behind: str, followed: bool) -> None:
    """The fits are left by the estimation records; what is a rival both uses decide."""
    records = linear_records(16, {"linear_spring": 0.4, "quadratic_drag": 0.2}, alike={"cubic_spring": "linear_spring"})
    form = LinearForm(records)
    nominal = form.fit((), [], None)
    spring = judged(form, [placed("cubic_spring")], form.fit([placed("cubic_spring")], [], nominal), nominal, nominal)
    rows = [spring, left_on_its_way(form, behind, nominal)]
    assert [row.passed for row in rows] == [True, False]
    assert [row.passed for row in moves._ended(table_of(form, nominal), rows, nominal)] == [True, followed]


def test_what_would_be_the_answer_but_for_its_last_steps_takes_them() -> None:
    form = LinearForm(linear_records(16, {"linear_spring": 0.4}))
    nominal = form.fit((), [], None)
    fit = replace(form.fit([placed("linear_spring")], [], nominal), converged=False)
    (row,) = moves._ended(table_of(form, nominal), [judged(form, fit.effects, fit, nominal, nominal)], nominal)
    assert row.passed


@pytest.mark.parametrize(
    ("estimation", "validation", "good"), [(0.0, 5.0, True), (0.0, 31.0, False), (2.0, 0.0, False)]
)
def test_a_law_that_contains_another_may_be_worse_on_neither_use(
    estimation: float, validation: float, good: bool
) -> None:
    """What it fits too closely costs it some of the validation records; more than that, and it was started badly."""
    form = LinearForm(linear_records(3, {"linear_spring": 0.4}))
    rich = form.fit([placed("linear_spring")], [], None)
    better = {
        use: [terms + gain / len(terms) for terms in rich.terms[use]]
        for use, gain in (("estimation", estimation), ("validation", validation))
    }
    assert as_good(rich, replace(rich, terms=better), contains=True) is good


@pytest.mark.parametrize(("beside", "goes"), [(-0.05, True), (0.3, False)])
def test_an_effect_that_is_no_law_beside_a_likelier_one_gives_way_to_it(beside: float, goes: bool) -> None:
    """A drag that would have to push beside friction was friction: the data want one of them."""
    records = linear_records(21, {"viscous_friction": 0.6})
    mixed(records, "quadratic_drag", viscous_friction=1.0, quadratic_drag=0.4)
    for use in USES:
        records.y[use] += beside * records.x[use]["quadratic_drag"]
    form = LinearForm(records)
    nominal = form.fit((), [], None)
    drag, friction, spring = placed("quadratic_drag"), placed("viscous_friction"), placed("linear_spring")
    base = form.fit([drag], [], nominal)
    both = judged(form, [friction], form.fit([drag, friction], [], base), base, nominal)
    assert both.comparison is not None
    assert both.comparison.evidence > POLICY.evidence
    assert any(refusal.kind is Kind.OTHER_LAW for refusal in both.refusals) is goes
    first = Round(nominal, score_test(form, nominal, ALL), (judged(form, [drag], base, nominal, nominal),))

    def step(*rows: Judged) -> Answer | None:
        past = Round(base, score_test(form, base, ALL), rows)
        return _step(table_of(form, nominal, first, past), answer_of(base, drag))

    found = step(both)
    assert found is not None
    if not goes:
        assert accepted(found) == {"quadratic_drag", "viscous_friction"}, "both are laws beside each other"
        return
    assert found.model.effects == (friction,)
    assert found.accepted[0].tie == ((friction,), (drag,)), "what went is asked again at the end"
    assert found.accepted[0].found == 1, "its rivals are those of the round that found it"
    assert both.fit is not None
    for ahead, stays in ((0.5 * POLICY.tie, False), (2.0 * POLICY.tie, True)):
        more = value(found.model) + ahead - value(both.fit)
        terms = {**both.fit.terms, "validation": [each + more / len(each) for each in both.fit.terms["validation"]]}
        passing = replace(both, added=(spring,), fit=replace(both.fit, terms=terms), refusals=())
        better = step(both, passing)
        assert better is not None
        names = {"quadratic_drag", "linear_spring"} if stays else {"viscous_friction"}
        assert accepted(better) == names, "a likelier candidate comes first; one that ties does not"


def test_two_laws_that_are_ones_beside_each_other_stay() -> None:
    form = LinearForm(linear_records(21, {"viscous_friction": 0.6, "quadratic_drag": 0.3}))
    nominal = form.fit((), [], None)
    drag, friction = placed("quadratic_drag"), placed("viscous_friction")
    base = form.fit([drag], [], nominal)
    both = judged(form, [friction], form.fit([drag, friction], [], base), base, nominal)
    past = Round(base, score_test(form, base, ALL), (replace(both, refusals=(Refusal(Kind.UNCONVERGED),)),))
    assert [*exchange_contradicted(table_of(form, nominal, past), answer_of(base, drag))] == []


@pytest.mark.parametrize(("first", "refined"), [("coulomb_friction", True), ("linear_spring", False)])
def test_a_second_friction_keeps_no_refinement_of_the_first_from_its_place(
    first: str, refined: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two frictions at a joint imitate one law: what refines the first is that law, though the two explain more."""
    form = LinearForm(linear_records(24, {}))
    for own in form.records.x.values():
        own |= {name: own["cubic_spring"] for name in ("coulomb_friction", "stribeck_friction", "sublinear_friction")}
    nominal = form.fit((), [], None)
    law, rich, second = placed(first), placed("stribeck_friction"), placed("sublinear_friction")

    def likelier(effects: Sequence[Placed], gain: float) -> Fit:
        terms = {use: [each + gain / len(each) for each in parts] for use, parts in nominal.terms.items()}
        values = nominal.values | {one.name(name): 1.0 for one in effects for name in one.effect.parameter_names}
        return replace(nominal, effects=tuple(effects), values=values, terms=terms)

    base, both, instead = likelier([law], 100.0), likelier([law, second], 130.0), likelier([rich], 120.0)
    row = judged(form, [second], both, base, nominal)
    assert row.passed
    answer = answer_of(base, law)
    past = Round(base, score_test(form, nominal, ALL), (row,))

    def refining(table: FitTable, answer: Answer) -> list[Answer]:
        return [answer.exchanged(0, rich, instead, 0)]

    monkeypatch.setattr("harness.diagnosis.search.search.generalise_earlier", refining)
    found = _step(table_of(form, nominal, past), answer)
    assert found is not None
    assert [one.placed for one in found.accepted] == ([rich] if refined else [law, second])


def test_an_early_law_is_refined_where_only_a_later_effect_shows_what_it_lacks() -> None:
    """A drag hides what stiffens: alone the linear spring explains as much as the stiffening one."""
    records = linear_records(23, {})
    size, share = 0.5, 0.3
    for use in USES:
        own = records.x[use]
        hidden = own["cubic_spring"].copy()
        own["cubic_spring"] = own["linear_spring"] + share * hidden
        own["quadratic_drag"] = own["quadratic_drag"] - share / size * hidden
        records.y[use] += own["cubic_spring"] + size * own["quadratic_drag"]
    form = LinearForm(records)
    nominal = form.fit((), [], None)
    stiffening = replace(placed("cubic_spring").effect, nests=("linear_spring",), grows="stiffening")
    others = [one for one in ALL if one.effect.name != "cubic_spring"]
    outcome = search(form, nominal, [*others, Placed(stiffening, "theta")])
    assert accepted(outcome) == {"cubic_spring", "quadratic_drag"}
    assert {one.effect.name for one in outcome.model.effects} == accepted(outcome)
    whole = compared(outcome.model, nominal)
    assert sum(one.evidence for one in outcome.accepted) == pytest.approx(whole.evidence), "what it gained is its own"


def test_a_rival_takes_the_place_of_an_earlier_effect_from_its_own_nominal_parameters() -> None:
    """What the nominal parameters were beside the earlier effect may lie far from what they are beside its rival."""
    starts: list[Mapping[str, float]] = []

    class Form(LinearForm):
        def begin(self, effects: Any, given: Any, base: Fit | None, hope: float = -np.inf) -> Begun:
            starts.extend(given)
            return super().begin(effects, given, base, hope)

    form = Form(linear_records(17, {"linear_spring": 0.4, "quadratic_drag": 0.4}))
    nominal = form.fit((), [], None)
    wrong, right, later = placed("cubic_spring"), placed("linear_spring"), placed("quadratic_drag")
    alone = form.fit([right], [], nominal)
    alone = replace(alone, values={**alone.values, "a": 7.0})
    past = Round(nominal, score_test(form, nominal, ALL), (judged(form, [right], alone, nominal, nominal),))
    answer = answer_of(form.fit([wrong, later], [], nominal), wrong, later)
    assert accepted(climbed(table_of(form, nominal, past, past), answer, exchange)) == {
        "linear_spring",
        "quadratic_drag",
    }
    assert {start["a"] for start in starts} == {7.0, form.fit([wrong, later], [], nominal).values["a"]}
    assert all(main("quadratic_drag") in start for start in starts), "the later effect stays where it is"


@pytest.mark.parametrize(
    ("evidence", "validation", "sure"), [(830.0, 1.0, True), (30.0, 1.0, False), (830.0, -1.0, True)]
)
def test_what_the_estimation_records_alone_are_sure_of_is_told(evidence: float, validation: float, sure: bool) -> None:
    """An end stop that the validation records do not touch, or deny: nothing can be named, and something is missing."""

    class Form(LinearForm):
        def change(self, fit: Fit, placed: Placed) -> float:
            return 0.1

    form = Form(linear_records(15, {}))
    nominal = form.fit((), [], None)
    refused = Refusal(Kind.VALIDATION, numbers=(validation, 6.7))
    fit = form.fit([placed("cubic_spring")], [], nominal)
    row = Judged(fit.effects, fit, FitComparison(evidence, validation, 6.7, 48.0), (refused,))
    outcome = Outcome(form, nominal, nominal, rounds=(Round(nominal, score_test(form, nominal, ALL), (row,)),))
    assert (outcome.promised() is row) == sure
