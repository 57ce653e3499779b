"""Write docs/reference/*.md from the sources: ``python docs/make_reference.py`` after a change of a part."""

from __future__ import annotations

import ast
import html
import inspect
import re
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

import msgspec

import harness
import identifiers
import plants
import scenarios
from harness import api
from harness.benchmark import suite
from harness.data import sections
from harness.schemas import report_schema

TARGET = Path(__file__).with_name("reference")
MADE = "<!-- written by docs/make_reference.py from the sources -->"
DATASET = {
    "(top level)": sections.Description,
    "[time]": sections.TimeSection,
    "[signals.NAME]": sections.SignalSection,
    "[[runs]]": sections.RunSection,
    "[[runs.beside]]": sections.BesideSection,
    "[nominal]": sections.NominalSection,
    "[nominal.parameters] NAME": sections.NominalParameter,
    "[resample]": sections.ResampleSection,
    "[filter]": sections.FilterSection,
    "[source]": sections.SourceSection,
    "[[source.files]]": sections.SourceFile,
}
SUITE = {
    "(top level)": suite.Suite,
    "[[groups]]": suite.Group,
    "plants, scenarios, identifiers of a group": suite.SuitePart,
    "[groups.score]": suite.ScoreSettings,
}
EFFECTS = (
    "Letters in units: F force, q position, v rate, a acceleration of the coordinate, u input, y output, dt sample "
    "time, T length of the record."
)
CHOOSING = "[choosing an identifier](../choosing.md)"
SUITE_KEYS = {
    "name": "Name in tables and folders; of a group: what its tables are called.",
    "groups": "Each group is a full product of its parts.",
    "description": "A sentence about the suite.",
    "seeds": "Seeds of every cell; those of a group count before those of the suite.",
    "time_limit": "Seconds that one cell may take; then its row says `timeout`.",
    "cell_seconds": "Mean CPU time of a cell, as the author measured it: for `--dry-run` before any has run.",
    "plants": "Parts, see below.",
    "scenarios": "Parts, see below.",
    "identifiers": "Parts, see below.",
    "score": "How the models are scored.",
    "axes": "Options with several values, by `kind.option`: each value makes a cell of its own.",
    "id": "Id of a registered part; a plant may also be a file or `recording:NAME`.",
    "options": "Options of the part.",
    "label": "Name in the table; by default the id.",
    "streams": "Name of the random streams; parts that share it meet the same random numbers.",
    "at": "Filled by `axes`.",
    "horizon": "Horizon of the simulation error [s]; the whole record without it.",
    "runs": "Records that a model is fitted to.",
    "held_out": "Records that it is scored on.",
    "curve": "Lengths of the stream at which the regret is drawn; few where a fit is long.",
    "control": "Columns of control: what a design on the model costs on the true plant, and what learning costs.",
}


def cell(value: object) -> str:
    """Return a value as the cell of a table; code with a bar in it as HTML, which every renderer shows alike."""
    parts = re.split(r"`([^`]*[|<][^`]*)`", " ".join(str(value).split()))
    parts[1::2] = [f"<code>{html.escape(code, quote=False).replace('|', '&#124;')}</code>" for code in parts[1::2]]
    parts[::2] = [text.replace("|", "\\|").replace("<", "&lt;") for text in parts[::2]]
    return "".join(parts)


def rows(titles: list[str], lines: list[list[object]]) -> list[str]:
    """Return a table."""
    if not lines:
        return []
    head = ["| " + " | ".join(titles) + " |", "|" + "---|" * len(titles)]
    return [*head, *("| " + " | ".join(map(cell, line)) + " |" for line in lines), ""]


def plain(text: str) -> str:
    """Return a docstring as Markdown."""
    return re.sub(r":\w+:`~?(?:[\w.]*\.)?(\w+)`", r"`\1`", text).replace("``", "`")


def meanings(struct: type) -> dict[str, str]:
    """Return what stands under each field of a record."""
    (tree,) = ast.parse(inspect.getsource(struct)).body
    assert isinstance(tree, ast.ClassDef)
    found = {}
    for field, after in zip(tree.body, [*tree.body[1:], ast.Pass()], strict=True):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
            text = after.value.value if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) else ""
            found[field.target.id] = inspect.cleandoc(str(text))
    return found


