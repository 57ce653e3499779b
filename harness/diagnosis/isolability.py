"""What this experiment could tell apart at all, computed from the model and the excitation, before the residual."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from harness.diagnosis.search.fit import Column, Fit, Form, Linearised
from harness.diagnosis.search.scores import ScoreTest


def unseen(test: ScoreTest, form: Form, fit: Fit) -> list[dict[str, Any]]:
    """Return the effects that an experiment cannot show, each with what does the same.

    - ``test``: of the dictionary beside the fit
    - returns ``name``, ``at``, ``reason``; ``parameter``, the nominal parameter whose change is most like the effect's
      (None where that is an initial state); ``left``, the share of the effect that nothing free can take up
    """
    linear = form.linearised(fit)
    hidden = sorted(test.hidden, key=lambda lead: str(lead.placed))
    columns: dict[str, list[Column]] = {}
    for column in form.columns(fit, [lead.placed for lead in hidden]) if hidden else ():
        columns.setdefault(str(column.placed), []).append(column)
    rows = []
    for lead in hidden:
        by = _absorbing(columns.get(str(lead.placed), []), linear, fit)
        what = f"the nominal parameter {by}" if by else "nominal parameters or initial states"
        rows.append(
            {
                "name": lead.placed.effect.name,
                "at": lead.placed.at,
                "reason": f"{what} can do the same",
                "parameter": by,
                "left": round(lead.share, 5),
            }
        )
    return rows


def _absorbing(columns: Sequence[Column], linear: Linearised, fit: Fit) -> str | None:
    """Return the nominal parameter whose change is most like an effect's, None where it is none."""
    nuisance = linear.nuisance["estimation"]
    sizes = np.linalg.norm(nuisance, axis=0)
    best, name = 0.0, None
    for column in columns:
        for change in column.estimation.T:
            size = np.linalg.norm(change)
            if not size > 0:
                continue
            cosines = np.abs(change @ nuisance) / (np.where(sizes > 0, sizes, np.inf) * size)
            place = int(np.argmax(cosines))
            if cosines[place] > best:
                best, name = float(cosines[place]), fit.free[place] if place < linear.shared else None
    return name
