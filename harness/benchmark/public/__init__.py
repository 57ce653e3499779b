"""The public table: our identifiers and the loop under the official rules of public benchmarks, beside others' figures.

``rules`` says what is scored, ``reading`` where the data are, ``choices`` what is entered, ``blackbox`` and ``greybox``
learn, ``running`` runs and keeps, ``tables`` shows. A new set is a rule and a reader; what is entered for it stands in
``choices.toml``, what others published in ``published.toml``.
"""

from __future__ import annotations

from harness.benchmark.public.result import PublicResult, read_public
from harness.benchmark.public.running import bench_public
from harness.benchmark.public.tables import records, rich_public

__all__ = ["PublicResult", "bench_public", "read_public", "records", "rich_public"]
