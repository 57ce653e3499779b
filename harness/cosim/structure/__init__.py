"""Systems of other tools: SSP packages and folders, and OSP system structures, read and laid flat."""

from __future__ import annotations

from harness.cosim.structure.describe import Describe, describe_structure
from harness.cosim.structure.open import opened

__all__ = ["Describe", "describe_structure", "opened"]
