"""A plant in a process of its own: what crashes or hangs there ends that process only.

``isolated`` is the plant that stands for it, ``child`` runs the other side, ``frames`` what passes between them.
"""

from __future__ import annotations

from harness.extras import on_demand

_SHOWN = {
    "IsolatedPlant": "isolated",
}
__all__ = [*_SHOWN]
__getattr__ = on_demand(__name__, _SHOWN)
