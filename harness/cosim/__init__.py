"""Co-simulation: several plants, controllers and sensors coupled into one plant (the master algorithm).

At each communication instant the outputs of the parts are brought up to date in the order of their direct
feedthrough, then every part that is due steps. Under ``"jacobi"`` all of them step with the inputs of that instant;
under ``"gauss-seidel"`` they step in sequence, and a part sees the new outputs of those before it (Kübler and
Schiehlen 2000, Math. Comput. Modelling Dyn. Syst. 6:93; Gomes et al. 2018, ACM Comput. Surv. 51:49, sec. 4).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from harness.extras import on_demand

if TYPE_CHECKING:
    from harness.cosim.description import Make, couple, own_steps, read_coupling
    from harness.cosim.master import Coupled, Order
    from harness.cosim.ssp import couple_ssp
    from harness.cosim.wiring import Connection

__all__ = ["Connection", "Coupled", "Make", "Order", "couple", "couple_ssp", "own_steps", "read_coupling"]

_WHERE = {
    "Connection": "wiring",
    "Coupled": "master",
    "Make": "description",
    "Order": "master",
    "couple": "description",
    "couple_ssp": "ssp",
    "own_steps": "description",
    "read_coupling": "description",
}

__getattr__ = on_demand(__name__, _WHERE)
