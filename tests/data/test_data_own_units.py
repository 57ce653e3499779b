"""What a person is shown is in the units of the log: readings with their zero, differences and errors without."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from harness import api, registry
from harness.comparison import compare
from harness.comparison.models import _bode_figure, _time_figure
from harness.comparison.uncertain import response_figure
from harness.diagnosis.report import evidence_page
from harness.units import told
from plants.mockups import mockup


@pytest.fixture
def oven(tmp_path: Path) -> Path:
    """Return the log of an oven: its heater in kW, its temperature in degC with one spike, a door that stays shut."""
    rng, dt, rows = np.random.default_rng(3), 5.0, 400
    power = np.repeat(rng.uniform(0.0, 0.4, rows // 20), 20)
    above = np.zeros(rows)
    for k in range(1, rows):
        above[k] = above[k - 1] + dt / 2000.0 * (1000.0 * min(power[k - 1], 0.3) - above[k - 1] / 0.5)
    table = np.c_[dt * np.arange(rows), power, 20.0 + above + 0.05 * rng.standard_normal(rows), np.full(rows, 3.0)]
    table[200, 2] = 500.0
    np.savetxt(tmp_path / "oven.csv", table, delimiter=",", header="time [s],P [kW],T [degC],door [mm]", comments="")
    return tmp_path / "oven.csv"


def test_sentences_and_pictures_tell_a_temperature_in_degc(oven: Path) -> None:
    fitted = api.identify(oven, input="P", output="T", identifier="arx", options={"order": 2})
    assert fitted.in_own_unit(0.05, fitted.model.spec.outputs[0]) == "0.05 degC"
    data = api.load_dataset(oven, input="P", output=["T", "door"]).dataset
    (spike,) = (odd.words for odd in data.oddities or () if odd.kind == "spike")
    assert spike.startswith("T reads 500 degC in row 200 (t = 1000 s), where its neighbours predict")
    assert float(spike.split("predict ")[1].split(" degC")[0]) < 200.0
    assert any("door never moves (3 mm)" in note for note in data.warnings)
    shown = compare({"a": fitted.model}, api.load_dataset(oven, input="P", output="T").dataset)
    for figure in (fitted.plot(), _time_figure(shown)):
        axis = figure.axes[-1]
        assert axis.get_ylabel() == "T [degC]"
        low, high = np.percentile(axis.lines[0].get_ydata(), [5, 95])
        assert 20.0 < low < high < 180.0
        assert (
            np.abs(np.asarray(axis.lines[1].get_ydata())[-5:] - np.asarray(axis.lines[0].get_ydata())[-5:]).max() < 30
        )


@pytest.mark.slow
def test_a_report_draws_and_tells_what_the_log_says(
    oven: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "oven.eqs").write_text(
        "input P [W]\nlevel T [K]\nC = 1500 J/K >= 0\nR = 0.4 K/W >= 0\nT0 = 293.15 K fixed\n"
        "T' = (P - (T - T0)/R)/C\noutput T\n"
    )
    drawn, draw = [], evidence_page.draw
    monkeypatch.setattr(evidence_page, "draw", lambda made: (drawn.append(made), draw(made))[1])
    report = api.close_loop(oven, model=str(tmp_path / "oven.eqs"), out=tmp_path / "out")
    made = drawn[0]
    overlay = made.overlays[0]
    assert (overlay.unit, 15.0 < overlay.measured.min(), overlay.measured.max() < 180.0) == ("degC", True, True)
    assert np.abs(overlay.measured - overlay.before).max() < 50.0
    view = made.views[0]
    assert (view.unit, view.residual_unit, made.views[1].unit) == ("degC", "degC", "kW")
    assert np.abs(view.before).max() < 50.0
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Noise: T 0.0" in page
    assert report.data["noise"]["after"]["sensors"]["T"]["unit"] == "K"
    assert {effect["at"] for effect in report.data["effects"]} == {"P"}
    assert "<td>kW</td>" in page


def test_units_with_two_readings_and_other_zeros_come_back() -> None:
    assert told(np.array([273.15, 283.15]), "K", "C", reading=True)[0].tolist() == [0.0, 10.0]
    size, unit = told(1.0, "K", "degF")
    assert (size, unit) == (pytest.approx(1.8), "degF")
    assert told(1.0, "rad", "V") == (1.0, "rad")


def test_pictures_of_models_are_in_the_units_of_the_log(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    u = np.repeat(rng.choice([-1.0, 1.0], 40), 5)
    speed = np.zeros(200)
    for k in range(199):
        speed[k + 1] = 0.8 * speed[k] + 400.0 * u[k]
    table = np.c_[0.05 * np.arange(200), u, speed + rng.standard_normal(200)]
    np.savetxt(tmp_path / "a.csv", table, delimiter=",", header="t [s],u [mV],n [1/min]", comments="")
    named = {"input": "u", "output": "n"}
    model = api.identify(tmp_path / "a.csv", identifier="arx", **named).model  # type: ignore[arg-type]
    data = api.load_dataset(tmp_path / "a.csv", **named).dataset  # type: ignore[arg-type]
    steps = response_figure({"arx": model}, data.recorded).axes[0]
    assert steps.get_title() == "n [1/min] after a unit step of u [mV]"
    assert np.asarray(steps.lines[0].get_ydata())[-1] == pytest.approx(2000.0, rel=0.02)
    gain = _bode_figure(compare({"arx": model}, data)).axes[0]
    assert [text.get_text() for text in gain.get_legend().get_texts()] == ["n [1/min] / u [mV]", "arx"]
    assert np.asarray(gain.lines[1].get_ydata())[0] == pytest.approx(2000.0, rel=0.05)


def test_a_fit_says_which_signals_its_parameters_hold_in_si_units(oven: Path) -> None:
    found = api.identify(oven, input="P", output="T", identifier="arx", options={"order": 2})
    assert found.units_said() == (
        "parameters, equations and residuals are those of SI units: P in W (kW in the data), T in K (degC in the data)"
    )
    assert found.units_said() in found._repr_html_()
    table = {"u": np.sin(np.arange(100.0)), "y": np.cos(0.3 * np.arange(100.0))}
    assert api.identify(table, input="u", output="y", sample_time=0.1, identifier="arx").units_said() == ""


def test_the_errors_of_a_calibration_are_in_the_units_of_the_log() -> None:
    u = np.repeat(np.random.default_rng(0).normal(size=20), 10)
    with registry.create("plants", "mass-spring-fmu", sample_time=0.05, m=1.5, k=4.0) as plant:
        y = np.vstack([plant.reset(rng=np.random.default_rng(0)), plant.rollout(u[:-1, None])])[:, 0]
        force, place = plant.spec.inputs[0].name, plant.spec.outputs[0].name
    table = {"t [s]": 0.05 * np.arange(200), f"{force} [N]": u, f"{place} [mm]": 1e3 * y}
    found = api.calibrate(table, model=mockup("mass_spring"), free=["m"], starts=1)
    (row,) = (one for one in found.error_rows() if one["use"] == "validation")
    assert row["unit"] == "mm"
    assert float(row["rms before"]) == pytest.approx(1e3 * found.errors_before["validation"][0][place][0], rel=1e-3)
