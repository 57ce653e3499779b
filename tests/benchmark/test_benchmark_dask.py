"""The cluster engine gives the rows of the local one."""

from __future__ import annotations

import os
import signal
import socket
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest

from harness.benchmark import bench
from harness.errors import InputError

distributed = pytest.importorskip("distributed", reason="the optional package distributed is not installed")

SUITE = """
name = "cluster"
seeds = [0, 1]
time_limit = 5.0
[[groups]]
plants = [{id = "test-lag"}]
scenarios = [{id = "prbs", options = {samples = 100}}]
identifiers = [{id = "test-fit"}, {id = "test-online"}, {id = "test-fit", label = "dead", options = {fail = "exit"}}]
"""


@pytest.fixture
def cluster(plugins: Path) -> Iterator[str]:
    """Start a scheduler and a worker on this machine only; yield HOST:PORT."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # whatever dask deprecates is not ours
        made = distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address=None, worker_dashboard_address=None
        )
        with made:
            yield made.scheduler_address.removeprefix("tcp://")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_cluster_gives_the_same_rows(cluster: str, tmp_path: Path) -> None:
    suite = tmp_path / "cluster.toml"
    suite.write_text(SUITE)
    bench(suite, out=tmp_path / "far", engine=f"dask://{cluster}")
    bench(suite, out=tmp_path / "near", workers=2)
    far, near = ((tmp_path / name / "results.parquet").read_bytes() for name in ("far", "near"))
    assert far == near


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_cluster_worker_killed_in_the_middle_loses_nothing(plugins: Path, tmp_path: Path) -> None:
    suite = tmp_path / "cluster.toml"
    naps = ", ".join(f'{{id = "test-fit", label = "nap {k}", options = {{nap = 0.3}}}}' for k in range(4))
    suite.write_text(SUITE[: SUITE.index("identifiers")] + f"identifiers = [{naps}]\n")
    killed: list[int] = []

    def kill_one(done: int, total: int, what: str) -> None:
        if done and not killed:
            info = made.scheduler_info["workers"]
            killed.append(next(iter(client.run(os.getpid, workers=[next(iter(info))]).values())))
            os.kill(killed[0], signal.SIGKILL)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with (
            distributed.LocalCluster(
                n_workers=2,
                threads_per_worker=1,
                host="127.0.0.1",
                dashboard_address=None,
                worker_dashboard_address=None,
            ) as made,
            distributed.Client(made, set_as_default=False) as client,
        ):
            engine = f"dask://{made.scheduler_address.removeprefix('tcp://')}"
            result = bench(suite, out=tmp_path / "out", engine=engine, seeds=(0, 5), progress=kill_one)
    assert killed
    assert [row.status for row in result.rows] == ["ok"] * 24


@pytest.mark.filterwarnings("ignore")
def test_no_scheduler_is_said_plainly(plugins: Path, tmp_path: Path) -> None:
    suite = tmp_path / "cluster.toml"
    suite.write_text(SUITE)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with pytest.raises(InputError, match="expected a scheduler at"):
        bench(suite, engine=f"dask://127.0.0.1:{port}")
