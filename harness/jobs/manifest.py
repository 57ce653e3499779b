"""What a folder of rows says of itself: which format it has, and which version wrote it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from harness.errors import InputError
from harness.jobs.stored import reading


def read_manifest(path: Path, form: str, kind: type[msgspec.Struct], *, what: str, command: str) -> dict[str, Any]:
    """Return the content of a manifest of one format; fields that an earlier version did not write are not there.

    Raises InputError if there is none, it is damaged, or it is of another format: then its name, and the version that
    wrote it, are said.

    - ``path``: a JSON file with the key ``format``
    - ``form``: the format that this version reads
    - ``kind``: what the content is, key by key; keys with a default may be missing
    - ``what``: what the folder holds, for a message (``"benchmark"``)
    - ``command``: what writes such a folder
    """
    wanted = f"a folder with a {path.name} of format {form}"
    try:
        content = msgspec.json.decode(path.read_bytes())
    except OSError:
        raise InputError(
            f"no {what} here",
            expected=wanted,
            got="none in it" if path.parent.is_dir() else "a file" if path.parent.is_file() else "no such folder",
            remedy=f"give the folder that {command} wrote",
            file=path.parent,
        ) from None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(
            f"no {what} here",
            expected=wanted,
            got=f"{path.name} that is no JSON ({error})",
            remedy="take a copy of the folder that is whole",
            file=path.parent,
        ) from error
    found = content.get("format") if isinstance(content, dict) else None
    if found != form:
        writer = _writer(content) if found else None
        named = f"format {found}, written by sysid-harness {writer or 'of an unknown version'}"
        raise InputError(
            f"a {what} of another format",
            expected=wanted,
            got=named if found else "no format",
            remedy="read it with the version that wrote it, or run it anew into a new folder",
            file=path.parent,
        )
    with reading(path):
        whole: dict[str, Any] = msgspec.to_builtins(msgspec.convert(content, kind))
    return whole


def _writer(content: dict[str, Any]) -> Any:
    """Return the version that wrote a manifest, as far as it says so."""
    others = content.get("versions")
    return content.get("version") or (others.get("sysid-harness") if isinstance(others, dict) else None)
