"""What the page says first, what it leaves out, and the digits of its figures: rendered from made-up reports."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from harness.diagnosis import close_loop
from harness.diagnosis.arm.page import _cards, render_arm
from harness.diagnosis.arm.report import _summary
from harness.diagnosis.effort import EFFORT
from harness.diagnosis.forms.fit_records import LikelihoodDetail
from harness.diagnosis.policy import POLICY
from harness.diagnosis.report.estimates import estimate, ratios, scaled_together
from harness.diagnosis.report.evidence_page import _driven, render_evidence
from harness.diagnosis.report.figures import Overlay, Pictures, ResidualView, draw
from harness.diagnosis.report.html import environment, error_rows
from harness.diagnosis.report.keys import blank, numbers
from harness.diagnosis.report.words import shown
from harness.effects import builtin
from harness.physics import load_model
from harness.schemas import report_schema
from harness.signals import Channel, PlantSpec

EFFECT = {
    "name": "input_compression", "at": "u", "may_be_part_of": "", "given": False, "rounds": False, "formula": "F",
    "summary": "A drive that tires.",
    "parameters": {"c": {"value": 0.6, "low": 0.58, "high": 0.62, "unit": "1/N", "state": "determined",
                         "meaning": "share"}},
}  # fmt: skip


def report(verdict: str, before: float = 0.1, after: float = 0.002, **more: Any) -> dict[str, Any]:
    """Return the content of a report of a pendulum."""
    data = {**blank(), "dataset": "run", "model": "pendulum", "verdict": verdict, "summary": "theta 0.1 -> 0.002 rad",
            "policy": numbers(POLICY), "form": "maximum likelihood", "explained_share": 0.9957}  # fmt: skip
    data["converged"] = {"nominal": True, "final": True}
    for when, rms in (("before", before), ("after", after)):
        score = {"theta": {"rms": rms, "nrmse": rms, "unit": "rad"}}
        data["errors"][when] = {
            "equation_error": {"meaning": "one step"},
            "simulation_error": {"validation": score, "whole_record": True, "horizon_s": None,
                                 "initial_state": "estimated", "other_horizons": []},
        }  # fmt: skip
        data["parameters"][when] = {"J": {"value": 50.0012, "low": 49.9971, "high": 50.0053, "unit": "kg m^2",
                                          "state": "determined"}}  # fmt: skip
    if verdict == "effects_found":
        data |= {"effects": [EFFECT], "tie_sets": [[EFFECT]], "separating_experiments": [[]], "separate_with": [[]]}
    return data | more


def text_of(page: str) -> str:
    """Return the words of a page."""
    return " ".join(re.sub(r"<[^>]+>", " ", re.sub(r"<style>.*?</style>", "", page, flags=re.S)).split())


def test_a_model_that_does_not_fit_gets_no_praise_and_says_first_what_to_check() -> None:
    misfit = ["a force would have to be 3000 % of what moves q", "check the sign of u: that repairs it"]
    page = render_evidence(report("model_does_not_fit", misfit=misfit, searched=[EFFECT]), {})
    words = text_of(page)
    assert words.index("Why the model does not fit") < words.index("What to check") < words.index("Errors")
    assert words.index("What to check") < words.index("Check the sign of u")
    for praise in ('class="tile"', "input compression", "99.57", "times smaller", "No other effect", "stand-in</span>"):
        assert praise not in page, praise
    assert "99.57 %" in render_evidence(report("effects_found"), {})


def test_the_size_of_the_unknown_force_counts_its_white_part_as_its_share_does() -> None:
    """A force of 2e-7 N m was 0.08 % of what moves the joint, as 2e-4 N m of it was white and not told."""

    def noise(white: float) -> dict[str, Any]:
        force = {"s": 0.03, "tau_s": 0.2, "w": white, "share": 0.05, "unit": "N m", "at_least": False}
        return {"sensors": {"theta": {"r": 1e-3, "unit": "rad"}}, "forces": {"theta": force}}

    found = report("effects_found", noise={"before": noise(0.4), "after": noise(0.04)})
    words = text_of(render_evidence(found, {"residual": "<svg></svg>"})).replace("&nbsp;", " ")
    assert "theta 0.4011 → 0.05 N m (0.03 of it drawn here, fading in 0.2 s, the rest white; 5 % of what" in words


@pytest.mark.slow
def test_a_misfit_is_no_finding_in_a_real_report_either(foreign_pendulum, tmp_path) -> None:
    data = foreign_pendulum(1, command=lambda u: -u, n=600)
    found = close_loop(data, "pendulum", dictionary=[builtin()["input_compression"]], out=tmp_path).data
    assert found["verdict"] == "model_does_not_fit"
    assert set(found) == set(blank()) == set(report_schema()["properties"])
    assert {one["name"] for one in found["searched"]} <= {"input_compression"}
    assert found["effects"] == found["tie_sets"] == found["separate_with"] == []
    assert found["explained_share"] is None
    assert not found["stand_in"]["flagged"]
    assert not any(row["accepted"] for row in found["candidates"])
    for key in ("errors", "parameters", "noise"):
        assert found[key]["before"] == found[key]["after"], key
    assert 'class="tile"' not in (tmp_path / "report.html").read_text()


@pytest.mark.parametrize(
    ("value", "low", "high", "words"),
    [
        (50.0012, 49.9971, 50.0053, ("50.0012", "49.9971 … 50.0053")),
        (0.0499951, 0.0499792, 0.0500111, ("0.049995", "0.049979 … 0.050011")),
        (3.1416, 3.1411, 3.1421, ("3.14160", "3.14110 … 3.14210")),
        (1623.4, 1370.0, 1877.0, ("1620", "1370 … 1880")),
        (0.1, 0.002, 5.0, ("0.100", "0.002 … 5.000")),
        (-0.0001, -0.02, 0.02, ("0.000", "-0.020 … 0.020")),
        (7.5e-7, 7.1e-7, 7.9e-7, ("7.50e-07", "7.10e-07 … 7.90e-07")),
    ],
)
def test_an_interval_has_the_digits_that_it_leaves(value: float, low: float, high: float, words: tuple) -> None:
    found = shown({"value": value, "low": low, "high": high, "state": "determined"})
    assert (found["value"], found["interval"]) == words


def test_a_logarithm_on_its_bound_is_0() -> None:
    assert shown({"value": 1e-12, "low": None, "high": None, "state": "on_bound"}) == {
        "value": "0",
        "interval": "on bound",
    }


def a_fit(deviation: float, **more: Any) -> Any:
    """Return a fit of one positive parameter."""
    ends = {"J": (0.018 * np.exp(-min(1.96 * deviation, 50)), 0.018 * np.exp(min(1.96 * deviation, 50)))}
    fields = {"values": {"J": 0.018}, "free": ("J",), "deviations": {"J": deviation}, "interval": ends.get,
              "logarithmic": frozenset({"J"}), "on_bound": (), "system": SimpleNamespace(
                  parameter=lambda name: SimpleNamespace(unit="kg m^2"))}  # fmt: skip
    return SimpleNamespace(**{**fields, **more})


@pytest.mark.parametrize(
    ("fit", "state"),
    [
        (a_fit(0.1), "determined"),
        (a_fit(5.0), "not_determined"),
        (a_fit(float("inf")), "not_determined"),
        (a_fit(0.0, on_bound=("J",)), "on_bound"),
        (a_fit(0.1, free=()), "fixed"),
    ],
)
def test_what_is_not_determined_has_no_interval(fit: Any, state: str) -> None:
    one = estimate(fit, "J")
    assert one["state"] == state
    assert (one["low"] is None) == (state != "determined")
    assert shown(one)["interval"] == state.replace("_", " ") or state == "determined"
    assert estimate(fit, "J", ["J"])["low"] is None


def test_a_free_swing_tells_ratios_only_and_their_covariance_their_intervals() -> None:
    system = load_model("pendulum")
    runs = [SimpleNamespace(u=np.zeros((100, 1)))]
    swing: Any = SimpleNamespace(estimation=runs)
    pushed: Any = SimpleNamespace(estimation=[SimpleNamespace(u=np.full((100, 1), 0.2))])
    names = ("J", "b", "mgl")
    common = 9.0 * np.ones((3, 3))  # all of them grow together; each has 0.01 of its own
    best = SimpleNamespace(names=list(names), covariance=common + 1e-4 * np.eye(3), logarithmic=[True] * 3,
                           parameters={"J": 0.1, "b": 0.02, "mgl": 1.0})  # fmt: skip
    nothing: Any = None
    kept = LikelihoodDetail({}, nothing, cast(Any, best), nothing)
    fit: Any = SimpleNamespace(system=system, free=names, values=best.parameters, detail=kept)
    together = scaled_together(system, fit, swing)
    assert together == ["J", "b", "mgl"]
    assert scaled_together(system, fit, pushed) == []  # a constant torque is no free swing
    named: Any = SimpleNamespace(
        coordinates=system.coordinates, parameters=[SimpleNamespace(name="x", unit="furlong?")]
    )
    assert scaled_together(named, SimpleNamespace(system=named, free=("x",)), swing) == []  # a unit of somebody's own
    fit.free = ("b", "mgl")
    assert scaled_together(system, fit, swing) == []  # a known inertia fixes the others
    found = ratios(fit, together)
    assert set(found) == {"b/J", "mgl/J"}
    assert found["mgl/J"]["value"] == pytest.approx(10.0)
    assert found["mgl/J"]["unit"] == "1/s^2"
    assert found["mgl/J"]["high"] == pytest.approx(10.0 * np.exp(1.96 * 0.01 * np.sqrt(2)))


def test_the_page_says_above_the_parameters_that_only_ratios_are_known() -> None:
    one = {"value": 20.0, "low": 19.9, "high": 20.1, "unit": "1/s^2", "state": "determined"}
    words = text_of(render_evidence(report("nothing_missing", ratios={"mgl/J": one}), {}))
    assert words.index("ratios of inertia") < words.index("mgl/J") < words.index("parameter value 95 % interval")
    assert "19.90 … 20.10" in words


@pytest.mark.parametrize(("adequacy", "green"), [("explained", True), ("mostly_explained", False)])
def test_nothing_missing_is_green_only_where_the_motion_is_explained(adequacy: str, green: bool) -> None:
    """A force that changes by a step is no effect, and its record is not well explained: no green word beside it."""
    page = render_evidence(report("nothing_missing", adequacy=adequacy), {})
    (badge,) = re.findall(r'<span class="badge (\w+)">nothing missing</span>', page)
    assert badge == adequacy
    colours = dict(re.findall(r"\.(\w+) {{ background: var\(--(\w+)\)".replace("{{", "{"), page))
    assert (colours[badge] == "good") is green


def test_an_error_that_grew_stands_first_and_nothing_that_stayed_is_bold() -> None:
    page = render_evidence(report("effects_found", before=1.0, after=2.0), {})
    assert "2 times larger" in page[page.index('class="tile"') : page.index("</header>") + 2000]
    same = render_evidence(report("effects_found", before=1.0, after=1.0), {})
    assert 'class="n a">1</td>' not in same
    assert 'class="n same">1</td>' in same
    assert [row["changed"] for row in error_rows(report("effects_found", 1.0, 1.01))] == [False]


def test_arrows_do_not_break() -> None:
    page = render_evidence(report("effects_found"), {})
    assert "0.1\u00a0→\u00a00.002 rad" in page
    assert "-&gt;" not in page


def a_view(**more: Any) -> ResidualView:
    """Return a view of a force of 1 N with a smoother's deviation of 0.1 N."""
    x = np.linspace(0, 1, 400)
    fields: dict[str, Any] = {"axis": "x", "unit": "m", "x": x, "before": np.ones(400), "after": None, "fitted": None,
                              "residual_unit": "N", "port": "latent force at x",
                              "bands": (np.full(400, 0.1), None)}  # fmt: skip
    return ResidualView(**{**fields, **more})


