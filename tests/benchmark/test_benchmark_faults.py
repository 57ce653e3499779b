"""Whatever breaks is a row, on both engines; what is killed is continued to the same table."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import sys
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from harness.benchmark import bench

BREAKS = {"segfault": "crashed", "kill": "crashed", "hang": "timeout", "exit": "crashed"}
SOUND = 8
SEEDS = 2


def write_suite(folder: Path, nap: float = 0.0) -> Path:
    """Write a suite in which every seed meets each way to break, between sound cells."""
    parts = [f'{{id = "test-fit", label = "sound {k}", options = {{nap = {nap}}}}}' for k in range(SOUND)]
    for place, how in enumerate(BREAKS):
        parts.insert(2 * place + 1, f'{{id = "test-fit", label = "{how}", options = {{fail = "{how}"}}}}')
    path = folder / "faults.toml"
    path.write_text(
        f'name = "faults"\nseeds = {list(range(SEEDS))}\ntime_limit = 3.0\n[[groups]]\nplants = [{{id = "test-lag"}}]\n'
        f'scenarios = [{{id = "prbs", options = {{samples = 60}}}}]\nidentifiers = [{", ".join(parts)}]\n'
    )
    return path


@contextlib.contextmanager
def cluster(workers: int) -> Iterator[str]:
    """Start a cluster on this machine only; yield what names the engine."""
    distributed = pytest.importorskip("distributed", reason="the optional package distributed is not installed")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # whatever dask deprecates is not ours
        with distributed.LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            host="127.0.0.1",
            dashboard_address=None,
            worker_dashboard_address=None,
        ) as made:
            yield f"dask://{made.scheduler_address.removeprefix('tcp://')}"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_every_cell_is_one_row_with_its_status_on_both_engines(plugins: Path, tmp_path: Path) -> None:
    suite = write_suite(tmp_path)
    near = bench(suite, out=tmp_path / "near", workers=2)
    with cluster(2) as engine:
        far = bench(suite, out=tmp_path / "far", engine=engine)
    for result in (near, far):
        assert len({row.job for row in result.rows}) == len(result.rows) == SEEDS * (SOUND + len(BREAKS))
        statuses = Counter((row.identifier.split()[0], row.status) for row in result.rows)
        assert statuses == {("sound", "ok"): SEEDS * SOUND} | {(how, status): SEEDS for how, status in BREAKS.items()}
        reasons = {row.identifier: row.reason for row in result.rows}
        assert "SIGSEGV" in reasons["segfault"]
        assert "SIGKILL" in reasons["kill"]
        assert "exit status 7" in reasons["exit"]
        assert reasons["hang"] == "hang is over its time limit of 3 s"
    assert (tmp_path / "near" / "results.parquet").read_bytes() == (tmp_path / "far" / "results.parquet").read_bytes()


SCRIPT = "import sys; from harness.benchmark import bench; bench(sys.argv[1], out=sys.argv[2], workers=2)"


@pytest.mark.slow
@pytest.mark.parametrize("whole", [True, False], ids=["with its workers", "alone"])
def test_killed_at_any_moment_and_resumed_it_ends_with_the_same_table(
    plugins: Path, tmp_path: Path, whole: bool
) -> None:
    suite = write_suite(tmp_path, nap=0.1)
    bench(suite, out=tmp_path / "undisturbed", workers=2)
    expected = (tmp_path / "undisturbed" / "results.parquet").read_bytes()
    out = tmp_path / "killed"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(plugins), os.environ.get("PYTHONPATH", "")])}
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, str(suite), str(out)], env=environment, start_new_session=True
    )
    rows = random.randrange(1, SEEDS * (SOUND + len(BREAKS)) // 2)
    deadline = time.monotonic() + 120
    while len(list(out.glob("shards/*.json"))) < rows and process.poll() is None and time.monotonic() < deadline:
        time.sleep(random.uniform(0.0, 0.1))
    assert process.poll() is None, f"over before {rows} rows were there"
    if whole:
        os.killpg(process.pid, signal.SIGKILL)
    else:
        process.kill()
    process.wait()
    assert not (out / "results.parquet").exists()
    result = bench(suite, out=out, workers=2, resume=True)
    assert len(result.rows) == result.planned
    assert (out / "results.parquet").read_bytes() == expected
