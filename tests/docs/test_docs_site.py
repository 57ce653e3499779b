"""The site builds without a broken link, its generated pages are those of the sources, and links of the README lead."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]
LINK = re.compile(r"\]\(([^)#\s]+)(?:#[\w-]*)?\)")
PATH = re.compile(r"`((?:docs|examples|benchmarks|harness|plants|scenarios|identifiers)/[\w./-]*)`")


@pytest.mark.slow
def test_the_site_builds_and_every_link_and_anchor_leads_somewhere(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "site" / "reference" / "effects.html").is_file()
    assert (
        (tmp_path / "site" / "search" / "search_index.js").read_text(encoding="utf-8").startswith("window.searchIndex")
    )
    assert "coulomb_friction" in (tmp_path / "site" / "search" / "search_index.json").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("page", "faults"),
    [
        ("<p>```python no-run\nx = 1</p>", ["a fence that is none"]),
        (r"<li><code>F = -c \|v\| v</code></li>", ["a bar with its backslash"]),
        ("<code>a &amp;lt; b</code>", ["an escape that is escaped"]),
        ("<p>| a | b |</p>", ["a table that is none"]),
        ("<pre><code>a | b &lt; c</code></pre><p>fine</p>", []),
    ],
)
def test_what_markdown_did_not_understand_is_seen(
    page: str, faults: list[str], script: Callable[[str], ModuleType]
) -> None:
    assert script("docs/site_hooks.py").broken(page) == faults


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md", "examples/third_party_identifier/README.md"])
def test_links_and_paths_of_pages_outside_the_site_lead_somewhere(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    here = (ROOT / page).parent
    links = [link for link in LINK.findall(text) if "://" not in link]
    assert [link for link in links if not (here / link).exists()] == []
    assert [path for path in PATH.findall(text) if not (ROOT / path).exists()] == []
