"""Zip archives of the FMI and SSP standards: what must not be unpacked is refused, and the entry named."""

from __future__ import annotations

import contextlib
import stat
import zipfile
from pathlib import Path

from harness.errors import InputError

STARTS = "extra/sysid-harness/starts.json"
"""Entry of an FMU that names the start values which its description has and its binary may not (calibrated ones)."""
LARGE = 32 << 20  # bytes; smaller entries may be packed as tightly as they like


def check_entries(
    path: Path,
    archive: zipfile.ZipFile,
    *,
    entries: int = 20_000,
    total: int = 2 << 30,
    ratio: float = 200,
    windows: bool = False,
) -> list[zipfile.ZipInfo]:
    """Return the entries of an archive that is safe to unpack.

    Raises InputError if an entry leaves the folder, is a link or encrypted, shares its name with another, or is a bomb.

    - ``path``: for the message
    - ``archive``: open for reading
    - ``entries, total``: most entries; most bytes unpacked
    - ``ratio``: most bytes unpacked for each byte packed, of large entries
    - ``windows``: let entries separate folders by backslashes, as some tools on Windows write them; the caller unpacks
      them by :func:`plain_name`
    """
    found = archive.infolist()
    if len(found) > entries:
        raise _refuse(path, "too many entries", f"at most {entries}", str(len(found)), "check where it comes from")
    seen: dict[str, tuple[bool, int, int]] = {}
    size = 0
    for entry in found:
        name = plain_name(entry) if windows else entry.orig_filename
        parts = name.rstrip("/").split("/")
        if "\\" in name or ":" in name or name.startswith("/") or ".." in parts or "\0" in name:
            raise _refuse(
                path, "an entry leaves its folder", "a relative path with '/'", repr(name), "do not trust it", name
            )
        if entry.create_system == 3 and not _plain(entry.external_attr >> 16):
            raise _refuse(path, "an entry is a link", "files and folders", repr(name), "do not trust it", name)
        key = "/".join(part for part in parts if part not in ("", ".")).casefold()
        content = (name.endswith("/"), entry.file_size, entry.CRC)
        if key in seen and seen[key] != content:  # the same thing may be listed twice
            raise _refuse(path, "two entries share a name", "unique names", repr(name), "export it again", name)
        seen[key] = content
        if entry.flag_bits & 1:
            raise _refuse(path, "an entry is encrypted", "readable entries", repr(name), "remove the password", name)
        size += entry.file_size
        if entry.file_size > LARGE and entry.file_size > ratio * max(entry.compress_size, 1):
            raise _refuse(
                path,
                "an entry unpacks like a bomb",
                f"at most {ratio} times its packed size",
                f"{entry.file_size / max(entry.compress_size, 1):.0f} times ({entry.file_size >> 20} MiB)",
                "do not trust it",
                name,
            )
        if size > total:
            raise _refuse(
                path, "too large", f"at most {total >> 20} MiB unpacked", f"more, at {name!r}", "shrink it", name
            )
    return found


def plain_name(entry: zipfile.ZipInfo) -> str:
    r"""Return the name of an entry with slashes, whatever wrote it.

    Examples
    --------
    >>> plain_name(zipfile.ZipInfo("binaries\\win64/model.dll"))
    'binaries/win64/model.dll'
    """
    return entry.orig_filename.replace("\\", "/")


def has_document_type(text: bytes) -> bool:
    """Return True if an XML document declares a document type, in whatever encoding: entities hide bombs and files.

    Examples
    --------
    >>> bomb = '<?xml version="1.0" encoding="UTF-16"?><!DOCTYPE a []><a/>'
    >>> has_document_type(bomb.encode("utf-16")), has_document_type(b"<a>DOCTYPE</a>")
    (True, False)
    """
    from xml.parsers import expat

    found: list[str] = []
    parser = expat.ParserCreate()
    parser.StartDoctypeDeclHandler = lambda name, *_: found.append(name)
    parser.StartElementHandler = lambda *_: _leave()
    with contextlib.suppress(_Element):
        try:
            parser.Parse(text, True)
        except expat.ExpatError as error:
            # an encoding that only other parsers know is not looked through: only what is plain ASCII can be
            unknown = error.code == expat.errors.codes[expat.errors.XML_ERROR_UNKNOWN_ENCODING]
            return bool(found) or unknown or b"<!DOCTYPE" in text.replace(b"\0", b"")
        except (ValueError, LookupError):
            return True
    return bool(found)


class _Element(Exception):
    """The first element: no document type can follow."""


def _leave() -> None:
    raise _Element


def _refuse(path: Path, what: str, expected: str, got: str, remedy: str, place: str | None = None) -> InputError:
    return InputError(what, expected=expected, got=got, remedy=remedy, file=path, place=place)


def _plain(mode: int) -> bool:
    """Return True for a regular file or folder, or where the archive does not say."""
    return stat.S_IFMT(mode) in (0, stat.S_IFREG, stat.S_IFDIR)
