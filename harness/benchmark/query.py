"""Questions in SQL over the stored rows of a benchmark, finished or not."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from harness.benchmark.store import Store
from harness.extras import optional
from harness.jobs.query import QueryResult, ask


def query(directory: str | Path, sql: str | None = None, *, filters: Mapping[str, Any] | None = None) -> QueryResult:
    """Ask the stored rows of a benchmark.

    Parameters
    ----------
    directory : path
        Folder that ``bench`` wrote or is writing: rows of an unfinished run are part of the answer.
    sql : str, optional
        DuckDB's SQL over the tables ``results`` (a row for each cell), ``timings``, ``regret`` and ``traces``. Files on
        this machine are not within its reach. Without it the answer is ``results``.
    filters : mapping, optional
        Column to value: only such rows, in every table that has the column.

    Raises
    ------
    InputError
        If the folder holds no benchmark, a filter or the query cannot be used, or the extra ``query``, which SQL needs,
        is not installed.
    """
    if sql is not None:
        optional("duckdb", "a query", "'sysid-harness[query]'")
    store = Store(Path(directory))
    if store.shares():
        store.merge()
    store.read_manifest()
    return ask(store.arrow(), sql, filters)
