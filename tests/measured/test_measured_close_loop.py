"""The loop on recordings of real hardware."""

from __future__ import annotations

import pytest

from harness.diagnosis import close_loop_file

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
