"""Model exchange: states integrated here, events located, snapshots exact, failures named."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness.errors import InputError, PlantError
from plants.fmu.plant import FmuPlant

RNG = np.random.default_rng(0)
Make = Callable[..., FmuPlant]


@pytest.fixture(params=[(2, "cvode"), (3, "cvode"), (2, "rk45"), (3, "rk45")], ids=lambda p: f"fmi{p[0]}-{p[1]}")
def ball(request: pytest.FixtureRequest, odd_fmu: Callable[..., Path]) -> Iterator[Make]:
    version, solver = request.param
    made: list[FmuPlant] = []

    def make(**options: Any) -> FmuPlant:
        options = {"sample_time": 0.05, "solver": solver, "tolerance": 1e-9, **options}
        made.append(FmuPlant(odd_fmu("ball", version), **options))
        return made[-1]

    yield make
    for one in made:
        one.close()


def bounces(t: np.ndarray, h: float = 1.0, g: float = 10.0, e: float = 0.5) -> np.ndarray:
    """Return the height of a bouncing ball in closed form."""
    v, start, heights = 0.0, 0.0, np.empty_like(t)
    for k, now in enumerate(t):
        while True:
            flight = (v + np.sqrt(v * v + 2 * g * h)) / g
            if now - start <= flight:
                break
            v, h, start = e * (g * flight - v), 0.0, start + flight
        s = now - start
        heights[k] = h + v * s - g * s * s / 2
    return heights


def test_free_fall_under_an_input_is_exact(ball: Make) -> None:
    plant = ball()
    assert plant.kind == "me"
    assert plant.abilities == {"batch", "snapshots", "truth"}
    plant.reset(rng=RNG, x0={"h": 100.0, "v": 3.0})
    y = plant.rollout(np.full((20, 1), 4.0))
    t = 0.05 * np.arange(1, 21)
    assert y[:, 0] == pytest.approx(100.0 + 3.0 * t - 3.0 * t**2, abs=2e-5)
    assert y[:, 1] == pytest.approx(3.0 - 6.0 * t, abs=2e-5)
    assert plant.truth() == pytest.approx(y[-1])


def test_bounces_are_located(ball: Make) -> None:
    plant = ball(outputs=["h"])
    t = 0.05 * np.arange(25)  # until the third bounce
    got = np.concatenate([plant.reset(rng=RNG), plant.rollout(np.zeros((24, 1)))[:, 0]])
    assert got == pytest.approx(bounces(t), abs=2e-5)


def test_time_event_inside_a_sample(ball: Make) -> None:
    plant = ball(parameters={"when": 0.12, "dv": 7.0}, outputs=["v"])
    plant.reset(rng=RNG, x0={"h": 100.0})
    v = plant.rollout(np.zeros((6, 1)))[:, 0]
    t = 0.05 * np.arange(1, 7)
    assert v == pytest.approx(-10.0 * t + 7.0 * (t > 0.12), abs=1e-6)


def test_stepping_rollout_reset_and_snapshot_agree_bit_for_bit(ball: Make) -> None:
    plant = ball()
    u = 3.0 * np.sin(np.arange(22.0)).reshape(-1, 1)
    plant.reset(rng=RNG)
    rolled = plant.rollout(u)
    plant.reset(rng=RNG)
    stepped = []
    for k, row in enumerate(u):
        if k == 12:
            taken = plant.get_state()
        stepped.append(plant.step(row))
    assert np.array_equal(stepped, rolled)
    plant.set_state(taken)
    assert np.array_equal(plant.rollout(u[12:]), rolled[12:])


def test_the_fmu_may_end_the_simulation(ball: Make) -> None:
    plant = ball(parameters={"end": 0.2})
    plant.reset(rng=RNG, x0={"h": 100.0})
    with pytest.raises(PlantError, match="ends the simulation") as caught:
        plant.rollout(np.zeros((10, 1)))
    assert caught.value.status == "terminated"
    with pytest.raises(InputError, match="reset"):
        plant.step(np.zeros(1))


def test_events_without_end_are_named(ball: Make) -> None:
    plant = ball()  # the bounces of a ball that comes to rest accumulate (Zeno)
    plant.reset(rng=RNG)
    with pytest.raises(PlantError, match="1000 events") as caught:
        plant.rollout(np.zeros((40, 1)))
    assert caught.value.status == "timeout"


def test_local_variables_in_other_units_become_si(ball: Make) -> None:
    plant = ball(outputs=["height_mm"])
    assert plant.spec.outputs[0].unit == "m"
    assert plant.reset(rng=RNG, x0={"h": 1.5}) == pytest.approx([1.5])


def test_agrees_with_fmpy(odd_fmu: Callable[..., Path]) -> None:
    import fmpy

    path = odd_fmu("ball", 2)
    theirs = fmpy.simulate_fmu(
        str(path), stop_time=1.0, output_interval=0.05, relative_tolerance=1e-9, record_events=False, output=["h"]
    )
    with FmuPlant(path, sample_time=0.05, outputs=["h"], tolerance=1e-9) as plant:
        ours = np.concatenate([plant.reset(rng=RNG), plant.rollout(np.zeros((20, 1)))[:, 0]])
    assert ours == pytest.approx(theirs["h"], abs=1e-4)


@pytest.mark.parametrize("version", [2, 3])
def test_at_the_default_tolerance_agrees_with_fmpy_and_with_the_closed_form(
    odd_fmu: Callable[..., Path], version: int
) -> None:
    import fmpy

    path = odd_fmu("ball", version)
    theirs = fmpy.simulate_fmu(
        str(path), stop_time=1.0, output_interval=0.05, relative_tolerance=1e-8, record_events=False, output=["h"]
    )
    for solver, error in (("cvode", 2e-6), ("rk45", 1e-12)):
        with FmuPlant(path, sample_time=0.05, outputs=["h"], solver=solver) as plant:  # type: ignore[arg-type]
            assert plant.tolerance == 1e-8
            ours = np.concatenate([plant.reset(rng=RNG), plant.rollout(np.zeros((20, 1)))[:, 0]])
        assert ours == pytest.approx(bounces(0.05 * np.arange(21)), abs=error)
        assert ours == pytest.approx(theirs["h"], abs=error + 1e-7)


def test_an_unknown_solver_is_refused(odd_fmu: Callable[..., Path]) -> None:
    with pytest.raises(InputError, match="solver"):
        FmuPlant(odd_fmu("ball", 2), sample_time=0.05, solver="euler")  # type: ignore[arg-type]
