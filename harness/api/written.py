"""Files that a command writes: refused before the work begins, whole when they are there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.data.whole_files import write_text
from harness.errors import InputError
from harness.signals import Trajectory

if TYPE_CHECKING:
    from harness.comparison import Comparison
    from harness.data.oddities import DataCheck
    from harness.vetting import Agreement, Vetting

PICTURES = (".svg", ".png", ".pdf")
"""Endings of the pictures that are drawn."""


def refuse_overwrite(*outs: str | Path | None, force: bool, endings: Sequence[str] = ()) -> None:
    """Raise if a file that is to be written would be overwritten, its folder is missing, or it ends otherwise."""
    for path in (Path(out) for out in outs if out is not None):
        if path.exists() and not force:
            raise InputError(
                "the output exists", expected="a new file", got="an existing one", remedy="--force", file=path
            )
        if not path.parent.is_dir():
            raise InputError(
                "the output's folder is missing",
                expected="an existing folder",
                got="none",
                remedy=f"make {path.parent} first",
                file=path,
            )
        if endings and path.suffix not in endings:
            ends = f"a name that ends in {', '.join(endings[:-1])} or {endings[-1]}"
            raise InputError("output file", expected=ends, got=str(path), remedy="rename it")


def write_page(out: str | Path | None, found: Vetting | Agreement | Comparison | DataCheck) -> None:
    """Write what was found as a page of its own, if one was asked for."""
    if out is not None:
        write_text(Path(out), found.html())


def draw(plot: Callable[[], Any], out: str | Path | None) -> None:
    """Write a picture if one was asked for."""
    from harness.data.whole_files import whole_file
    from harness.plots import plain_texts

    if out is not None:
        with whole_file(out) as scratch:
            plain_texts(plot()).savefig(scratch, format=Path(out).suffix[1:])


def write_record(record: Trajectory, out: str | Path | None, **more: Any) -> None:
    """Write a record if a file was asked for."""
    if out is not None:
        from harness.data import write_trajectory

        write_trajectory(record, out, **more)
