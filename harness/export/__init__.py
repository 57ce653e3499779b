"""Models out: co-simulation FMUs with their C source."""

from __future__ import annotations

from harness.export.fmu import export, write_fmu

__all__ = ["export", "write_fmu"]
