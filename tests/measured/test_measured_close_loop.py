"""The loop on recordings of real hardware."""

from __future__ import annotations

import pytest

from harness.diagnosis import close_loop_file
from harness.effects import builtin

pytestmark = pytest.mark.slow

MASS = (
    95.11  # kg, of the data's authors (Janot, Gautier & Brunot 2019); its other figures depend on the law of friction
)
MASS_BY_OUR_FIT = 0.01
FRICTION = {"coulomb_friction", "stribeck_friction", "asymmetric_friction", "sublinear_friction", "yield_friction",
            "hysteresis", *(name for name, law in builtin().items() if law.grows)}  # fmt: skip


def validation_error(report, when: str, output: str) -> float:
    """Rms of the simulation error of the validation records."""
    return report.data["errors"][when]["simulation_error"]["validation"][output]["rms"]


@pytest.mark.slow
def test_emps_lacks_friction_that_no_single_law_of_the_dictionary_describes(recordings_folder, tmp_path) -> None:
    report = close_loop_file("emps", out=tmp_path)
    data = report.data
    assert report.verdict == "effects_found"
    found = {(one["name"], one["at"]) for one in data["effects"]}
    assert any(name in FRICTION and place == "q" for name, place in found)
    assert ("asymmetric_damping", "q") in found
    assert validation_error(report, "before", "q") == pytest.approx(1.92e-3, rel=0.05)
    assert validation_error(report, "after", "q") <= 0.53e-3
    assert data["errors"]["after"]["simulation_error"]["horizon_s"] == 1.0
    assert data["parameters"]["after"]["M"]["value"] == pytest.approx(MASS, rel=MASS_BY_OUR_FIT)
    assert data["closed_loop"]["u"]["feedback"]
    # bristles have a state of their own: no residual force is set beside a one-step error
    equation = {when: data["errors"][when]["equation_error"] for when in ("before", "after")}
    assert equation["before"]["meaning"] == equation["after"]["meaning"]
    assert equation["before"]["validation"]["q"]["unit"] == equation["after"]["validation"]["q"]["unit"] == "m"
    # one step of 1 ms, from readings of 27 nm and bristles that the measured motion has bent
    one_step = {when: equation[when]["validation"]["q"]["rms"] for when in equation}
    assert one_step["after"] < 0.9 * one_step["before"]  # the reading is a third of a sample late
    assert one_step["before"] < 1e-7


@pytest.mark.slow
def test_the_arm_of_a_pendulum_lacks_dry_friction_with_drag_and_a_delay_of_its_rate_sensor(
    recordings_folder, tmp_path
) -> None:
    """As its authors say: dry friction and drag together (Kaheman et al. 2023)."""
    report = close_loop_file("multi-arm-pendulum", out=tmp_path)
    data = report.data
    assert report.verdict == "effects_found"
    found = {(one["name"], one["at"]) for one in data["effects"]}
    assert {("sensor_delay", "theta_rate"), ("quadratic_drag", "theta")} < found
    assert any(name in FRICTION and place == "theta" for name, place in found)
    assert validation_error(report, "before", "theta") == pytest.approx(12.3e-3, rel=0.02)
    assert validation_error(report, "after", "theta") <= 3.8e-3  # rad
    drag = data["parameters"]["after"]["quadratic_drag@theta.c"]
    assert drag["low"] > 0
    assert any("instead of 1000 Hz" in text for text in data["warnings"])
