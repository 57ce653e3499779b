"""FMUs that end a step in anything but success: each way has its status, and the plant survives."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from harness.errors import InputError, PlantError
from plants.fmu import engine as fmu_engine
from plants.fmu.plant import FmuPlant

RNG = np.random.default_rng(0)
MODES = {
    name: code
    for code, name in enumerate(
        "well segfault aborts exits hangs returns_nan chatters discards terminates fails fatal warns halves crawls "
        "pends fails_start crashes_start hangs_start".split()
    )
}
Make = Callable[..., FmuPlant]


@pytest.fixture(params=[True, False], ids=["c-loop", "python-loop"])
def make(
    request: pytest.FixtureRequest, odd_fmu: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> Iterator[Make]:
    if not request.param:
        monkeypatch.setattr(fmu_engine, "native_library", lambda: None)
    made: list[FmuPlant] = []

    def plant(mode: str, version: int = 2) -> FmuPlant:
        made.append(
            FmuPlant(odd_fmu("hostile", version), sample_time=0.01, step=0.005, parameters={"mode": MODES[mode]})
        )
        return made[-1]

    yield plant
    for one in made:
        one.close()


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize(
    ("mode", "status", "words"),
    [
        ("returns_nan", "diverged", "not finite"),
        ("discards", "crashed", "discarded"),
        ("terminates", "terminated", "ends the simulation at t = 0.02"),
        ("fails", "crashed", r"\(error\).*told to fail"),
        ("fatal", "crashed", r"\(fatal\)"),
    ],
)
def test_each_bad_end_has_its_status(make: Make, mode: str, status: str, words: str, version: int) -> None:
    for many in (False, True):
        plant = make(mode, version)
        plant.reset(rng=RNG)
        before = [] if many else [plant.step(np.ones(1))[0] for _ in range(2)]
        assert many or before == pytest.approx([0.01, 0.02])
        with pytest.raises(PlantError, match=words) as caught:
            plant.rollout(np.ones((5, 1))) if many else plant.step(np.ones(1))
        assert caught.value.status == status
        assert "\n" not in str(caught.value)
        with pytest.raises(InputError, match="reset"):
            plant.step(np.ones(1))
        if mode == "fatal":
            with pytest.raises(PlantError, match="fatal"):
                plant.reset(rng=RNG)
        else:
            assert plant.reset(rng=RNG) == pytest.approx([0.0])
            assert plant.rollout(np.ones((2, 1)))[-1] == pytest.approx([0.02])


def test_a_pending_step_is_refused(make: Make) -> None:
    plant = make("pends")
    plant.reset(rng=RNG)
    with pytest.raises(PlantError, match="pending"):
        plant.rollout(np.ones((5, 1)))


def test_a_start_that_fails_says_why(make: Make) -> None:
    plant = make("fails_start")
    with pytest.raises(PlantError, match="told to fail at the start") as caught:
        plant.reset(rng=RNG)
    assert caught.value.status == "crashed"


@pytest.mark.parametrize("version", [2, 3])
def test_a_step_that_ends_early_is_continued(make: Make, version: int) -> None:
    plain, early = make("well", version), make("halves", version)
    u = np.arange(8.0).reshape(-1, 1)
    results = []
    for plant in (plain, early):
        plant.reset(rng=RNG)
        stepped = np.array([plant.step(row) for row in u])
        plant.reset(rng=RNG)
        assert np.array_equal(plant.rollout(u), stepped)
        results.append(stepped)
    assert np.allclose(results[0], results[1], rtol=0, atol=1e-14)


def test_endless_discards_end(make: Make) -> None:
    plant = make("crawls")
    plant.reset(rng=RNG)
    with pytest.raises(PlantError, match="does not end") as caught:
        plant.rollout(np.ones((5, 1)))
    assert caught.value.status == "timeout"


@pytest.mark.parametrize("version", [2, 3])
def test_warnings_are_logged_and_the_run_goes_on(make: Make, version: int, caplog: pytest.LogCaptureFixture) -> None:
    plant = make("warns", version)
    plant.reset(rng=RNG)
    with caplog.at_level(logging.WARNING, logger="plants.fmu.plant"):
        assert plant.rollout(np.ones((5, 1)))[-1] == pytest.approx([0.05])
    assert "calls ended with a warning" in caplog.text


def test_messages_of_the_fmu_go_to_the_log_not_to_stdout(
    make: Make, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    plant = make("fails")
    plant.reset(rng=RNG)
    with caplog.at_level(logging.WARNING, logger="plants.fmu.plant"), pytest.raises(PlantError):
        plant.rollout(np.ones((5, 1)))
    assert "told to fail" in caplog.text
    assert capfd.readouterr().out == ""
