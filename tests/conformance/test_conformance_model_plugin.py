"""A model that another distribution registers is a nominal model like ours, in every command that takes one."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from harness import api, registry
from harness.errors import InputError
from harness.physics import load_model

MODULE = '''
"""Models of somebody else."""

from harness.physics import Mechanism


def slider():
    """Mass that slides on a rail with viscous friction."""
    made = Mechanism(
        "slider", q="s", u="push", p="m c", units={"s": "m"}, parameters={"m": ("kg", 1.0), "c": ("N s/m", 0.5)}
    )
    (s,), (v,), (push,), (m, c) = made.q, made.v, made.u, made.p
    made.body(m, (s, 0))
    made.Q = [push - c * v]
    return made
'''


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Return an environment with an installed distribution that registers a model."""
    site = tmp_path_factory.mktemp("site")
    (site / "sliding.py").write_text(MODULE)
    described = site / "sliding-0.1.dist-info"
    described.mkdir()
    (described / "METADATA").write_text("Metadata-Version: 2.1\nName: sliding\nVersion: 0.1\n")
    (described / "entry_points.txt").write_text("[sysid_harness.models]\nslider = sliding:slider\n")
    paths = [str(site), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a CSV file of the slider: m = 2 kg, c = 0.8 N s/m."""
    rng, dt = np.random.default_rng(0), 0.05
    force = np.repeat(rng.normal(size=30), 10).tolist()
    decay = np.exp(-0.4 * dt)
    s, v, rows = 0.0, 0.0, []
    for k, u in enumerate(force):
        rows.append(f"{k * dt:.2f},{u!r},{float(s + 1e-4 * rng.normal())!r}")
        steady = u / 0.8
        s += steady * dt + (v - steady) * (1 - decay) / 0.4
        v = steady + (v - steady) * decay
    path = tmp_path_factory.mktemp("data") / "run.csv"
    path.write_text("time [s],push [N],s [m]\n" + "\n".join(rows) + "\n")
    return path


def sysid(environment: dict[str, str], *arguments: object) -> subprocess.CompletedProcess[str]:
    code = "import sys; from harness.command import main; main(sys.argv[1:])"
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )


def test_identify_passes_the_model_on(environment: dict[str, str], record: Path, tmp_path: Path) -> None:
    out = tmp_path / "model.json"
    done = sysid(environment, "identify", record, "--identifier", "output-error", "--model", "slider", "-o", out)
    assert done.returncode == 0, done.stderr
    fitted = json.loads(out.read_text())
    assert fitted["model"] == "slider"
    assert fitted["parameters"] == pytest.approx({"m": 2.0, "c": 0.8}, rel=5e-3)


@pytest.mark.slow
def test_the_loop_is_closed_and_exported_with_it(environment: dict[str, str], record: Path, tmp_path: Path) -> None:
    done = sysid(environment, "close-loop", record, "--model", "slider", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "out" / "report.json").read_text())["verdict"] == "nothing_missing"
    done = sysid(environment, "export", tmp_path / "out", "-o", tmp_path / "slider.fmu", "--fmi", "2")
    assert done.returncode == 0, done.stderr


def test_isolability_and_check_know_it(environment: dict[str, str]) -> None:
    planned = sysid(environment, "isolability", "slider", "--scenario", "multisine", "-S", "duration=4.0", "--json")
    assert planned.returncode == 0, planned.stderr
    assert any("coulomb_friction" in text for text in json.loads(planned.stdout)["effects"])
    off = sysid({**environment, "SYSID_HARNESS_NO_PLUGINS": "1"}, "isolability", "slider", "--scenario", "multisine")
    assert off.returncode == 2
    assert "unknown model" in off.stderr


def test_an_unknown_model_is_answered_with_the_nearest() -> None:
    with pytest.raises(InputError, match=r"unknown model.*did you mean pendulum"):
        load_model("pendulm")


def test_identify_fits_the_model_that_is_named(record: Path) -> None:
    text = record.read_text().replace("push [N],s [m]", "u [N],q [m]")
    other = record.with_name("drive.csv")
    other.write_text(text)
    for name in ("oscillator", "drive"):  # both have these ports: without a name there is no choosing
        assert api.identify(other, model=name, identifier="lumped-momentum").model.to_dict()["model"] == name
    with pytest.raises(InputError):
        registry.create("identifiers", "lumped-momentum").fit(
            [r.trajectory for r in _loaded(other).dataset.runs], rng=np.random.default_rng(0)
        )


def _loaded(path: Path):
    from harness.data import load_dataset

    return load_dataset(path, model="drive")
