"""What a person who waits for a long run wants to know: how far, how fast, how long still, and what went wrong."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

Report = Callable[[int, int, str], None]


def duration(seconds: float) -> str:
    """Return a time span in words that fit a narrow line.

    Examples
    --------
    >>> duration(4.2), duration(250), duration(8000), duration(200000)
    ('4 s', '4 min', '2 h 13 min', '2 d 7 h')
    """
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    if minutes < 90:
        return f"{minutes} min"
    hours, minutes = divmod(minutes, 60)
    if hours < 48:
        return f"{hours} h {minutes} min"
    return f"{hours // 24} d {hours % 24} h"


@dataclass
class Progress:
    """Counts rows as they come, writes them to a log, and tells a reporter."""

    log: Path  # One line for each row
    # Rows that were asked for, and those that were there before
    total: int
    done: int
    report: Report | None = None  # Called as ``report(done, total, text)``
    statuses: Counter[str] = field(default_factory=Counter)
    started: float = field(default_factory=time.monotonic)
    fresh: int = 0

    def __call__(self, title: str, rows: Sequence[tuple[str, str]]) -> None:
        """Take note of rows that have been added: the status of each, and what the log says of it."""
        self.statuses.update(status for status, _ in rows)
        if rows:
            now = datetime.now().astimezone().isoformat(timespec="seconds")
            with self.log.open("a", encoding="utf-8") as log:
                log.writelines(f"{now} {status:10s} {text}\n" for status, text in rows)
        self.done += len(rows)
        self.fresh += len(rows)
        if self.report is not None:
            self.report(self.done, self.total, f"{title}  {self}".strip())

    def __str__(self) -> str:
        """Return counts by status, rate and time left."""
        counts = ", ".join(f"{n} {status}" for status, n in self.statuses.most_common())
        elapsed = time.monotonic() - self.started
        if not self.fresh or elapsed <= 0:
            return ""
        rate = self.fresh / elapsed
        speed = f"{rate:.3g} a second" if rate >= 1 else f"one in {duration(1 / rate)}"
        return f"({counts}; {speed}, {duration((self.total - self.done) / rate)} left)"
