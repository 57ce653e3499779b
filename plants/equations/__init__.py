"""Plants given by their equations: mechanisms and ODEs of ``harness.physics``, linear systems, surrogates.

Add one in ``ode`` from a model of the catalogue.
"""

from __future__ import annotations

from harness.extras import on_demand

_SHOWN = {
    "LinearPlant": "linear",
    "OdePlant": "ode_plant",
    "cart_pole_ode": "ode",
    "chain_ode": "ode",
    "glider_ode": "surrogates",
    "hydro_cart_pole_ode": "surrogates",
    "linear_ode": "ode",
    "pendulum_ode": "ode",
}
__all__ = [*_SHOWN]
__getattr__ = on_demand(__name__, _SHOWN)
