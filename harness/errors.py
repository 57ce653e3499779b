"""What can go wrong, in words a user can act on.

Every error of the project derives from :class:`HarnessError`, and each has a ``status``: the word that a
benchmark row carries when the error ends its cell.
"""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from typing import Any
from unicodedata import category

ENDING = re.compile(r"\.[A-Za-z]\w{0,15}")
"""Ending of a file's name; ids of parts have none."""
UNREADABLE = (OSError, ValueError, RecursionError)
"""What a text that is to be JSON or TOML raises: no file, no such text, or brackets deeper than its reader goes."""


def printable(text: str) -> str:
    r"""Return a text of others as it may go to a terminal, a page or an XML file: control characters are spelled out.

    Lines and tabs stay.

    Examples
    --------
    >>> print(printable("speed" + chr(27) + "[2J"))
    speed\x1b[2J
    """
    return text if text.isprintable() else "".join(map(_shown, text))


def _shown(c: str) -> str:
    """Return a character, or how it is spelled out where it cannot be seen."""
    plain = c.isprintable() or c in "\n\t" or category(c) == "Zs"
    return c if plain else c.encode("unicode_escape").decode()


class HarnessError(Exception):
    """Root of the project's errors; the command line prints its text on one line and exits with 2."""

    status = "failed"


class InputError(HarnessError):
    """Input that cannot be used.

    Parameters
    ----------
    what : str
        What is wrong, in a few words.
    expected, got : str
        What was expected and what came.
    remedy : str
        What the user can do about it.
    file, place : str or Path, optional
        Where the input came from, and the place inside it (a key, a column, a row).

    Examples
    --------
    >>> print(InputError("unknown unit", expected="a unit of angle", got="'volt'",
    ...                  remedy="write unit = rad", file="a.toml", place="signals.theta.unit"))
    a.toml: signals.theta.unit: unknown unit: expected a unit of angle, got 'volt'; remedy: write unit = rad
    """

    status = "refused"

    def __init__(
        self,
        what: str,
        *,
        expected: str,
        got: str,
        remedy: str,
        file: str | Path | None = None,
        place: str | None = None,
    ) -> None:
        self.what, self.expected, self.got, self.remedy = what, expected, got, remedy
        self.file, self.place = file, place
        super().__init__(what, expected, got, remedy, file, place)

    def __str__(self) -> str:
        where = "".join(f"{part}: " for part in (self.file, self.place) if part is not None)
        text = f"{where}{self.what}: expected {self.expected}, got {self.got}; remedy: {self.remedy}"
        return " ".join(text.split())

    def __reduce__(self) -> tuple[object, ...]:
        given = {name: getattr(self, name) for name in ("expected", "got", "remedy", "file", "place")}
        return partial(type(self), self.what, **given), ()

    def located(self, *, file: str | Path | None = None, place: str | None = None) -> InputError:
        """Return the same error with the file or place filled in where it was not known."""
        return type(self)(
            self.what,
            expected=self.expected,
            got=self.got,
            remedy=self.remedy,
            file=self.file if self.file is not None else file,
            place=self.place if self.place is not None else place,
        )


def as_written(file: str | Path, wanted: str) -> AbstractContextManager[None]:
    """Refuse, in one line, a file whose content is not what sysid wrote, where reading it meets something else.

    Parameters
    ----------
    file : path
    wanted : str
        What it should be.

    Raises
    ------
    InputError
        In place of what reading content of another shape raises.

    Examples
    --------
    >>> try:
    ...     with as_written("report.json", "report.json of sysid close-loop"):
    ...         {}["verdict"]
    ... except InputError as error:
    ...     print(error.what, error.expected)
    damaged content report.json of sysid close-loop, as it was written
    """
    return _instead(
        lambda error: InputError(
            "damaged content",
            expected=f"{wanted}, as it was written",
            got=f"{type(error).__name__}: {' '.join(str(error).split())[:160]}",
            remedy="restore the file, or have it written anew",
            file=file,
        )
    )


def unknown_name(
    what: str, name: str, known: Iterable[str], *, remedy: str = "correct the name", **where: Any
) -> InputError:
    """Return the refusal of a name that is none of those that are known.

    Parameters
    ----------
    what, name : str
        What is named, and the name.
    known : iterable of str
    remedy : str
        What to do where none of them is near.
    **where
        File and place of :class:`InputError`.

    Examples
    --------
    >>> print(unknown_name("unknown parameter", "mas", ["m", "k"]))
    unknown parameter: expected one of m, k, got 'mas'; remedy: correct the name
    """
    names = list(known)
    expected = f"one of {', '.join(names) or '(none)'}"
    return InputError(what, expected=expected, got=repr(name), remedy=did_you_mean(str(name), names, remedy), **where)


def refuse_unknown(what: str, given: str | Iterable[str], known: Iterable[str], **said: Any) -> None:
    """Refuse a name, or the first of several, that is none of those that are known.

    Parameters
    ----------
    what : str
        What is named.
    given : str or iterable of str
    known : iterable of str
    **said
        Remedy, file and place of :func:`unknown_name`.

    Raises
    ------
    InputError
        With the names that are near.

    Examples
    --------
    >>> refuse_unknown("initial state", {"theta": 0.1}, ["theta", "omega"])
    """
    names = list(known)
    for name in given if isinstance(given, Iterable) and not isinstance(given, str) else [given]:
        if name not in names:
            raise unknown_name(what, name, names, **said)


