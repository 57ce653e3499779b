"""Models that switch: affine pieces with their regions, jumps of the state where a guard is met.

A new method goes into a file of its own; imports :mod:`identifiers.common`, and trees of :mod:`identifiers.learned`.
"""

from __future__ import annotations

from harness.extras import on_demand

_SHOWN = {
    "HybridAutomaton": "automaton",
    "PiecewiseAffine": "piecewise_affine",
}
__all__ = [*_SHOWN]
__getattr__ = on_demand(__name__, _SHOWN)
