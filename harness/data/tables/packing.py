"""Packed files: how much one may unpack to (a small file that fills the memory is no table), and the log in one."""

from __future__ import annotations

import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from harness.errors import InputError
from harness.trust import UNZIPPING

LARGEST = 2 << 30  # Bytes that any packed table may unpack to: a table of 1e8 numbers.
NUMBER = 8  # Bytes of a number in memory.
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

    Raises InputError with the size.

    - ``size``: bytes; equal values pack without any limit, so there is no ratio to hold it against
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

    Raises InputError with the size.
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


@contextmanager
def unzipped(path: Path, is_log: Callable[[Path], bool]) -> Iterator[Path]:
    """Unpack the one log of a zip archive into a folder that goes when it has been read.

    Raises InputError if it is no archive, unpacks to too much, or holds no log or several.

    - ``is_log``: whether a file is one, by its name
    """
    refuse_bomb(path)
    with tempfile.TemporaryDirectory(prefix="sysid-") as folder:
        try:
            with zipfile.ZipFile(path) as archive:
                files = [one for one in archive.namelist() if not one.endswith("/") and not one.startswith("__MACOSX/")]
                logs = [one for one in files if is_log(Path(PurePosixPath(one).name))]
                for one in logs[:1]:
                    with archive.open(one) as packed, (Path(folder) / PurePosixPath(one).name).open("wb") as out:
                        shutil.copyfileobj(packed, out)
        except UNZIPPING as error:
            raise InputError(
                "not a zip archive", expected="a log packed by zip", got=str(error)[:120],
                remedy="check that it was copied whole; unpack what has a password", file=path,
            ) from error  # fmt: skip
        if len(logs) != 1:
            raise InputError(
                f"an archive with {len(logs)} logs",
                expected="one",
                got=", ".join(map(repr, (logs or files)[:8])) or "an empty archive",
                remedy="unpack it (unzip), and give the files that are meant (--run names further records)",
                file=path,
            )
        yield Path(folder) / PurePosixPath(logs[0]).name
