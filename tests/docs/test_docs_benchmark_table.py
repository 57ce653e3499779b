"""The benchmark table of docs/benchmarks.md: one of its rows is made again."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

from harness.benchmark import bench
from harness.benchmark.suite import load_suite

ROOT = Path(__file__).resolve().parents[2]


def test_a_row_of_the_page_is_made_again(tmp_path: Path, script: Callable[[str], ModuleType]) -> None:
    maker = script("docs/make_benchmark_table.py")
    pages = [page.read_text(encoding="utf-8").split(maker.BEGIN)[1].split(maker.END)[0] for page in maker.PAGES]
    printed = pages[0]
    assert pages == [printed] * 2
    assert (ROOT / "README.md") in maker.PAGES
    (group,) = [group for group in load_suite("quick").groups if group.name == "linear"]
    scenario = next(part for part in group.scenarios if part.name == "prbs")
    options = ", ".join(f"{key} = {value}" for key, value in scenario.options.items())
    (tmp_path / "again.toml").write_text(
        'name = "again"\nseeds = [0, 1, 2, 3, 4, 5]\n[[groups]]\nplants = [{ id = "linear-ode" }]\n'
        f'scenarios = [{{ id = "prbs", options = {{ {options} }} }}]\n'
        'identifiers = [{ id = "dmdc", options = { delays = 6 } }, { id = "rls", options = { order = 4 } }]\n'
    )
    again = maker.excerpt(bench(tmp_path / "again.toml", workers=1)).splitlines()[2]
    # alone in its table the line leads it, and rounding may differ by a last digit between processors
    cells = [cell.strip(" *") for cell in again.split("|")]
    shown = next(line for line in printed.splitlines() if "| dmdc |" in line)
    assert cells == [cell.strip(" *") for cell in shown.split("|")]
