"""Benchmarks: a suite of plants x scenarios x identifiers x seeds becomes rows, a table and a page.

``bench`` runs a suite, ``table`` reads one back; everything else here serves these two.
"""

from __future__ import annotations

from harness.benchmark.query import Answer, query
from harness.benchmark.row import Row
from harness.benchmark.running import BenchResult, bench, plan, table
from harness.benchmark.suite import Suite, load_suite

__all__ = ["Answer", "BenchResult", "Row", "Suite", "bench", "load_suite", "plan", "query", "table"]
