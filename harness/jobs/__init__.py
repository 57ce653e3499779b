"""Jobs at any scale: batches of rows on this machine's cores or on a dask cluster; whatever breaks is a row.

:func:`run_jobs` does the work of benchmarks and of fleets alike. A :class:`Batch` says what its jobs are, how a worker
does them and what the row of one looks like that broke its worker.
"""

from __future__ import annotations

from harness.jobs.batch import Batch, Desk, shard_file
from harness.jobs.engines import DaskEngine, Engine, LocalEngine, make_engine, run_jobs

__all__ = ["Batch", "DaskEngine", "Desk", "Engine", "LocalEngine", "make_engine", "run_jobs", "shard_file"]
