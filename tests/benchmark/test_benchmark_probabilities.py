"""Columns of distributions and of control: filled where a model has them, absent where no model does."""

from __future__ import annotations

from pathlib import Path

import pytest

from harness.benchmark import bench, render
from harness.benchmark.page.report import render_html

SUITE = """
name = "probable"
seeds = [0]
[[groups]]
plants = [{ id = "grid-mdp" }]
scenarios = [{ id = "random-policy", options = { samples = 600 } }]
identifiers = [
  { id = "mdp-counting", options = { prior = 0.5 } },
  { id = "mdp-counting", label = "no prior", options = { prior = 0.0 } },
  { id = "mdp-online" },
]
[[groups]]
plants = [{ id = "linear-ode" }]
scenarios = [{ id = "prbs", options = { samples = 400, amplitude = 1.0, noise = 0.01 } }]
identifiers = [{ id = "arx", options = { order = 2 } }, { id = "hold" }]
"""


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory):
    folder = tmp_path_factory.mktemp("suite")
    (folder / "suite.toml").write_text(SUITE)
    return bench(folder / "suite.toml", workers=1)


def test_a_model_of_probabilities_has_a_log_score_and_coverage(result):
    rows = {row.identifier: row for row in result.rows}
    counted = rows["mdp-counting"]
    assert counted.status == "ok"
    assert counted.log_score > 0.5, "nats above the frequencies of the record"
    assert 0.8 < counted.coverage < 1.0
    assert rows["hold"].log_score is None
    assert rows["hold"].coverage is None
    assert rows["no prior"].log_score is None, "it called impossible what then happened"
    assert rows["no prior"].coverage is not None


def test_an_online_identifier_of_probabilities_has_a_regret_in_log_loss(result):
    rows = {row.identifier: row for row in result.rows}
    online = rows["mdp-online"]
    assert online.status == "ok"
    assert online.log_regret > 0
    assert online.average_log_regret == pytest.approx(online.log_regret / (online.samples - 1))
    assert rows["mdp-counting"].log_regret is None


def test_the_columns_stand_in_every_form_of_the_table(result):
    for text in (render(result, "markdown"), render_html(result)):
        assert "90 % sets hold" in text
        assert "log regret" in text
    assert r"90 \% sets hold" in render(result, "latex")
    assert "log_score_median" in render(result, "csv")


def test_without_such_models_the_table_is_as_it_was(tmp_path: Path):
    (tmp_path / "suite.toml").write_text(
        'name = "plain"\nseeds = [0]\n[[groups]]\nplants = [{ id = "pendulum-ode" }]\n'
        'scenarios = [{ id = "prbs", options = { samples = 100, amplitude = 0.2 } }]\nidentifiers = [{ id = "hold" }]\n'
    )
    text = render(bench(tmp_path / "suite.toml", workers=1), "markdown")
    assert "log score" not in text
