"""Jobs at any scale: batches of rows on this machine's cores or on a dask cluster; whatever breaks is a row.

:func:`run_jobs` does the work of benchmarks and of fleets alike. A :class:`JobBatch` says what its jobs are, how a
worker does them and what the row of one looks like that broke its worker.
"""

from __future__ import annotations

from harness.jobs.batch import Desk, JobBatch, shard_file
from harness.jobs.engines import DaskEngine, JobEngine, LocalEngine, make_engine, run_jobs

__all__ = ["DaskEngine", "Desk", "JobBatch", "JobEngine", "LocalEngine", "make_engine", "run_jobs", "shard_file"]
