"""The loop on recordings of real hardware."""

from __future__ import annotations

import pytest

from harness import registry
from harness.data import load_dataset
from harness.diagnosis import close_loop, close_loop_file
from harness.effects import builtin

PUBLISHED = {"M": 95.11, "Fv": 203.5, "offset": -3.16}


@pytest.mark.slow
def test_emps_lacks_dry_friction(recordings_folder, tmp_path) -> None:
    report = close_loop_file("emps", out=tmp_path)
    data = report.data
    assert report.verdict == "effects_found"
    assert [(one["name"], one["at"]) for one in data["effects"]] == [("coulomb_friction", "q")]
    assert "asymmetric_friction" in {one["name"] for one in data["tie_sets"][0]}
    before, after = (data["errors"][key] for key in ("before", "after"))
    assert before["equation_error"]["validation"]["q"]["rms"] == pytest.approx(9.24, rel=0.05)
    assert before["equation_error"]["validation"]["q"]["unit"] == "N"
    assert after["equation_error"]["validation"]["q"]["rms"] <= 3.3
    assert data["errors"]["after"]["simulation_error"]["horizon_s"] == 1.0
    assert after["simulation_error"]["validation"]["q"]["rms"] <= 1e-3
    started = [one["simulation_error"]["from_measured_state"]["validation"]["q"]["rms"] for one in (before, after)]
    assert started[0] == pytest.approx(5.98e-3, rel=0.03)
    assert started[1] <= 2.3e-3
    for name, published in PUBLISHED.items():
        assert data["parameters"]["after"][name]["value"] == pytest.approx(published, rel=0.02)
    assert data["effects"][0]["parameters"]["Fc"]["value"] == pytest.approx(20.39, rel=0.02)
    assert data["noise_floor"]["q"]["value"] is None
    assert data["closed_loop"]["u"]["p"] is not None


@pytest.mark.slow
def test_the_arm_of_a_pendulum_lacks_dry_friction_and_drag_together(recordings_folder) -> None:
    loaded = load_dataset(registry.dataset_path("multi-arm-pendulum"))
    system = loaded.system()
    names = ("coulomb_friction", "quadratic_drag", "stribeck_friction", "sensor_delay")
    few = [builtin()[one] for one in names]
    report = close_loop(loaded.for_system(system), system, dictionary=few, workers=1)
    data = report.data
    assert report.verdict == "effects_found"
    found = {one["name"]: one["parameters"] for one in data["effects"]}
    assert (
        {"coulomb_friction", "quadratic_drag"} <= set(found) <= {"coulomb_friction", "quadratic_drag", "sensor_delay"}
    )
    assert found["coulomb_friction"]["Fc"]["value"] > 0
    assert found["quadratic_drag"]["c"]["value"] > 0
    before, after = (
        data["errors"][key]["simulation_error"]["validation"]["theta"]["rms"] for key in ("before", "after")
    )
    assert after < 0.6 * before
    assert after <= 7.5e-3  # rad; initial states are estimated, so the nominal model starts from 12.4 mrad, not 24.6
    alone = [row for row in data["candidates"] if "stribeck_friction" in str(row) or "coulomb_friction" in str(row)]
    assert any("unphysical sign" in (row["reason"] or "") for row in alone)
    assert any("instead of 1000 Hz" in text for text in data["warnings"])
