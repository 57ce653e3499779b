"""Plug-ins: the only way from the harness to plants, identifiers, scenarios, effects and models.

Everything, our own parts included, is found through entry points of the installed distributions, and nothing is
imported before it is asked for. ``SYSID_HARNESS_NO_PLUGINS=1`` leaves only the project's own parts.
"""

from __future__ import annotations

import ast
import functools
import importlib.metadata
import importlib.util
import inspect
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.errors import HarnessError, InputError, PluginError, did_you_mean, refuse_no_file, refuse_unknown
from harness.fingerprint import files_named, fingerprint, sources
from harness.options import instead, meant_options

DISTRIBUTION = "sysid-harness"
KINDS = (
    "plants",
    "identifiers",
    "scenarios",
    "effects",
    "models",
    "analyses",
    "suites",
    "recordings",
    "model_readers",
    "tools",
)

FORMER = {("plants", "compass-gait-ode"): "compass-gait-pymunk"}
"""By kind and former id the id of what took its place, which need not be the same thing: it is named, never taken."""


def singular(kind: str) -> str:
    """Return the word for one part of a kind.

    Examples
    --------
    >>> singular("plants"), singular("analyses")
    ('plant', 'analysis')
    """
    return "analysis" if kind == "analyses" else kind[:-1].replace("_", " ")


@dataclass(frozen=True)
class Entry:
    """One registered part: its kind, its id, where it lives and which distribution brought it."""

    kind: str
    id: str
    target: str
    distribution: str
    point: importlib.metadata.EntryPoint

    @property
    def summary(self) -> str:
        """First line of the part's docstring, read from its source without importing it."""
        module, _, attribute = self.point.value.partition(":")
        try:
            found = importlib.util.find_spec(module)
        except (ImportError, ValueError):
            return "(module not found)"
        if found is None:
            return "(module not found)"
        if not attribute or found.origin is None or not found.origin.endswith(".py"):
            return ""
        tree = _parsed(found.origin)
        for number, node in enumerate(tree.body):
            text = ""
            if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == attribute:
                text = ast.get_docstring(node) or ""
            elif isinstance(node, ast.Assign) and any(getattr(t, "id", "") == attribute for t in node.targets):
                after = tree.body[number + 1] if number + 1 < len(tree.body) else None
                if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
                    text = str(after.value.value)
            if text:
                return text.strip().splitlines()[0]
        return ""

    @property
    def needs(self) -> tuple[str, ...]:
        """Packages that the part cannot do without: ``NEEDS`` of its module, or of the nearest package around it.

        Read from source: a part that needs a package may not be importable without it.
        """
        module = self.point.value.partition(":")[0]
        while module:
            try:
                found = importlib.util.find_spec(module)
            except (ImportError, ValueError):
                return ()
            for node in _parsed(found.origin).body if found is not None and str(found.origin).endswith(".py") else ():
                if isinstance(node, ast.Assign) and any(getattr(t, "id", "") == "NEEDS" for t in node.targets):
                    return tuple(ast.literal_eval(node.value))
            module = module.rpartition(".")[0]
        return ()

    @property
    def code(self) -> str:
        """A hash of the package of a part of others; empty for ours, which ``fingerprint.own_code`` tells."""
        if self.distribution == DISTRIBUTION:
            return ""
        try:
            found = importlib.util.find_spec(self.point.value.partition(":")[0].partition(".")[0])
        except (ImportError, ValueError):
            return ""
        if found is None:
            return ""
        folders = [Path(place) for place in found.submodule_search_locations or ()]
        return fingerprint([sources(place) for place in folders], files_named(found.origin or ""))


@functools.cache
def _parsed(file: str) -> ast.Module:
    """Return the syntax tree of a source file: many parts live in one."""
    return ast.parse(Path(file).read_text(encoding="utf-8"))


@functools.cache
def _all(kind: str) -> dict[str, Entry]:
    """Return the entries of a kind by id, our own first; of two with one id ours wins, then the first by name."""
    refuse_unknown("unknown kind of part", kind, KINDS, remedy="use one of these")
    own_only = os.environ.get("SYSID_HARNESS_NO_PLUGINS", "") not in ("", "0")
    found: list[Entry] = []
    for point in importlib.metadata.entry_points(group=f"sysid_harness.{kind}"):
        name = point.dist.name if point.dist is not None else "?"
        if own_only and name != DISTRIBUTION:
            continue
        found.append(Entry(kind, point.name, point.value, name, point))
    found.sort(key=lambda e: (e.distribution != DISTRIBUTION, e.distribution, e.id))
    result: dict[str, Entry] = {}
    for item in found:
        result.setdefault(item.id, item)
    if not result and kind not in ("model_readers", "tools"):
        raise PluginError(
            f"no {kind} are registered: expected the entry points of an installed {DISTRIBUTION}, got none; "
            "remedy: install the project (pip install -e .)"
        )
    return result


def entries(kind: str) -> tuple[Entry, ...]:
    """Return all registered parts of a kind, sorted by id.

    Examples
    --------
    >>> "pendulum-ode" in [entry.id for entry in entries("plants")]
    True
    """
    return tuple(sorted(_all(kind).values(), key=lambda e: e.id))


def code_of(kind: str, id: str) -> str:
    """Return :attr:`Entry.code` of a part, empty for what is not registered (a plant's file, a recording)."""
    known = _all(kind)
    return known[id].code if id in known else ""


