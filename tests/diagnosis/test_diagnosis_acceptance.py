"""What is accepted: evidence, validation and its error, intervals, and what physics forbids, from made-up densities."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from linear_form import placed
from made_fits import FORM, NoForm, a_fit

from harness.diagnosis.policy import POLICY
from harness.diagnosis.search.compare import compared, difference, impossible, judged, wrong_signs
from harness.diagnosis.search.fit import Fit
from harness.diagnosis.search.refusal import Kind, Refusal
from harness.diagnosis.search.ties import undecided
from harness.effects import builtin
from harness.effects.effect import Placed
from harness.signals import FloatArray

# ---- evidence and intervals ------------------------------------------------------------------------------------------


def test_the_penalty_is_that_of_bic() -> None:
    fit = a_fit(count=7)
    assert fit.penalised == pytest.approx(-400 - 3.5 * np.log(400))
    assert fit.log_likelihood("validation") == pytest.approx(-400)
    longer = a_fit((np.zeros(400), np.zeros(900)), count=7)
    assert longer.samples == 400
    assert longer.penalised == pytest.approx(fit.penalised), "the validation records have no part in it"


def test_an_interval_is_that_of_the_normal_law_and_of_the_logarithm_where_that_was_fitted() -> None:
    fit = a_fit()
    assert fit.interval("a") == pytest.approx((1 - 0.196, 1 + 0.196))
    fit = a_fit(logarithmic=frozenset({"a"}))
    assert fit.interval("a") == pytest.approx((np.exp(-0.196), np.exp(0.196)))


def test_evidence_is_of_the_estimation_and_validation_of_the_validation_records() -> None:
    gains = np.linspace(0.0, 0.2, 400), np.full(400, 0.01)
    found = compared(a_fit(gains, count=4), a_fit())
    assert found.evidence == pytest.approx(gains[0].sum() - 0.5 * np.log(400))
    assert found.validation == pytest.approx(4.0)
    assert found.error == pytest.approx(0.0, abs=1e-9)
    assert found.total == pytest.approx(found.evidence + 4.0)


def test_the_error_of_a_gain_is_that_of_a_sum_over_blocks() -> None:
    rng = np.random.default_rng(0)
    slow = np.repeat(rng.standard_normal(20), 20)  # constant within a block: samples are not independent
    gain, error = difference(a_fit((slow, slow)), a_fit(), ("validation",))
    blocks = slow.reshape(20, 20).sum(axis=1)
    assert gain == pytest.approx(blocks.sum())
    assert error == pytest.approx(np.sqrt(20) * blocks.std(ddof=1))
    both, wider = difference(a_fit((slow, slow)), a_fit(), ("estimation", "validation"))
    assert both == pytest.approx(2 * gain)
    assert wider == pytest.approx(np.sqrt(40) * np.tile(blocks, 2).std(ddof=1))


def predicting(e: FloatArray, s: float = 1.0) -> Fit:
    """Return a fit with these innovations on the validation records."""
    innovations = {use: [(e[:, None], np.full((len(e), 1), s))] for use in ("estimation", "validation")}
    terms = -0.5 * (e**2 / s + np.log(2 * np.pi * s))
    return a_fit(terms={use: [terms] for use in innovations}, innovations=innovations)


def test_what_an_effect_does_in_one_place_only_is_no_error_of_its_gain() -> None:
    """An end stop that is touched once: over many records its gain scatters by as much as the error says."""
    missing = np.zeros(4000)
    missing[1810:1860] = 1.0  # of one block of twenty
    gains, errors = [], []
    for seed in range(300):
        e = np.random.default_rng(seed).standard_normal(4000)
        gain, error = difference(predicting(e), predicting(e + missing), ("validation",))
        gains.append(gain)
        errors.append(error)
    assert np.mean(gains) == pytest.approx(25.0, abs=2.0)  # half of what is missing, squared
    assert np.std(gains) == pytest.approx(np.sqrt(50.0), rel=0.15)
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(np.sqrt(50.0), rel=0.15)


def test_a_first_sample_that_one_fit_holds_for_exact_decides_nothing() -> None:
    """Its initial state is fitted to it: a sensor without noise gives that one reading a variance of nothing."""
    rng = np.random.default_rng(0)
    e, missing = rng.standard_normal(4000), 0.2 * np.sin(np.arange(4000) / 50.0)
    _, usual = difference(predicting(e), predicting(e + missing), ("validation",))
    exact = predicting(e + missing)
    exact.innovations["validation"][0][1][0] = 1e-16
    _, error = difference(predicting(e), exact, ("validation",))
    assert error == pytest.approx(usual, rel=0.05)


def test_innovations_that_are_coloured_widen_the_error() -> None:
    """They stay for a quarter of a block, and the model holds them for white: its gain is a matter of luck."""
    rng = np.random.default_rng(1)
    change = 0.1 * np.sin(np.arange(4000) / 300.0)
    errors = []
    for e in (rng.standard_normal(4000), np.repeat(rng.standard_normal(80), 50)):
        errors.append(difference(predicting(e), predicting(e + change), ("validation",))[1])
    assert errors[1] > 4.0 * errors[0]


@pytest.mark.parametrize(
    ("gap", "distance", "rival"), [(1.0, 1e-5, False), (-1.0, 1e-5, True), (1.0, 1e-2, True), (50.0, 1e-2, False)]
)
def test_a_general_law_is_a_rival_where_it_is_another_model_or_pays_for_its_parameter(
    gap: float, distance: float, rival: bool
) -> None:
    simple, general = placed("coulomb_friction"), placed("stribeck_friction")
    answer = a_fit(effects=[simple])
    form: Any = NoForm(distance=distance)
    assert undecided(form, answer, simple, a_fit(effects=[general]), [general], gap) is rival


# ---- what is accepted ------------------------------------------------------------------------------------------------


def verdict(
    estimation: float, validation: FloatArray, *, name: str = "quadratic_drag", form: Any = FORM, **more: object
) -> dict[Kind, tuple[float, ...]]:
    """Return the refusals of a candidate with one parameter more, with their numbers."""
    one = placed(name)
    evidence = estimation + 0.5 * np.log(400)
    fit = a_fit((np.full(400, evidence / 400), validation), [one], count=4, **more)
    base = a_fit()
    return {refusal.kind: refusal.numbers for refusal in judged(form, [one], fit, base, base).refusals}


GAIN = np.full(400, 0.05)


def test_what_passes_has_evidence_and_gains_on_validation() -> None:
    assert verdict(5.1, GAIN / 4) == {}
    assert verdict(4.9, GAIN / 4)[Kind.EVIDENCE] == pytest.approx((4.9, 5.0, 10.0))
    assert Kind.VALIDATION in verdict(50.0, -GAIN)


def test_both_uses_together_are_the_evidence() -> None:
    """118 on the validation records are no less than 59 on each: 4 where 5 were asked was a damping not named."""
    assert verdict(4.0, GAIN) == {}
    assert verdict(7.9, GAIN / 10)[Kind.EVIDENCE][-1] == pytest.approx(10.0)
    assert verdict(8.1, GAIN / 10) == {}
    assert verdict(0.1, GAIN) == {}
    assert verdict(-0.1, GAIN) == {Kind.ESTIMATION: pytest.approx((-0.1, 0.0))}


def test_an_effect_that_nobody_would_miss_is_not_named_however_sure_it_is() -> None:
    faint = verdict(500.0, GAIN, form=NoForm(change=0.9 * POLICY.least))
    assert faint == {Kind.SIZE: pytest.approx((0.9 * POLICY.least, POLICY.least))}
    assert verdict(500.0, GAIN, form=NoForm(change=1.1 * POLICY.least)) == {}


def test_a_line_that_wanders_is_no_periodic_force() -> None:
    def reasons(*evidence: float) -> tuple[Refusal, ...]:
        one = placed("periodic_disturbance")
        values = {"a": 1.0, **dict.fromkeys(map(one.name, one.effect.parameter_names), 1.0)}
        fit = a_fit((np.full(400, 1.0), GAIN), [one], values=values, line_rivals={str(one): evidence})
        return judged(FORM, [one], fit, a_fit(), a_fit()).refusals

    assert reasons(-0.1, -0.1) == ()
    assert reasons(0.1, -0.1) == (Refusal(Kind.INCOHERENT, "periodic_disturbance@theta", (0.1,)),)
    assert reasons(-0.1, 0.1) == (Refusal(Kind.ANSWERING, "periodic_disturbance@theta", (0.1,)),)


def with_errors(share: float, uses: int) -> FloatArray:
    """Return a gain of one use (400,) whose sum over so many such uses is this many of its standard errors."""
    blocks = np.random.default_rng(1).standard_normal(20)
    blocks -= blocks.mean()
    every = np.tile(blocks, uses)
    return np.repeat(blocks + share * every.std(ddof=1) / np.sqrt(len(every)), 20)


def test_a_validation_gain_within_its_error_is_chance() -> None:
    for share, passes in ((0.9, False), (1.1, True)):
        assert (verdict(9e3, with_errors(POLICY.alone_z * share, 1)) == {}) is passes


def test_a_gain_of_both_uses_within_its_errors_is_chance() -> None:
    uneven = 5.0 * np.random.default_rng(1).standard_normal(20)
    uneven -= uneven.mean()
    error = np.sqrt(40) * np.concatenate([uneven, np.zeros(20)]).std(ddof=1)
    for share, passes in ((0.9, False), (1.1, True)):
        every = share * POLICY.gain_z * error / 40  # of each block of either use, without what makes it uneven
        even = np.full(400, every / 20)
        gain = even + np.repeat(uneven, 20) / 20
        one, penalty = placed("quadratic_drag"), 0.5 * np.log(400) / 400
        fit = a_fit((gain + penalty, even), [one], count=4)
        found = compared(fit, a_fit())
        assert found.validation > POLICY.alone_z * found.error
        assert found.total > 2 * POLICY.evidence
        assert judged(FORM, [one], fit, a_fit(), a_fit()).passed is passes


def test_what_did_not_converge_or_cannot_be_is_rejected() -> None:
    assert Kind.UNCONVERGED in verdict(50.0, GAIN, converged=False)
    one = placed("quadratic_drag")
    values = {"a": 1.0, one.main(): -0.5}
    assert Kind.SIGN in verdict(50.0, GAIN, values=values)
    assert [one.kind for one in judged(FORM, [one], None, a_fit(), a_fit()).refusals] == [Kind.NOT_SIMULATED]
    dear: Any = NoForm(untried=[str(one)])
    assert [one.kind for one in judged(dear, [one], None, a_fit(), a_fit()).refusals] == [Kind.COST]


def test_a_sign_is_asked_of_what_the_law_is_about_and_the_data_tell() -> None:
    """Of the width that rounds a friction, or of a value that was held, no sign says anything."""
    for name, sign, refused in (("Fc", "+", True), ("w", "+", False), ("Fc", "-", False), ("Fc", "any", False)):
        law = placed("coulomb_friction").effect
        parts = [replace(one, sign=sign) if one.name == name else one for one in law.parameters]
        for fixed in (False, True):
            held = [replace(one, fixed=fixed or one.fixed) for one in parts]
            one = Placed(replace(law, parameters=tuple(held)), "theta")
            values = {one.name("Fc"): 0.5, one.name("w"): 0.5} | {one.name(name): -0.5}
            found = [(refusal.kind, refusal.subject) for refusal in wrong_signs(one, values)]
            assert found == [(Kind.SIGN, name)] * (refused and not fixed)
            assert wrong_signs(one, dict.fromkeys(values, 0.0)) == [], "nothing has no sign"


def test_a_value_on_its_bound_is_no_estimate() -> None:
    drag = builtin()["quadratic_drag"]
    parameter = replace(drag.parameters[0], maximum=0.5)
    bounded = Placed(replace(drag, parameters=(parameter,)), "theta")
    assert impossible(FORM, bounded, a_fit(effects=[bounded]))[0].kind is Kind.BOUND
    for maximum, lies_on_it in ((0.6, False), (0.50007, False), (0.50004, True)):  # within a ten-thousandth
        near = Placed(replace(drag, parameters=(replace(parameter, maximum=maximum),)), "theta")
        assert [one.kind for one in impossible(FORM, near, a_fit(effects=[near]))] == [Kind.BOUND] * lies_on_it


def test_a_value_is_told_where_only_the_nominal_scale_is_not() -> None:
    one = placed("quadratic_drag")
    wide = {"a": 0.1, one.main(): 0.9}
    (reason,) = impossible(FORM, one, a_fit(effects=[one], deviations=wide))
    assert reason.kind is Kind.UNDETERMINED
    assert impossible(FORM, one, a_fit(effects=[one], deviations=wide, beside={one.main(): 0.1})) == []


@pytest.mark.parametrize(
    ("before", "after", "size", "traded"),
    [(0.1, 2.0, 0.9, True), (0.1, 0.1, 0.9, False), (2.0, 2.0, 0.9, False), (0.1, 2.0, 0.1, False)],
)
def test_an_effect_beside_which_a_parameter_is_told_no_more_only_trades_with_it(
    before: float, after: float, size: float, traded: bool
) -> None:
    """Deviations of a parameter of 1 without and beside an effect of 0.5, and of that effect."""
    one = placed("quadratic_drag")
    base = a_fit(deviations={"a": before})
    fit = a_fit(
        (np.full(400, 1.0), GAIN), [one], count=4, deviations={"a": after, one.main(): size}, beside={one.main(): 0.1}
    )
    refusals = judged(FORM, [one], fit, base, base).refusals
    assert [refusal.subject for refusal in refusals if refusal.kind is Kind.TRADED] == ["a"] * traded
    held = replace(fit, free=("a",))
    assert Kind.TRADED not in {refusal.kind for refusal in judged(FORM, [one], held, base, base).refusals}


def test_stribeck_friction_that_rises_with_speed_is_against_its_own_law() -> None:
    one = placed("stribeck_friction")
    values = {"a": 1.0, **{one.name(name): 0.5 for name in one.effect.parameter_names}}
    values[one.name("w")] = 0.01
    low, high = {one.name("Fs"): 0.1}, {one.name("Fs"): 0.9}  # Fc is 0.5
    kinds = {refusal.kind for refusal in impossible(FORM, one, a_fit(effects=[one], values=values | low))}
    assert Kind.LAW in kinds
    assert impossible(FORM, one, a_fit(effects=[one], values=values | high)) == []


def test_what_the_data_could_just_show_is_no_estimate() -> None:
    """Bristles that slip within a sample are dry friction; a damping on its ceiling is a rigid joint."""
    one = placed("lugre_coulomb_friction")
    shortest = one.name("xs")
    assert impossible(FORM, one, a_fit(effects=[one])) == []
    (reason,) = impossible(FORM, one, a_fit(effects=[one], on_bound=(shortest,)))
    assert (reason.kind, reason.subject, *reason.numbers) == (Kind.BOUND, "xs", 0.5)
    assert impossible(FORM, one, a_fit(effects=[one], on_bound=(one.name("tau"),))) == [], "a nuisance"


def test_a_second_effect_that_changes_next_to_nothing_is_left_out() -> None:
    one = placed("quadratic_drag")
    nominal = a_fit()
    first = a_fit((np.full(400, 1.0), np.full(400, 1.0)), count=4)
    for more, passes in ((0.015, False), (0.06, True)):
        gain = np.full(400, 1.0 + more)
        second = judged(FORM, [one], a_fit((gain + 0.02, gain), [one], count=5), first, nominal)
        assert (Kind.SHARE not in {refusal.kind for refusal in second.refusals}) is passes


def test_what_brings_less_than_nothing_is_told_no_share() -> None:
    """A negative part of a negative whole was "119 % of what all effects bring: it changes nothing"."""
    one, gain = placed("quadratic_drag"), np.full(400, 0.5)
    for first in (a_fit((gain, gain), count=4), a_fit((-gain, -gain), count=4)):
        second = judged(FORM, [one], a_fit((first.terms["estimation"][0] - 0.1, gain), [one], count=5), first, a_fit())
        assert not second.passed
        assert Kind.SHARE not in {refusal.kind for refusal in second.refusals}


def test_what_the_first_effect_brings_where_none_was_fitted_makes_no_second_one_small() -> None:
    """A delay brought 360 where it was fitted and 7200 on a record of another load; friction beside it brought 93."""
    one, gain = placed("quadratic_drag"), np.full(400, 0.5)
    first = a_fit((gain, 20 * gain), count=4)
    second = judged(FORM, [one], a_fit((gain + 0.1, 20 * gain + 0.1), [one], count=5), first, a_fit())
    assert second.passed
