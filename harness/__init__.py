"""The contracts of sysid-harness, and everything that is neither a plant, an identifier nor a scenario."""

from __future__ import annotations

from importlib.util import find_spec as _find_spec
from pathlib import Path as _Path

__version__ = "0.1.0"


def _check_siblings() -> None:
    """Refuse to run beside foreign packages called plants, identifiers or scenarios (such names exist elsewhere)."""
    for name in ("plants", "identifiers", "scenarios"):
        found = _find_spec(name)
        places = [] if found is None else [_Path(place) for place in found.submodule_search_locations or ()]
        if not any((place / "_sysid_harness").is_file() for place in places):
            got = f"the package at {places[0]}" if places else "nothing"
            raise ImportError(
                f"sysid-harness: the package {name!r}: expected the one installed with sysid-harness, got {got}; "
                f"remedy: uninstall the other distribution that brings {name!r}, or use a fresh virtual environment"
            )


_check_siblings()