def entry(kind: str, id: str) -> Entry:
    """Return one registered part.

    Raises
    ------
    InputError
        If no part of that kind has this id; the message names what took its place (:data:`FORMER`), lists the nearest
        ids, or says that there is no such file of a plant.
    """
    known, id = _all(kind), str(id)
    if id in known:
        return known[id]
    if (now := FORMER.get((kind, id))) is not None:
        raise InputError(
            f"former id of a {singular(kind)}",
            expected=repr(now),
            got=repr(id),
            remedy=f"say {now}, which took its place",
        )
    if kind == "plants":  # the only parts that may be files
        refuse_no_file(id, "the id of a plant (sysid list plants), an FMU, or a system of them")
    raise InputError(
        f"unknown {singular(kind)}",
        expected=f"one of {', '.join(sorted(known))}",
        got=repr(id),
        remedy=did_you_mean(id, known, f"run 'sysid list {kind}'"),
    )


def load(kind: str, id: str) -> Any:
    """Return the object behind an id, importing it now.

    Raises
    ------
    InputError
        If the id is unknown.
    PluginError
        If the plug-in raises while it is imported.
    """
    found = entry(kind, id)
    try:
        return found.point.load()
    except HarnessError:
        raise
    except Exception as error:
        raise PluginError(
            f"{singular(kind)} {id!r} of {found.distribution} ({found.target}) does not load: "
            f"{type(error).__name__}: {error}; remedy: repair or uninstall {found.distribution}"
        ) from error


def dataset_path(dataset: Any) -> Any:
    """Return the file of a data set: a path as it is, or the recipe of a recording by its name; data pass through.

    Raises
    ------
    InputError
        If a bare name is neither a file or folder nor a recording.

    Examples
    --------
    >>> dataset_path("emps").name
    'emps.toml'
    """
    if not isinstance(dataset, str | Path):
        return dataset
    path, name = Path(dataset), str(dataset)
    if path.suffix or len(path.parts) != 1 or path.is_file():
        return path
    known = _all("recordings")
    if name not in known:
        if path.is_dir():
            return path
        raise InputError(
            "no such file or recording",
            expected=f"a file of data, or one of the recordings {', '.join(sorted(known))}",
            got=repr(name),
            remedy=did_you_mean(name, known, "check the path, or run 'sysid list recordings'"),
        )
    return Path(load("recordings", name))


def named_options(kind: str, id: str) -> dict[str, inspect.Parameter]:
    """Return the named options of a part, by name.

    Examples
    --------
    >>> sorted(named_options("identifiers", "hold"))
    []
    """
    signature = inspect.signature(load(kind, id))
    named = (inspect.Parameter.KEYWORD_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return {name: p for name, p in signature.parameters.items() if p.kind in named}


def takes_option(kind: str, id: str, name: str) -> bool:
    """Return True if a part takes an option: its own, or one of the class that it hands its options on to.

    Examples
    --------
    >>> takes_option("plants", "pendulum-ode", "effects"), takes_option("identifiers", "hold", "effects")
    (True, False)
    """
    if name in named_options(kind, id):
        return True
    factory = load(kind, id)
    made = returned_class(factory)
    open_ended = any(p.kind is p.VAR_KEYWORD for p in inspect.signature(factory).parameters.values())
    return open_ended and made is not None and name in inspect.signature(made).parameters


def returned_class(factory: Any) -> type | None:
    """Return the class that a factory says it returns."""
    try:
        found = inspect.signature(factory, eval_str=True).return_annotation
    except (NameError, TypeError, ValueError):
        return None
    return found if inspect.isclass(found) and found.__module__.partition(".")[0] != "builtins" else None


def create(kind: str, id: str, /, **options: Any) -> Any:
    """Return a part made with these options.

    Raises
    ------
    InputError
        If an option is unknown or missing, or has a value that cannot be meant; the message lists those that there are.
    PluginError
        If the plug-in raises anything else.
    """
    factory: Callable[..., Any] = load(kind, id)
    known = named_options(kind, id)
    open_ended = any(p.kind is p.VAR_KEYWORD for p in inspect.signature(factory).parameters.values())
    unknown = sorted(set(options) - set(known)) if not open_ended else []
    missing = sorted(name for name, p in known.items() if p.default is p.empty and name not in options)
    if unknown or missing:
        remedy = instead(unknown, known) if unknown else f"give {', '.join(missing)}"
        raise InputError(
            f"options of {singular(kind)} {id!r}",
            expected=f"options among ({', '.join(known)})" + (f" with {', '.join(missing)} given" if missing else ""),
            got=", ".join(f"{k}={v!r}" for k, v in options.items()) or "none",
            remedy=remedy,
        )
    options = meant_options(f"{singular(kind)} {id!r}", factory, options)
    try:
        return factory(**options)
    except HarnessError:
        raise
    except Exception as error:
        if options and isinstance(error, TypeError | ValueError | AttributeError | LookupError):
            raise InputError(
                f"options of {singular(kind)} {id!r}",
                expected="values that it can work with",
                got=", ".join(f"{k}={v!r}" for k, v in options.items()),
                remedy="correct them (SYSID_HARNESS_DEBUG=1 shows what it stumbles over)",
            ) from error
        raise PluginError(
            f"{singular(kind)} {id!r} raised {type(error).__name__}: {error}; "
            f"remedy: check its options or report it to {entry(kind, id).distribution}"
        ) from error
