"""Writing FMUs: the C glue that serves FMI 2.0 and 3.0 from one source, and the build from a model's C code."""

from __future__ import annotations

from harness.fmi import build

__all__ = ["build"]
