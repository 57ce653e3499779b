"""Figures of ``report.json`` from made-up fits: what a reader takes for the truth."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from harness.diagnosis.forms.apart import Apart
from harness.diagnosis.policy import POLICY
from harness.diagnosis.report import candidates, evidence_json
from harness.diagnosis.report.estimates import effect_data
from harness.diagnosis.report.html import environment
from harness.diagnosis.search.compare import FitComparison, Judged
from harness.diagnosis.search.fit import Jump
from harness.diagnosis.search.refusal import Kind, Refusal
from harness.diagnosis.search.table import Accepted
from harness.effects import builtin
from harness.effects.effect import Placed

DRAG = Placed(builtin()["quadratic_drag"], "theta")


def a_fit(**more: Any) -> Any:
    """Return a fit with one effect; its interval is 0.4 to 0.6."""
    name = DRAG.main()
    fields = {
        "values": {name: 0.5},
        "free": (name,),
        "deviations": {name: 0.05},
        "interval": lambda name: (0.4, 0.6),
        "system": SimpleNamespace(parameter=lambda name: SimpleNamespace(unit="N m s^2/rad^2")),
        "converged": True,
        "on_bound": (),
        "logarithmic": frozenset(),
    }
    return SimpleNamespace(**{**fields, **more})


def test_an_effect_shows_its_size_its_interval_and_twice_its_evidence() -> None:
    shown = effect_data(a_fit(), Accepted(DRAG, (), 50.0, 20.0, part_of="theta over u"))
    assert (shown["name"], shown["at"]) == ("quadratic_drag", "theta")
    assert (shown["evidence"], shown["delta_bic"], shown["validation_gain"]) == (50.0, 100.0, 20.0)
    size = shown["parameters"]["c"]
    assert (size["value"], size["low"], size["high"], size["unit"]) == (0.5, 0.4, 0.6, "N m s^2/rad^2")
    assert shown["may_be_part_of"] == "a force at theta over u"


def test_what_is_not_known_is_null() -> None:
    fixed = effect_data(a_fit(free=()), Accepted(DRAG, (), float("nan"), 1.0))
    assert fixed["evidence"] is None
    assert fixed["may_be_part_of"] == ""
    assert fixed["parameters"]["c"]["low"] is None


def test_a_candidate_shows_why_it_was_rejected_or_what_it_ties_with() -> None:
    comparison = FitComparison(30.0, 10.0, 4.0, 8.0)
    passed = Judged((DRAG,), a_fit(), comparison, ())
    rejected = Judged((DRAG,), a_fit(), comparison, (Refusal(Kind.UNCONVERGED),))
    row = candidates._row(passed, 1, {passed.name}, set())
    assert (row["accepted"], row["reason"]) == (True, "")
    assert (row["evidence"], row["validation_gain"], row["validation_error"]) == (30.0, 10.0, 4.0)
    assert row["main"] == {DRAG.main(): [0.5, 0.4, 0.6]}
    assert candidates._row(passed, 1, set(), {passed.name})["reason"] == "tied with the answer"
    assert candidates._row(passed, 1, set(), set())["reason"] == "another candidate explains more"
    row = candidates._row(rejected, 1, {rejected.name}, set())
    assert (row["accepted"], row["reason"]) == (False, "its fit did not converge")


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"interval": lambda name: (0.0, float("inf")), "deviations": {DRAG.main(): float("inf")}}, "not determined"),
        ({"interval": lambda name: (1e-9, 1e9), "logarithmic": frozenset({DRAG.main()})}, "far too wide"),
        ({"interval": lambda name: (0.5, 0.5), "deviations": {DRAG.main(): 0.0}}, "of no width"),
    ],
)  # fmt: skip
def test_a_candidate_has_limits_where_a_parameter_has(more: dict[str, Any], words: str) -> None:
    """The table of candidates said 1e-9 to 1e9, or 0 to null, where the answer said null and null."""
    judged = Judged((DRAG,), a_fit(**more), None, (Refusal(Kind.NOT_SIMULATED),))
    row = candidates._row(judged, 1, set(), set())
    assert row["main"] == {DRAG.main(): [0.5, None, None]}, words
    answer = effect_data(a_fit(**more), Accepted(DRAG, (), 1.0, 1.0))
    assert [answer["parameters"]["c"][key] for key in ("low", "high")] == [None, None]


def test_what_no_score_test_sees_stands_among_the_candidates_where_it_was_begun_and_left() -> None:
    """A hidden resonance that was left after its first steps stood nowhere: one could not tell that it was tried."""
    lead = SimpleNamespace(placed=DRAG, gain=12.5, share=1.0)
    step = SimpleNamespace(
        candidates=[], test=SimpleNamespace(leads=[lead], hidden=[]), left=frozenset({str(DRAG), "elasticity@theta"})
    )
    found = SimpleNamespace(
        outcome=SimpleNamespace(rounds=[step], accepted=[]), policy=POLICY, misfit=("no",), nominal=None, untried=(),
        runs=SimpleNamespace(before=None),
    )  # fmt: skip
    seen, hidden = candidates.candidate_rows(found, ())
    assert [(row["name"], row["at"], row["promise"]) for row in (seen, hidden)] == [
        ("quadratic_drag", "theta", 12.5), ("elasticity", "theta", None),
    ]  # fmt: skip
    assert seen["reason"] == hidden["reason"] == "the first steps of its refit gained too little"
    assert environment().from_string("{{ row.promise|number }}").render(row=hidden) == "–"


def data(verdict: str, **more: Any) -> dict[str, Any]:
    """Return what the summary is made from."""
    errors = {
        when: {"simulation_error": {"validation": {"theta": {"rms": rms, "unit": "rad"}}}}
        for when, rms in (("before", 0.1), ("after", 0.002))
    }
    effect = {"name": "quadratic_drag", "at": "theta", "may_be_part_of": "", "rounds": False}
    return {
        "verdict": verdict, "model": "pendulum", "misfit": ["the sign is wrong"], "errors": errors,
        "explained_share": 0.99996, "effects": [effect], "tie_sets": [[effect]],
        "stand_in": {"flagged": False, "reasons": []}, "left_over": [], "withdrawn": [], "noise": forces(1e-5), **more,
    }  # fmt: skip


SPRING = {"name": "cubic_spring", "at": "theta", "may_be_part_of": "", "rounds": False}
PART = {"name": "quadratic_drag", "at": "theta", "may_be_part_of": "a force at theta over u", "rounds": False}
ROUNDING = {"name": "sensor_quantisation", "at": "theta", "parameters": {"step": {"value": 1.534e-3, "unit": "rad"}},
            "may_be_part_of": "", "rounds": True}  # fmt: skip


def forces(share: float) -> dict[str, Any]:
    """Return the noise of a report: a force of 0.05 N m, which is this share of what moves the coordinate."""
    force = {"s": 0.03, "w": 0.04, "tau_s": 4.0, "unit": "N m", "share": share, "at_least": False}
    return {"after": {"sensors": {}, "forces": {"theta": force}}}


@pytest.mark.parametrize(
    ("verdict", "more", "words"),
    [
        ("effects_found", {}, "pendulum lacks quadratic drag at theta; validation simulation error theta 0.1 -> 0.002"),
        (
            "effects_found",
            {"tie_sets": [[{"name": name, "at": "theta"} for name in ("quadratic_drag", "cubic_drag", "thrust")]]},
            "pendulum lacks quadratic drag or cubic drag or thrust at theta (these data cannot tell which); validation",
        ),
        (
            "effects_found",
            {"stand_in": {"flagged": True, "reasons": ["two laws"]}},
            "stands in for something that pendulum lacks and the dictionary does not have (two laws), and leaves a "
            "force of 0.001 % of what moves theta; validation",
        ),
        (
            "effects_found",
            {
                "effects": [SPRING, PART],
                "tie_sets": [[SPRING], [PART]],
                "stand_in": {"flagged": True, "reasons": ["a force is left"]},
            },
            "cubic spring at theta stands in for something that pendulum lacks and the dictionary does not have (a "
            "force is left; quadratic drag at theta may be a part of what is left), and leaves a force of 0.001 %",
        ),
        (
            "effects_found",
            {"effects": [ROUNDING], "noise": forces(0.054)},
            "nothing is missing in pendulum apart from an unmeasured force at theta (0.05 N m, 5.4 % of what "
            "moves it), except that theta is read in steps of 0.00153 rad; validation simulation error theta 0.1 -> 0",
        ),
        ("nothing_missing", {}, "nothing is missing in pendulum: validation simulation error theta 0.1 rad"),
        (
            "nothing_missing",
            {"noise": forces(0.054)},
            "apart from an unmeasured force at theta (0.05 N m, 5.4 % of what moves it): validation",
        ),
        ("unexplained", {}, "no effect of the dictionary explains it: gremlins would (theta 0.1 rad; "),
        (
            "unexplained",
            {"recorded": {"theta": {"unit": "rad", "recorded": "deg"}}},
            "gremlins would (theta 5.73 deg; ",
        ),
        ("model_does_not_fit", {}, "pendulum does not fit these data: the sign is wrong"),
    ],
)
def test_the_summary_says_the_verdict_and_rounds_nothing_up(verdict: str, more: dict[str, Any], words: str) -> None:
    text = evidence_json._summary(data(verdict, **more), POLICY.least, "gremlins would")
    assert words in text
    assert "100 %" not in text
    if verdict != "model_does_not_fit":
        assert "99.99 % of the validation motion" in text


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (
            {"best": "theta over theta_rate", "rival": (60.0, 1.0)},
            "a free force at theta over theta_rate predicts what is left",
        ),
        (
            {"withdrawn": True, "rival": (60.0, 1.0)},
            "the likeliest answer, quadratic drag at theta, does not bring free",
        ),
        (
            {"rival": (60.0, 1.0)},
            "quadratic drag at theta would bring 60 in log-likelihood on the estimation records, but the validation "
            "records show nothing of it; excite it in both",
        ),
        ({"rival": (60.0, 40.0)}, "60 in log-likelihood on the estimation records, but its fit did not converge"),
        ({"beaten": "elastic_load@q"}, "elastic load at q alone helps free runs more, but is not accepted"),
        ({"disagree": True}, "the validation records want other parameters"),
        ({"disagree": True, "alone": "estimation record 2 of 3"}, "estimation record 2 of 3 wants other parameters"),
        (
            {"jumps": (("estimation", 8.0), ("validation", 12.0))},
            "jumps at 8 s of the estimation records and at 12 s of the validation records: something happens there",
        ),
        ({"further": 6.84}, "the error of free runs is 6.8 times as large on the validation records as on"),
        ({}, "the unmeasured force is too large for a disturbance"),
        ({"runs_leave": 0.64}, "free runs leave 80 % of what a straight line leaves"),
        ({"lasting": 0.4}, "a lasting error of free runs (of theta, 40 % of its motion) is left"),
    ],
)
def test_what_is_missing_without_a_name_is_told_by_what_speaks_for_it(more: dict[str, Any], words: str) -> None:
    gain = more.get("rival")
    row = (
        None if gain is None else Judged((DRAG,), a_fit(), FitComparison(*gain, 4.0, 8.0), (Refusal(Kind.UNCONVERGED),))
    )
    found = SimpleNamespace(
        left=SimpleNamespace(name=more["best"]) if "best" in more else None,
        promised=row,
        outcome=SimpleNamespace(
            withdrawn=[SimpleNamespace(placed=DRAG)] if "withdrawn" in more else [],
        ),
        policy=POLICY,
        rival=more.get("beaten", ""),
        disagree=more.get("disagree", False),
        apart=Apart(60.0, [np.full(1000, 0.06)], "J", 0.05, more.get("alone", "")),
        shaken="jumps" in more,
        jumps=tuple(Jump("theta", use, 0, time, 20.0, 0.2) for use, time in more.get("jumps", ())),
        astray="further" in more,
        runs=SimpleNamespace(further=more.get("further"), worst=0, left=more.get("runs_leave", 0.1)),
        form=SimpleNamespace(latent="lasting" not in more),
        lasting=more.get("lasting"),
        dataset=SimpleNamespace(spec=SimpleNamespace(outputs=(SimpleNamespace(name="theta"),))),
    )
    assert words in evidence_json._cause(found)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (None, "hardly changed"),
        (1.0, "hardly changed"),
        (1.04, "hardly changed"),
        (0.97, "hardly changed"),
        (21.8, "21.8 times smaller"),
        (1.1, "1.1 times smaller"),
        (0.6326, "1.58 times larger"),
        (0.05, "20 times larger"),
    ],
)
def test_a_card_says_what_the_error_did_also_where_it_grew(factor: float | None, words: str) -> None:
    text = environment().from_string("{{ factor|change }}").render(factor=factor)
    assert text == words
