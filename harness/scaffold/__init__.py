"""New plug-ins: a distribution of its own that works, to be changed into what one wants."""

from __future__ import annotations

import keyword
import re
from pathlib import Path

from harness.errors import InputError, refuse_unknown
from harness.scaffold.templates import SOURCES

__all__ = ["KINDS", "entry_name", "new"]

KINDS = tuple(SOURCES)  # Kinds of plug-ins that can be begun.

_PROJECT = """[build-system]
requires = ["hatchling>=1.26"]
build-backend = "hatchling.build"

[project]
name = "sysid-NAME"
version = "0.1.0"
description = "Plug-in of sysid-harness: KIND NAME"
readme = "README.md"
requires-python = ">=3.11"
dependencies = ["numpy>=1.26", "sysid-harness>=0.1"]

[project.entry-points."sysid_harness.KINDs"]
ENTRY = "PACKAGE:ATTRIBUTE"
READER
[tool.hatch.build.targets.wheel]
packages = ["src/PACKAGE"]
"""

_README = """# sysid-NAME

Plug-in of sysid-harness: KIND `NAME`.

    pip install -e .
    sysid list KINDs
    sysid check ENTRY
    python -m pytest

What it does stands in `src/PACKAGE/__init__.py`: a working example to be replaced.
"""

_TEST = '''"""The plug-in keeps its contract."""

from __future__ import annotations

from harness import api


def test_it_keeps_its_contract() -> None:  # once it is installed: pip install -e .
    broken = [f"{one.name}: {one.reason}" for one in api.check("ENTRY") if not one.passed]
    assert broken == []
'''


def entry_name(kind: str, name: str) -> str:
    """Return the id under which a new plug-in is found: ids of effects are written with underscores.

    Examples
    --------
    >>> entry_name("effect", "soft-friction"), entry_name("plant", "soft-wall")
    ('soft_friction', 'soft-wall')
    """
    return name.replace("-", "_") if kind == "effect" else name


def new(kind: str, name: str, *, folder: str | Path = ".") -> list[Path]:
    """Write a new plug-in as a distribution of its own.

    Parameters
    ----------
    kind : str
        identifier, plant, scenario, effect or model.
    name : str
        Its id: letters, digits and hyphens, a letter first.
    folder : path
        Where ``sysid-NAME/`` is made.

    Raises
    ------
    InputError
        If the kind or the name cannot be used, or the folder is there.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     [path.name for path in new("effect", "soft-friction", folder=folder)]
    ['pyproject.toml', 'README.md', '__init__.py', 'py.typed', 'test_contract.py']
    """
    refuse_unknown("kind of plug-in", kind, SOURCES, remedy="choose one of these, or dataset (of files)")
    plain = name.replace("-", "_")
    if not re.fullmatch(r"[a-z][a-z0-9]*(?:[-_][a-z0-9]+)*", name) or keyword.iskeyword(plain):
        raise InputError(
            "name of a plug-in",
            expected="small letters, digits and hyphens, a letter first",
            got=repr(name),
            remedy="choose another, such as soft-friction",
        )
    target = Path(folder) / f"sysid-{name}"
    if target.exists():
        raise InputError("the folder exists", expected="a new one", got=str(target), remedy="choose another name")
    title = "".join(part.capitalize() for part in plain.split("_"))
    function = kind in ("effect", "model")
    words = {
        "PACKAGE": f"sysid_{plain}",
        "ATTRIBUTE": plain if function else title,
        "FUNCTION": plain,
        "CLASS": title,
        "ENTRY": entry_name(kind, name),
        "NAME": name,
        "KIND": kind,
        "READER": f'\n[project.entry-points."sysid_harness.model_readers"]\n{name} = "sysid_{plain}:{title}Model"\n'
        if kind == "identifier"
        else "",
    }

    def filled(text: str) -> str:
        for word, meaning in words.items():
            text = text.replace(word, meaning)
        return text

    package = target / "src" / words["PACKAGE"]
    files = {
        target / "pyproject.toml": filled(_PROJECT),
        target / "README.md": filled(_README),
        package / "__init__.py": filled(SOURCES[kind]),
        package / "py.typed": "",
        target / "tests" / "test_contract.py": filled(_TEST),
    }
    for path, text in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return list(files)
