"""What is registered, and what each part is: its text, its options, its law, read from the docstrings."""

from __future__ import annotations

import importlib.util
import inspect
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from harness import registry
from harness.errors import InputError, did_you_mean, refuse_no_file

LISTED = ("plants", "identifiers", "scenarios", "effects", "models", "analyses", "suites", "recordings")
"""Kinds of parts that a person chooses among."""
DESCRIBED = ("plants", "identifiers", "scenarios", "effects", "models", "analyses")
"""Kinds of parts that have a description of their own."""
TOLD = ("", "Notes", "References")
"""Sections of a docstring that say what a part is; the empty name stands for what comes before the first heading."""
OF_CLASS = re.compile(r"; options as of \w+\.")  # How a factory says that its class tells the rest.


def list_parts(kind: str | None = None) -> dict[str, list[dict[str, str]]]:
    """Return the registered parts by kind: id, one line about it, the distribution that brought it, what it ``needs``.

    That is the package without which it does not run where this Python has none, and empty elsewhere.

    Parameters
    ----------
    kind : str, optional
        One of plants, identifiers, scenarios, effects, models, analyses, suites, recordings; all of them if not given.

    Raises
    ------
    InputError
        If the kind is unknown.

    Examples
    --------
    >>> "dmdc" in [row["id"] for row in list_parts("identifiers")["identifiers"]]
    True
    """
    if kind is not None and kind not in LISTED:
        expected = f"one of {', '.join(LISTED)}, the id of one of them, or a file"
        refuse_no_file(kind, expected)
        raise InputError(
            "nothing to list",
            expected=expected,
            got=repr(kind),
            remedy="put a dataset.toml, a log or a report into it, or name a file"
            if Path(kind).is_dir()
            else did_you_mean(
                kind, (*LISTED, *(one.id for place in DESCRIBED for one in registry.entries(place))), "correct the word"
            ),
        )
    return {
        name: [
            {
                "id": entry.id,
                "summary": OF_CLASS.sub(".", _plain(entry.summary)),
                "distribution": entry.distribution,
                "needs": next((name for name in entry.needs if importlib.util.find_spec(name) is None), ""),
            }
            for entry in registry.entries(name)
        ]
        for name in ((kind,) if kind is not None else LISTED)
    }


def describe_part(id: str, kind: str | None = None) -> dict[str, Any] | None:
    """Return the description and the options of a registered part; None if there is none of this id.

    Parameters
    ----------
    id : str
    kind : str, optional
        Where to look; without it the first kind that has this id.

    Returns
    -------
    dict or None
        ``kind``, ``id``, ``distribution``, ``text`` (its docstring), ``facts`` (of an effect: where it acts, its law,
        what it is easily confused with, what tells it apart) and ``options``: rows with name, default, meaning.

    Examples
    --------
    >>> [row["name"] for row in describe_part("hold")["options"]], describe_part("prbs")["kind"]
    ([], 'scenarios')
    >>> describe_part("coulomb_friction")["facts"]["law"]
    'F = -Fc sgn(v), sgn(v) = tanh(v/w)'
    """
    for place in DESCRIBED if kind is None else (kind,):
        for entry in registry.entries(place):
            if entry.id == id:
                made = registry.load(place, id)
                head = {"kind": place, "id": id, "distribution": entry.distribution}
                return head | (_effect(made, entry.summary) if place == "effects" else _factory(place, id, made))
    return None


def _effect(effect: Any, summary: str) -> dict[str, Any]:
    """Return what an effect is."""
    facts = {
        "acts on": ", ".join(effect.kinds),
        "law": effect.formula,
        "easily confused with": ", ".join(effect.family),
        "what tells it apart": effect.experiment,
    }
    rows = [
        {"name": one.name, "default": "fitted", "meaning": f"{one.meaning} [{one.unit}]"} for one in effect.parameters
    ]
    return {"text": _plain(summary), "facts": {name: text for name, text in facts.items() if text}, "options": rows}


def _factory(kind: str, id: str, made: Any) -> dict[str, Any]:
    """Return what a part is that is made with options; what its own text leaves out, that of its class says."""
    text = inspect.getdoc(made) or ""
    made_class = made if inspect.isclass(made) else registry.returned_class(made)
    classes = [] if made_class is None else [one for one in made_class.__mro__ if one.__doc__ and one is not object]
    kept = getattr(made_class, "Options", None)  # a class may keep its options in one object
    others = (getattr(made, "__options_of__", None), *classes, kept)
    texts = [text, *(inspect.cleandoc(one.__doc__ or "") for one in others if one is not None)]
    said = _told(text)
    if classes and OF_CLASS.search(said):  # what the class does is what the part does
        said = OF_CLASS.sub(".", said) + "\n\n" + _told(inspect.cleandoc(classes[0].__doc__ or ""))
    rows = [
        {
            "name": one.name,
            "default": "needed" if one.default is one.empty else _default(one.default),
            "meaning": next((meaning for one_text in texts if (meaning := _meaning(one_text, one.name))), ""),
        }
        for one in registry.named_options(kind, id).values()
    ]
    return {"text": said, "facts": {}, "options": rows}


def _sections(text: str) -> Mapping[str, str]:
    """Return a NumPy docstring's sections by heading."""
    pieces = re.split(r"^(\w[\w ]*)\n-{3,}\n", text, flags=re.MULTILINE)
    return {
        "": pieces[0].strip(),
        **{name: body.strip() for name, body in zip(pieces[1::2], pieces[2::2], strict=True)},
    }


def _told(text: str) -> str:
    """Return what a docstring says a part is, without its markup."""
    found = _sections(text)
    return _plain("\n\n".join(found[name] for name in TOLD if found.get(name)))


def _default(value: Any) -> str:
    """Return a default as one writes it."""
    return "(its own)" if "factory" in repr(value) else repr(value)


def _meaning(text: str, name: str) -> str:
    """Return what a docstring says of a parameter."""
    body = _sections(text).get("Parameters", "")
    found = re.search(rf"^(?:\w+, )*{re.escape(name)}(?:, \w+)* : [^\n]*\n((?:[ ]+[^\n]*\n?)+)", body, re.MULTILINE)
    return _plain(" ".join(found[1].split())) if found else ""


def _plain(text: str) -> str:
    """Return a docstring without its markup."""
    text = re.sub(r":\w+:`~?(?:[\w.]*\.)?(\w+)`", r"\1", text)
    return re.sub(r"``(.+?)``", r"\1", text)
