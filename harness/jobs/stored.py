"""Files of results read back: one that was cut, changed or written by something else is said in one line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from harness.errors import HarnessError, InputError

WHOLE = "take a copy that is whole, or run it anew into a new folder"


class Within:
    """A file or folder of a store, by its name in the store's ``folder``."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __get__(self, store: Any, owner: object = None) -> Path:
        return Path(store.folder, self.name)


def damaged(path: Path, got: object, remedy: str = WHOLE) -> InputError:
    """Return the refusal of a file of results that is not what was written."""
    return InputError(
        "a damaged file of results", expected="what this version writes", got=" ".join(str(got).split())[:200],
        remedy=remedy, file=path,
    )  # fmt: skip


@contextmanager
def reading(path: Path, remedy: str = WHOLE) -> Iterator[None]:
    """Say of a file that it is damaged, whatever its reader stumbles over; nothing but reading is done in the body.

    Raises InputError with the file.

    Examples
    --------
    >>> with reading(Path("rows.json")):
    ...     [][0]
    Traceback (most recent call last):
    ...
    harness.errors.InputError: rows.json: a damaged file of results: expected what this version writes, got IndexError:
    list index out of range; remedy: take a copy that is whole, or run it anew into a new folder
    """
    try:
        yield
    except HarnessError:
        raise
    except Exception as error:
        raise damaged(path, f"{type(error).__name__}: {error}", remedy) from error


def read_columns(path: Path) -> Any:
    """Return a Parquet file of results as an Arrow table; bytes that were changed are noticed.

    Raises InputError if it is damaged or no Parquet file.
    """
    from pyarrow import parquet

    with reading(path):
        table = parquet.read_table(path, page_checksum_verification=True)
        table.validate(full=True)
        return table
