"""Benchmark suites that come with the project, as paths to their files."""

from __future__ import annotations

from pathlib import Path

__all__ = ["quick", "smoke"]

_here = Path(__file__).resolve().parent

quick = _here / "quick.toml"
"""Every plant family under every identifier family, in about a minute."""

smoke = _here / "smoke.toml"
"""A few cells, in seconds."""
