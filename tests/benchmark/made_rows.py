"""Tasks and rows of a benchmark that nobody ran, for tests of what is made of them."""

from __future__ import annotations

from typing import Any

from harness.benchmark.parts import Cell, ScoreSettings, SuitePart, Task
from harness.benchmark.row import Row

SCORES = (
    "equation_error", "simulation_error", "log_score", "coverage", "regret", "regret_over_theory", "log_regret",
    "control_score", "predictive_cost", "control_regret", "fit_seconds", "memory_mib",
)  # fmt: skip


def task(
    identifier: str = "hold", seed: int = 0, *, jobs: tuple[str, ...] = ("j",), plant: str = "p", **more: Any
) -> Task:
    """Return a task of cells of one identifier."""
    part = SuitePart(identifier, more.pop("options", {}))
    cells = tuple(Cell(job, part) for job in jobs)
    return Task(
        SuitePart(plant), SuitePart("s"), seed, more.pop("score", ScoreSettings()), more.pop("time_limit", 60.0), cells
    )


def row(name: str = "arx", seed: int = 0, **more: Any) -> Row:
    """Return a row of a cell."""
    own = {"plant": "p", "scenario": "s"} | more
    return Row(job=f"{own['plant']}{name}{seed}", identifier=name, seed=seed, **own)
