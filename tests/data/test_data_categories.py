"""Recorded categories: declared in dataset.toml, read as such, other numbers refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from harness import api
from harness.data import load_dataset, read_trajectory
from harness.data.recipe.draft import draft_dataset
from harness.errors import InputError
from harness.registry import create
from harness.rng import Streams
from harness.rollout import run

TOML = """
name = "grid"
sample_time = 1.0
[signals.action]
role = "input"
unit = "1"
categories = {actions}
[signals.observation]
role = "output"
unit = "1"
categories = 6
[[runs]]
file = "run.csv"
rows = [0, 900]
[[runs]]
file = "run.csv"
use = "validation"
rows = [900, 1200]
"""


def written(folder: Path, actions: int = 4) -> Path:
    plant = create("plants", "grid-pomdp", rows=2, columns=3, walls=[])
    data = run(plant, create("scenarios", "random-policy", samples=1200), streams=Streams("g", "s", 0))
    lines = ["time [s],action [1],observation [1]"]
    lines += [f"{t},{u},{y}" for t, u, y in zip(data.t, data.u[:, 0], data.y[:, 0], strict=True)]
    (folder / "run.csv").write_text("\n".join(lines), encoding="utf-8")
    (folder / "dataset.toml").write_text(TOML.format(actions=actions), encoding="utf-8")
    return folder / "dataset.toml"


def test_categories_are_identified_from_a_file_and_their_distributions_scored(tmp_path):
    file = written(tmp_path)
    spec = load_dataset(file).dataset.spec
    assert [(c.kind, c.categories) for c in (*spec.inputs, *spec.outputs)] == [("category", 4), ("category", 6)]
    found = api.identify(file, identifier="mdp-counting", options={"prior": 0.5}, out=tmp_path / "model.json")
    (score,) = found.probability["validation"]
    assert score.skill[0] > 0.05
    assert not [warning for warning in found.warnings if "saturated" in warning]
    assert api.identify(file, identifier="hold").probability == {}


def test_numbers_that_are_no_categories_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"integer in 0 \.\. 2"):
        load_dataset(written(tmp_path, actions=3))
    with pytest.raises(InputError, match="at least 2"):
        load_dataset(written(tmp_path, actions=1))


def test_what_a_finite_plant_wrote_as_csv_is_identified_as_it_is(tmp_path):
    """It was refused until somebody wrote categories = N into a dataset.toml by hand."""
    log = tmp_path / "run.csv"
    api.simulate("grid-pomdp", scenario="random-policy", out=log, options={"rows": 2, "columns": 3, "walls": []})
    columns = {"input": "action", "output": "observation"}
    found = api.identify(log, **columns)
    assert found.probability["estimation"][0].log_score > -2.0  # counts, not the amounts of a linear model
    assert any("observation count as names, 6 categories" in warning for warning in found.warnings)
    spec = read_trajectory(log, inputs=["action"]).spec
    assert [(c.kind, c.categories) for c in (*spec.inputs, *spec.outputs)] == [("category", 4), ("category", 6)]
    assert "categories = 6  # numbers that are names, as the title says" in draft_dataset([log])


def test_categories_of_a_plain_table_are_said_in_the_place_of_units_and_never_guessed(tmp_path):
    written(tmp_path)
    log, columns = tmp_path / "run.csv", {"input": "action", "output": "observation"}
    assert {c.kind for c in load_dataset(log, **columns).dataset.spec.outputs} == {"real"}
    said = load_dataset(log, **columns, unit={"action": "category 0..3", "observation": "category 0..5"})
    assert [c.categories for c in (*said.dataset.spec.inputs, *said.dataset.spec.outputs)] == [4, 6]
    with pytest.raises(InputError, match=r"integer in 0 \.\. 4"):
        load_dataset(log, **columns, unit={"observation": "category 0..4"})
    assert '# categories = 6  # whole numbers 0 to 5: codes of states (unit = "1")?' in draft_dataset([log])
