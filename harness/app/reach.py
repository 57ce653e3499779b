"""Which files the page may touch: what was opened on the command line, what was uploaded, what its own runs wrote.

The room of data takes a second to import: everything in this package does so where it is used, and the page is there.
"""

from __future__ import annotations

import os
import re
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from harness.errors import InputError

MODELS = (".urdf", ".fmu", ".eqs")
"""Nominal models that are files. An MJCF and a Python file may name any other file and stay with the command line."""
UPLOADED = "uploaded"
MOST, DEEPEST = 400, 4
"""Files that are listed, and how deep in the opened folder."""
LARGEST = 4 << 30
"""Bytes of an upload."""
LONGEST = 200
"""Characters of a file's name."""


@dataclass
class SessionFiles:
    """The files of one session, by the names that the page uses: paths below what was opened, or ``uploaded/N/NAME``.

    Parameters
    ----------
    opened : Path or None
        A file or a folder.
    work : Path
        A folder of the session, for uploads and results.
    stays : bool
        True where this folder is there after the session.
    """

    opened: Path | None
    work: Path
    stays: bool = False
    uploads: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.opened is not None and not self.opened.exists():
            raise InputError(
                "nothing to open",
                expected="a file or a folder",
                got=f"no {str(self.opened)!r}",
                remedy="check the path, or leave it out and drop a log on the page",
            )

    @property
    def folder(self) -> Path | None:
        """What paths are relative to."""
        return None if self.opened is None else self.opened if self.opened.is_dir() else self.opened.parent

    def names(self) -> dict[str, list[str]]:
        """Return the logs, data sets and models in reach."""
        found = [*self._below(), *self.uploads]
        return {
            "logs": [name for name in found if not name.lower().endswith(MODELS)],
            "models": [name for name in found if name.lower().endswith(MODELS)],
        }

    def path(self, name: str) -> Path:
        """Return the path of a file in reach.

        Raises
        ------
        InputError
            If it is not there, or lies outside of what was opened, be it by a link.
        """
        found = self._place(name)
        if found is None:
            raise InputError(
                "a file outside of what was opened",
                expected=f"a file of {self.opened}" if self.opened is not None else "an uploaded file",
                got=repr(name[:LONGEST]),
                remedy="open its folder (sysid open FOLDER), or drop it on the page",
            )
        if not found.exists():
            raise InputError("no such file", expected="a file in reach", got=repr(name), remedy="check the name")
        return found

    def _place(self, name: str) -> Path | None:
        """Return where a name leads, if that is in reach."""
        if "\0" in name or len(name) > 4 * LONGEST:
            return None
        if name in self.uploads:
            return self.work / name
        if self.opened is None or self.folder is None:
            return None
        found = (self.folder / name).resolve()
        if self.opened.is_dir():
            return self.folder / name if found.is_relative_to(self.opened.resolve()) else None
        return self.opened if found == self.opened.resolve() else None

    def plain(self, text: str) -> str:
        """Return a text with uploaded files called by the names that the person knows."""
        return re.sub(re.escape(f"{self.work}{os.sep}{UPLOADED}{os.sep}") + r"\d+[/\\]", "", text)

    def runs_within(self, description: Path) -> None:
        """Refuse a data set of the opened folder whose records lie outside of it.

        Raises
        ------
        InputError
            With the file. A data set that was itself named on the command line may name any file.
        """
        from harness.data.recipe.description import read_description

        if self.opened is None or not self.opened.is_dir():
            return
        for file in (file for run in read_description(description).runs for file in run.files):
            named = (description.parent / file).resolve()
            if not named.is_relative_to(self.opened.resolve()):
                raise InputError(
                    "a record outside of what was opened",
                    expected=f"files of {self.opened}",
                    got=file,
                    remedy=f"open the data set itself: sysid open {description}",
                    file=description,
                )

    async def take(self, name: str, content: AsyncIterator[bytes]) -> str:
        """Write an upload to the session's folder and return its name.

        Raises
        ------
        InputError
            If its name or size cannot be used, or it is no log and no model that may be uploaded.
        """
        from harness.data.tables.table import FORMATS, suffix_of

        if not name or name.startswith(".") or len(name) > LONGEST or name != os.path.basename(name) or "\\" in name:
            raise InputError("name of an upload", expected="a plain file name", got=repr(name), remedy="rename it")
        suffix = suffix_of(Path(name))
        if suffix not in FORMATS and suffix not in MODELS:
            raise InputError(
                "an upload of this kind",
                expected=f"a log ({', '.join(FORMATS)}) or a model ({', '.join(MODELS)})",
                got=repr(suffix or name),
                remedy="convert it, for example to CSV; a dataset.toml or an MJCF: sysid open its folder",
            )
        place = f"{UPLOADED}/{len(self.uploads) + 1}/{name}"
        target = self.work / place
        target.parent.mkdir(parents=True, exist_ok=True)
        size = 0
        with target.open("wb") as stream:
            async for chunk in content:
                size += len(chunk)
                if size > LARGEST:
                    break
                stream.write(chunk)
        if not 0 < size <= LARGEST:
            target.unlink()
            raise InputError(
                "size of an upload",
                expected=f"1 byte to {LARGEST >> 30} GiB",
                got="nothing" if not size else "more",
                remedy="sysid open its folder" if size else "choose a file with something in it",
                file=name,
            )
        self.uploads.append(place)
        return place

    def _below(self) -> Iterator[str]:
        """Yield what can be read below the opened folder, in the order of names; or what was opened itself."""
        from harness.data.tables.bags import is_bag_folder

        if self.opened is None or self.folder is None:
            return
        if is_bag_folder(self.opened) or not self.opened.is_dir():
            yield "." if self.opened.is_dir() else self.opened.name
            return
        count = 0
        for where, folders, files in os.walk(self.opened):
            here = Path(where)
            bags = [one for one in folders if is_bag_folder(here / one)]
            deeper = len(here.relative_to(self.opened).parts) < DEEPEST
            folders[:] = sorted(one for one in folders if deeper and one not in bags and not one.startswith("."))
            for one in sorted([*bags, *filter(_is_offered, files)]):
                yield (here / one).relative_to(self.opened).as_posix()
                count += 1
                if count >= MOST:
                    return


def _is_offered(name: str) -> bool:
    """Return True for a file that is a log, a data set or a model by its name."""
    from harness.data.tables.table import FORMATS, suffix_of

    suffix = suffix_of(Path(name))
    return suffix in FORMATS or suffix in MODELS or name.endswith("dataset.toml")
