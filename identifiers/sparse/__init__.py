"""Sparse regression: STLSQ, LASSO and best subsets over libraries of functions.

May import ``identifiers.common``. Add a selection rule in ``selection``.
"""

from __future__ import annotations

from harness.extras import on_demand

_SHOWN = {
    "Narx": "narx",
    "Stlsq": "stlsq",
}
__all__ = [*_SHOWN]
__getattr__ = on_demand(__name__, _SHOWN)
