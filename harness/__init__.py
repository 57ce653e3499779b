"""Co-simulation test harness for system identification that closes the loop with measured data.

What most people need is here, loaded when it is used::

    import harness

    record = harness.simulate("pendulum-ode", scenario="multisine")
    report = harness.close_loop("log.csv", model="pendulum", out="report")

The rooms behind it are packages of their own: ``harness.physics``, ``harness.effects``, ``harness.cosim``,
``harness.export``, ...
"""

from __future__ import annotations

from importlib.util import find_spec as _find_spec
from pathlib import Path as _Path

from harness.extras import on_demand as _on_demand

__version__ = "0.1.0"


def _check_siblings() -> None:
    """Refuse to run beside foreign packages called plants, identifiers or scenarios (such names exist elsewhere)."""
    for name in ("plants", "identifiers", "scenarios"):
        found = _find_spec(name)
        places = [] if found is None else [_Path(place) for place in found.submodule_search_locations or ()]
        if not any((place / "_sysid_harness").is_file() for place in places):
            file = None if found is None else found.origin
            got = f"the package at {places[0]}" if places else f"the file {file}" if file else "nothing"
            remedy = (
                f"rename that file, or start Python from another folder: it hides the package {name!r}"
                if file and not places
                else f"uninstall the other distribution that brings {name!r}, or use a fresh virtual environment"
            )
            raise ImportError(
                f"sysid-harness: the package {name!r}: expected the one installed with sysid-harness, got {got}; "
                f"remedy: {remedy}"
            )


_check_siblings()

_HOMES = {
    "Channel": "signals",
    "PlantSpec": "signals",
    "Trajectory": "signals",
    "Run": "signals",
    "Dataset": "signals",
    "Experiment": "protocols",
    "Streams": "rng",
    "run": "rollout",
    "predict": "scoring",
    "equation_error": "scoring",
    "simulation_error": "scoring",
    "regret": "scoring",
    "load_dataset": "api",
    "create": "registry",
    "effect": "effects",
    "load_model": "fitted",
    "trusting": "trust",
    "simulate": "api",
    "identify": "api",
    "calibrate": "api",
    "close_loop": "api",
    "isolability": "api",
    "bench": "api",
    "export_fmu": "api",
    "equations": "api",
    "compare": "api",
    "spectrum": "api",
    "order": "api",
    "modes": "api",
    "analyse": "api",
    "check": "api",
    "vet": "api",
    "agreement": "api",
    "list_parts": "api",
    "errors": "",
    "testing": "",
}
__all__ = [*sorted(_HOMES)]
__getattr__ = _on_demand(__name__, _HOMES)
