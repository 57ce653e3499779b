"""Benchmark suites that come with the project, as paths to their files."""

from __future__ import annotations

from pathlib import Path

__all__ = ["further", "measured", "quick", "smoke", "standard"]

_here = Path(__file__).resolve().parent

quick = _here / "quick.toml"
"""Every plant family under every identifier family, in about a minute."""

standard = _here / "standard.toml"
"""Ten seeds of every plant family under every identifier family, and three axes: what a paper would cite."""

further = _here / "further.toml"
"""Plants whose state jumps, slow systems online, hidden states, methods for one form: what standard does not hold."""

measured = _here / "measured.toml"
"""The public recordings."""

smoke = _here / "smoke.toml"
"""A few cells, in seconds."""
