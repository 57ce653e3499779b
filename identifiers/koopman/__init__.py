"""Linear models of lifted states: extended DMD with control.

May import ``identifiers.common`` and ``identifiers.linear.least_squares``. Add a dictionary of observables in
``identifiers.common.library``.
"""

from __future__ import annotations

from harness.extras import on_demand

_SHOWN = {
    "Edmdc": "koopman",
    "EigenfunctionsOfModel": "eigenfunctions",
}
__all__ = [*_SHOWN]
__getattr__ = on_demand(__name__, _SHOWN)
