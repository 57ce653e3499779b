"""Models whose equations are known: lumped and inertial parameters, grey boxes, filters, residual physics.

May import ``identifiers.common``; the equations come from ``harness.physics``. Add a method as one file, its entry
point in ``pyproject.toml``.
"""

from __future__ import annotations

from harness.extras import on_demand

_SHOWN = {
    "CalibrationPoses": "arms.poses",
    "Contacts": "arms.floating",
    "FloatingInertial": "arms.floating",
    "GliderFunctions": "glider",
    "GravityAtRest": "arms.rest",
    "Inertial": "arms.inertial",
    "JointCalibration": "arms.calibration",
    "MassIntervals": "arms.mass_intervals",
    "MaximumLikelihood": "stochastic",
    "OutputError": "grey_box",
    "PushedInPlane": "pushed_plane",
    "PushedObject": "pushed",
    "ResidualPhysics": "residual",
    "lumped_energy": "lumped",
    "lumped_momentum": "lumped",
    "lumped_torque": "lumped",
}
__all__ = [*_SHOWN]
__getattr__ = on_demand(__name__, _SHOWN)
