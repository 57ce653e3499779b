"""Studies of the closed loop on simulated truths: confusion, false alarms, coverage, cost."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sysid_lab.running import StudyResult, study

__all__ = ["StudyResult", "study"]


def __getattr__(name: str) -> Any:
    """Load a public name on first use: the command line must start fast."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module("sysid_lab.running"), name)
