"""Plants: engines and data behind the one stepping interface of :mod:`harness.protocols`."""

from __future__ import annotations

from harness.extras import on_demand

_SHOWN = {
    "GymPlant": "gym",
    "ReplayPlant": "replay",
}
__all__ = [*_SHOWN]
__getattr__ = on_demand(__name__, _SHOWN)