def test_every_figure_says_in_words_what_it_shows() -> None:
    y = np.sin(np.arange(400.0))
    made = Pictures(overlays=[Overlay("x", "m", np.arange(400.0), y, y - 0.5, None)], views=[a_view()], before=y, u=y,
                    isolability=(("a@x", "b@x"), np.array([[1.0, 0.95], [0.95, 1.0]])),
                    coverage=[("x", "m", y, y, y, y)])  # fmt: skip
    figures = {name: svg for name, svg in draw(made).items() if svg.startswith("<svg")}
    assert set(figures) == {"overlay", "residual", "tests", "isolability", "coverage"}
    for name, svg in figures.items():
        assert re.match(r'<svg role="img" aria-label="[^"]{30,}"', svg), name
    assert "rms error 0.5 m before" in figures["overlay"]
    assert "b@x and a@x" in figures["isolability"]


def test_the_band_lies_around_the_smoothed_force(monkeypatch: pytest.MonkeyPatch) -> None:
    from matplotlib.axes import Axes

    drawn = []
    original = Axes.fill_between

    def kept(self: Axes, x: Any, low: Any, high: Any, **more: Any) -> Any:
        drawn.append((more["label"], np.asarray(low), np.asarray(high)))
        return original(self, x, low, high, **more)

    monkeypatch.setattr(Axes, "fill_between", kept)
    draw(Pictures(views=[a_view(), a_view(axis="time", unit="s")]))
    bands = [(low, high) for label, low, high in drawn if "2 sd" in label]
    assert len(bands) == 2
    for low, high in bands:
        np.testing.assert_allclose(low, 0.8)
        np.testing.assert_allclose(high, 1.2)


