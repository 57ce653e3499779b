"""What is kept belongs to the code that made it: another state of the project, or of a plug-in, is another key."""

from __future__ import annotations

import importlib.metadata
from pathlib import Path

import pytest

from harness.fingerprint import PACKAGES, own_code
from harness.registry import Entry


def tree(root: Path, text: str = "x = 1\n", page: str = "one") -> Path:
    """Write the four packages with one file each, and a page beside them."""
    for name in PACKAGES:
        (root / name / "room").mkdir(parents=True, exist_ok=True)
        (root / name / "room" / "law.py").write_text(text)
    (root / PACKAGES[0] / "room" / "page.html").write_text(page)
    return root


def test_another_state_of_a_checkout_is_another_code(tmp_path: Path) -> None:
    first = own_code(tree(tmp_path / "a"))
    assert own_code(tree(tmp_path / "b")) == first, "the same files elsewhere are the same code"
    assert own_code(tree(tmp_path / "c", page="two")) == first, "how a page looks decides no answer"
    assert own_code(tree(tmp_path / "d", "x = 2\n")) != first
    moved = tree(tmp_path / "e")
    (moved / "plants" / "room" / "law.py").rename(moved / "plants" / "room" / "other.py")
    assert own_code(moved) != first


@pytest.mark.parametrize("changed", ["identifier.py", "inner/helper.py"])
def test_any_file_of_a_plug_in_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changed: str) -> None:
    folder = tmp_path / "a_plug_in_of_others"
    (folder / "inner").mkdir(parents=True)
    for name in ("__init__.py", "identifier.py", "inner/__init__.py", "inner/helper.py"):
        (folder / name).write_text("x = 1\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    point = importlib.metadata.EntryPoint("one", "a_plug_in_of_others.identifier:One", "sysid_harness.identifiers")
    entry = Entry("identifiers", "one", point.value, "others", point)
    before = entry.code
    assert before
    assert entry.code == before
    (folder / changed).write_text("x = 2\n")
    assert entry.code != before
