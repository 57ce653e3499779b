"""Arms in PyBullet: URDFs by path, robots that PyBullet ships.

``arm`` has the plant, ``world`` the client and its settings; add a robot in ``robots``.
"""

from __future__ import annotations

from harness.extras import on_demand

NEEDS = ("pybullet",)

_SHOWN = {
    "ArmPlant": "arm",
    "MarkedArmPlant": "marked_arm",
    "acrobot": "robots",
    "double_pendulum": "robots",
    "iiwa": "robots",
    "one_joint_arm": "robots",
    "panda": "robots",
}
__all__ = [*_SHOWN]
__getattr__ = on_demand(__name__, _SHOWN)
