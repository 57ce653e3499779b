"""A distribution of somebody else: installed, listed, checked and benchmarked, as a user would do it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "third_party_identifier"

SUITE = """
name = "third"
seeds = [0]
[[groups]]
plants = [{ id = "pendulum-ode" }]
scenarios = [{ id = "multisine", options = { duration = 4.0 } }]
identifiers = [{ id = "neighbours", options = { lags = 2 } }, { id = "hold" }]
"""


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Install the example into a folder of its own and return an environment that sees it."""
    target = tmp_path_factory.mktemp("site")
    source = tmp_path_factory.mktemp("source") / "example"
    import shutil

    shutil.copytree(EXAMPLE, source, ignore=shutil.ignore_patterns("__pycache__", "build", "dist"))
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps", "--no-index"]
    done = subprocess.run(
        [*pip, "--no-build-isolation", "--target", str(target), str(source)],
        capture_output=True,
        text=True,
        check=False,
    )
    if "No module named 'hatchling'" in done.stderr or "Cannot import 'hatchling" in done.stderr:
        pytest.skip("hatchling is not installed here, so the example cannot be built: pip install hatchling")
    assert done.returncode == 0, done.stderr
    paths = [str(target), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}


def sysid(environment: dict[str, str], *arguments: str) -> subprocess.CompletedProcess[str]:
    code = "import sys; from harness.command import main; main(sys.argv[1:])"
    return subprocess.run(
        [sys.executable, "-c", code, *arguments],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )


def test_it_is_listed_with_its_distribution(environment: dict[str, str]) -> None:
    done = sysid(environment, "list", "identifiers", "--json")
    assert done.returncode == 0, done.stderr
    rows = {row["id"]: row for row in json.loads(done.stdout)["identifiers"]}
    assert rows["neighbours"]["distribution"] == "sysid-neighbours"
    assert rows["neighbours"]["summary"].startswith("Predict the next output")
    switched_off = sysid({**environment, "SYSID_HARNESS_NO_PLUGINS": "1"}, "list", "identifiers", "--json")
    assert "neighbours" not in switched_off.stdout


@pytest.mark.slow
def test_it_passes_every_check(environment: dict[str, str]) -> None:
    done = sysid(environment, "check", "neighbours", "--json")
    assert done.returncode == 0, done.stdout + done.stderr
    results = json.loads(done.stdout)
    assert len(results) >= 14
    assert all(result["passed"] for result in results)


def test_it_is_benchmarked_beside_ours(environment: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "suite.toml").write_text(SUITE)
    done = sysid(environment, "bench", str(tmp_path / "suite.toml"), "--out", str(tmp_path / "out"), "--workers", "1")
    assert done.returncode == 0, done.stderr
    import pyarrow.parquet as pq

    rows = {row["identifier"]: row for row in pq.read_table(tmp_path / "out" / "results.parquet").to_pylist()}
    assert rows["neighbours"]["status"] == "ok", rows["neighbours"]["reason"]
    assert rows["neighbours"]["equation_error"] < 0.2 * rows["hold"]["equation_error"]


def test_its_own_tests_pass(environment: dict[str, str]) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(EXAMPLE / "tests"), "-k", "learn"],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        cwd=EXAMPLE,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
