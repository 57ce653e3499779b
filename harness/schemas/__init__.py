"""Public formats as JSON schemas."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

__all__ = ["report_schema"]


def report_schema() -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of the ``report.json`` that ``sysid close-loop`` writes.

    Examples
    --------
    >>> "verdict" in report_schema()["required"]
    True
    """
    found: dict[str, Any] = json.loads(Path(__file__).with_name("report.json").read_text(encoding="utf-8"))
    return found
