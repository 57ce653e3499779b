"""Times of jobs side by side, and what is claimed of them: for the scripts of this folder."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any


def least_times(
    *jobs: Callable[[], Any], rounds: int = 5, clock: Callable[[], float] = time.process_time
) -> tuple[list[float], list[Any]]:
    """Return the least time [s] of each job, run in turn so that other work counts little, and what each returned."""
    times, answers = [float("inf")] * len(jobs), [None] * len(jobs)
    for _ in range(rounds):
        for place, job in enumerate(jobs):
            began = clock()
            answers[place] = job()
            times[place] = min(times[place], clock() - began)
    return times, answers


def verdict(holds: bool, claim: str) -> bool:
    """Print a claim and whether it holds, which is returned."""
    print(f"  {'holds ' if holds else 'MISSED'} {claim}")
    return holds
