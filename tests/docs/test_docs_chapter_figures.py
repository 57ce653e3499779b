"""The page on the textbook's chapter: its figures are what its commands print."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture
def check(script: Callable[[str], ModuleType]) -> ModuleType:
    return script("docs/check_chapter.py")


def test_a_figure_that_no_command_printed_is_noticed(
    check: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert check.figures("With 5 % it errs by 0.198, `-O x=0.3`, of 1500 ([a](b.md#c-0.5)).") == ["0.198", "1500"]
    page = tmp_path / "page.md"
    page.write_text("```sh\necho 0.01234 2000\n```\n\nIt errs by 12.3 mm, 1.23 % of 2.00 m.\n\n```sh\nexit 3\n```\n")
    monkeypatch.setattr(check, "PAGE", page)
    assert check.main() == 1
    said = capsys.readouterr().out
    assert "exit status 3" in said
    assert "printed nowhere" not in said
    page.write_text("```sh\necho 0.01234 2000\n```\n\nIt errs by 12.4 mm.\n")
    assert check.main() == 1
    assert "printed nowhere: 12.4" in capsys.readouterr().out


@pytest.mark.slow
def test_every_figure_of_the_page_is_what_was_printed(check: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    assert check.main() == 0, capsys.readouterr().out
