"""Cart-poles and their relatives in pymunk.

``plant`` has what they share; add one as a file with its own bodies and constraints.
"""

from __future__ import annotations

from harness.extras import on_demand

NEEDS = ("pymunk",)

_SHOWN = {
    "PymunkBallBeam": "ball_beam",
    "PymunkBouncingMass": "bouncing_mass",
    "PymunkCartPole": "cart_pole",
    "PymunkCartWall": "soft_wall",
    "PymunkCompassGait": "compass_gait",
    "PymunkDoubleCartPole": "double_cart_pole",
    "PymunkPushedBlock": "pushed_block",
    "PymunkPushedObject": "pushed_object",
}
__all__ = [*_SHOWN]
__getattr__ = on_demand(__name__, _SHOWN)
