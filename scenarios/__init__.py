"""Scenarios: excitation, feedback, noise and the suites that combine them."""

from __future__ import annotations

from harness.extras import on_demand

_SHOWN = {
    "AcrobotLqr": "acrobot",
    "AdaptiveControl": "adaptive",
    "AdaptiveTracking": "adaptive_tracking",
    "ArmComputedTorque": "closed_loop",
    "ArmDesigned": "designed",
    "ArmPd": "closed_loop",
    "CartPoleLqr": "closed_loop",
    "Chirp": "open_loop",
    "FilteredNoise": "open_loop",
    "FreeSwing": "open_loop",
    "Multisine": "open_loop",
    "Prbs": "open_loop",
    "PredictiveControl": "planning",
    "RandomPolicy": "open_loop",
    "ReplayedInput": "recorded",
    "Steps": "open_loop",
    "Triangle": "triangles",
}
__all__ = [*_SHOWN]
__getattr__ = on_demand(__name__, _SHOWN)
