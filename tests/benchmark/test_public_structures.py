"""Effects that are added to a physical model by the free runs of halves, and the grey box that begins with them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness.benchmark.public import greybox, structures
from harness.benchmark.public.choices import GreyChoice
from harness.benchmark.public.rules import RULES, Rule
from harness.benchmark.public.structures import PublicModel, grown, halves_figure, refitted
from harness.effects import builtin
from harness.effects.compose import compose
from harness.effects.effect import Placed
from harness.physics import load_model
from harness.signals import PlantSpec, Trajectory

RULE = RULES["emps"]
PLACES = ["coulomb_friction@q", "linear_spring@q", "input_gain@u"]
BARE = PublicModel("drive")
ALL_PLACES = structures._places


@pytest.fixture(scope="module")
def record() -> Trajectory:
    """Return a record of a drive with dry friction that nobody declared."""
    friction = Placed(builtin()["coulomb_friction"], "q", {})
    system = compose(load_model("drive"), [friction]).with_parameters(
        {"M": 2.0, "Fv": 1.5, "coulomb_friction@q.Fc": 0.8}
    )
    spec = PlantSpec(system.inputs, system.outputs, 0.05)
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-4.0, 4.0, 60), 10)[:, None]
    y = system.simulator(0.05).rollout(system.vector(), np.zeros(system.nx), u)
    return Trajectory(0.05 * np.arange(len(u)), u, y + 1e-4 * rng.normal(size=y.shape), spec)


@pytest.fixture(autouse=True)
def few_places(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(structures, "_places", lambda structure: PLACES)


def test_the_effect_that_is_there_is_added_and_no_other(record: Trajectory) -> None:
    said: list[str] = []
    best, error = grown(RULE, [BARE], [record], 2, said.append)
    assert best.effects == ("coulomb_friction@q",)
    assert best.start["coulomb_friction@q.Fc"] == pytest.approx(0.8, rel=0.02)
    assert error < 0.05 * halves_figure(RULE, BARE, [record])
    assert error == pytest.approx(halves_figure(RULE, best, [record]), rel=0.05)
    assert any("coulomb_friction@q, linear_spring@q" in text for text in said)
    assert grown(RULE, [BARE], [record], 0)[0] is BARE


def test_a_start_that_does_worse_than_where_another_led_is_not_followed(record: Trajectory) -> None:
    said: list[str] = []
    wrong = PublicModel("drive", effects=("linear_spring@q",))
    best, _ = grown(RULE, [BARE, wrong], [record], 1, said.append)
    assert best.effects == ("coulomb_friction@q",)
    assert not any(text.startswith("linear_spring@q,") for text in said)


def test_an_effect_that_errs_more_where_it_was_fitted_is_passed_over(
    record: Trajectory, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = structures._own_figure

    def doubtful(rule: Rule, model: Any, records: Any) -> float:
        return np.inf if "coulomb_friction@q.Fc" in model.parameters else own(rule, model, records)

    monkeypatch.setattr(structures, "_own_figure", doubtful)
    best, _ = grown(RULE, [BARE], [record], 1)
    assert "coulomb_friction@q" not in best.effects


def test_a_structure_that_cannot_be_fitted_is_none(record: Trajectory) -> None:
    broken = PublicModel("drive", start={"no-such-parameter": 1.0})
    assert refitted(RULE, broken, [record]) is None
    assert halves_figure(RULE, broken, [record]) == np.inf


@pytest.mark.parametrize("grow", [0, 1])
def test_the_grey_box_grows_beyond_what_the_loop_ended_with(
    record: Trajectory, grow: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import harness.diagnosis

    def loop(data: object, *, out: Path, **_: object) -> None:
        model = refitted(RULE, BARE, [record])
        assert model is not None
        (out / "model.json").write_text(json.dumps(model.to_dict()))
        (out / "report.json").write_text('{"verdict": "nothing_missing"}')

    monkeypatch.setattr(harness.diagnosis, "close_loop_file", loop)
    choice = GreyChoice(model="drive", grow=grow)
    monkeypatch.setattr(greybox, "signals_of", lambda rule, choice: greybox.PublicSignals(record.spec, (1.0,), (0.0,)))
    found = greybox.repaired(RULE, [record], choice, tmp_path)
    if grow:
        assert found.words.startswith("drive with coulomb friction at q, added by free runs (0.")
        assert found.refitted
    else:
        assert found.words == "drive: nothing missing"


def test_what_acts_at_some_time_of_the_training_records_is_not_added() -> None:
    """A disturbance faster than half of the sampling rate had been added to the tanks."""
    found = set(ALL_PLACES(PublicModel("drive")))
    assert "coulomb_friction@q" in found
    assert not {"periodic_disturbance@q", "payload_step@q", "drifting_damping@q", "sensor_drift@q"} & found
