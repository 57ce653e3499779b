"""Planted faults change what stands in the sources: a fault whose text is gone is never planted."""

from __future__ import annotations

import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_every_fault_has_its_text_once_in_its_file() -> None:
    faults = tomllib.loads((ROOT / "lab/planted_faults.toml").read_text(encoding="utf-8"))["fault"]
    assert len(faults) >= 60
    counts = {fault["name"]: (ROOT / fault["file"]).read_text(encoding="utf-8").count(fault["old"]) for fault in faults}
    assert len(counts) == len(faults), "names are unique"
    assert {name: count for name, count in counts.items() if count != 1} == {}
    assert all(fault["new"] != fault["old"] for fault in faults)
