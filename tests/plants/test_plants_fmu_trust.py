"""An FMU's reset and its kept states are believed only after they were tried."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from harness.errors import InputError, PlantError
from plants.fmu.plant import FmuPlant
from plants.fmu.probe import probe
from plants.isolation.isolated import IsolatedPlant
from plants.mockups import mockup

RNG = np.random.default_rng(0)
SOUND, KEEPS_STATE, KEEPS_START, KEEPS_LIBRARY, LOSES_SNAPSHOT, STANDS_STILL = range(6)
INPUTS = np.linspace(0.5, 2.0, 30)[:, None]


def forgetful(path: Path, mode: int) -> dict[str, object]:
    """Return the options of a plant that forgets to forget."""
    return {"path": str(path), "sample_time": 0.1, "parameters": {"mode": mode}}


def rolled(plant: FmuPlant | IsolatedPlant, how: str, x0: dict[str, float] | None = None) -> np.ndarray:
    """Return the outputs of one run."""
    first = plant.reset(rng=RNG, x0=x0)
    if how == "batch":
        return np.vstack([first, plant.rollout(INPUTS)])
    return np.vstack([first, *(plant.step(row) for row in INPUTS)])


@pytest.mark.parametrize("how", ["batch", "steps"])
@pytest.mark.parametrize(("mode", "found"), [(SOUND, "reset"), (KEEPS_STATE, "instance")])
def test_a_second_run_is_the_first_one(
    how: str, mode: int, found: str, odd_fmu: Callable[..., Path], caplog: pytest.LogCaptureFixture
) -> None:
    with (
        caplog.at_level(logging.WARNING, "plants.fmu.plant"),
        FmuPlant(**forgetful(odd_fmu("forgetful"), mode)) as plant,
    ):
        runs = [rolled(plant, how) for _ in range(4)]
        assert plant.way_back == found
        assert sum("reset does not bring the FMU back" in text for text in plant.warnings) == (found != "reset")
    for again in runs[1:]:
        assert np.array_equal(again, runs[0])
    assert runs[0][-1] == pytest.approx([0.1 * INPUTS.sum()])
    assert sum("every run gets a fresh instance" in r.message for r in caplog.records) == (found != "reset")


def test_a_start_value_does_not_outlive_its_run(odd_fmu: Callable[..., Path]) -> None:
    with FmuPlant(**forgetful(odd_fmu("forgetful"), KEEPS_START)) as plant:
        assert rolled(plant, "batch", {"y": 100.0})[0] == [100.0]
        assert rolled(plant, "batch")[0] == [0.0]
        assert plant.way_back == "instance"


def test_a_loop_in_c_is_held_against_a_fresh_instance(odd_fmu: Callable[..., Path]) -> None:
    for mode, found in ((SOUND, "reset"), (KEEPS_STATE, "instance")):
        with FmuPlant(**forgetful(odd_fmu("forgetful"), mode)) as plant:
            plant.reset(rng=RNG)
            assert plant.native_step() is not None
            plant._engine.u[:] = 1.0
            assert [plant._engine.one() for _ in range(9)] == [0] * 9  # as a loop in C would
            assert plant.reset(rng=RNG) == [0.0]
            assert plant.way_back == found


def test_where_only_a_fresh_process_helps_an_isolated_plant_takes_one(odd_fmu: Callable[..., Path]) -> None:
    options = forgetful(odd_fmu("forgetful"), KEEPS_LIBRARY)
    with IsolatedPlant("fmu", options) as plant:
        runs = [rolled(plant, "batch") for _ in range(3)]
        assert len(plant.warnings) == 1
        assert "only a fresh process does" in plant.warnings[0]
    assert np.array_equal(runs[1], runs[0])
    assert np.array_equal(runs[2], runs[0])
    with FmuPlant(**options) as plant:
        rolled(plant, "batch")
        rolled(plant, "batch")
        assert plant.needs_process


def test_states_that_are_not_kept_are_refused_once_they_are_asked_for(odd_fmu: Callable[..., Path]) -> None:
    with FmuPlant(**forgetful(odd_fmu("forgetful"), LOSES_SNAPSHOT)) as plant:
        plant.reset(rng=RNG)
        plant.step(np.ones(1))
        assert "snapshots" in plant.abilities
        with pytest.raises(InputError, match=r"another continuation.*replay the inputs"):
            plant.get_state()
        assert "snapshots" not in plant.abilities
        assert rolled(plant, "batch")[-1] == pytest.approx([0.1 * INPUTS.sum()])


@pytest.mark.parametrize("how", ["batch", "steps"])
def test_an_fmu_that_stands_still_where_a_way_back_is_asked_for_runs_and_gives_no_states(
    how: str, odd_fmu: Callable[..., Path]
) -> None:
    with FmuPlant(**forgetful(odd_fmu("forgetful"), STANDS_STILL)) as plant:
        wanted = rolled(plant, how)
        assert wanted[-1] == pytest.approx([0.1 * INPUTS.sum()])
        plant.reset(rng=RNG)
        plant.step(np.ones(1))
        with pytest.raises(InputError, match=r"another continuation.*replay the inputs"):
            plant.get_state()
        assert np.array_equal(rolled(plant, how), wanted)


@pytest.mark.parametrize("fmi", [2, 3])
def test_trying_a_state_leaves_the_run_as_it_was(fmi: int) -> None:
    inputs = 0.3 * INPUTS
    with (
        FmuPlant(mockup("pendulum", fmi), sample_time=0.02) as plant,
        FmuPlant(mockup("pendulum", fmi), sample_time=0.02) as other,
    ):
        expected = [other.reset(rng=RNG), *other.rollout(inputs)]
        assert np.array_equal(plant.reset(rng=RNG), expected[0])
        for k, row in enumerate(inputs):
            assert np.array_equal(plant.step(row), expected[k + 1])
            if k in (0, 7):
                state = plant.get_state()
        assert plant.truth()[0] == expected[-1][0]
        plant.set_state(state)
        assert np.array_equal(plant.rollout(inputs[8:]), expected[9:])


def test_the_probe_says_it(odd_fmu: Callable[..., Path]) -> None:
    result = probe(odd_fmu("forgetful"), sample_time=0.1, parameters={"mode": KEEPS_STATE}, samples=40)
    found = {finding.check: finding for finding in result.findings}
    assert found["reset"].passed is False
    assert "fresh instance" in found["reset"].note
    result = probe(odd_fmu("forgetful"), sample_time=0.1, parameters={"mode": LOSES_SNAPSHOT}, samples=40)
    assert {f.check: f.passed for f in result.findings}["restore"] is False


def test_a_run_that_fails_on_trial_does_not_end_the_plant(odd_fmu: Callable[..., Path]) -> None:
    options = {"path": str(odd_fmu("hostile")), "sample_time": 0.01, "parameters": {"mode": 9, "when": 0.05}}
    with FmuPlant(**options) as plant:
        for _ in range(3):
            plant.reset(rng=RNG)
            with pytest.raises(PlantError, match="told to fail"):
                plant.rollout(np.ones((20, 1)))
        assert plant.way_back == "reset"
