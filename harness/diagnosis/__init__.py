"""Closing the loop: find the residual, trace it to an effect the model lacks, add it, report before and after."""

from __future__ import annotations

from typing import TYPE_CHECKING

from harness.extras import on_demand

if TYPE_CHECKING:
    from harness.diagnosis.algorithm import diagnose
    from harness.diagnosis.close import Report, close_loop, close_loop_file
    from harness.diagnosis.diagnosis import Diagnosis

__all__ = ["Diagnosis", "Report", "close_loop", "close_loop_file", "diagnose"]
__getattr__ = on_demand(
    __name__,
    {
        "Diagnosis": "diagnosis",
        "Report": "close",
        "close_loop": "close",
        "close_loop_file": "close",
        "diagnose": "algorithm",
    },
)
