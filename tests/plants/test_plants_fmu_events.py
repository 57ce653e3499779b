"""FMI 3.0 co-simulation in event mode, on an FMU that refuses every call in the wrong mode."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness.errors import InputError, PlantError
from harness.signals import FloatArray
from plants.fmu.plant import FmuPlant, describe
from plants.mockups import mockup

RNG = np.random.default_rng(0)
DT = 0.1
# u positive: y reaches its level 1 within steps; sign turns the motion round from the 13th sample on
INPUTS = np.column_stack([2.7 + 0.02 * np.arange(60), np.where((np.arange(60) // 13) % 2 == 0, 1, -1)])


def motion(u: FloatArray, when: float) -> FloatArray:
    """Return y and count after every sample, from y' = gain sign u with y wrapped at 1."""
    rows, y, count = [], 0.0, 0
    for k, (value, sign) in enumerate(u):
        kicked = np.clip((k + 1) * DT - when, 0.0, DT)  # time in this sample with the gain doubled
        y += sign * value * (DT + kicked)
        while y > 1.0 + 1e-12:
            y, count = y - 1.0, count + 1
        rows.append((y, count))
    return np.array(rows)


@pytest.fixture
def events(odd_fmu: Callable[..., Path]) -> Iterator[Callable[..., FmuPlant]]:
    made: list[FmuPlant] = []

    def make(**options: Any) -> FmuPlant:
        made.append(FmuPlant(odd_fmu("events", 3), **{"sample_time": DT, **options}))
        made[-1].reset(rng=RNG)
        return made[-1]

    yield make
    for plant in made:
        plant.close()


@pytest.mark.parametrize("when", [1000.0, 1.7, 2.345])
@pytest.mark.parametrize("early", [False, True])
@pytest.mark.parametrize("step", [None, 0.02])
def test_events_in_event_mode_give_the_motion_of_the_equation(
    events: Callable[..., FmuPlant], when: float, early: bool, step: float | None
) -> None:
    inside = events(parameters={"when": when}, step=step).rollout(INPUTS)
    outside = events(parameters={"when": when}, step=step, event_mode=True, early_return=early)
    got = outside.rollout(INPUTS)
    expected = motion(INPUTS, when)
    assert expected[-1, 1] >= 1, "there must be something to find"
    for rows in (inside, got):
        assert rows == pytest.approx(expected, abs=1e-9)
    outside.reset(rng=RNG)
    assert np.array_equal(np.array([outside.step(row) for row in INPUTS]), got)
    assert outside.file.interface("cs").hasEventMode


def test_event_mode_is_entered_for_events_and_for_discrete_inputs_only(events: Callable[..., FmuPlant]) -> None:
    plant = events(event_mode=True, early_return=True, outputs=["entries", "count"], parameters={"when": 1.25})
    rows = plant.rollout(INPUTS[:30])
    turns = int(np.count_nonzero(np.diff(INPUTS[:30, 1])))
    assert rows[-1, 0] == turns + rows[-1, 1] + 1  # the last one is the event in time


def test_a_snapshot_brings_the_announced_event_back(events: Callable[..., FmuPlant]) -> None:
    plant = events(event_mode=True, early_return=True, parameters={"when": 2.345})
    plant.rollout(INPUTS[:20])
    kept, packed = plant.get_state(), plant.serialize_state()
    rest = plant.rollout(INPUTS[20:])  # passes the event in time, after which no other is announced
    plant.set_state(kept)
    assert np.array_equal(plant.rollout(INPUTS[20:]), rest)
    plant.deserialize_state(packed)
    assert np.array_equal(plant.rollout(INPUTS[20:]), rest)


def test_the_fmu_may_end_the_simulation_at_an_event(events: Callable[..., FmuPlant]) -> None:
    plant = events(event_mode=True, parameters={"limit": 1})
    with pytest.raises(PlantError, match="ends the simulation at an event") as caught:
        plant.rollout(INPUTS)
    assert caught.value.status == "terminated"
    with pytest.raises(InputError, match="reset"):
        plant.step(INPUTS[0])


def test_clocks_are_listed_told_and_refused_as_signals(events: Callable[..., FmuPlant]) -> None:
    plant = events()
    assert [channel.name for channel in plant.spec.outputs] == ["y", "count"]
    assert any("clocks" in text and "tick" in text for text in plant.warnings)
    assert "tick" in [row["name"] for row in describe(plant.file.path)["variables"]]
    with pytest.raises(InputError, match=r"'tick' cannot be a signal.*got Clock"):
        FmuPlant(plant.file.path, sample_time=DT, outputs=["tick"])


@pytest.mark.parametrize("option", ["event_mode", "early_return"])
def test_event_mode_is_refused_where_there_is_none(odd_fmu: Callable[..., Path], option: str) -> None:
    for path in (mockup("pendulum", 2), odd_fmu("ball", 3)):
        with pytest.raises(InputError, match=option):
            FmuPlant(path, sample_time=DT, **{option: True})
    if option == "event_mode":
        with pytest.raises(InputError, match="without hasEventMode"):
            FmuPlant(mockup("pendulum", 3), sample_time=DT, event_mode=True)


@pytest.mark.parametrize("option", ["parameters", "start"])
def test_values_without_names_are_refused(option: str) -> None:
    with pytest.raises(InputError, match=f"option {option}.*values by name"):
        FmuPlant(mockup("pendulum", 2), sample_time=DT, **{option: "Fc: 0.1"})
