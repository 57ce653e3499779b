"""Controllers that learn from the plant they drive: motions that are repeated, balance while parameters are learned.

May import every other family of identifiers. An analysis here closes a loop over a plant and says what it costs; add
one as one file with a frozen dataclass that has ``takes`` and ``of`` (:class:`harness.models.analysis.Analysis`), and
its entry point ``sysid_harness.analyses`` in ``pyproject.toml``.
"""

from __future__ import annotations

from harness.extras import on_demand

_SHOWN = {
    "AdaptiveBalance": "adaptive_balance",
    "LearnedMotion": "learned_motion",
    "OffsetBound": "offset_bound",
}
__all__ = [*_SHOWN]
__getattr__ = on_demand(__name__, _SHOWN)
