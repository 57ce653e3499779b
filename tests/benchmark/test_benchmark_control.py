"""The columns of control: what the design on a model costs on the true plant, and what learning to control costs."""

from __future__ import annotations

from pathlib import Path

import pytest

from harness.benchmark import bench
from harness.benchmark.page.exports import render

SUITE = """
name = "control"
seeds = [0]
[[groups]]
plants = [{id = "pendulum-ode", options = {sample_time = 0.05, outputs = [["theta", 0], ["theta", 1]]}}]
scenarios = [{id = "multisine", options = {duration = 10.0, amplitude = 0.2, band = [0.05, 3.0], noise = 0.001}}]
SCORE
identifiers = [
  {id = "least-squares"}, {id = "arx", options = {order = 3}}, {id = "stlsq"}, {id = "edmdc", options = {degree = 3}},
  {id = "hold"}, {id = "rls"},
]
[[groups]]
plants = [{id = "cart-pole-ode", options = {sample_time = 0.02}}]
scenarios = [{id = "cart-pole-lqr", options = {duration = 8.0, noise = 0.0002}}]
SCORE
identifiers = [{id = "arx"}]
"""


def suite(folder: Path, score: str) -> Path:
    path = folder / "control.toml"
    path.write_text(SUITE.replace("SCORE", score), encoding="utf-8")
    return path


def test_columns_of_control_are_filled_on_true_plants(tmp_path: Path) -> None:
    result = bench(suite(tmp_path, "score = {horizon = 0.5, control = true}"), out=tmp_path / "out", workers=1)
    rows = {(row.plant, row.identifier): row for row in result.rows}
    assert {row.status for row in rows.values()} == {"ok"}
    states, lags = rows["pendulum-ode", "least-squares"], rows["pendulum-ode", "arx"]
    for row in (states, lags, rows["cart-pole-ode", "arx"]):  # the last about its unstable equilibrium
        assert row.control_status == "ok"
        assert 1.0 - 1e-6 <= row.control_score < 1.1
        assert row.stabilisable
        assert row.detectable
    assert (states.model_order, states.controllable, states.observable) == (2, 2, 2)
    assert lags.model_order > lags.observable == 6
    assert 0 < states.control_regret < 1000
    assert lags.control_regret is None, "its states are not measured"
    other = rows["pendulum-ode", "stlsq"]
    assert (other.control_score, other.control_status[:31]) == (None, "SparseModel is linear in no coo")
    for row in (other, states):  # the states are measured, and the models hardly wrong: as good as the plant itself
        assert row.predictive_cost == pytest.approx(1.0, abs=0.05)
    assert rows["cart-pole-ode", "arx"].predictive_cost > 1.0, "two of four states are not measured"
    still, online = rows["pendulum-ode", "hold"], rows["pendulum-ode", "rls"]
    assert still.control_status == "not for control: HoldModel: no input moves it"
    assert still.predictive_cost is None
    assert (online.control_status, online.regret is None) == ("ok", False), (
        "what a pass leaves is a model like any other"
    )
    assert 1.0 - 1e-6 <= online.control_score < 1.1
    lifted = rows["pendulum-ode", "edmdc"]
    assert lifted.control_status == "ok"
    assert 1.0 - 1e-6 <= lifted.control_score < 1.5
    assert lifted.model_order == 9, "monomials of two states up to degree 3, without the constant"
    text = render(result, "markdown")
    assert "| control score | MPC cost | control regret | model for control |" in text
    assert "2 controllable and 2 observable of 2" in text
    assert "control_score_median" in render(result, "csv")
    (columns,) = [line for line in render(result, "latex").splitlines() if "begin{tabular}" in line]
    assert columns.endswith("llll}")
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "control regret" in page
    kept = result.query("select control_score from results where identifier = 'least-squares'")
    assert kept[0]["control_score"] == pytest.approx(states.control_score)


def test_without_being_asked_there_are_none(tmp_path: Path) -> None:
    result = bench(suite(tmp_path, "score = {horizon = 0.5}"), out=tmp_path / "out", workers=1)
    assert all(row.control_score is None and row.control_status == "" for row in result.rows)
    assert "control" not in render(result, "markdown").splitlines()[0]