def test_an_input_that_does_not_move_has_no_panel() -> None:
    spec = PlantSpec((Channel("u", "N"),), (Channel("x", "m"),), 1.0)
    found: Any = SimpleNamespace(dataset=SimpleNamespace(spec=spec, recorded={"u": "mN"}))
    still: Any = SimpleNamespace(u=np.full((10, 1), 0.3))
    moving: Any = SimpleNamespace(u=np.arange(10.0)[:, None])
    assert _driven(found, still) == []
    ((name, unit, values),) = _driven(found, moving)
    assert (name, unit, values[-1]) == ("u", "mN", 9000.0)


def test_the_deciding_numbers_are_grouped() -> None:
    groups = numbers(POLICY)
    assert set(groups) == {"policy", "effort", "data", "run", "plan", "arm", "odd"}
    assert groups["policy"]["evidence"]["value"] == 5.0
    assert set(groups["effort"]) == set(EFFORT.__dataclass_fields__)
    assert set(report_schema()["properties"]["policy"]["properties"]) == set(groups)


def test_large_figures_have_no_powers_of_ten() -> None:
    texts = environment().from_string("{{ 1357.2|change }}; {{ 12345.6|number }}; {{ 12.345|percent }}").render()
    assert texts == "1360 times smaller; 12350; 1230 %"


