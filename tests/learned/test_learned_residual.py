"""A force learned at the end of a closed loop: it lowers the error, says what it is not, exports, and refuses."""

from __future__ import annotations

import functools
import json
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from harness import api
from harness.errors import InputError
from harness.physics.fitting.output_error import fit_output_error
from harness.physics.fitting.residual_force import LABEL
from harness.physics.models import pendulum
from harness.registry import create
from harness.rng import Streams
from harness.rollout import run
from harness.signals import Trajectory
from identifiers.mechanics.grey_box import GreyBoxModel
from identifiers.mechanics.physical import recipe_for


@functools.cache
def records(friction: float | None) -> tuple[Trajectory, Trajectory]:
    """Return records of an arm of PyBullet with joint friction in N m, or of the pendulum of the model itself."""
    if friction is None:
        arm = create("plants", "pendulum-ode", sample_time=0.02)
    else:
        arm = create("plants", "arm-bullet", joint_friction=friction, sample_time=0.02)
    scenario = create("scenarios", "multisine", duration=8.0, amplitude=2.0, band=[0.05, 2.0], noise=0.001)
    streams = Streams("arm", "multisine", 0)
    first, second = (run(arm, scenario, streams=streams, role=f"{role}/0").measured() for role in ("e", "v"))
    return first, second


def data(folder: Path, friction: float | None) -> Path:
    """Write the records and the data set of a loop."""
    for record, name in zip(records(friction), ("e.csv", "v.csv"), strict=True):
        rows = np.column_stack([record.t, record.u[:, 0], record.y[:, 0]])
        np.savetxt(folder / name, rows, delimiter=",", header="time [s],u [N m],theta [rad]", comments="")
    (folder / "dataset.toml").write_text(
        'name = "arm"\nsignals.u = { role = "input" }\nsignals.theta = { role = "output" }\n'
        'nominal.model = "pendulum"\nnominal.parameters.mgl = { value = 9.81 }\n'
        '[[runs]]\nfile = "e.csv"\n[[runs]]\nfile = "v.csv"\nuse = "validation"\n'
    )
    return folder / "dataset.toml"


@functools.cache
def fitted() -> dict[str, float]:
    """Return the parameters of the arm, from a record without friction."""
    return dict(fit_output_error(pendulum().system(), [records(0.0)[0]], horizon=1.0).parameters)


def loop(folder: Path, verdict: str = "unexplained", values: dict[str, float] | None = None) -> Path:
    """Write what a closed loop leaves: the pendulum with its parameters right, and no dry friction."""
    spec = records(0.0)[0].spec
    model = GreyBoxModel(spec, recipe_for(spec, "loop", model="pendulum"), fitted() if values is None else values)
    (folder / "loop").mkdir()
    (folder / "loop" / "model.json").write_text(json.dumps(model.to_dict()))
    report = {
        "format": "sysid-harness/close-loop/2",
        "verdict": verdict,
        "adequacy": "does_not_fit" if verdict == "unexplained" else "explained",
        "model": "pendulum",
        "dataset": "arm",
        "summary": "a force is missing",
        "horizon": {"seconds": 2.0, "reason": "test"},
    }
    (folder / "loop" / "report.json").write_text(json.dumps(report))
    return folder / "loop"


def test_the_command_learns_labels_and_exports_into_the_same_fmu(tmp_path, sysid):
    folder, dataset = loop(tmp_path), data(tmp_path, 0.15)
    out = tmp_path / "learned"
    said = sysid("learn-residual", folder, dataset, "--out", out, "--argument", "theta_rate").out
    assert LABEL in said
    found = json.loads((out / "learned.json").read_text())
    rms = found["errors"]["validation"]["theta"]
    assert found["helps"]
    assert rms["after"] < 0.5 * rms["before"]
    assert found["parameters"]["after"]["J"] == found["parameters"]["before"]["J"], "named parameters stay"
    assert found["force"]["hull"]["low"][0] < -1.0 < 1.0 < found["force"]["hull"]["high"][0]
    page = (out / "learned.html").read_text()
    assert LABEL in page
    assert "with the force" in page
    sysid("export", out, "-o", tmp_path / "repaired.fmu", "--fmi", "2")
    with zipfile.ZipFile(tmp_path / "repaired.fmu") as archive:
        described = ElementTree.fromstring(archive.read("modelDescription.xml"))
    assert LABEL in described.attrib["description"]
    assert "known for theta_rate in [" in described.attrib["description"]
    sysid("learn-residual", folder, dataset, "--out", out, status=2)  # an earlier result is not overwritten
    with pytest.raises(InputError, match="not a finished closed loop"):
        api.learn_residual(out, dataset, out=tmp_path / "twice")


def test_refit_moves_named_parameters_but_those_that_are_known(tmp_path):
    folder, dataset = loop(tmp_path), data(tmp_path, 0.15)
    found = api.learn_residual(folder, dataset, out=tmp_path / "out", arguments=["theta_rate"], refit=True)
    before, after = found.data["parameters"]["before"], found.data["parameters"]["after"]
    assert after["mgl"] == before["mgl"], "declared fixed in the data set"
    assert after["b"] != before["b"]


def test_where_only_noise_is_left_nothing_is_learned(tmp_path):
    folder, dataset = loop(tmp_path, values=pendulum().system().values()), data(tmp_path, None)
    found = api.learn_residual(folder, dataset, out=tmp_path / "out")
    assert found.data["errors"]["validation"]["theta"]["before"] < 1.05e-3, "the noise of the record"
    assert not found.learned.helps
    assert "stays as it is" in str(found)
    assert not (tmp_path / "out" / "model.json").exists()
    assert (tmp_path / "out" / "learned.html").is_file()


def test_refusals(tmp_path):
    dataset = data(tmp_path, 0.15)
    with pytest.raises(InputError, match="not a model"):
        api.learn_residual(tmp_path, dataset, out=tmp_path / "out")
    folder = loop(tmp_path, verdict="nothing_missing")
    with pytest.raises(InputError, match="nothing to learn"):
        api.learn_residual(folder, dataset, out=tmp_path / "out")
    with pytest.raises(InputError, match="a folder of its own"):
        api.learn_residual(folder, dataset, out=folder)
    assert not (tmp_path / "out").exists()
