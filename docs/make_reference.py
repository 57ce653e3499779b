"""Write docs/reference.md from the sources: run ``python docs/make_reference.py`` after a change of a part."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import msgspec

from harness import api
from harness.data import description
from harness.effects import builtin

TARGET = Path(__file__).with_name("reference.md")


def cell(value: object) -> str:
    """Return a value as the cell of a table."""
    return " ".join(str(value).split()).replace("|", "\\|")


def rows(titles: list[str], lines: list[list[object]]) -> list[str]:
    """Return a table."""
    head = ["| " + " | ".join(titles) + " |", "|" + "---|" * len(titles)]
    return [*head, *("| " + " | ".join(map(cell, line)) + " |" for line in lines), ""]


def keys() -> list[str]:
    """Return every key of a dataset.toml."""
    sections: list[tuple[str, Any]] = [
        ("(top level)", description.Description),
        ("[time]", description.TimeSection),
        ("[signals.NAME]", description.SignalSection),
        ("[[runs]]", description.RunSection),
        ("[nominal]", description.NominalSection),
        ("[nominal.parameters] NAME", description.NominalParameter),
        ("[resample]", description.ResampleSection),
        ("[source]", description.SourceSection),
        ("[[source.files]]", description.SourceFile),
    ]
    text = ["## Keys of dataset.toml", ""]
    for title, struct in sections:
        text += [f"### {title}", "", inspect.getdoc(struct) or "", ""]
        lines: list[list[object]] = []
        for field in msgspec.structs.fields(struct):
            needed = field.default is msgspec.NODEFAULT and field.default_factory is msgspec.NODEFAULT
            default = "" if field.default is msgspec.NODEFAULT else repr(field.default)
            kind = str(field.type).replace("typing.", "").replace("harness.data.description.", "")
            kind = kind.removeprefix("<class '").removesuffix("'>")
            lines.append([f"`{field.name}`", f"`{kind}`", "needed" if needed else f"`{default or 'empty'}`"])
        text += rows(["key", "type", "default"], lines)
    return text


def effects() -> list[str]:
    """Return the catalogue of effects."""
    text = ["## Effects", "", "Letters in units: F force, q position, v rate, a acceleration of the coordinate.", ""]
    for name, one in sorted(builtin().items()):
        summary = next(row["summary"] for row in api.list_parts("effects")["effects"] if row["id"] == name)
        text += [f"### {name}", "", summary, ""]
        facts = [
            ("acts on", ", ".join(one.kinds)),
            ("law", f"`{one.formula}`" if one.formula else ""),
            ("easily confused with", ", ".join(one.family)),
            ("what tells it apart", one.experiment),
        ]
        text += [f"- {title}: {cell(value)}" for title, value in facts if value]
        text += [
            "",
            *rows(["parameter", "unit", "meaning"], [[f"`{p.name}`", p.unit, p.meaning] for p in one.parameters]),
        ]
    return text


def parts(kind: str, title: str) -> list[str]:
    """Return registered parts with their options."""
    text = [f"## {title}", ""]
    for row in api.list_parts(kind)[kind]:
        if row["distribution"] != "sysid-harness":
            continue
        part = api.describe_part(row["id"])
        assert part is not None
        text += [f"### {row['id']}", "", row["summary"], ""]
        if part["options"]:
            lines = [[f"`{one['name']}`", f"`{one['default']}`", one["meaning"]] for one in part["options"]]
            text += rows(["option", "default", "meaning"], lines)
    return text


def reference() -> str:
    """Return the page."""
    head = [
        "# Reference",
        "",
        "Written by `docs/make_reference.py` from the sources; `sysid list ID` shows one part.",
        "",
    ]
    body = keys() + effects() + parts("identifiers", "Identifiers") + parts("plants", "Plants")
    return "\n".join([*head, *body, *parts("scenarios", "Scenarios")]).rstrip() + "\n"


if __name__ == "__main__":
    TARGET.write_text(reference(), encoding="utf-8")
