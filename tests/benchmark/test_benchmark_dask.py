"""The cluster engine gives the rows of the local one."""

from __future__ import annotations

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


@pytest.mark.filterwarnings("ignore")
def test_no_scheduler_is_said_plainly(plugins: Path, tmp_path: Path) -> None:
    suite = tmp_path / "cluster.toml"
    suite.write_text(SUITE)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with pytest.raises(InputError, match="expected a scheduler at"):
        bench(suite, engine=f"dask://127.0.0.1:{port}")
