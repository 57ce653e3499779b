"""One run at a time on a folder of results: a second one would overwrite what the first one writes."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from harness.errors import InputError


@contextmanager
def alone_in(folder: Path | None) -> Iterator[None]:
    """Hold a folder for this run; the system lets go of it when the process ends, however that happens.

    Raises InputError if another run holds it, or it cannot be made.

    - ``folder``: made if it is not there; None where nothing is written

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as name, alone_in(Path(name)):
    ...     try:
    ...         with alone_in(Path(name)):
    ...             pass
    ...     except InputError as error:
    ...         print(error.what)
    another run writes into the folder
    """
    if folder is None:
        yield
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            "folder for the results", expected="a folder that can be made", got=str(error), remedy="choose another"
        ) from error
    if os.name != "posix":  # a system without such locks
        yield
        return
    import fcntl

    held = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(
                "another run writes into the folder",
                expected="one run at a time",
                got="a second",
                remedy="wait for its end or stop it, or choose another --out",
                file=folder,
            ) from None
        except OSError:
            pass  # a network file system that locks no folders
        yield
    finally:
        with suppress(OSError):  # foreign code may have closed it
            os.close(held)
