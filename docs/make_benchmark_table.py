"""Write the benchmark tables of the documentation from a folder that ``sysid bench`` wrote.

Run ``sysid bench quick --seeds 0..5 --out DIR`` and then ``python docs/make_benchmark_table.py DIR`` for the excerpt in
README.md and docs/benchmarks.md; the same with ``sysid bench standard --out DIR`` for docs/standard.md.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from harness.benchmark import BenchResult, render, table

PAGES = (Path(__file__).parent / "benchmarks.md", Path(__file__).parents[1] / "README.md")
BEGIN, END = "<!-- table: linear-ode prbs -->\n", "<!-- end of table -->"
PLACE = ("linear-ode", "prbs")


def timeless(line: str) -> str:
    """Return a line of the table without its last column, the seconds of one machine."""
    return "|".join(line.split("|")[:-2]) + "|"


def excerpt(result: BenchResult) -> str:
    """Return the lines of one plant and scenario as Markdown."""
    lines = render(result, "markdown").splitlines()
    chosen = lines[:2] + [line for line in lines[2:] if line.startswith(f"| {PLACE[0]} | {PLACE[1]} |")]
    return "\n".join(without_empty([timeless(line) for line in chosen])) + "\n"


def without_empty(lines: Sequence[str]) -> list[str]:
    """Return the lines of a table without the columns of other places: those that are empty here behind the regret."""
    cells = [line.strip().strip("|").split("|") for line in lines]
    first = next(i for i, title in enumerate(cells[0]) if title.strip() == "regret") + 1
    kept = [i for i in range(len(cells[0])) if i < first or any(row[i].strip() for row in cells[2:])]
    return ["|" + "|".join(row[i] for i in kept) + "|" for row in cells]


def whole(result: BenchResult) -> str:
    """Return a page with the whole table and the reasons of what has no score.

    Raises
    ------
    SystemExit
        If cells are missing: a table is committed whole or not at all.
    """
    if len(result.rows) != result.planned:
        raise SystemExit(f"{len(result.rows)} of {result.planned} cells: run the rest with --resume first")
    table = "\n".join(map(timeless, render(result, "markdown").splitlines()))
    reasons = [
        f"- {line.plant} x {line.scenario} x {line.identifier}: {count} {status}: {reason}"
        for line in result.summary()
        for status, reason, count in line.problems
    ]
    versions = ", ".join(f"{name} {version}" for name, version in result.versions.items())
    return (
        f"# The suite `{result.suite}`\n\n{result.description} {result.ok} of {len(result.rows)} cells have a score. "
        f"Made by `sysid bench {result.suite}` and `docs/make_benchmark_table.py`; how to read it: "
        f"`docs/benchmarks.md`. Versions: {versions}.\n\n{table}\n\n## Without a score\n\n" + "\n".join(reasons) + "\n"
    )


def main(arguments: Sequence[str]) -> None:
    """Write the excerpt between the marks of every page, or the page of the whole suite."""
    result = table(arguments[0])
    if result.suite == "standard":
        (Path(__file__).parent / "standard.md").write_text(whole(result), encoding="utf-8")
        return
    for page in PAGES:
        before, rest = page.read_text(encoding="utf-8").split(BEGIN)
        page.write_text(before + BEGIN + excerpt(result) + rest[rest.index(END) :], encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
