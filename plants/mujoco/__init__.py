"""Robots in MuJoCo: any MJCF or URDF by path, and the one-joint arm for comparison with other engines.

``plant`` steps, ``settings`` puts options into the model, ``signals`` names inputs and outputs; add a robot in
``robots``.
"""

from __future__ import annotations

from harness.extras import on_demand

NEEDS = ("mujoco",)

_SHOWN = {
    "MujocoPlant": "plant",
    "one_joint_arm": "robots",
}
__all__ = [*_SHOWN]
__getattr__ = on_demand(__name__, _SHOWN)
