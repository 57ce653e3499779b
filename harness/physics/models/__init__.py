"""The catalogue of nominal models.

``catalogue`` has most of the mechanical ones, ``chain``, ``flight`` and ``tanks`` others. Add a model as a function
that returns a mechanism or an ODE, with its entry point in ``pyproject.toml``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from harness.extras import on_demand

if TYPE_CHECKING:
    from harness.physics.models.catalogue import (
        BUILT_IN,
        acrobot,
        cart_pole,
        double_pendulum,
        drive,
        linear,
        load_model,
        oscillator,
        pendulum,
    )
    from harness.physics.models.chain import mass_chain
    from harness.physics.models.flight import perching_glider, planar_quadrotor
    from harness.physics.models.tanks import two_tanks

__all__ = [
    "BUILT_IN",
    "acrobot",
    "cart_pole",
    "double_pendulum",
    "drive",
    "linear",
    "load_model",
    "mass_chain",
    "oscillator",
    "pendulum",
    "perching_glider",
    "planar_quadrotor",
    "two_tanks",
]
__getattr__ = on_demand(__name__, dict.fromkeys(__all__, "catalogue"))
