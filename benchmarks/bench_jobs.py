"""Jobs at scale: rows under faults on both engines, cost of scheduling, table of a hundred thousand cells.

Run ``OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/bench_jobs.py [faults|schedule|overhead|table]``;
without a word all of them. Checked here: 2000 cells with segfaults, hangs and kills among them give exactly 2000 rows
on the local engine and on a dask cluster; the parent's CPU time for each task does not grow with their number, while
that of the peer (every task scheduled with pebble at once) is printed beside it; the table of 1e5 cells needs < 1 GiB.
Printed: the wall time of cells of 0.1 s on one worker and on two, and the CPU time of the large table.
"""

from __future__ import annotations

import json
import operator
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import wait
from pathlib import Path

MODULE = """
import ctypes, os, signal, time
from dataclasses import dataclass
import numpy as np
from identifiers.baselines import HoldLast

@dataclass(frozen=True)
class Odd:
    fail: str = ""
    nap: float = 0.0
    def fit(self, trajectories, *, rng):
        if self.nap:
            time.sleep(self.nap)
        if self.fail == "segfault":
            ctypes.string_at(0)
        if self.fail == "hang":
            time.sleep(1e4)
        if self.fail == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        return HoldLast().fit(trajectories, rng=rng)
"""
POINTS = "[sysid_harness.identifiers]\nodd = bench_jobs_plugin:Odd\n"


def plugin(folder: Path) -> None:
    """Install identifiers that break, in a folder that this process and its workers see."""
    (folder / "bench_jobs_plugin.py").write_text(MODULE)
    info = folder / "bench_jobs_plugin-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: bench-jobs-plugin\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(POINTS)
    sys.path.insert(0, str(folder))
    os.environ["PYTHONPATH"] = os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")])


def suite(folder: Path, seeds: int, identifiers: str, limit: float = 30.0) -> Path:
    """Write a suite of very short cells."""
    path = folder / f"jobs-{seeds}.toml"
    path.write_text(
        f'name = "jobs"\nseeds = {json.dumps(list(range(seeds)))}\ntime_limit = {limit}\n[[groups]]\n'
        'plants = [{ id = "linear-ode" }]\nscenarios = [{ id = "prbs", options = { samples = 40 } }]\n'
        f"identifiers = [{identifiers}]\n"
    )
    return path


def faults(folder: Path, cells: int = 2000) -> None:
    """Count the rows of a run in which one cell in a hundred breaks its process."""
    from harness.benchmark import bench

    quiet = ", ".join(f'{{ id = "odd", label = "good {k}" }}' for k in range(97))
    broken = ", ".join(
        f'{{ id = "odd", label = "{how}", options = {{ fail = "{how}" }} }}' for how in ("segfault", "kill", "hang")
    )
    path = suite(folder, cells // 100, f"{quiet}, {broken}", limit=20.0)
    result = bench(path, out=folder / "faults-local", workers=2)
    report("local", result.rows, cells)
    import distributed

    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None) as made:
        result = bench(
            path, out=folder / "faults-dask", engine=f"dask://{made.scheduler_address.removeprefix('tcp://')}"
        )
    report("dask", result.rows, cells)
    same = (folder / "faults-local" / "results.parquet").read_bytes() == (
        folder / "faults-dask" / "results.parquet"
    ).read_bytes()
    print(f"equal tables on both engines: {same}")
    assert same


