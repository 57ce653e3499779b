"""The whole loop on truth made elsewhere, and its promises to the user: report, resume, errors."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from harness.diagnosis import close_loop
from harness.diagnosis.report.keys import blank
from harness.effects import builtin
from harness.errors import InputError
from harness.physics.models import pendulum
from harness.signals import Run


def dry(q: float, v: float, u: float, t: float) -> float:
    return -0.05 * math.copysign(1.0, v) if v else 0.0


@pytest.fixture(scope="module")
def dry_report(foreign_pendulum, tmp_path_factory):
    out = tmp_path_factory.mktemp("dry")
    data = foreign_pendulum(1, dry)
    return close_loop(data, "pendulum", out=out), out, data


def test_dry_friction_is_named_with_its_size(dry_report) -> None:
    report, _, _ = dry_report
    assert report.verdict == "effects_found"
    (effect,) = report.data["effects"]
    assert (effect["name"], effect["at"]) == ("coulomb_friction", "theta")
    level = effect["parameters"]["Fc"]
    assert level["value"] == pytest.approx(0.05, rel=0.03)
    assert level["low"] < level["value"] < level["high"]
    assert report.data["tie_sets"][0][0] == {"name": "coulomb_friction", "at": "theta"}
    for name, true in (("J", 0.1), ("b", 0.05), ("mgl", 1.0)):
        assert report.data["parameters"]["after"][name]["value"] == pytest.approx(true, rel=0.05)
    before, after = (report.data["errors"][key]["simulation_error"]["validation"] for key in ("before", "after"))
    assert before["theta"]["rms"] > 10 * after["theta"]["rms"]
    assert after["theta"]["rms"] < 1.5e-3


def test_report_json_is_complete_and_has_no_nan(dry_report) -> None:
    report, out, _ = dry_report
    stored = json.loads((out / "report.json").read_text(), parse_constant=lambda word: pytest.fail(word))
    assert stored == json.loads(json.dumps(report.data))
    assert stored["format"] == "sysid-harness/close-loop/2"
    wanted = {"dataset", "model", "verdict", "adequacy", "effects", "tie_sets", "errors", "parameters", "noise",
              "candidates", "left_over", "policy", "warnings", "seconds"}  # fmt: skip
    assert wanted <= set(stored)
    for key in ("before", "after"):
        errors = stored["errors"][key]
        assert set(errors) == {"equation_error", "simulation_error", "one_step", "log_likelihood"}
        assert set(errors["simulation_error"]["estimation"]["theta"]) == {"rms", "nrmse", "unit"}
        assert errors["simulation_error"]["test"] == {}
    assert stored["noise"]["after"]["sensors"]["theta"]["r"] == pytest.approx(1e-3, rel=0.1)
    forces = [stored["noise"][key]["forces"]["theta"]["s"] for key in ("before", "after")]
    assert forces[1] < 0.1 * forces[0]  # the friction was the latent force
    assert stored["policy"]["policy"]["evidence"]["reason"]
    assert set(stored) == set(blank())
    assert any("validation used for selection" in text for text in stored["warnings"])
    rejected = [row for row in stored["candidates"] if not row["accepted"]]
    assert rejected
    assert all(row["reason"] for row in rejected)


def test_page_is_one_file_that_says_the_verdict_first(dry_report) -> None:
    _, out, _ = dry_report
    page = (out / "report.html").read_text()
    assert "http://" not in page.replace("http://www.w3.org", "").replace("http://purl.org", "").replace(
        "http://creativecommons.org", ""
    )
    assert page.index("lacks coulomb friction") < page.index("<svg")
    assert page.count("<svg") >= 5


@pytest.mark.slow
def test_a_report_is_not_overwritten_and_resume_uses_what_is_there(dry_report) -> None:
    report, out, data = dry_report
    with pytest.raises(InputError, match="--force"):
        close_loop(data, "pendulum", out=out)
    again = close_loop(data, "pendulum", out=out, resume=True)
    first, second = (one.data for one in (report, again))
    for key in ("verdict", "adequacy"):
        assert first[key] == second[key]
    for name, one in first["parameters"]["after"].items():
        assert second["parameters"]["after"][name]["value"] == pytest.approx(one["value"], rel=1e-3)


@pytest.mark.slow
def test_nothing_missing_on_white_noise(foreign_pendulum) -> None:
    report = close_loop(foreign_pendulum(2), pendulum())
    assert report.verdict == "nothing_missing"
    assert report.data["effects"] == []
    assert report.data["adequacy"] == "explained"


@pytest.mark.slow
def test_a_coloured_disturbance_is_no_effect(foreign_pendulum) -> None:
    for seed in (3, 4):
        report = close_loop(foreign_pendulum(seed, coloured=0.02), "pendulum")
        assert report.verdict == "nothing_missing"
        assert report.data["noise"]["after"]["forces"]["theta"]["s"] == pytest.approx(0.02 * 0.4, rel=0.4)


@pytest.mark.slow
def test_a_dead_zone_of_the_actuator_is_named_at_the_input(foreign_pendulum) -> None:
    data = foreign_pendulum(5, command=lambda u: np.sign(u) * np.maximum(np.abs(u) - 0.08, 0.0))
    report = close_loop(data, "pendulum")
    (effect,) = report.data["effects"]
    assert (effect["name"], effect["at"]) == ("dead_zone", "u")
    assert effect["parameters"]["width"]["value"] == pytest.approx(0.08, rel=0.05)


@pytest.mark.slow
def test_cogging_of_three_periods_a_turn_is_named(foreign_pendulum) -> None:
    """Near the bound of 2.5 below which it is none, and far from that of 1000."""
    data = foreign_pendulum(8, lambda q, v, u, t: 0.08 * math.sin(3.0 * q + 0.4))
    rivals = ("cogging", "cubic_spring", "quadratic_spring", "eccentric_load", "coulomb_friction")
    report = close_loop(data, "pendulum", dictionary=[builtin()[name] for name in rivals])
    assert [one["name"] for one in report.data["effects"]] == ["cogging"]
    assert report.data["effects"][0]["parameters"]["k"]["value"] == pytest.approx(3.0, abs=0.05)


@pytest.mark.slow
def test_tilt_offset_and_eccentric_load_are_tied(foreign_pendulum) -> None:
    report = close_loop(foreign_pendulum(6, lambda q, v, u, t: -0.05 * math.cos(q)), "pendulum")
    tied = {member["name"] for member in report.data["tie_sets"][0]}
    assert {"gravity_tilt", "sensor_offset", "eccentric_load"} <= tied
    assert report.data["separating_experiments"][0]


@pytest.mark.slow
def test_outside_the_dictionary_is_never_called_explained(foreign_pendulum) -> None:
    data = foreign_pendulum(8, lambda q, v, u, t: 0.06 * math.sin(4 * q) * math.tanh(v), amplitude=0.5)
    report = close_loop(data, "pendulum")
    assert report.verdict == "unexplained" or report.data["adequacy"] != "explained"


def test_data_that_cannot_be_judged_are_refused(foreign_pendulum) -> None:
    data = foreign_pendulum(1, n=200)
    only = replace(data, runs=data.runs[:1])
    with pytest.raises(InputError, match="validation"):
        close_loop(only, "pendulum")
    with pytest.raises(InputError, match="do not fit the model"):
        close_loop(data, "oscillator")
    short = replace(data, runs=tuple(Run(run.trajectory[:20], run.use) for run in data))
    with pytest.raises(InputError, match="too short"):
        close_loop(short, "pendulum")
    still = replace(
        data,
        runs=tuple(Run(replace(run.trajectory, u=np.zeros((200, 1)), y=np.zeros((200, 1))), run.use) for run in data),
    )
    with pytest.raises(InputError, match="never move"):
        close_loop(still, "pendulum")


@pytest.mark.slow
@pytest.mark.parametrize(
    "law",
    [
        lambda q, v, u, t: 0.15 * math.cos(5 * q) * v,  # a torque ripple that pumps and brakes
        lambda q, v, u, t: -5.0 * (q - 0.3) * math.exp(-(((q - 0.3) / 0.1) ** 2)),  # a magnet near one angle
        lambda q, v, u, t: -0.02 * v / (0.15 + abs(q - 0.6)) ** 2,  # a film squeezed at one angle
    ],
    ids=["ripple", "magnet", "squeeze film"],
)
def test_a_strong_law_outside_the_dictionary_is_never_a_disturbance(foreign_pendulum, law) -> None:
    data = foreign_pendulum(21, law, amplitude=0.6)
    few = [builtin()[name] for name in ("coulomb_friction", "sensor_offset", "input_delay", "force_bias")]
    report = close_loop(data, "pendulum", dictionary=few)
    assert report.verdict in ("unexplained", "model_does_not_fit")
    assert report.data["adequacy"] in ("proxy_or_incomplete", "does_not_fit")


@pytest.mark.slow
def test_three_percent_of_coloured_torque_stay_a_disturbance(foreign_pendulum) -> None:
    few = [builtin()[name] for name in ("coulomb_friction", "sensor_offset", "input_delay", "force_bias")]
    report = close_loop(foreign_pendulum(4, coloured=0.03), "pendulum", dictionary=few)
    assert report.verdict == "nothing_missing"
    assert report.data["adequacy"] in ("explained", "mostly_explained")


@pytest.mark.slow
def test_two_effects_are_both_named(foreign_pendulum) -> None:
    def law(q: float, v: float, u: float, t: float) -> float:
        return -0.05 * math.tanh(v / 1e-3) - 0.02 * abs(v) * v

    names = ("coulomb_friction", "quadratic_drag", "stribeck_friction", "asymmetric_friction", "cubic_spring",
             "sensor_offset", "input_delay", "force_bias")  # fmt: skip
    report = close_loop(foreign_pendulum(9, law), "pendulum", dictionary=[builtin()[one] for one in names])
    found = {one["name"]: one["parameters"] for one in report.data["effects"]}
    assert set(found) == {"coulomb_friction", "quadratic_drag"}
    assert found["coulomb_friction"]["Fc"]["value"] == pytest.approx(0.05, rel=0.05)
    assert found["quadratic_drag"]["c"]["value"] == pytest.approx(0.02, rel=0.1)
