"""Write the excerpt of ``quick`` into README.md and docs/benchmarks.md, from a folder that ``sysid bench quick`` wrote.

Run ``sysid bench quick --seeds 0..5 --out DIR`` and then ``python docs/make_benchmark_table.py DIR``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from harness.benchmark import BenchResult, render, table

PAGES = [Path(__file__).parents[1] / "README.md", Path(__file__).parent / "benchmarks.md"]
BEGIN, END = "<!-- table: linear-ode prbs -->\n", "<!-- end of table -->"
PLACE = ("linear-ode", "prbs")


def excerpt(result: BenchResult) -> str:
    """Return the lines of one plant and scenario as Markdown; no times, which are those of one machine."""
    lines = render(result, "markdown").splitlines()
    chosen = lines[:2] + [line for line in lines[2:] if line.startswith(f"| {PLACE[0]} | {PLACE[1]} |")]
    return "\n".join("|".join(line.split("|")[:-2]) + "|" for line in chosen) + "\n"


def main(arguments: Sequence[str]) -> None:
    """Write the excerpt between the marks of every page."""
    text = excerpt(table(arguments[0]))
    for page in PAGES:
        before, rest = page.read_text(encoding="utf-8").split(BEGIN)
        page.write_text(before + BEGIN + text + rest[rest.index(END) :], encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