def report(name: str, rows: tuple, cells: int) -> None:
    """Print and check the rows by status."""
    counts = Counter(row.status for row in rows)
    print(f"{name:6s} {len(rows)} rows for {cells} cells: {dict(counts)}")
    assert len({row.job for row in rows}) == len(rows) == cells
    assert counts == {"ok": cells * 97 // 100, "crashed": cells * 2 // 100, "timeout": cells // 100}


def schedule() -> None:
    """Parent's CPU time for each of n empty tasks: all at once, and a few ahead (what the local engine does)."""
    from concurrent.futures import FIRST_COMPLETED

    from harness.jobs.engines import AHEAD
    from harness.workers import worker_pool

    per_task: dict[str, list[float]] = {"all at once": [], "a few ahead": []}
    sizes = (500, 1000, 2000)
    for n in sizes:
        for how, found in per_task.items():
            with worker_pool(2) as pool:
                pool.schedule(operator.neg, args=[0]).result()
                started, left = time.process_time(), n
                waiting = {
                    pool.schedule(operator.neg, args=[k]) for k in range(n if how == "all at once" else 2 * AHEAD)
                }
                left -= len(waiting)
                while waiting:
                    done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                    fresh = min(left, len(done))
                    waiting |= {pool.schedule(operator.neg, args=[k]) for k in range(fresh)}
                    left -= fresh
                found.append(1e3 * (time.process_time() - started) / n)
    for how, found in per_task.items():
        print(f"{how:12s} " + "  ".join(f"{n} tasks {ms:.2f} ms each" for n, ms in zip(sizes, found, strict=True)))
    ours = per_task["a few ahead"]
    print(f"ratio at {sizes[-1]} tasks: {per_task['all at once'][-1] / ours[-1]:.1f}")
    assert ours[-1] < 1.5 * ours[0], "scheduling is not linear"


def overhead(folder: Path) -> None:
    """Wall time of cells of 0.1 s over the sum of their naps, two workers against one."""
    from harness.benchmark import bench

    names = ", ".join(f'{{ id = "odd", label = "nap {k}", options = {{ nap = 0.1 }} }}' for k in range(20))
    path = suite(folder, 20, names)
    walls = {}
    for workers in (1, 2):
        started = time.perf_counter()
        result = bench(path, workers=workers)
        whole = time.perf_counter() - started
        inside = sum(row.fit_seconds + row.score_seconds for row in result.rows)
        walls[workers] = whole
        print(f"{workers} workers: {whole:.1f} s for {inside:.1f} s of cells, start of the workers included")
    print(f"two workers are {walls[1] / walls[2]:.2f} times as fast as one")


def table(folder: Path, cells: int = 100_000) -> None:
    """Time the table and the page of a large store, in a process of its own."""
    from harness.benchmark.row import Row
    from harness.benchmark.store import FORMAT, Store, _write_text, versions

    store = Store(folder / "large")
    store.folder.mkdir()
    rows = [
        Row(
            job=f"{k}",
            plant=f"plant {k // 10 % 10}",
            scenario="prbs",
            identifier=f"method {k % 10}",
            seed=k // 100,
            equation_error=0.1 + 1e-6 * (k * 7919 % 1000),
            simulation_error=0.2 + 1e-4 * (k * 104729 % 1000),
            noise_floor=0.01,
            outputs=["y"],
            units=["m"],
            samples=100,
            held_out_samples=100,
        )
        for k in range(cells)
    ]
    listed = [[row.job, row.plant, row.scenario, row.identifier, row.seed] for row in rows]
    content = {"format": FORMAT, "suite": "large", "description": "", "cells": listed, "versions": versions()}
    _write_text(store.manifest, json.dumps(content))
    store.write(rows)
    code = (
        "import io, resource, sys, time\nfrom rich.console import Console\nfrom harness.benchmark import table\n"
        "found = table(sys.argv[1]); Console(file=io.StringIO()).print(found.table())\n"
        "used = resource.getrusage(resource.RUSAGE_SELF)\n"
        "print(len(found.rows), used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(store.folder)], capture_output=True, text=True, check=True)
    count, seconds, memory = done.stdout.split()
    print(
        f"{count} cells: table and page in {float(seconds):.1f} s of CPU and {float(memory):.0f} MiB, imports included"
    )
    assert float(memory) < 1024


if __name__ == "__main__":
    wanted = sys.argv[1:] or ["faults", "schedule", "overhead", "table"]
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(scratch)
        plugin(place)
        if "faults" in wanted:
            faults(place)
        if "schedule" in wanted:
            schedule()
        if "overhead" in wanted:
            overhead(place)
        if "table" in wanted:
            table(place)
        print(f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB at most")
