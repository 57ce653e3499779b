"""Closing the loop: find the residual, trace it to an effect the model lacks, add it, report before and after."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from harness.diagnosis.algorithm import diagnose
    from harness.diagnosis.close import Report, close_loop, close_loop_file
    from harness.diagnosis.diagnosis import Diagnosis

__all__ = ["Diagnosis", "Report", "close_loop", "close_loop_file", "diagnose"]


def __getattr__(name: str) -> Any:
    """Load a public name on first use: the loop needs CasADi and SciPy."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    home = {"diagnose": "algorithm", "Diagnosis": "diagnosis"}.get(name, "close")
    return getattr(import_module(f"harness.diagnosis.{home}"), name)
