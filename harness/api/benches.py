"""Benchmarks: planned, run, read back, asked."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from harness.benchmark import QueryResult
    from harness.benchmark.planning import BenchPlan
    from harness.benchmark.public import PublicResult


def stored_public(directory: str | Path) -> PublicResult | None:
    """Return the public table that a folder holds, or None; see :func:`harness.benchmark.public.read_public`."""
    if not (Path(directory) / "public.json").is_file():
        return None
    from harness.benchmark import public

    return public.read_public(directory)


def plan_bench(suite: str | Path, **asked: Any) -> BenchPlan:
    """Return what :func:`bench` would run, and how long it would take; see :func:`harness.benchmark.plan`."""
    from harness import benchmark

    return benchmark.plan(suite, **asked)


def query(directory: str | Path, sql: str | None = None, *, filters: Mapping[str, Any] | None = None) -> QueryResult:
    """Return the answer to a query over the tables of a benchmark's or a fleet's folder, or its first table.

    See :func:`harness.benchmark.query` and :func:`harness.fleet.query`.
    """
    from harness import benchmark, fleet

    room = fleet.query if fleet.is_fleet_folder(directory) else benchmark.query
    return room(directory, sql, filters=filters)
