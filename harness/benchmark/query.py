"""Questions in SQL over the stored rows of a benchmark, finished or not."""

from __future__ import annotations

from pathlib import Path

from harness.benchmark.store import Store
from harness.data.binary_files import optional
from harness.jobs.query import Answer, ask

__all__ = ["query"]


def query(directory: str | Path, sql: str) -> Answer:
    """Ask the stored rows of a benchmark.

    Parameters
    ----------
    directory : path
        Folder that ``bench`` wrote or is writing: rows of an unfinished run are part of the answer.
    sql : str
        DuckDB's SQL over the tables ``results`` (a row for each cell), ``timings``, ``regret`` and ``traces``. Files on
        this machine are not within its reach.

    Raises
    ------
    InputError
        If the folder holds no benchmark, DuckDB refuses the query, or the extra ``query`` is not installed.
    """
    optional("duckdb", "a query", "'sysid-harness[query]'")
    store = Store(Path(directory))
    if store.shares():
        store.merge()
    store.read_manifest()
    return ask(store.arrow(), sql)
