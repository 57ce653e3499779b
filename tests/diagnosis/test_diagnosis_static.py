"""A model without states: a load cell with a gain and an offset, through the command line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from harness.command import main
from harness.diagnosis.records.horizon import choose_horizon
from harness.physics.fitting.output_error import fit_output_error
from harness.physics.symbolic.ode import Ode
from harness.signals import Dataset, PlantSpec, Run, Trajectory

MODEL = '''"""A load cell."""

from harness.physics.symbolic.ode import Ode


def cell():
    made = Ode("cell", x="", u="u", p="a c", units={"u": "N"}, parameters={"a": 1.0, "c": 0.0})
    (u,), (a, c) = made.u, made.p
    made.outputs = {"y": (a * u + c, "N")}
    return made
'''


def written(path: Path, seed: int) -> str:
    """Write a record of y = 2 u + 0.3 + u^3 / 2."""
    rng, t = np.random.default_rng(seed), np.arange(400) * 0.02
    u = sum(0.4 * np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in (0.3, 0.7, 1.1))
    y = 2.0 * u + 0.3 + 0.5 * u**3 + 0.01 * rng.standard_normal(400)
    np.savetxt(path, np.column_stack([t, u, y]), delimiter=",", header="time [s],u [N],y [N]", comments="")
    return str(path)


def test_a_static_model_is_refused_in_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It was a fault, exit 1; without it nothing at the input could be seen, and a cubic law was "nothing missing"."""
    (tmp_path / "cell.py").write_text(MODEL)
    files = [written(tmp_path / f"{seed}.csv", seed) for seed in (1, 2)]
    out = tmp_path / "out"
    arguments = [files[0], "--validation", files[1], "--model", f"{tmp_path / 'cell.py'}:cell", "--out", str(out)]
    with pytest.raises(SystemExit) as end:
        main(["close-loop", *arguments])
    assert end.value.code == 2
    said = capsys.readouterr().err
    assert "the model cell is static" in said
    assert "remedy: give it the dynamics" in said
    assert not (out / "report.json").exists()


def test_a_static_model_can_be_fitted() -> None:
    """As the remedy says."""
    made = Ode("gain", x="", u="u", p="a", units={"u": "N"}, parameters={"a": 1.0})
    made.outputs = {"y": (made.p[0] * made.u[0], "N")}
    system, u = made.system(), np.random.default_rng(0).normal(size=(200, 1))
    record = Trajectory(np.arange(200) * 0.1, u, 3.0 * u, PlantSpec(system.inputs, system.outputs, 0.1))
    assert fit_output_error(system, [record]).parameters["a"] == pytest.approx(3.0)


def test_a_static_model_is_simulated_whole() -> None:
    made = Ode("gain", x="", u="u", p="a", units={"u": "N"}, parameters={"a": 1.0})
    made.outputs = {"y": (made.p[0] * made.u[0], "N")}
    system = made.system()
    record = Trajectory(
        np.arange(80) * 0.1, np.ones((80, 1)), np.ones((80, 1)), PlantSpec(system.inputs, system.outputs, 0.1)
    )
    horizon = choose_horizon(system, system.values(), Dataset("x", (Run(record, "estimation"),)))
    assert (horizon.seconds, "static" in horizon.reason) == (None, True)
