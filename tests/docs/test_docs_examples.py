"""Every Python block of README.md and docs/*.md runs, in order, in one namespace a file and a folder of its own.

A block that opens with ```python no-run is left out (it needs something that a test has not, and says so in the text).
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
FENCE = re.compile(r"^```(?P<info>[^\n`]*)\n(?P<code>.*?)^```\s*$", re.MULTILINE | re.DOTALL)


def blocks(text: str) -> list[tuple[int, str]]:
    """Return the line and the code of every block that is to run."""
    found = []
    for match in FENCE.finditer(text):
        if match["info"].split() == ["python"]:
            found.append((text.count("\n", 0, match.start("code")) + 1, match["code"]))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_examples_of_a_page_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = blocks(page.read_text(encoding="utf-8"))
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, object] = {"__name__": "__main__"}
    for line, code in found:
        # line numbers of a traceback are those of the page
        exec(compile("\n" * (line - 1) + code, str(page), "exec"), namespace)


def test_blocks_are_found_and_marked_ones_left_out() -> None:
    text = "a\n```python\nx = 1\n```\n```python no-run\nx = 1 / 0\n```\n```sh\nls\n```\n```python\ny = x\n```\n"
    assert blocks(text) == [(3, "x = 1\n"), (12, "y = x\n")]


def test_every_registered_plant_stands_in_the_table() -> None:
    from harness import registry

    text = (ROOT / "docs" / "plants.md").read_text(encoding="utf-8")
    own = [entry.id for entry in registry.entries("plants") if entry.distribution == "sysid-harness"]
    assert [name for name in own if f"| `{name}` |" not in text] == []
