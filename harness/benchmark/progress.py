"""What a person who waits for a long run wants to know: how far, how fast, how long still, and what went wrong."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import datetime

from harness.benchmark.row import Row, read_row
from harness.benchmark.store import Store

__all__ = ["Progress", "duration"]

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
    """Counts rows as they come, writes them to the log, and tells a reporter.

    Parameters
    ----------
    store : Store
        Rows that are finished are handed to it.
    total, done : int
        Rows that were asked for, and those that were there before.
    report : callable, optional
        Called as ``report(done, total, text)``.
    """

    store: Store
    total: int
    done: int
    report: Report | None = None
    statuses: Counter[str] = field(default_factory=Counter)
    started: float = field(default_factory=time.monotonic)
    fresh: int = 0

    def __call__(self, title: str, jobs: Sequence[str]) -> None:
        """Take note of rows that have been added."""
        rows = [read_row(path) for path in (self.store.shards / f"{job}.json" for job in jobs) if path.exists()]
        self.statuses.update(row.status for row in rows)
        self._log(rows)
        self.store.finished(jobs)
        self.done += len(jobs)
        self.fresh += len(jobs)
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

    def _log(self, rows: Sequence[Row]) -> None:
        """Append a line for each row to ``bench.log``."""
        if not rows:
            return
        now = datetime.now().astimezone().isoformat(timespec="seconds")
        lines = [
            f"{now} {row.status:10s} {row.plant} x {row.scenario} x {row.identifier} seed {row.seed} "
            f"{row.fit_seconds + row.score_seconds:.2f} s{': ' + row.reason if row.reason else ''}\n"
            for row in rows
        ]
        with self.store.log.open("a", encoding="utf-8") as log:
            log.writelines(lines)
