"""The reference page holds every part that is registered and every key of a data set."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import msgspec
import pytest

from harness import api, registry
from harness.command import main
from harness.data.description import Description, SignalSection

DOCS = Path(__file__).resolve().parents[2] / "docs"
REMEDY = "run python docs/make_reference.py"


@pytest.mark.parametrize("kind", ["effects", "identifiers", "plants", "scenarios"])
def test_every_part_stands_in_the_reference(kind: str) -> None:
    text = (DOCS / "reference.md").read_text(encoding="utf-8")
    own = [entry.id for entry in registry.entries(kind) if entry.distribution == "sysid-harness"]
    assert [name for name in own if f"\n### {name}\n" not in text] == [], REMEDY


def test_every_key_stands_in_the_reference_and_the_page_can_be_made() -> None:
    text = (DOCS / "reference.md").read_text(encoding="utf-8")
    for struct in (Description, SignalSection):
        for field in msgspec.structs.fields(struct):
            assert f"| `{field.name}` |" in text, REMEDY
    spec = importlib.util.spec_from_file_location("make_reference", DOCS / "make_reference.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert "### coulomb_friction" in module.reference()


def test_a_part_is_shown_with_its_options(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["list", "arm-bullet"])
    assert ended.value.code == 0
    shown = capsys.readouterr().out
    assert "Pendulum in PyBullet" in shown
    assert "From hinge to centre of mass [m]" in shown
    part = api.describe_part("dmdc")
    assert part is not None
    assert {row["name"]: row["default"] for row in part["options"]}["delays"] == "1"
    assert api.describe_part("nonsense") is None