def as_described(
    what: str, *, remedy: str = "fit it again: other versions wrote other files"
) -> AbstractContextManager[None]:
    """Refuse, in one line, a description that ``to_dict`` did not write, as :func:`as_written` a file.

    Examples
    --------
    >>> with as_described("a model"):
    ...     {}["spec"]
    Traceback (most recent call last):
    harness.errors.InputError: description of a model: expected what to_dict() writes, got KeyError: 'spec'; remedy:
    fit it again: other versions wrote other files
    """
    return _instead(
        lambda error: InputError(
            f"description of {what}",
            expected="what to_dict() writes",
            got=f"{type(error).__name__}: {error}",
            remedy=remedy,
        )
    )


@contextmanager
def _instead(refusal: Callable[[Exception], InputError]) -> Iterator[None]:
    """Raise a refusal in place of what reading content of another shape raises."""
    try:
        yield
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise refusal(error) from error


def no_file(path: str | Path) -> str:
    """Return what stands where a file was expected: nothing, or files with similar names.

    Examples
    --------
    >>> no_file("nowhere/run7.csv"), no_file(".")
    ('no file (nor a folder nowhere)', 'a folder')
    """
    path = Path(path)
    if os.path.isdir(path):
        return "a folder"
    if not os.path.isdir(path.parent):
        return f"no file (nor a folder {path.parent})"
    try:
        near = difflib.get_close_matches(path.name, os.listdir(path.parent), n=2)
    except OSError:  # a folder whose content may not be seen
        near = []
    return f"no file (near it: {', '.join(near)})" if near else "no file"


ALIKE = 0.65
"""Likeness of names from which one is proposed for the other: order and model have 0.6, sesnor and sensor 0.83."""


PART = 2
"""Letters of a word that stands in many names by chance."""


def nearest(name: str, known: Iterable[str], most: int = 3) -> list[str]:
    """Return the known names that a wrong one is near to or a part of, in letters of any size, the nearest first.

    Examples
    --------
    >>> nearest("frction", ["mass", "friction"]), nearest("order", ["model"])
    (['friction'], [])
    >>> nearest("ARX", ["arx", "narx"]), nearest("coulomb", ["coulomb_friction", "cogging"])
    (['arx', 'narx'], ['coulomb_friction'])
    """
    names = {one.lower(): one for one in known}
    word = name.lower()
    near = difflib.get_close_matches(word, names, n=most, cutoff=ALIKE)
    near += [one for one in names if len(word) > PART and word in one and one not in near]
    return [names[one] for one in near[:most]]


def did_you_mean(name: str, known: Iterable[str], otherwise: str, most: int = 3) -> str:
    """Return a remedy: the known names that a wrong one is near to, or what to do where it is near to none.

    Examples
    --------
    >>> did_you_mean("pendulm", ["pendulum", "drive"], "run 'sysid list'")
    'did you mean pendulum?'
    """
    near = nearest(name, known, most)
    return f"did you mean {' or '.join(near)}?" if near else otherwise


def unread(path: str | Path, error: Exception) -> str:
    """Return in words why a file was not read.

    Examples
    --------
    >>> unread("nowhere/rows.csv", FileNotFoundError()), unread("rows.csv", PermissionError(13, "Permission denied"))
    ('no file (nor a folder nowhere)', 'Permission denied')
    """
    if isinstance(error, FileNotFoundError | NotADirectoryError | IsADirectoryError):
        return no_file(path)
    if isinstance(error, UnicodeDecodeError):
        return "bytes that are no text in UTF-8"
    return error.strerror or type(error).__name__ if isinstance(error, OSError) else f"{type(error).__name__}: {error}"


def refuse_no_file(name: str, expected: str) -> None:
    """Refuse what can only be the name of a file, by its folder or its ending, where there is no such file.

    Parameters
    ----------
    name : str
        What a person gave. Nothing happens if it may be the id of a part.
    expected : str
        What may stand there.

    Raises
    ------
    InputError
        If there is no such file.

    Examples
    --------
    >>> refuse_no_file("pendulum", "the id of a plant, or a file")
    >>> refuse_no_file("nowhere/run7.csv", "the id of a plant, or a file")
    Traceback (most recent call last):
    harness.errors.InputError: nowhere/run7.csv: no such file: expected the id of a plant, or a file, got no file (nor a
    folder nowhere); remedy: check the path
    """
    path = Path(name)
    told = any(mark and mark in name for mark in (os.sep, os.altsep)) or ENDING.fullmatch(path.suffix)
    if told and not os.path.exists(path):
        raise InputError("no such file", expected=expected, got=no_file(path), remedy="check the path", file=path)


class FitError(InputError):
    """Data from which this identifier cannot learn a model (too short, not exciting, rank deficient)."""

    status = "unfit"


class NotLinearError(InputError, AttributeError):
    """What only linear models have, asked of another one: for ``hasattr`` and ``getattr`` it is not there."""


class PluginError(HarnessError):
    """A plug-in that cannot be found, does not load, or raises where the contract forbids it."""

    status = "crashed"


class PlantError(HarnessError):
    """A plant that did not survive its run.

    Parameters
    ----------
    reason : str
        One line for the row of the table.
    status : {"diverged", "crashed", "timeout", "terminated"}
        What happened.
    """

    def __init__(self, reason: str, *, status: str = "crashed") -> None:
        super().__init__(reason)
        self.status = status

    def __reduce__(self) -> tuple[object, ...]:
        return partial(type(self), str(self), status=self.status), ()
