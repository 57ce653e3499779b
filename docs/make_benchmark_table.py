"""Write the excerpt of ``quick`` into docs/benchmarks.md, from a folder that ``sysid bench quick`` wrote.

Run ``sysid bench quick --seeds 0..5 --out DIR`` and then ``python docs/make_benchmark_table.py DIR``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from harness.benchmark import table
from harness.benchmark.exports import render
from harness.benchmark.running import BenchResult

PAGE = Path(__file__).parent / "benchmarks.md"
BEGIN, END = "<!-- table: linear-ode prbs -->\n", "<!-- end of table -->"
PLACE = ("linear-ode", "prbs")


def excerpt(result: BenchResult) -> str:
    """Return the lines of one plant and scenario as Markdown; no times, which are those of one machine."""
    lines = render(result, "markdown").splitlines()
    chosen = lines[:2] + [line for line in lines[2:] if line.startswith(f"| {PLACE[0]} | {PLACE[1]} |")]
    return "\n".join("|".join(line.split("|")[:-2]) + "|" for line in chosen) + "\n"


def main(arguments: Sequence[str]) -> None:
    """Write the excerpt between the marks of the page."""
    before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
    PAGE.write_text(before + BEGIN + excerpt(table(arguments[0])) + rest[rest.index(END) :], encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
