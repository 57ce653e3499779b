"""Probes of FMUs beside the scores: made once, kept over a resume, only where a plant can be probed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from harness.benchmark import bench

SUITE = """
name = "probed"
seeds = [0]

[[groups]]
plants = [{ id = "mass-spring-fmu" }, { id = "linear-ode" }]
scenarios = [{ id = "prbs", options = { samples = 200, amplitude = 1.0 } }]
identifiers = [{ id = "hold" }]
"""


@pytest.mark.slow
def test_fmus_are_probed_once_and_the_result_lies_with_the_scores(tmp_path: Path) -> None:
    suite = tmp_path / "probed.toml"
    suite.write_text(SUITE, encoding="utf-8")
    out = tmp_path / "out"
    bench(suite, out=out, workers=1)
    content = json.loads((out / "probes.json").read_text(encoding="utf-8"))
    assert list(content) == ["mass-spring-fmu"]
    result = content["mass-spring-fmu"]["result"]
    assert result["passed"] is True
    assert {finding["check"] for finding in result["findings"]} >= {"units", "finite", "reset", "restore", "step"}
    written = (out / "probes.json").stat().st_mtime_ns
    bench(suite, out=out, workers=1, resume=True)
    assert (out / "probes.json").stat().st_mtime_ns == written
