"""One refit: a model with effects, fitted from start values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.diagnosis.descent import Bar
from harness.diagnosis.forms import Form, placed_name
from harness.effects.effect import Placed
from harness.errors import HarnessError

__all__ = ["Task", "solved"]


@dataclass(frozen=True)
class Task:
    """One refit: the effects, full parameter values to start from, and what it must promise to be carried on."""

    effects: tuple[Placed, ...]
    starts: tuple[Mapping[str, float], ...]
    bar: Bar | None = None

    @property
    def key(self) -> str:
        """Name in the store."""
        places = ";".join(",".join(f"{k}={v:.12g}" for k, v in sorted(one.items())) for one in self.starts)
        bar = "" if self.bar is None else f"|{placed_name(self.bar.effects)}+{self.bar.gain:g}"
        return f"{placed_name(self.effects)}|{places}{bar}"


def solved(form: Form, task: Task, seed: int) -> dict[str, Any]:
    """Solve one task; a refit that cannot be made is a record with its reason, not an exception."""
    try:
        with np.errstate(all="ignore"):
            return form.solve(task.effects, task.starts, seed=seed, bar=task.bar)
    except (HarnessError, ArithmeticError, np.linalg.LinAlgError, MemoryError) as error:
        return {"failed": " ".join(str(error).split())[:300]}
