"""Every Python block of README.md and docs/*.md runs by itself, as a reader copies it, in a folder of its own.

A block that begins with ``# continues the block above`` runs after that one. A block below
``<!-- no-run -->`` is left out (it needs something that a test has not, and says so in the text).
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
FENCE = re.compile(r"^```(?P<info>[^\n`]*)\n(?P<code>.*?)^```\s*$", re.MULTILINE | re.DOTALL)
LEFT_OUT = "<!-- no-run -->\n"
CONTINUES = "# continues the block above\n"


def blocks(text: str) -> list[list[tuple[int, str]]]:
    """Return for every block that is to run its line and code, after those that it continues."""
    found: list[list[tuple[int, str]]] = []
    for match in FENCE.finditer(text):
        if match["info"].split() == ["python"] and not text[: match.start()].endswith(LEFT_OUT):
            block = (text.count("\n", 0, match.start("code")) + 1, match["code"])
            if match["code"].startswith(CONTINUES) and found:
                found[-1].append(block)
            else:
                found.append([block])
    return found


EXAMPLES = [
    pytest.param(page, chain, id=f"{page.name}:{chain[0][0]}")
    for page in PAGES
    for chain in blocks(page.read_text(encoding="utf-8"))
]


@pytest.mark.slow
@pytest.mark.parametrize(("page", "chain"), EXAMPLES)
def test_an_example_runs_alone(
    page: Path, chain: list[tuple[int, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, object] = {"__name__": "__main__"}
    for line, code in chain:
        # line numbers of a traceback are those of the page
        exec(compile("\n" * (line - 1) + code, str(page), "exec"), namespace)


def test_blocks_are_found_and_marked_ones_left_out() -> None:
    text = "a\n```python\nx = 1\n```\n<!-- no-run -->\n```python\nx = 1 / 0\n```\n```sh\nls\n```\n"
    text += f"```python\n{CONTINUES}y = x\n```\n"
    assert blocks(text) == [[(3, "x = 1\n"), (13, f"{CONTINUES}y = x\n")]]
    assert blocks("```python\nx = 1\n```\n```python\ny = 2\n```\n") == [[(2, "x = 1\n")], [(5, "y = 2\n")]]


def test_every_registered_plant_stands_in_the_table() -> None:
    from harness import registry

    text = (ROOT / "docs" / "plants.md").read_text(encoding="utf-8")
    own = [entry.id for entry in registry.entries("plants") if entry.distribution == "sysid-harness"]
    assert [name for name in own if f"| `{name}` |" not in text] == []


def test_the_page_on_plug_ins_shows_what_is_written(tmp_path: Path) -> None:
    from harness.scaffold import new

    text = (ROOT / "docs" / "plugins.md").read_text(encoding="utf-8")
    for kind, name in (("effect", "soft-friction"), ("model", "cart")):
        (source,) = (path for path in new(kind, name, folder=tmp_path) if path.name == "__init__.py")
        code = source.read_text(encoding="utf-8")
        begins = re.search(r"^(?:@effect|def )", code, re.MULTILINE)
        assert begins is not None
        assert code[begins.start() :].strip() in text, kind
