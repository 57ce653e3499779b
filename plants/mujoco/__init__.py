"""Robots in MuJoCo: any MJCF or URDF by path, and the one-joint arm for comparison with other engines.

``plant`` steps, ``settings`` puts options into the model, ``signals`` names inputs and outputs; add a robot in
``robots``.
"""

NEEDS = ("mujoco",)
