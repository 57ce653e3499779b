"""Benchmarks: a suite of plants x scenarios x identifiers x seeds becomes rows, a table and a page.

``bench`` runs a suite, ``table`` reads one back, ``rich_table`` and ``render`` show it; everything else here serves
these.
"""

from __future__ import annotations

from harness.benchmark.page.exports import render
from harness.benchmark.page.tables import rich_table
from harness.benchmark.parts import Suite
from harness.benchmark.query import query
from harness.benchmark.result import BenchResult
from harness.benchmark.row import Row
from harness.benchmark.running import bench, plan, table
from harness.benchmark.suite import load_suite
from harness.jobs.query import QueryResult

__all__ = [
    "BenchResult",
    "QueryResult",
    "Row",
    "Suite",
    "bench",
    "load_suite",
    "plan",
    "query",
    "render",
    "rich_table",
    "table",
]
