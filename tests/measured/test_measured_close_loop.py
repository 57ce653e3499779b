"""The loop on recordings of real hardware."""

from __future__ import annotations

import pytest

from harness import registry
from harness.data import load_dataset
from harness.diagnosis import close_loop, close_loop_file
from harness.effects import builtin

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
    assert data["stand_in"]["flagged"]
    assert data["adequacy"] == "proxy_or_incomplete"
    assert validation_error(report, "before", "q") == pytest.approx(4.01e-3, rel=0.05)
    assert validation_error(report, "after", "q") <= 0.62e-3
    assert data["errors"]["after"]["simulation_error"]["horizon_s"] == 1.0
    assert data["parameters"]["after"]["M"]["value"] == pytest.approx(MASS, rel=MASS_BY_OUR_FIT)
    assert data["closed_loop"]["u"]["feedback"]
    # bristles have a state of their own: no residual force is set beside a one-step error
    equation = {when: data["errors"][when]["equation_error"] for when in ("before", "after")}
    assert equation["before"]["meaning"] == equation["after"]["meaning"]
    assert equation["before"]["validation"]["q"]["unit"] == equation["after"]["validation"]["q"]["unit"] == "m"
    # one step of 1 ms from readings of 27 nm knows nothing of bristles that slip within 25 um
    assert max(equation[when]["validation"]["q"]["rms"] for when in equation) < 1e-6


@pytest.mark.slow
def test_the_arm_of_a_pendulum_lacks_a_law_of_friction_and_a_delay_of_its_rate_sensor(recordings_folder) -> None:
    loaded = load_dataset(registry.dataset_path("multi-arm-pendulum"))
    system = loaded.system()
    names = ("coulomb_friction", "quadratic_drag", "stribeck_friction", "sensor_delay")
    few = [builtin()[one] for one in names]
    report = close_loop(loaded.for_system(system), system, dictionary=few)
    data = report.data
    assert report.verdict == "effects_found"
    found = {(one["name"], one["at"]) for one in data["effects"]}
    assert ("sensor_delay", "theta_rate") in found
    assert found & {("coulomb_friction", "theta"), ("stribeck_friction", "theta")}
    assert validation_error(report, "after", "theta") < 0.6 * validation_error(report, "before", "theta")
    assert validation_error(report, "after", "theta") <= 7.5e-3  # rad; the nominal model 12.3 mrad
    assert any("instead of 1000 Hz" in text for text in data["warnings"])