def keys(title: str, structs: Mapping[str, Any], told: Mapping[str, str] | None = None) -> list[str]:
    """Return every key of a file of settings."""
    text = [f"# {title}", ""]
    for place, struct in structs.items():
        text += [f"## {place}", "", plain(inspect.getdoc(struct) or ""), ""]
        about = told or meanings(struct)
        lines: list[list[object]] = []
        for field in msgspec.structs.fields(struct):
            needed = field.default is msgspec.NODEFAULT and field.default_factory is msgspec.NODEFAULT
            kind = re.sub(r"typing\.|harness\.[\w.]*\.", "", str(field.type))
            kind = kind.removeprefix("<class '").removesuffix("'>")
            default = "empty" if field.default is msgspec.NODEFAULT or field.default == "" else repr(field.default)
            if isinstance(field.default, msgspec.Struct):
                default = "see below"
            lines.append([f"`{field.name}`", f"`{kind}`", "needed" if needed else f"`{default}`", about[field.name]])
        text += rows(["key", "type", "default", "meaning"], lines)
    return text


def parts(kind: str, title: str, head: str) -> list[str]:
    """Return registered parts with their text, their facts and their options."""
    text = [f"# {title}", "", head, ""]
    for row in api.list_parts(kind)[kind]:
        if row["distribution"] != "sysid-harness":
            continue
        part = api.describe_part(row["id"], kind)
        assert part is not None
        text += [f"## {row['id']}", "", part["text"], ""]
        text += [f"- {name}: `{' '.join(str(fact).split())}`" if name == "law" else f"- {name}: {cell(fact)}"
                 for name, fact in part["facts"].items()]  # fmt: skip
        text += [""] * bool(part["facts"])
        if kind == "effects":
            lines = [[f"`{one['name']}`", one["meaning"]] for one in part["options"]]
            text += rows(["parameter", "meaning [unit]"], lines)
        else:
            lines = [[f"`{one['name']}`", f"`{one['default']}`", one["meaning"]] for one in part["options"]]
            text += rows(["option", "default", "meaning"], lines)
    return text


def commands() -> list[str]:
    """Return every command with its arguments and options."""
    from sysid_lab.cli import app as lab
    from typer.core import TyperGroup
    from typer.main import get_command

    from harness.cli.app import app

    parts = [(name, get_command(one)) for name, one in (("sysid", app), ("sysid-lab", lab))]
    text = ["# Commands", "", "`sysid COMMAND --help` shows the same; ids complete in the shell after",
            "`sysid --install-completion`. Each command is a call of the same name in `harness.api`;",
            "`sysid-lab` is a distribution of its own, see `lab/README.md`.", ""]  # fmt: skip
    found = [(f"{program} {name}", command) for program, group in parts if isinstance(group, TyperGroup)
             for name, command in sorted(group.commands.items()) if not command.hidden]  # fmt: skip
    for name, command in found:
        text += [f"## {name}", "", plain(inspect.cleandoc(command.help or "")), ""]
        lines: list[list[object]] = []
        for one in command.params:
            shown = str(one.metavar or one.name).upper() if one.param_type_name == "argument" else ", ".join(one.opts)
            described = getattr(one, "help", None) or ""
            default = "" if one.default is None or one.default is False or callable(one.default) else one.default
            default = "" if "UNSET" in repr(default).upper() else default
            lines.append([f"`{shown}`", f"`{default}`" if default != "" else "", described])
        text += rows(["argument or option", "default", "meaning"], lines)
    return text


