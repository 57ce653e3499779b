"""Parameters of a system of FMUs from records, and the package that holds them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from harness import api, calibrate
from harness.calibration.variables import contents_of, free_parameters
from harness.errors import InputError
from harness.parts.files import make_plant
from harness.signals import Trajectory

TRUTH = {"arm.mgl": 1.3, "law.Kp": 1.5}


@pytest.fixture(scope="module")
def packages(script: Callable[[str], ModuleType]) -> ModuleType:
    """The packages that the tests of co-simulation build."""
    return script("tests/cosim/test_cosim_ssp.py")


@pytest.mark.slow
def test_parameters_of_two_components(tmp_path: Path, packages: ModuleType) -> None:
    system, copy = tmp_path / "loop.ssp", tmp_path / "copy.ssp"
    packages.package(system)
    rng = np.random.default_rng(0)
    with make_plant(str(system), {"sample_time": 0.02, "parameters": TRUTH}) as plant:
        u = np.repeat(rng.normal(size=(6, 1)), 20, axis=0)
        y = np.vstack([plant.reset(rng=rng, x0={"arm.theta": 0.2}), plant.rollout(u[:-1])])
        record = Trajectory(np.arange(120) * 0.02, u, y + 1e-3 * rng.normal(size=y.shape), plant.spec)
    found = calibrate(record, model=system, free=list(TRUTH), starts=1, model_out=copy)
    assert found.estimate.covariance is not None
    for name, deviation in zip(found.estimate.names, np.sqrt(np.diag(found.estimate.covariance)), strict=True):
        assert abs(found.parameters[name] - TRUTH[name]) < 4 * deviation < 0.1
    assert found.before == {"arm.mgl": 1.0, "law.Kp": 0.8}  # the FMU's own, and what the package binds
    assert found.starts[0]["arm.theta"] == pytest.approx(0.2, abs=5e-3)
    window = {"stop": 1.0, "step": 0.02}
    theirs = api.simulate(str(copy), **window)
    ours = api.simulate(str(system), options={"parameters": found.parameters}, **window)
    assert np.array_equal(theirs.y, ours.y)


def test_names_of_a_system_and_its_values(tmp_path: Path, packages: ModuleType) -> None:
    """What can be free in a system: components' parameters, with the values that the package binds."""
    system = packages.package(tmp_path / "loop.ssp")
    contents = contents_of(system)
    assert contents.variables["law.Kp"].start == 0.8
    assert contents.variables["arm.J"].start == pytest.approx(0.05)  # 500 kg cm^2
    (gain,) = free_parameters(contents, ["law.Kp"], {"law.Kp": (0.1, 2.0)}, {})
    assert (gain.value, gain.minimum, gain.maximum) == (0.8, 0.1, 2.0)
    with pytest.raises(InputError, match=r"did you mean law\.Kp"):
        free_parameters(contents, ["law.kp"], {}, {})
    with (
        make_plant(str(system), {"sample_time": 0.02}) as plant,
        make_plant(str(system), {"sample_time": 0.02, "parameters": TRUTH}) as other,
    ):
        u = np.full((20, 1), 0.5)
        rows = []
        for one, values in ((plant, TRUTH), (other, {})):
            one.preset(values)  # type: ignore[attr-defined]
            one.reset(rng=np.random.default_rng(0))
            rows.append(one.rollout(u))  # type: ignore[attr-defined]
        assert np.array_equal(*rows)