# ---- arms ---------------------------------------------------------------------------------------------------------


def arm_report(verdict: str, **more: Any) -> dict[str, Any]:
    """Return the content of a report of an arm of two joints."""
    joint = {"link_joint": "one", "judged": True, "standstill": 0.0, "torque_rms": 10.0, "unit": "N m",
             "effects": [], "clock_s": 0.0,
             "left": {"share": 0.01, "noise": 0.0, "predictable": False, "axis": None}}  # fmt: skip
    joints = [{**joint, "joint": "q1", "before": {"validation": 1.0}, "after": {"validation": 1.0}},
              {**joint, "joint": "q2", "before": {"validation": 3.0}, "after": {"validation": 0.3}}]  # fmt: skip
    return {**blank(), "dataset": "log", "model": "iiwa", "verdict": verdict, "summary": "arm", "inertia": "fixed",
            "joints": joints, "policy": numbers(POLICY), "explained_share": 0.99, **more}  # fmt: skip


def test_the_page_of_an_arm_has_cards_and_its_first_picture_is_the_residual() -> None:
    found = {"effects": [EFFECT], "tie_sets": [[EFFECT]], "separating_experiments": [[]], "separate_with": [[]]}
    page = render_arm(arm_report("effects_found", **found), {"levels": "LEVELS", "residual": "RESIDUAL"})
    words = text_of(page)
    assert words.index("torque residual of q2 (rms)") < words.index("10 times smaller") < words.index("RESIDUAL")
    assert words.index("RESIDUAL") < words.index("LEVELS")
    assert 'class="n same">1</td>' in page
    assert 'class="n a">0.3</td>' in page


def test_an_arm_that_does_not_fit_says_why_before_everything_else() -> None:
    misfit = ["at q3 what the model leaves is 53 % as large", "check the sign of tau2: that repairs it"]
    page = render_arm(
        arm_report("model_does_not_fit", misfit=misfit, searched=[EFFECT], explained_share=None),
        {"levels": "LEVELS", "residual": "RESIDUAL"},
    )
    words = text_of(page)
    assert words.index("Why the model does not fit") < words.index("What to check") < words.index("RESIDUAL")
    assert 'class="tile"' not in page
    assert "input compression" not in page


def test_cards_of_an_arm_are_the_joints_that_got_an_effect_unless_the_whole_arm_did() -> None:
    data = arm_report("effects_found", effects=[{**EFFECT, "at": "q1"}])
    data["joints"][0]["effects"] = ["coulomb_friction@q1"]
    assert [one["joint"] for one in _cards(data, "validation")] == ["q1"]
    data["effects"][0]["at"] = "flange"
    assert [one["joint"] for one in _cards(data, "validation")] == ["q2", "q1"]


@pytest.mark.parametrize(
    ("after", "flagged", "words"),
    [
        (0.3, False, "arm iiwa lacks input compression at u; torque residual of a joint up to 10 times smaller"),
        (6.0, False, "the torque residual grows (of a joint 2 times larger, validation), although"),
        (0.3, True, "input compression at u stands in for something that arm iiwa lacks"),
    ],
)
def test_the_summary_of_an_arm_says_what_its_residual_did(after: float, flagged: bool, words: str) -> None:
    data = arm_report("effects_found", effects=[EFFECT], tie_sets=[[EFFECT]])
    data["joints"][1]["after"]["validation"] = after
    data["stand_in"] = {"flagged": flagged, "reasons": ["two laws of friction"] if flagged else []}
    assert words in _summary(data, [])
    nothing = _summary(arm_report("nothing_missing"), [])
    assert nothing.endswith("and the rest is not predictable")
