"""The search on a form whose answers are known in closed form: what it finds, and what it holds for tied."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from linear_form import (
    ALL,
    NAMES,
    USES,
    LinearForm,
    accepted,
    found_in,
    linear_records,
    main,
    mixed,
    placed,
    table_of,
    tie_of,
)

from harness.diagnosis.policy import POLICY
from harness.diagnosis.search.compare import judged
from harness.diagnosis.search.fit import Begun, Column, Fit
from harness.diagnosis.search.leftover import Axis, Leftover, _Beside, _expected, _Explained, left_over
from harness.diagnosis.search.moves import climbed, specialise
from harness.diagnosis.search.scores import projected, score_test
from harness.diagnosis.search.search import search
from harness.diagnosis.search.table import Accepted, Answer, Round
from harness.diagnosis.search.ties import tied, total
from harness.effects import builtin
from harness.effects.effect import Placed

# ---- the score test --------------------------------------------------------------------------------------------------


def test_a_column_that_diverges_promises_nothing_and_warns_of_nothing() -> None:
    records = linear_records(3, {"cubic_spring": 0.4})
    for use in USES:
        records.x[use]["quadratic_drag"] = 1e200 * records.x[use]["quadratic_drag"]
    form = LinearForm(records)
    test = score_test(form, form.fit((), [], None), ALL)
    assert [lead.gain for lead in test.hidden] == [0.0]
    assert test.leads[0].placed.effect.name == "cubic_spring"


def test_a_promise_is_the_gain_where_everything_is_linear() -> None:
    form = LinearForm(linear_records(3, {"cubic_spring": 0.4, "quadratic_drag": 0.1}))
    nominal = form.fit((), [], None)
    test = score_test(form, nominal, ALL)
    assert test.leads[0].placed.effect.name == "cubic_spring"
    for lead in test.leads:
        whole = form.fit([lead.placed], [], nominal)
        gain = whole.log_likelihood("estimation") - nominal.log_likelihood("estimation")
        assert lead.gain == pytest.approx(gain, rel=1e-6, abs=1e-9)
        assert lead.penalised == pytest.approx(gain - 0.5 * np.log(1000), rel=1e-6, abs=1e-6)
        name = main(lead.placed.effect.name)
        own = form.records.x["estimation"]
        rest = np.column_stack([own["a"], own["b"]])
        column = own[lead.placed.effect.name]
        left = column - rest @ np.linalg.lstsq(rest, column, rcond=None)[0]
        y = form.records.y["estimation"]
        assert lead.starts[0][name] == pytest.approx(float(left @ y / (left @ left)), rel=1e-6), "size and sign"
        assert lead.share == pytest.approx(np.linalg.norm(left) / np.linalg.norm(column), rel=1e-9)
        assert lead.starts[0] == pytest.approx(whole.values, rel=1e-6), "what was free already moves along"
    gains = [lead.penalised for lead in test.leads]
    assert gains == sorted(gains, reverse=True)


def test_a_start_that_moves_too_far_leaves_what_was_free_where_it_is() -> None:
    """Beyond a factor of two the first order means nothing, but where the effect vanishes there is a way back."""
    form = LinearForm(linear_records(3, {"cubic_spring": -3.0}, absorbed={"cubic_spring": 0.5}))
    nominal = form.fit((), [], None)
    spring = builtin()["cubic_spring"]
    (stiffness,) = spring.parameters
    stays = Placed(replace(spring, parameters=(replace(stiffness, neutral=None),)), "theta")
    for one, names in ((stays, set()), (placed("cubic_spring"), {"a", "b"})):
        (lead,) = score_test(form, nominal, [one]).leads
        assert set(lead.starts[0]) == {main("cubic_spring"), *names}


def test_what_is_free_moves_along_with_the_whole_of_a_law_that_cannot_be_a_tenth_of_itself() -> None:
    """A limit that clips ten times as much gains most as a tenth of itself; a start has all of it."""
    records = linear_records(3, {"linear_spring": 0.3})
    limited = Placed(builtin()["saturation"], "u")
    for use in USES:
        own = records.x[use]
        own["ten times"] = 3.0 * own["linear_spring"] + 0.5 * own["a"]

    class Form(LinearForm):
        def columns(self, fit: Fit, candidates: Sequence[Placed]) -> list[Column]:
            x = [-self.records.x[use]["ten times"][:, None] for use in USES]
            return [Column(limited, {"limit": 4.0}, ("effect",), *x)]

    form = Form(records)
    nominal = form.fit((), [], None)
    (lead,) = score_test(form, nominal, [limited]).leads
    own = records.x["estimation"]
    with_it = np.linalg.lstsq(np.column_stack([own["a"], own["b"]]), own["ten times"], rcond=None)[0]
    assert lead.starts[0]["saturation@u.limit"] == 4.0
    for name, share in zip("ab", with_it, strict=True):
        assert lead.starts[0][name] == pytest.approx(nominal.values[name] - share)


def test_what_the_nominal_parameters_take_up_cannot_be_seen() -> None:
    form = LinearForm(linear_records(4, {}, absorbed={"cubic_spring": 0.001, "quadratic_drag": 0.05}))
    test = score_test(form, form.fit((), [], None), ALL)
    assert [lead.placed.effect.name for lead in test.hidden] == ["cubic_spring"]
    assert {lead.placed.effect.name for lead in test.leads} == set(NAMES) - {"cubic_spring"}


def test_cosines_show_what_mimics_what() -> None:
    form = LinearForm(linear_records(5, {}, alike={"cubic_spring": "linear_spring"}))
    names, cosines = score_test(form, form.fit((), [], None), ALL).cosines()
    i, j, k = (names.index(f"{name}@theta") for name in ("cubic_spring", "linear_spring", "quadratic_drag"))
    assert cosines[i, j] > 0.99
    assert cosines[i, k] < 0.2
    assert np.diag(cosines) == pytest.approx(1.0)


# ---- what is left ----------------------------------------------------------------------------------------------------


def test_the_evidence_of_a_free_force_is_that_of_normal_coefficients() -> None:
    form = LinearForm(linear_records(6, {"cubic_spring": 0.3}))
    fit = form.fit((), [], None)
    best = left_over(form, fit).best
    assert best is not None
    assert best.name == "theta over cubic_spring"
    own = form.records.x["estimation"]
    rest = np.column_stack([own["a"], own["b"]])
    column, y = own["cubic_spring"] / np.linalg.norm(own["cubic_spring"]), form.records.y["estimation"]
    q = np.linalg.qr(rest)[0]
    column, y = column - q @ (q.T @ column), y - q @ (q.T @ y)
    size, along = float(column @ column), float(column @ y)
    gains = [0.5 * (v * along**2 / (1 + v * size) - np.log1p(v * size)) for v in np.geomspace(1e-2, 1e6, 17)]
    assert best.evidence == pytest.approx(max(gains), rel=1e-6)
    assert best.values[0] == pytest.approx(0.3, abs=0.1), "sign and size of the force"
    assert best.validation > 10


def test_a_free_force_has_as_many_coefficients_as_the_innovations_tell() -> None:
    """The trace of what takes the innovations to the force: less than one of a function that is hardly seen."""
    form = LinearForm(linear_records(6, {"cubic_spring": 4.0}, absorbed={"cubic_spring": 0.05}))
    fit = form.fit((), [], None)
    basis, residual = projected(form, fit)
    (column,) = [one for one in form.test_functions(fit) if one.names[1] == "cubic_spring"]
    linear = form.linearised(fit)
    found = _Explained.of(column, _Beside.of(linear, basis, residual), linear, POLICY)
    unit = column.estimation[:, 0] / np.linalg.norm(column.estimation[:, 0])
    left = unit - basis @ (basis.T @ unit)
    size, along = float(left @ left), float(left @ residual)
    prior = max(np.geomspace(1e-2, 1e6, 17), key=lambda v: v * along**2 / (1 + v * size) - np.log1p(v * size))
    assert found.count == pytest.approx(prior * size / (1 + prior * size), rel=1e-6)
    errors = {use: [(part[:, None], np.ones((len(part), 1)))] for use, part in form.linearised(fit).residual.items()}
    read = replace(fit, innovations=errors)
    gains = [replace(found, count=count).beside_memory(read, 2) for count in (2.0, 5.0)]
    assert gains[0][0] - gains[1][0] == pytest.approx(1.5 * np.log(1000)), "they are paid, where the force was fitted"
    assert gains[0][1] == gains[1][1]


def test_parameters_move_where_their_spread_and_the_validation_records_want_them() -> None:
    rng = np.random.default_rng(0)
    left, along, moved = rng.standard_normal(40), rng.standard_normal((40, 2)), np.array([2.0, -1.0])
    stacked = np.vstack([along, np.eye(2)]), np.concatenate([left, moved])
    best = stacked[1] - stacked[0] @ np.linalg.lstsq(*stacked, rcond=None)[0]
    found = _expected(left, along, moved)
    assert found.sum() == pytest.approx(0.5 * float(best @ best), rel=1e-9), "the move is paid as well"
    assert found == pytest.approx(0.5 * best[:40] ** 2 + 0.5 * float(best[40:] @ best[40:]) / 40, rel=1e-9)


def test_nothing_can_be_predicted_of_white_noise() -> None:
    for seed in range(20):
        form = LinearForm(linear_records(seed, {}))
        assert left_over(form, form.fit((), [], None)).best is None


def test_a_force_that_helps_on_one_use_only_is_chance() -> None:
    records = linear_records(7, {"cubic_spring": 0.5})
    own = records.x["validation"]
    records.y["validation"] = records.y["validation"] - 1.0 * own["cubic_spring"]  # the other way round there
    form = LinearForm(records)
    assert left_over(form, form.fit((), [], None)).best is None


@pytest.mark.parametrize(
    ("evidence", "gain", "left"),
    [(40.0, 30.0, True), (40.0, 5.0, False), (60.0, 5.0, True), (60.0, -1.0, False), (4.0, 30.0, True)],
)
def test_a_force_that_one_use_is_sure_of_is_left_unless_the_other_refuses_it(
    evidence: float, gain: float, left: bool
) -> None:
    axis = Axis("theta over u", evidence, gain, 20.0, (), np.zeros(0))
    assert (Leftover((axis,)).best is axis) is left
    drift = replace(axis, drifts=True)
    assert Leftover((drift,)).best is None, "by chance a force follows the motion in one record for a while"


# ---- the search ------------------------------------------------------------------------------------------------------


def test_nothing_is_found_where_nothing_is() -> None:
    for seed in range(40):
        outcome = found_in({}, seed)
        assert not outcome.accepted
        assert outcome.model is outcome.nominal


@pytest.mark.parametrize("name", NAMES)
def test_what_is_hidden_is_found_alone(name: str) -> None:
    outcome = found_in({name: 0.3}, 1)
    assert accepted(outcome) == {name}
    assert tie_of(outcome, name) == {name}
    low, high = outcome.model.interval(main(name))
    assert low < 0.3 < high
    one = outcome.accepted[0]
    assert one.evidence > POLICY.evidence
    assert one.validation > 0


def test_a_force_the_wrong_way_round_is_no_friction() -> None:
    assert accepted(found_in({"quadratic_drag": -0.3}, 2)) == set()


def test_an_effect_of_the_estimation_records_only_is_chance() -> None:
    records = linear_records(8, {"cubic_spring": 0.3})
    own = records.x["validation"]
    records.y["validation"] = records.y["validation"] - 0.3 * own["cubic_spring"]
    form = LinearForm(records)
    assert accepted(search(form, form.fit((), [], None), ALL)) == set()


def test_two_and_three_effects_are_all_found() -> None:
    two = {"quadratic_drag": 0.3, "cubic_spring": 0.4}
    outcome = found_in(two, 3)
    assert [one.placed.effect.name for one in outcome.accepted] == ["cubic_spring", "quadratic_drag"], "largest first"
    three = {**two, "force_bias": 0.3}
    assert accepted(found_in(three, 3)) == set(three)


def test_no_more_effects_are_named_than_the_policy_allows() -> None:
    assert len(accepted(found_in(dict.fromkeys(NAMES, 0.3), 4))) == POLICY.most


def test_what_the_data_cannot_tell_apart_is_tied() -> None:
    outcome = found_in({"linear_spring": 0.3}, 5, alike={"cubic_spring": "linear_spring"})
    (name,) = accepted(outcome)
    assert tie_of(outcome, name) == {"linear_spring", "cubic_spring"}


def test_rivals_that_the_data_tell_apart_are_no_tie() -> None:
    records = linear_records(6, {"linear_spring": 0.5})
    for use in ("estimation", "validation"):
        own = records.x[use]
        own["cubic_spring"] = 0.8 * own["linear_spring"] + 0.6 * own["cubic_spring"]
    form = LinearForm(records)
    outcome = search(form, form.fit((), [], None), ALL)
    assert accepted(outcome) == {"linear_spring"}
    assert tie_of(outcome, "linear_spring") == {"linear_spring"}


@pytest.mark.parametrize(("own", "rivals"), [(0.02, {"cubic_spring"}), (1e-4, set())])
@pytest.mark.parametrize("later", [{}, {"quadratic_drag": 0.3}])
def test_a_general_law_is_a_rival_only_if_its_model_is_another_one(
    own: float, rivals: set[str], later: Mapping[str, float]
) -> None:
    """It is as likely in either case; what differs by a ten-thousandth of what happens is the special case itself."""
    records = linear_records(5, {"linear_spring": 1.0, **later})
    mixed(records, "cubic_spring", linear_spring=1.0, cubic_spring=own)

    class Told(LinearForm):
        def distance(self, fit: Fit, other: Fit) -> float:
            mine, theirs = (
                self._matrix(one.effects, "estimation") @ np.array(list(one.values.values())) for one in (fit, other)
            )
            return float((mine - theirs).std() / mine.std())

    form = Told(records)
    general = Placed(replace(placed("cubic_spring").effect, nests=("linear_spring",)), "theta")
    outcome = search(
        form, form.fit((), [], None), [*(one for one in ALL if one.effect.name != "cubic_spring"), general]
    )
    assert accepted(outcome) == {"linear_spring", *later}
    assert tie_of(outcome, "linear_spring") == {"linear_spring", *rivals}


def test_a_rival_that_a_later_effect_tells_apart_is_no_longer_tied() -> None:
    """Alone, the cubic spring is as likely as the linear one, as it takes up some of the drag; beside the drag not."""
    records = linear_records(16, {"linear_spring": 0.4, "quadratic_drag": 0.3})
    mixed(records, "cubic_spring", linear_spring=1.0, quadratic_drag=0.3, cubic_spring=0.64)
    form = LinearForm(records)
    nominal = form.fit((), [], None)
    rivals = [judged(form, [placed(name)], form.fit([placed(name)], [], None), nominal, nominal) for name in NAMES]
    alone = {row.name for row in rivals if tied(rivals[0], row)}
    assert alone == {"linear_spring@theta", "cubic_spring@theta"}, "tied at first"
    outcome = search(form, nominal, ALL)
    assert accepted(outcome) == {"linear_spring", "quadratic_drag"}
    assert tie_of(outcome, "linear_spring") == {"linear_spring"}


def test_a_rival_that_is_part_of_the_answer_is_not_tied_with_the_rest_of_it() -> None:
    records = linear_records(17, {"linear_spring": 0.3, "quadratic_drag": 0.3})
    form = LinearForm(records)
    nominal = form.fit((), [], None)
    first, second = (
        judged(form, [placed(name)], form.fit([placed(name)], [], None), nominal, nominal)
        for name in ("linear_spring", "quadratic_drag")
    )
    assert tied(first, second), "each alone is as likely"
    outcome = search(form, nominal, ALL)
    assert accepted(outcome) == {"linear_spring", "quadratic_drag"}
    assert [len(one.tie) for one in outcome.accepted] == [1, 1]


def test_a_general_law_gives_way_to_its_special_case_beside_a_later_effect() -> None:
    """Alone, the general law takes up some of the drag that is missing as well; beside the drag it need not."""
    records = linear_records(19, {"linear_spring": 0.5, "quadratic_drag": 0.8})
    mixed(records, "cubic_spring", linear_spring=1.0, quadratic_drag=0.8, cubic_spring=0.02)
    form = LinearForm(records)
    nominal = form.fit((), [], None)
    general = Placed(replace(placed("cubic_spring").effect, nests=("linear_spring",)), "theta")
    others = [one for one in ALL if one.effect.name != "cubic_spring"]
    outcome = search(form, nominal, [*others, general])
    first = max(outcome.rounds[0].candidates, key=total)
    assert first.added == (general,), "the first answer"
    assert accepted(outcome) == {"linear_spring", "quadratic_drag"}
    assert {one.effect.name for one in outcome.model.effects} == accepted(outcome)


@pytest.mark.parametrize(("more", "answer"), [(0.3, "linear_spring"), (0.8, "cubic_spring")])
def test_what_a_general_law_adds_is_asked_the_share_of_a_further_effect(more: float, answer: str) -> None:
    """Both are sure of it, by 90 and by 640 in log-likelihood: 1 and 7 % of what is missing."""
    records = linear_records(23, {"linear_spring": 3.0, "cubic_spring": more})
    mixed(records, "cubic_spring", linear_spring=1.0, cubic_spring=more / 3.0)
    form = LinearForm(records)
    general = Placed(replace(placed("cubic_spring").effect, nests=("linear_spring",)), "theta")
    outcome = search(form, form.fit((), [], None), [placed("linear_spring"), general])
    assert accepted(outcome) == {answer}
    assert "cubic_spring" in tie_of(outcome, answer), "the likelier law is shown"


@pytest.mark.parametrize("exchanged", [False, True])
def test_the_last_law_gives_way_to_its_special_case_where_an_earlier_one_was_exchanged(exchanged: bool) -> None:
    """Beside a cyclic error a spring crept; beside the bent scale that took its place it did not."""
    records = linear_records(19, {"linear_spring": 0.5, "quadratic_drag": 0.8})
    mixed(records, "cubic_spring", linear_spring=1.0, cubic_spring=0.02)
    form = LinearForm(records)
    nominal = form.fit((), [], None)
    drag, spring = placed("quadratic_drag"), placed("linear_spring")
    general = Placed(replace(placed("cubic_spring").effect, nests=("linear_spring",)), "theta")
    beside = frozenset({str(placed("force_bias") if exchanged else drag)})
    made = Accepted(drag, ((drag,),), 1, 1), Accepted(general, ((general,),), 1, 1, beside)
    rows = (judged(form, [spring], form.fit([spring], [], nominal), nominal, nominal),)
    table = table_of(form, nominal, Round(nominal, score_test(form, nominal, ALL), rows))
    found = climbed(table, Answer(form.fit([drag, general], [], nominal), made), specialise, simpler=True)
    assert accepted(found) == {"quadratic_drag", "linear_spring" if exchanged else "cubic_spring"}


def test_a_rival_that_begins_far_off_beside_a_later_effect_goes_on_while_its_steps_may_lead_to_a_tie() -> None:
    """A level of friction that was fitted without the spring costs hundreds beside it, of which a step gains most."""

    class Form(LinearForm):
        def begin(self, effects: Any, starts: Any, base: Fit | None, hope: float = -np.inf) -> Begun:
            begun = super().begin(effects, starts, base, hope)
            again = placed("cubic_spring") in effects and len(effects) > 1
            return replace(begun, log_likelihood=begun.log_likelihood - 140.0) if again and hope == -np.inf else begun

    hidden = {"linear_spring": 0.4, "quadratic_drag": 0.3}
    form = Form(linear_records(18, hidden, alike={"cubic_spring": "linear_spring"}))
    outcome = search(form, form.fit((), [], None), ALL)
    assert tie_of(outcome, "linear_spring") == {"linear_spring", "cubic_spring"}


def test_what_stays_tied_beside_a_later_effect_is_told() -> None:
    hidden = {"linear_spring": 0.4, "quadratic_drag": 0.3}
    outcome = found_in(hidden, 18, alike={"cubic_spring": "linear_spring"})
    assert len(outcome.accepted) == 2
    assert tie_of(outcome, "linear_spring") == {"linear_spring", "cubic_spring"}
    assert tie_of(outcome, "quadratic_drag") == {"quadratic_drag"}


@pytest.mark.parametrize("hidden", [0.0, 0.3])
def test_what_an_error_that_remembers_explains_as_well_is_not_missing(hidden: float) -> None:
    """Of free runs, which err for long: a slow force over some axis follows such an error by chance, in both uses."""
    records = linear_records(8, {"cubic_spring": hidden})
    for number, use in enumerate(USES):
        error = np.random.default_rng([9, number]).standard_normal(1000)
        for k in range(1, 1000):
            error[k] += 0.98 * error[k - 1]
        records.y[use] = records.y[use] + error
        slow = np.convolve(error, np.ones(401) / 401, "same")
        records.x[use]["force_bias"] = slow + 0.2 * records.x[use]["force_bias"]
    form = LinearForm(records)
    plain = form.fit((), [], None)
    a, b = (plain.values[name] for name in "ab")
    errors = {use: records.y[use] - a * own["a"] - b * own["b"] for use, own in records.x.items()}
    pairs = {use: [(error[:, None], np.ones((1000, 1)))] for use, error in errors.items()}
    found = left_over(form, replace(plain, innovations=pairs, free_run=True))
    assert found.best is not None, "it is doubt enough to call an effect a stand-in"
    missing = None if found.missing is None else found.missing.name
    assert missing == ("theta over cubic_spring" if hidden else None)
    beside_force = left_over(form, plain)
    assert beside_force.missing is beside_force.best is not None, "a force that nobody measured remembers for itself"
