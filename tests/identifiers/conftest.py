"""What the identifiers' tests share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from harness.protocols import OnlineIdentifier
from harness.signals import Trajectory


def passed(online: OnlineIdentifier, records: Sequence[Trajectory]) -> Any:
    """Return what an online identifier knows after records, sample by sample."""
    state = online.init(records[0].spec, rng=np.random.default_rng(0))
    for one in records:
        state = online.start(state, one.y[0])
        for k in range(len(one) - 1):
            state = online.update(state, one.u[k], one.y[k + 1])
    return state
