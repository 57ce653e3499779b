"""Identity by content: the key of everything that is kept and read back, whatever it is called and where it lies."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

PACKAGES = ("harness", "plants", "identifiers", "scenarios")
SOURCES = (".py", ".toml", ".c", ".h")
"""What decides an answer among the files of a package; pages and pictures do not."""


def fingerprint(*parts: Any) -> str:
    """Return a hash of the content of some things (32 hexadecimal digits).

    Parameters
    ----------
    *parts
        None, numbers, text, bytes, arrays; paths, whose files are read; mappings and dataclasses of such, in any order
        of their keys; sequences of such; and what has a ``fingerprint`` of its own, a compiled model say.

    Raises
    ------
    OSError
        If a file cannot be read.
    TypeError
        For anything else: a key that leaves out a part would answer for another thing.

    Examples
    --------
    >>> fingerprint({"a": 1.0, "b": (2, "x")}) == fingerprint({"b": [2, "x"], "a": 1.0})
    True
    >>> fingerprint(1.0) == fingerprint(np.nextafter(1.0, 2.0))
    False
    """
    digest = hashlib.sha256()
    for piece in _pieces(parts):
        digest.update(str(len(piece)).encode() + b":" + piece)
    return digest.hexdigest()[:32]


@cache
def own_code(root: Path | None = None) -> str:
    """Return a hash of what this project consists of: the part of a key that its version stands for once released.

    A checkout changes without another version, and a row that other code made is another row.

    Parameters
    ----------
    root : Path, optional
        The folder of the four packages, where this file lies if not given.

    Examples
    --------
    >>> own_code() == own_code()
    True
    """
    base = Path(__file__).resolve().parent.parent if root is None else root
    return fingerprint([sources(base / name) for name in PACKAGES])


def sources(folder: Path) -> dict[str, Path]:
    """Return the files of a package that decide what it answers, by their paths in it."""
    found = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if path.suffix in SOURCES}
    return {name: found[name] for name in sorted(found)}


def _pieces(part: Any) -> Iterable[bytes]:
    """Yield the content of a part, piece by piece, each with its kind."""
    if part is None or isinstance(part, bool | int | str):
        yield f"{type(part).__name__} {part}".encode()
    elif isinstance(part, float | np.floating):
        yield f"float {float(part).hex()}".encode()
    elif isinstance(part, bytes):
        yield b"bytes " + part
    elif isinstance(part, np.ndarray):
        yield f"array {part.dtype.str} {part.shape} ".encode() + np.ascontiguousarray(part).tobytes()
    elif isinstance(part, Path):
        yield b"file " + hashlib.sha256(part.read_bytes()).digest()
    elif isinstance(own := getattr(part, "fingerprint", None), str):
        yield f"own {own}".encode()
    elif dataclasses.is_dataclass(part) and not isinstance(part, type):
        yield f"dataclass {type(part).__qualname__}".encode()
        yield from _pieces({field.name: getattr(part, field.name) for field in dataclasses.fields(part)})
    elif isinstance(part, Mapping):
        yield f"mapping {len(part)}".encode()
        for key in sorted(part, key=str):
            yield from _pieces((str(key), part[key]))
    elif isinstance(part, set | frozenset):
        yield from _pieces(sorted(part, key=str))
    elif isinstance(part, tuple | list):
        yield f"sequence {len(part)}".encode()
        for item in part:
            yield from _pieces(item)
    else:
        raise TypeError(f"no fingerprint of a {type(part).__name__}")


def files_named(value: Any, folder: Path | None = None) -> list[Path]:
    """Return the files that options, or the content of a TOML, name: what they hold decides as much as what they are.

    Parameters
    ----------
    value : object
        Text, and mappings and sequences of such; text may be ``FILE.py:NAME``.
    folder : Path, optional
        Where relative paths start, the current one if not given.

    Examples
    --------
    >>> files_named({"model": "no-such-file.py:arm", "order": 3})
    []
    """
    if isinstance(value, Mapping):
        return [path for key in sorted(value, key=str) for path in files_named(value[key], folder)]
    if isinstance(value, list | tuple):
        return [path for item in value for path in files_named(item, folder)]
    if not isinstance(value, str | Path):
        return []
    text = str(value)
    name = text.rpartition(":")[0] if ".py:" in text else text
    path = (folder or Path()) / name
    try:
        return [path] if name and path.is_file() else []
    except (OSError, ValueError):  # a text that no file could be called by
        return []
