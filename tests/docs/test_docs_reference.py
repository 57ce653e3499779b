"""The reference pages are those of the sources, and hold every part that is registered and every key."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import msgspec
import pytest

from harness import api, registry

DOCS = Path(__file__).resolve().parents[2] / "docs"
REMEDY = "run python docs/make_reference.py"


@pytest.fixture
def maker(script: Callable[[str], ModuleType]) -> ModuleType:
    return script("docs/make_reference.py")


def test_the_pages_are_those_of_the_sources(maker: ModuleType) -> None:
    made = maker.pages()
    assert sorted(made) == sorted(page.name for page in (DOCS / "reference").iterdir())
    other = [name for name, text in made.items() if (DOCS / "reference" / name).read_text(encoding="utf-8") != text]
    assert other == [], REMEDY


@pytest.mark.parametrize("kind", ["effects", "identifiers", "plants", "scenarios", "models"])
def test_every_part_stands_in_the_reference(kind: str) -> None:
    text = (DOCS / "reference" / f"{kind}.md").read_text(encoding="utf-8")
    own = [entry.id for entry in registry.entries(kind) if entry.distribution == "sysid-harness"]
    assert [name for name in own if f"\n## {name}\n" not in text] == [], REMEDY


def test_every_identifier_stands_in_the_page_that_helps_to_choose() -> None:
    text = (DOCS / "choosing.md").read_text(encoding="utf-8")
    own = [entry.id for entry in registry.entries("identifiers") if entry.distribution == "sysid-harness"]
    told = {"lumped-torque", "lumped-energy"}  # forms of lumped-momentum
    assert [name for name in own if f"`{name}`" not in text and name not in told] == []


@pytest.mark.parametrize("page", ["DATASET", "SUITE"])
def test_every_key_is_explained(page: str, maker: ModuleType) -> None:
    for struct in getattr(maker, page).values():
        told = maker.SUITE_KEYS if page == "SUITE" else maker.meanings(struct)
        assert [field.name for field in msgspec.structs.fields(struct) if not told.get(field.name)] == []


def test_every_effect_is_told_with_its_law_and_what_tells_it_apart() -> None:
    for row in api.list_parts("effects")["effects"]:
        if row["distribution"] == "sysid-harness":
            part = api.describe_part(row["id"], "effects")
            assert part is not None
            assert {"acts on", "law", "easily confused with", "what tells it apart"} <= set(part["facts"]), row["id"]


def test_a_part_is_shown_with_its_options(sysid: Callable[..., Any]) -> None:
    shown = sysid("list", "arm-bullet").out
    assert "Pendulum in PyBullet" in shown
    assert "From hinge to centre of mass [m]" in shown
    part = api.describe_part("dmdc")
    assert part is not None
    assert {row["name"]: row["default"] for row in part["options"]}["delays"] == "1"
    assert api.describe_part("nonsense") is None


def test_options_of_a_factory_are_told_by_its_class_and_those_of_a_base_class_by_that() -> None:
    filter_ = api.describe_part("ekf")
    excitation = api.describe_part("multisine")
    assert filter_ is not None
    assert excitation is not None
    assert "options as of" not in filter_["text"]
    assert {row["name"]: row["meaning"] for row in filter_["options"]}["doubt"].startswith("Relative standard dev")
    assert {row["name"]: row["meaning"] for row in excitation["options"]}["duration"] != ""
