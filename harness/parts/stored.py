"""Models that ``sysid`` stored, read back by the identifier that knows their kind."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from harness import registry
from harness.errors import UNREADABLE, InputError, no_file, refuse_unknown, unread
from harness.models.determined import bands_of
from harness.protocols import Model
from harness.trust import registered_only

MODEL = "model.json"  # The model in a folder of ``sysid close-loop``.
REMEDY = "give the file that sysid identify -o wrote"
LARGEST = 1e150  # Size above which the square of a number overflows, and with it whatever is computed from it.


def read_model(path: str | Path, *, kinds: Sequence[str] = (), use: str = "read") -> Model:
    """Return a model that ``sysid identify -o`` or ``close-loop`` stored.

    Raises InputError if the file is missing or is no model, or names code that is not trusted
    (:func:`harness.trust.trusting`).

    - ``path``: the file, or the folder of ``close-loop``
    - ``kinds``: kinds that serve; all that an identifier reads if empty
    - ``use``: what a model of another kind cannot be, for the message
    """
    path = Path(path)
    whole = path.is_dir()
    path = path / MODEL if whole else path
    wanted = f"{MODEL} of sysid identify -o, or a folder of sysid close-loop"
    if not whole and not path.exists():
        raise InputError("no such file", expected=wanted, got=no_file(path), remedy="check the path", file=path)
    try:
        content: Any = json.loads(path.read_text(encoding="utf-8"))
    except UNREADABLE as error:
        from harness.data.tables.table import FORMATS

        raise InputError(
            "not a model",
            expected=wanted,
            got=f"no JSON ({error})" if isinstance(error, json.JSONDecodeError) else unread(path, error),
            remedy="name models first and the data set last" if path.suffix.lower() in FORMATS else REMEDY,
            file=path,
        ) from error
    if not isinstance(content, dict) or "kind" not in content:
        raise InputError("not a model", expected=wanted, got="JSON without a 'kind'", remedy=REMEDY, file=path)
    kind = content["kind"]
    registered_only(content, file=path)
    beside = path.parent / str(content.get("model", ""))
    if beside.suffix == ".eqs" and beside.is_file():  # equations lie where the model does
        content["model"] = str(beside)
    known = kinds or [entry.id for entry in registry.entries("model_readers")]
    refuse_unknown(
        f"a model that cannot be {use}",
        kind,
        known,
        remedy="fit one with another identifier (sysid list identifiers), or close the loop",
        file=path,
    )
    try:
        model: Model = registry.load("model_readers", kind).from_dict(content)
        _refuse_unsound(model)
    except InputError as error:
        raise error.located(file=path) from error
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise InputError(
            "not a model",
            expected=f"the whole description of a {kind} model",
            got=f"{type(error).__name__}: {' '.join(str(error).split())[:200]}",
            remedy="give the file as sysid identify -o wrote it, or fit it again: other versions wrote other files",
            file=path,
        ) from error
    return model


def _refuse_unsound(model: Any) -> None:
    """Raise ValueError for a model with matrices, offsets or bands that are no numbers, or too large to be squared."""
    bands_of(model)
    for name, value in vars(model).items() if hasattr(model, "__dict__") else ():
        if isinstance(value, np.ndarray) and value.dtype.kind == "f":
            wrong = value[~(np.abs(value) <= LARGEST)]
            if wrong.size:
                raise ValueError(f"{name} holds {wrong[0]:g}")
