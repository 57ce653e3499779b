"""FMUs (FMI 2 and 3, co-simulation and model exchange) behind the stepping interface; fmpy reads and loads them.

``plant`` has the plant, ``as_is`` runs a file by its own experiment, ``probe`` tries one before it is scored,
``engine`` steps through the function pointers. Our own mockups lie in ``plants/mockups``.
"""

from __future__ import annotations

from harness.extras import on_demand

_SHOWN = {
    "FmuPlant": "plant",
    "cart_pole_fmu": "mockups",
    "drive_fmu": "mockups",
    "mass_spring_fmu": "mockups",
    "pendulum_fmu": "mockups",
    "run_as_is": "as_is",
    "two_tanks_fmu": "mockups",
}
__all__ = [*_SHOWN]
__getattr__ = on_demand(__name__, _SHOWN)
