"""Sensitivities of whole runs out of an FMU's own directional derivatives, held against differences of runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from harness.calibration import calibrate
from harness.calibration.slopes import OwnSlopes, sensitivities
from harness.signals import Dataset, PlantSpec, Run, Trajectory
from plants.fmu.plant import FmuPlant
from plants.isolation.isolated import isolated

BOTH = pytest.mark.parametrize("version", [2, 3])
DT = 0.05
DERIVATIVES = {"h": "der(h)", "v": "der(v)"}


def pushes(n: int) -> np.ndarray:
    return 8.0 + 3.0 * np.repeat(np.random.default_rng(0).normal(size=(n // 5, 1)), 5, axis=0)


@BOTH
@pytest.mark.parametrize("apart", [False, True], ids=["here", "in a process of its own"])
def test_partial_derivatives_come_with_every_sample(odd_fmu: Callable[..., Path], version: int, apart: bool) -> None:
    options = {"sample_time": DT, "kind": "me", "start": {"h": 50.0}}
    path = odd_fmu("ball", version)
    with isolated("fmu", path=path, **options) if apart else FmuPlant(path, **options) as plant:  # type: ignore[arg-type]
        plant.reset(rng=np.random.default_rng(0))
        told = plant.rollout_partials(pushes(300), ["der(h)", "der(v)", "height_mm"], ["h", "v"])
        assert told.shape == (300, 2, 3, 2)
        np.testing.assert_allclose(told, np.broadcast_to([[0, 1], [0, 0], [1, 0]], told.shape), atol=1e-9)


@BOTH
def test_only_columns_that_agree_with_differences_are_trusted(odd_fmu: Callable[..., Path], version: int) -> None:
    with FmuPlant(odd_fmu("ball", version), sample_time=DT, kind="me") as plant:
        rows = pushes(100)

        def begin(p: np.ndarray, x0: np.ndarray) -> None:
            plant.preset({"g": p[0]})
            plant.reset(rng=np.random.default_rng(0), x0={"h": x0[0], "v": x0[1]})

        def run(p: np.ndarray, x0: np.ndarray, n: int) -> np.ndarray:
            begin(p, x0)
            return np.vstack([[x0[0], x0[1]], plant.rollout(rows[: n - 1])])

        p, x0 = np.array([10.0]), np.array([500.0, 1.0])

        def differences(k: int, n: int) -> np.ndarray:
            moved = np.concatenate([p, x0])
            moved[k] += 1e-3
            return (run(moved[:1], moved[1:], n) - run(p, x0, n)) / 1e-3

        own = OwnSlopes(plant, begin, ["g", "h", "v"], DERIVATIVES, ["h", "v"])
        own.try_out(p, x0, rows, differences)
        assert own.trusted == {1, 2}, "this FMU tells nothing by its parameter"
        found = own(p, x0, rows, [1, 2])
        for column, k in enumerate((1, 2)):
            np.testing.assert_allclose(found[..., column], differences(k, 100), atol=1e-4)
        wrong = OwnSlopes(plant, begin, ["g", "h", "v"], DERIVATIVES, ["h", "v"])
        wrong.try_out(p, x0, rows, lambda k, n: 1.1 * differences(k, n))
        assert not wrong.trusted


def test_a_calibration_by_own_slopes_finds_what_differences_find(odd_fmu: Callable[..., Path]) -> None:
    path, rng = odd_fmu("ball", 2), np.random.default_rng(1)
    u = pushes(80)
    with FmuPlant(path, sample_time=DT, kind="me", outputs=["h"], parameters={"g": 9.0}) as plant:
        y = np.vstack([plant.reset(rng=rng, x0={"h": 60.0, "v": 2.0}), plant.rollout(u[:-1])])
        spec = PlantSpec(plant.spec.inputs, plant.spec.outputs, DT)
    record = Trajectory(DT * np.arange(80), u, y + 0.01 * rng.normal(size=y.shape), spec)
    data = Dataset("ball", (Run(record, "estimation"),), noise={"h": 0.01})
    found = {how: calibrate(path, data, free=["g"], starts=1, slopes=how) for how in ("own", "differences")}
    assert any("h, v" in note for note in found["own"].notes)
    assert found["own"].runs < found["differences"].runs
    for one in found.values():
        assert one.parameters["g"] == pytest.approx(9.0, abs=0.01)
    near = {how: one.estimate.interval("g") for how, one in found.items()}
    np.testing.assert_allclose(near["own"], near["differences"], atol=1e-4)  # type: ignore[arg-type]
    with pytest.raises(Exception, match="expected one of differences, own"):
        calibrate(path, replace(data), free=["g"], slopes="mine")


@settings(deadline=None, max_examples=30)
@given(st.lists(st.floats(-2.0, 2.0), min_size=8, max_size=8), st.integers(2, 30))
def test_sensitivities_of_linear_systems_are_exact(numbers: list[float], n: int) -> None:
    """Those of x' = A x + B p, y = C x + D p are the blocks of the exponential of [[A, B], [0, 0]]."""
    a, b = np.array(numbers[:4]).reshape(2, 2), np.array(numbers[4:6])[:, None]
    c, d = np.array([[1.0, 0.5]]), np.array([[numbers[6]]])
    told = np.tile(np.block([[a, b], [c, d]]), (n, 2, 1, 1))
    start, forced = np.hstack([np.eye(2), np.zeros((2, 1))]), np.array([[0.0, 0.0, 1.0]])
    found = sensitivities(told, 2, 0.1, start, forced)
    whole = expm(0.1 * n * np.block([[a, b], [np.zeros((1, 3))]]))
    np.testing.assert_allclose(found[-1], np.hstack([c, d]) @ whole, rtol=1e-8, atol=1e-8)
