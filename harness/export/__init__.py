"""Models out: co-simulation FMUs with their C source, python-control systems."""

from __future__ import annotations

from harness.export.fmu import export, write_fmu, write_linear_fmu
from harness.export.linear import from_state_space, to_control

__all__ = ["export", "from_state_space", "to_control", "write_fmu", "write_linear_fmu"]
