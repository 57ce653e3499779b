"""The plan: balanced from the start, keys that stay, records that fit their task."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from harness.errors import InputError
from harness.study.context import rms
from harness.study.plan import BASES, Task, places, plan
from harness.study.records import make_records


def task(plant="pendulum", engine="laws", effects=(), level="", noise="low", disturbance=0.0, study="confusion"):
    return Task(study, plant, engine, tuple(effects), level, noise, disturbance, 0, 0)


def test_keys_are_unique_and_seeds_keep_to_their_base():
    tuning, judged = plan("all"), plan("all", base=BASES["judged"])
    assert len({one.key for one in tuning}) == len(tuning)
    assert all(0 <= one.seed < 1000 for one in tuning)
    assert all(BASES["judged"] <= one.seed < BASES["judged"] + 1000 for one in judged)
    assert not {one.key for one in tuning} & {one.key for one in judged}
    assert tuning[0].key == "none|pendulum|laws|none||drawn|0|0|0"
    assert tuning[0].seed == 837


def test_every_effect_that_fits_is_hidden_or_named_as_left_out():
    from harness.effects import builtin, place_all
    from harness.physics import load_model

    left = {"viscous_friction@theta", "viscous_friction@x", "quadratic_spring@x", "periodic_disturbance@theta",
            "cogging@theta"}  # fmt: skip
    for plant in ("pendulum", "cart-pole"):
        fitting = {str(one) for one in place_all(load_model(plant), builtin().values())}
        hidden = set(places(plant))
        assert hidden <= fitting
        assert fitting - hidden <= left


def test_each_effect_meets_both_sizes_noises_and_disturbances():
    tasks = [one for one in plan("confusion", cells=4) if one.study == "confusion" and one.effects]
    for name in places("cart-pole"):
        here = [one for one in tasks if (one.plant, one.engine, one.effects) == ("cart-pole", "laws", (name,))]
        cells = {(one.level, one.noise, one.disturbance) for one in here}
        assert len(here) == 4
        assert {cell[1] for cell in cells} == {"low", "high"}
        if "rectification" not in name:
            assert {cell[0] for cell in cells} == {"nominal", "quarter"}


def test_a_first_part_of_the_plan_is_balanced():
    part = plan("all")[:250]
    plants = Counter(one.plant for one in part)
    assert abs(plants["pendulum"] - plants["cart-pole"]) < 40
    classes = Counter(one.disturbance for one in part if one.study == "none")
    assert abs(classes[0.0] - classes[0.02]) <= 1
    sizes = Counter(one.level for one in part if one.study == "confusion")
    assert min(sizes["nominal"], sizes["quarter"]) > 15


def test_wrong_words_are_refused():
    with pytest.raises(InputError, match="study"):
        plan("everything")
    with pytest.raises(InputError, match="plants"):
        plan("all", plants=["crane"])
    with pytest.raises(InputError, match="at least 1"):
        plan("all", records=0)


def test_records_are_drawn_from_the_key_alone():
    one = task(effects=("coulomb_friction@theta",), level="nominal")
    first, again = make_records(one, samples=600), make_records(one, samples=600)
    other = make_records(task(effects=("coulomb_friction@theta",), level="quarter"), samples=600)
    assert np.array_equal(first.dataset.estimation[0].y, again.dataset.estimation[0].y)
    assert first.parameters != other.parameters


@pytest.mark.parametrize("plant", ["pendulum", "cart-pole"])
def test_forces_have_the_size_that_is_said(plant):
    made = make_records(task(plant, effects=("coulomb_friction@" + places(plant)[0].split("@")[1],), level="nominal"))
    force = made.hidden[0].named["Fc"]
    u = made.dataset.estimation[0].u
    assert 0.05 < force / rms(u) < 0.11
    assert made.dataset.spec.sample_time * len(u) == pytest.approx(20.0)


@pytest.mark.parametrize(("plant", "engine"), [("pendulum", "bullet"), ("cart-pole", "pymunk"), ("cart-pole", "fmu")])
def test_engines_agree_with_the_laws_where_nothing_is_hidden(plant, engine):
    from harness.study import engines, records

    values = records._draw_parameters(plant, np.random.default_rng(0))
    start = np.array([0.3, 0.0]) if plant == "pendulum" else np.array([0.0, 0.3, 0.0, 0.0])
    u = 0.5 * records.multisine(500, 0.004, np.random.default_rng(1), (0.5, 3.0))
    theirs = engines.engine_run(engine, plant, values, {}, u, start)
    ours = records.simulate(records._truth_values(plant, values), u, start=start)
    assert np.abs(theirs - ours.q).max() < 2e-3 * np.abs(ours.q).max()
