"""``sysid new`` begins plug-ins that work: each passes its checks and is found once it is installed."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from harness import api
from harness.errors import InputError
from harness.scaffold import KINDS, new

NAMES = {
    "identifier": "last-value",
    "plant": "spring",
    "scenario": "jumps",
    "effect": "soft-friction",
    "model": "crane",
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_what_is_begun_passes_its_checks(kind: str, tmp_path: Path, sysid: Callable[..., Any]) -> None:
    name = NAMES[kind]
    printed = sysid("new", kind, name, "--folder", tmp_path).out
    project = tomllib.loads((tmp_path / f"sysid-{name}" / "pyproject.toml").read_text())
    points = project["project"]["entry-points"]
    ((entry, target),) = points[f"sysid_harness.{kind}s"].items()
    assert printed.endswith(f"sysid check {entry}\n")  # the id under which it is found, not the name of the folder
    package, _, attribute = target.partition(":")
    source = tmp_path / f"sysid-{name}" / "src" / package / "__init__.py"
    results = api.check(f"{source}:{attribute}")
    skip = {"model_stored_and_read"}  # asks for the registered reader, which comes with the installation
    assert [(one.name, one.reason) for one in results if not one.passed and one.name not in skip] == []
    assert len(results) >= 5
    assert entry.replace("-", "_") == name.replace("-", "_")
    assert ("sysid_harness.model_readers" in points) == (kind == "identifier")
    compile((tmp_path / f"sysid-{name}" / "tests" / "test_contract.py").read_text(), "test", "exec")


def test_what_cannot_be_begun_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="kind of plug-in: expected one of identifier"):
        new("robot", "x", folder=tmp_path)
    for bad in ("Soft", "1st", "a/b", "class", "..", ""):
        with pytest.raises(InputError, match="name of a plug-in"):
            new("effect", bad, folder=tmp_path)
    new("effect", "mine", folder=tmp_path)
    with pytest.raises(InputError, match="the folder exists"):
        new("model", "mine", folder=tmp_path)
