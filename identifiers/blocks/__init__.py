"""Block-structured models: linear dynamics around a static curve, or with hysteresis inside.

May import ``identifiers.common`` and ``identifiers.linear``, whose models they start from. A new structure is a file of
its own, named by its method.
"""

from __future__ import annotations

from harness.extras import on_demand

_SHOWN = {
    "PrandtlIshlinskii": "prandtl_ishlinskii",
    "WienerHammerstein": "wiener_hammerstein",
}
__all__ = [*_SHOWN]
__getattr__ = on_demand(__name__, _SHOWN)
