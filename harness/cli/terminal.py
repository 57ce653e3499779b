"""The terminal: lines, JSON, tables and progress, on the stream where each belongs."""

from __future__ import annotations

import json
import math
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, cast

from harness.errors import printable
from harness.supervision.interrupts import stop_if_asked

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console
    from rich.progress import Progress, TaskID


def fail(message: str, status: int) -> int:
    """Print one line on standard error and return the exit status."""
    print(f"sysid: {printable(message)}", file=sys.stderr)
    return status


def say(text: str) -> None:
    """Print a line."""
    print(printable(text))


def noted(text: str) -> None:
    """Print a note beside the answer."""
    print(f"sysid: note: {printable(text)}", file=sys.stderr)


def print_json(content: Any) -> None:
    """Print JSON; what it cannot hold (NaN, infinity) is null."""
    print(json.dumps(_plain(content), indent=1, allow_nan=False))


def _plain(content: Any) -> Any:
    """Return content as JSON can hold it."""
    if isinstance(content, Mapping):
        return {str(key): _plain(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_plain(value) for value in content]
    if hasattr(content, "tolist"):  # arrays and numbers of numpy
        return _plain(content.tolist())
    return None if isinstance(content, float) and not math.isfinite(content) else content


def print_written(paths: Sequence[Any], *, as_json: bool) -> None:
    """Print which files were written."""
    if as_json:
        print_json({"written": [str(path) for path in paths]})
        return
    print_paths(*paths)


def print_paths(*paths: Path | None) -> None:
    """Print which files were written, of those that were asked for."""
    for path in paths:
        if path is not None:
            say(f"wrote {path}")


def wide_console() -> Console:
    """Return a console that folds nothing when its output is a file or a pipe."""
    from rich.console import Console

    width = None if sys.stdout.isatty() else max(120, int(os.environ.get("COLUMNS", "0") or 0))
    return Console(width=width, markup=False, highlight=False, emoji=False)  # "u [N m]" is text, no style


PROGRESS = "SYSID_HARNESS_PROGRESS"
"""Environment variable with the seconds between two lines of progress, for a program that reads them."""


class ProgressLines:
    """Progress where standard error is no terminal: one line every few seconds."""

    def __init__(self, title: str, counted: bool) -> None:
        self.title, self.counted = title, counted
        given = os.environ.get(PROGRESS, "")
        self.every = float(given) if given.replace(".", "", 1).isdecimal() else 5.0
        self.next = time.monotonic() + self.every

    def add_task(self, description: str, total: float | None = None) -> TaskID:
        """Return the only task there is."""
        return cast("TaskID", 0)

    def update(
        self, task: TaskID, *, completed: float = 0.0, total: float | None = None, description: str | None = None
    ) -> None:
        """Print a line if the last one is some seconds old."""
        stop_if_asked()
        if time.monotonic() < self.next:
            return
        self.next = time.monotonic() + self.every
        share = 100 * completed / (total or 1.0)
        come = f"{completed:.0f} of {total:.0f}" if self.counted and total else f"{share:.0f} %"
        print(f"{self.title}: {come}{f', {description}' if description else ''}", file=sys.stderr, flush=True)


@contextmanager
def jobs_bar(title: str, name: str) -> Iterator[Callable[[int, int, str], None]]:
    """Show how many of many jobs are done; yields what is called as ``show(done, total, what)``."""
    with progress_bar(title, counted=True) as bar:
        task = bar.add_task(name, total=None)

        def show(done: int, total: int, what: str) -> None:
            bar.update(task, completed=done, total=total, description=what)

        yield show


@contextmanager
def share_bar(title: str, name: str) -> Iterator[Callable[[float, str], None]]:
    """Show how much of one thing is done; yields what is called as ``show(share, what)``."""
    with progress_bar(title) as bar:
        task = bar.add_task(name, total=None)

        def show(share: float, what: str) -> None:
            bar.update(task, completed=share, total=1.0, description=what)

        yield show


@contextmanager
def progress_bar(title: str, *, counted: bool = False) -> Iterator[Progress | ProgressLines]:
    """Show on standard error how far something long has come: a bar on a terminal, else a line now and then."""
    if not sys.stderr.isatty():
        yield ProgressLines(title, counted)
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    class Bar(Progress):
        def update(self, *arguments: Any, **options: Any) -> None:
            stop_if_asked()
            super().update(*arguments, **options)

    with Bar(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn() if counted else TextColumn("{task.percentage:>3.0f}%"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
    ) as bar:
        yield bar


TEXT = 24
"""Columns that the last column of a table needs to be folded into; with fewer, rows are printed as lists."""


def print_table(titles: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Print a table whose last column may fold; where the terminal is too narrow for it, each row as a list.

    No number is ever cut or broken.
    """
    from rich.padding import Padding
    from rich.table import Table
    from rich.text import Text

    console = wide_console()
    cells = [[_cell(value) for value in row] for row in rows]
    if not titles:
        return
    widths = [max(map(len, column)) for column in zip(titles, *cells, strict=True)]
    if sum(widths[:-1]) + 2 * len(widths[:-1]) + min(widths[-1], TEXT) <= console.width:
        shown = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False)
        for place, title in enumerate(titles):
            shown.add_column(Text(printable(title)), overflow="fold", no_wrap=place < len(titles) - 1)
        for row in cells:
            shown.add_row(*map(Text, row))
        console.print(shown)
        return
    for row in cells:
        console.print(Text(f"{titles[0]}: {row[0]}"))
        for title, cell in zip(titles[1:], row[1:], strict=True):
            if cell:
                console.print(Padding(Text(f"{title}: {cell}"), (0, 0, 0, 2)))


def _cell(value: object) -> str:
    """Return a value as the text of a cell."""
    if value is None or isinstance(value, bool):
        return {None: "", True: "yes", False: "no"}[value]
    return f"{value:.4g}" if isinstance(value, float) else printable(str(value))


def print_rows(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print rows of one shape as a table."""
    print_table([name.replace("_", " ") for name in (rows[0] if rows else ())], [list(row.values()) for row in rows])
