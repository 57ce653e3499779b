"""Models out: co-simulation FMUs with their C source, python-control systems."""

from __future__ import annotations

from harness.export.fmu import export, write_fmu, write_linear_fmu
from harness.export.linear import to_control

__all__ = ["export", "to_control", "write_fmu", "write_linear_fmu"]
