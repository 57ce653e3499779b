"""Inputs and outputs of an FMU with units that have an offset: what goes in comes out, in SI."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import plants.fmu.engine
from plants.fmu.plant import FmuPlant

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("native", [True, False])
@pytest.mark.parametrize("version", [2, 3])
def test_temperatures_are_kelvin_outside_and_what_they_are_inside(
    native: bool, version: int, odd_fmu: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    if not native:
        monkeypatch.setattr(plants.fmu.engine, "native_library", lambda: None)
    with FmuPlant(odd_fmu("oven", version), sample_time=0.1) as plant:
        assert [str(channel) for channel in plant.spec.inputs] == ["wanted [K]", "drive [V]"]
        assert [channel.unit for channel in plant.spec.outputs] == ["K", "1"]
        assert plant.input_starts == pytest.approx([293.15, 0.0])
        assert plant.reset(rng=RNG)[0] == pytest.approx(293.15)
        air, raw = plant.step(np.array([300.0, 0.5]))
        assert air == pytest.approx(300.0)
        assert raw == pytest.approx(26.85 + 500.0)
        assert plant.rollout(np.array([[310.0, 0.0]] * 3))[-1] == pytest.approx([310.0, 36.85])
        assert plant.reset(rng=RNG, x0={"air": 283.15})[0] == pytest.approx(283.15)
