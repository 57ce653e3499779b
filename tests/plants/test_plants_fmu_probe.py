"""The probe finds what is wrong with an FMU, and runs foreign ones where a folder of them is given."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from harness.errors import HarnessError, InputError
from plants.fmu.archive import read_fmu
from plants.fmu.plant import FmuPlant, describe
from plants.fmu.probe import ProbeResult, probe
from plants.isolation.isolated import IsolatedPlant
from plants.mockups import mockup, models

MODES = {"segfault": 1, "hangs": 4, "nan": 5, "terminates": 8}


def verdicts(result: ProbeResult) -> dict[str, bool | None]:
    """Return the verdict of each check."""
    return {finding.check: finding.passed for finding in result.findings}


@pytest.mark.parametrize("model", models())
def test_our_own_fmus_pass(model: str) -> None:
    result = probe(mockup(model), samples=60, isolate=False)
    assert result.passed, str(result)
    assert verdicts(result)["restore"] is True
    assert json.loads(json.dumps(result.to_dict(), allow_nan=False))["passed"] is True


def test_a_coarse_integrator_inside_is_noticed() -> None:
    # the step limit lifted: one Runge-Kutta step of the pendulum for each communication step of 0.35 s
    result = probe(mockup("pendulum"), sample_time=0.35, samples=60, isolate=False, parameters={"substep": 10.0})
    assert verdicts(result)["step"] is False


@pytest.mark.parametrize(
    ("mode", "check", "words"),
    [
        ("segfault", "runs", "SIGSEGV"),
        ("hangs", "runs", "timeout"),
        ("nan", "finite", "not finite"),
        ("terminates", "runs", "terminated"),
    ],
)
def test_what_breaks_is_a_finding(mode: str, check: str, words: str, odd_fmu: Callable[..., Path]) -> None:
    result = probe(odd_fmu("hostile"), sample_time=0.01, timeout=1.0, parameters={"mode": MODES[mode]})
    assert not result.passed
    assert verdicts(result)[check] is False
    assert words in str(result)


def test_model_exchange_is_probed_by_its_tolerance(odd_fmu: Callable[..., Path]) -> None:
    result = probe(odd_fmu("ball"), sample_time=0.01, samples=30, isolate=False, start={"h": 50.0})
    assert verdicts(result) == {
        "units": True,
        "description": True,
        "runs": True,
        "finite": True,
        "reset": True,
        "restore": True,
        "tolerance": True,
    }


def test_what_is_no_fmu_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such FMU"):
        probe(tmp_path / "none.fmu")


def test_a_folder_of_fmus_is_really_run(tmp_path: Path) -> None:
    shutil.copy(mockup("mass_spring", 3), tmp_path / "given.fmu")
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-k", "foreign", "-rA", __file__]
    environment = {**os.environ, "SYSID_HARNESS_FMUS": str(tmp_path)}
    root = Path(__file__).parents[2]
    done = subprocess.run(command, env=environment, cwd=root, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout
    assert "test_foreign_fmus_run_and_repeat[given]" in done.stdout
    assert "1 passed" in done.stdout
    assert "skipped" not in done.stdout


def foreign() -> list[Path]:
    """Return the FMUs in $SYSID_HARNESS_FMUS."""
    folder = os.environ.get("SYSID_HARNESS_FMUS")
    return sorted(Path(folder).rglob("*.fmu")) if folder else []


@pytest.mark.skipif(not foreign(), reason="no foreign FMUs: set SYSID_HARNESS_FMUS to a folder, e.g. of Reference-FMUs")
@pytest.mark.parametrize("path", foreign(), ids=lambda p: p.stem)
def test_foreign_fmus_run_and_repeat(path: Path) -> None:
    try:
        kinds = read_fmu(path).kinds
    except InputError as error:
        assert "scheduled execution only" in str(error)  # noqa: PT017 (all that may be refused)
        return
    assert describe(path)["variables"]
    for kind in kinds:
        try:
            result = probe(path, sample_time=0.01, samples=100, kind=kind)
        except HarnessError as error:
            assert "no binary for this system" in str(error)  # noqa: PT017
            continue
        found = verdicts(result)
        assert found["runs"] or "terminated" in str(result), str(result)
        assert found.get("reset") is not False, str(result)
        assert found.get("restore") is not False, str(result)
        if kind == "cs" and found["runs"]:
            options = {"path": str(path), "sample_time": 0.01, "kind": kind}
            with FmuPlant(path, sample_time=0.01, kind=kind) as described:
                u = np.tile(described.input_starts, (50, 1))
            with IsolatedPlant("plants.fmu.plant:FmuPlant", options) as plant:
                rng = np.random.default_rng(0)
                plant.reset(rng=rng)
                stepped = np.array([plant.step(row) for row in u])
                plant.reset(rng=rng)
                assert np.array_equal(plant.rollout(u), stepped)