def python() -> list[str]:
    """Return what you may rely on from Python: what `import harness` shows, and the rooms of parts."""
    text = ["# Python", "", "You may rely on the names of this page, on the commands, on parts and their options, and",
            "on the files that are described here. A name that changes answers with one line for one release. All",
            "other names may change without a word.", "", "## Classes of parts", "",
            "`harness.create(kind, id)` makes any part. To import its class, take it from its room:", ""]  # fmt: skip
    table: list[list[object]] = []
    for package in (plants, identifiers, scenarios):
        below = [f"{package.__name__}.{one.name}" for one in iter_modules(package.__path__) if one.ispkg]
        rooms = {name: getattr(import_module(name), "__all__", ()) for name in (package.__name__, *below)}
        table += [[f"`{room}`", ", ".join(f"`{name}`" for name in names)] for room, names in rooms.items() if names]
    text += rows(["room", "names"], table)
    text += ["## import harness", "", "Each name is loaded when it is used.", ""]
    for name in harness.__all__:
        value = getattr(harness, name)
        doc = inspect.getdoc(value) or ""
        head = re.split(r"\n(?:Parameters|Attributes|Returns|Raises|Notes|Examples)\n-+\n", doc)[0]
        signature = ""
        if callable(value):
            signature = re.sub(
                r"harness\.[\w.]*\.|typing\.|collections\.abc\.|pathlib\.", "", str(inspect.signature(value))
            )
            signature = re.sub(r"(: |-> )(['\"])(.*?)\2", r"\1\3", signature)
            signature = re.sub(r"<function _*(\w+) at \w+>", r"\1", signature)
        text += [
            f"## {name}",
            "",
            *(["```text", f"{name}{signature}", "```", ""] if signature else []),
            plain(head),
            "",
        ]
        found = re.search(r"\nParameters\n-+\n(.*?)(?=\n\w+\n-+\n|\Z)", doc, re.DOTALL)
        lines = []
        for entry in re.split(r"\n(?=\S)", found[1].strip()) if found else ():
            title, _, body = entry.partition("\n")
            parameter, _, kind = title.partition(" : ")
            lines.append([f"`{parameter}`", kind, plain(inspect.cleandoc(body))])
        text += rows(["parameter", "type", "meaning"], lines)
    return text


def report() -> list[str]:
    """Return the content of report.json, from its schema."""
    schema = report_schema()
    text = ["# report.json", "", schema["description"], "",
            "JSON Schema 2020-12: `harness/schemas/report.json`, `harness.schemas.report_schema()`.", ""]  # fmt: skip

    def table(title: str, node: Mapping[str, Any]) -> None:
        lines: list[list[object]] = []
        needed = node.get("required", ())
        for name, one in node["properties"].items():
            kind = one.get("type", one.get("$ref", "").rpartition("/")[2] or "any")
            kind = " or ".join(kind) if isinstance(kind, list) else kind
            lines.append([f"`{name}`", kind, "always" if name in needed else "", one.get("description", "")])
        text.extend([f"## {title}", "", *([node["description"], ""] if title != "Top level" else [])])
        text.extend(rows(["key", "type", "there", "meaning"], lines))

    table("Top level", schema)
    for name, node in schema.get("$defs", {}).items():
        if "properties" in node:
            table(name, node)
    return text


def pages() -> dict[str, str]:
    """Return every page by its file name."""
    made = {
        "dataset.md": keys("Keys of dataset.toml", DATASET),
        "suites.md": keys("Keys of a suite", SUITE, SUITE_KEYS),
        "effects.md": parts("effects", "Effects", EFFECTS),
        "identifiers.md": parts("identifiers", "Identifiers", f"When to use which: {CHOOSING}."),
        "plants.md": parts("plants", "Plants", "How exact they are and what they can do: [plants](../plants.md)."),
        "scenarios.md": parts("scenarios", "Scenarios", "What excites a plant, sets its start and its sensors' noise."),
        "models.md": parts("models", "Models", "Nominal models by name: `--model NAME`."),
        "analyses.md": parts("analyses", "Analyses", "`sysid analyse ANALYSIS SUBJECT -O option=value`."),
        "commands.md": commands(),
        "python.md": python(),
        "report.md": report(),
    }  # fmt: skip
    return {name: "\n".join([MADE, "", *text]).rstrip() + "\n" for name, text in made.items()}


if __name__ == "__main__":
    TARGET.mkdir(exist_ok=True)
    for name, text in pages().items():
        (TARGET / name).write_text(text, encoding="utf-8")
