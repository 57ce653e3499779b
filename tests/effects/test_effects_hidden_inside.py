"""What is hidden in a plant that takes effects is part of its equations, and not held over each sample."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from harness import api, registry
from harness.data import load_dataset
from harness.effects import Placed, builtin, compose
from harness.effects.wrap import WrappedPlant
from harness.parts.files import make_hiding
from harness.physics import load_model

LEVELS = {"pendulum-ode": ("pendulum", "theta", 0.15), "cart-pole-ode": ("cart-pole", "x", 0.5)}


@pytest.mark.parametrize("plant", LEVELS)
def test_dry_friction_hidden_in_an_ode_is_that_of_its_law(tmp_path: Path, plant: str) -> None:
    """It was held from sample to sample, 2 mrad off, and the loop answered with an elasticity beside it, 3 of 3."""
    model, at, level = LEVELS[plant]
    path = tmp_path / "run.csv"
    api.simulate(plant, scenario="multisine", hide=[("coulomb_friction", at, {"Fc": level})], out=path,
                 scenario_options={"duration": 5.0, "amplitude": 0.6, "noise": 0.0})  # fmt: skip
    run = load_dataset(path, model=model).dataset.runs[0].trajectory
    system = compose(load_model(model), [Placed(builtin()["coulomb_friction"], at)])
    values = {**system.values(), f"coulomb_friction@{at}.Fc": level}
    y = system.simulator(0.01, substeps=32).rollout(system.vector(values), np.zeros(system.nx), run.u)
    assert np.abs(y - run.y).max() < 1e-6


@pytest.mark.parametrize("id", [entry.id for entry in registry.entries("plants") if entry.id.endswith("-ode")])
def test_plants_of_equations_take_what_is_hidden_where_they_say_so(id: str) -> None:
    takes = registry.takes_option("plants", id, "effects")
    assert takes is (id != "linear-ode")


def test_a_plant_that_takes_none_gets_them_around_it() -> None:
    pytest.importorskip("pymunk")
    with make_hiding("cart-pole-pymunk", {}, [("sensor_offset", "x", {"offset": 0.1})]) as made:
        assert isinstance(made, WrappedPlant)
        assert made.held == ()


@pytest.mark.parametrize(
    ("plant", "effect", "said"),
    [
        ("cart-pole-pymunk", ("coulomb_friction", "x", {"Fc": 0.3}), True),
        ("cart-pole-pymunk", ("input_delay", "u", {"tau": 0.02}), False),
        ("cart-pole-ode", ("coulomb_friction", "x", {"Fc": 0.3}), False),
    ],
)
def test_a_force_that_is_held_from_outside_is_said(
    plant: str, effect: tuple[str, str, dict[str, float]], said: bool
) -> None:
    pytest.importorskip("pymunk")
    notes: list[str] = []
    api.simulate(plant, scenario="multisine", hide=[effect], scenario_options={"duration": 0.5}, note=notes.append)
    assert any("held over each sample of 0.01 s" in text for text in notes) is said
