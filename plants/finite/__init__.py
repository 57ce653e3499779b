"""Finite Markov processes, fully observed and not.

Add one as a function that returns ``FiniteMdp`` or ``FinitePomdp``.
"""

from __future__ import annotations

from harness.extras import on_demand

_SHOWN = {
    "CorridorsMdp": "corridors",
    "FiniteMdp": "mdp",
    "FinitePomdp": "pomdp",
    "MachinesMdp": "machines",
    "TigerPomdp": "tiger",
    "grid_mdp": "mdp",
    "grid_pomdp": "pomdp",
}
__all__ = [*_SHOWN]
__getattr__ = on_demand(__name__, _SHOWN)
