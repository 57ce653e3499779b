"""An FMU that never returns from a step for some values: they are taken as impossible, and the others go on."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from harness.blackbox.reader import fmu_system
from harness.blackbox.runner import Runner
from harness.blackbox.simulator import FmuSimulator
from harness.diagnosis.fmu.prepare import choose_horizon, nominal_fmu
from harness.errors import PlantError
from harness.fmi import build
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory
from harness.supervision.patience import waiting

DT, N = 0.05, 200
SPEC = PlantSpec((Channel("u", "1"),), (Channel("y", "1"),), DT)
T = DT * np.arange(N)
U = np.sin(T)[:, None]


@pytest.fixture
def hanging(tmp_path: Path) -> Path:
    """An integrator that hangs from the time ``when`` on, 5 s as it stands."""
    if build.compiler() is None:
        pytest.skip("no C compiler: install gcc")
    source = Path(__file__).parents[1] / "plants" / "fmus" / "hostile"
    shutil.copytree(source, tmp_path / "source")
    described = tmp_path / "source" / "modelDescription.xml"
    text = described.read_text().replace('<Integer start="0"/>', '<Integer start="4"/>')
    described.write_text(text.replace('<Real start="0.02"/>', '<Real start="5"/>'))
    build.build_fmu(tmp_path / "source", 2, tmp_path / "theirs.fmu")
    return tmp_path / "theirs.fmu"


def test_values_that_hang_are_impossible_and_the_next_run_is_as_before(hanging: Path) -> None:
    system = fmu_system(hanging, SPEC, {"when": 20.0})
    with waiting(0.5):
        simulator = FmuSimulator(system, Runner(system, DT))
    x0 = np.zeros(system.nx)
    good = simulator.run(np.array([20.0]), x0, U)[1]
    assert good[:, 0] == pytest.approx(DT * np.concatenate([[0.0], np.cumsum(U[:-1, 0])]), abs=1e-9)
    assert np.isnan(simulator.run(np.array([5.0]), x0, U)[1][1:]).all()
    assert simulator.runner.stuck is not None
    assert str(simulator.runner.stuck).startswith("theirs.fmu: the step from t = 5 s does not end within 0.5 s (")
    assert np.array_equal(simulator.run(np.array([20.0]), x0, 1.0 * U)[1], good)


def test_a_model_that_hangs_as_it_stands_says_when(hanging: Path) -> None:
    record = Trajectory(T, U, np.cumsum(U, axis=0) * DT, SPEC)
    data = Dataset("hanging", (Run(record, "estimation"),))
    with waiting(0.5):
        with pytest.raises(PlantError, match="the step from t = 5 s does not end"):
            nominal_fmu(hanging, data)
        system = fmu_system(hanging, SPEC)  # where the first look is too short to meet it
        with pytest.raises(PlantError, match="the step from t = 5 s does not end"):
            choose_horizon(system, system.values(), data, Runner(system, DT))
