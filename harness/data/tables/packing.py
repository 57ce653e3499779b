"""How much a packed file may unpack to: a small file that fills the memory is no table."""

from __future__ import annotations

import zipfile
from pathlib import Path

from harness.errors import InputError
from harness.trust import UNZIPPING

LARGEST = 2 << 30
"""Bytes that any packed table may unpack to: a table of 1e8 numbers."""
NUMBER = 8
"""Bytes of a number in memory."""
RATIO, FREE = 200, 16 << 20
"""Times its packed size that a table may unpack to, beside what is small in any case [bytes]: logs pack 3 to 20 times,
deflate at most 1030 times."""


def most_unpacked(packed: int) -> int:
    """Return the bytes that so many packed bytes may unpack to.

    Examples
    --------
    >>> most_unpacked(1_500_000) >> 20, most_unpacked(1 << 30) >> 30
    (302, 2)
    """
    return min(LARGEST, RATIO * packed + FREE)


def refuse_large(path: Path, size: int) -> None:
    """Refuse a table that says itself that it needs more memory than any packed table may.

    Parameters
    ----------
    path : Path
    size : int
        Bytes; equal values pack without any limit, so there is no ratio to hold it against.

    Raises
    ------
    InputError
        With the size.
    """
    if size > LARGEST:
        raise InputError(
            "a packed table",
            expected=f"at most {LARGEST >> 20} MiB unpacked",
            got=f"{size >> 20} MiB",
            remedy="cut or thin it",
            file=path,
        )


def refuse_bomb(path: Path) -> None:
    """Refuse a zip archive (an Excel workbook) that unpacks to more; what is no archive passes, its reader says so.

    Raises
    ------
    InputError
        With the size.
    """
    if not zipfile.is_zipfile(path):
        return
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
    except UNZIPPING:
        return
    most = most_unpacked(path.stat().st_size)
    if size > most:
        raise InputError(
            "a packed table",
            expected=f"at most {most >> 20} MiB unpacked",
            got=f"{size >> 20} MiB",
            remedy="save it as CSV, or cut or thin it",
            file=path,
        )
