"""What a file may name: registered parts, and data of its own folder. Code is run only where a person names it.

One rule for every format (suites, couplings, data sets, stored models): code comes from the command line, from what is
installed, or from a file that the person trusts (``--trust FILE``). What reads such a file asks :func:`registered_only`
before anything is made of what it names.
"""

from __future__ import annotations

import importlib.util
import re
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from harness.errors import InputError

_TRUSTED: ContextVar[frozenset[Path]] = ContextVar("trusted", default=frozenset())
NATIVE = (".fmu", ".ssp", ".so", ".dll", ".dylib", ".pyd")
"""Endings of files that hold machine code."""
LIBRARIES = (b"\x7fELF", b"MZ", b"\xcf\xfa\xed\xfe", b"\xca\xfe\xba\xbe")
"""How libraries of Linux, Windows and macOS begin, whatever they are called."""
DESCRIPTIONS = ("modelDescription.xml", "SystemStructure.ssd")
"""What makes an archive or a folder an FMU or a package of FMUs, whatever it is called."""
UNZIPPING = (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, ValueError, OSError)
"""What reading an archive raises; RuntimeError if an entry is encrypted, or packed by a method that zipfile lacks."""
ADDRESS = re.compile(r"([A-Za-z_]\w*)[\w.]*:[A-Za-z_]\S*")
"""``module:attribute``, as Python's entry points and Gymnasium's environments are addressed."""
LONGEST = 4096  # characters of a path


@contextmanager
def trusting(*files: str | Path) -> Iterator[None]:
    """Let files run that another file names, or all that a file names, for as long as the context lasts.

    Parameters
    ----------
    *files : path
        A Python file (``mine.py`` or ``mine.py:swing``), an FMU; or a suite, coupling, data set or stored model, which
        may then name any code; or a folder, for all that it holds.

    Raises
    ------
    InputError
        If one of them does not exist.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     mine = Path(folder) / "mine.py"
    ...     _ = mine.write_text("")
    ...     with trusting(mine):
    ...         print(registered_only({"model": "mine.py:swing"}, file=Path(folder) / "model.json"))
    None
    """
    found = set()
    for name in files:
        path = Path(_file_of(str(name)))
        if not path.exists():
            raise InputError(
                "no such file to trust",
                expected="a file",
                got=repr(str(name)),
                remedy="check the path",
                place="--trust",
            )
        found.add(path.resolve())
    token = _TRUSTED.set(_TRUSTED.get() | found)
    try:
        yield
    finally:
        _TRUSTED.reset(token)


def trusted() -> tuple[str, ...]:
    """Return the files that are trusted now, for a worker that reads files elsewhere."""
    return tuple(sorted(map(str, _TRUSTED.get())))


def runs_python(name: str) -> bool:
    """Return True for a model whose definition is a Python file: reading it runs that file.

    Examples
    --------
    >>> runs_python("mine.py:arm"), runs_python("mine.py"), runs_python("pendulum")
    (True, True, False)
    """
    return ".py:" in name or name.endswith(".py")


def registered_only(content: Any, *, file: str | Path, place: str = "", options: bool = False) -> None:
    """Refuse what a file says if it names code that nobody trusts.

    Parameters
    ----------
    content : object
        What was read: texts, lists and tables of any depth. Free text (a description) is to be left out.
    file : path
        Where it was read.
    place : str
        Its place there.
    options : bool
        True for options of parts, whose texts may be opened, written or imported as well: no path then leaves the
        folder of the file (or the working folder), and no text is ``module:attribute``.

    Raises
    ------
    InputError
        With the text, and ``--trust`` as the remedy.

    Examples
    --------
    >>> registered_only({"plant": "pendulum-ode"}, file="suite.toml")
    >>> try:
    ...     registered_only(["evil.py:arm"], file="model.json", place="model")
    ... except InputError as error:
    ...     print(error)
    model.json: model[0]: a file that runs code: expected registered parts and data only, or --trust evil.py, got
    'evil.py:arm'; remedy: if you trust that code, give --trust evil.py (in Python harness.trusting("evil.py"))
    """
    folder, allowed = Path(file).absolute().parent, _TRUSTED.get()
    if _allowed(Path(file).resolve(), allowed):
        return
    for where, text in _texts(content, place):
        named = _file_of(text)
        places = {path for base in (folder, Path.cwd()) if (path := _resolved(base / named)) is not None}
        outside = options and _leaves(named, folder)  # is not even looked into
        code = runs_python(text) or named.endswith(NATIVE) or (not outside and any(map(_is_code, places)))
        if code or outside:
            there = {path for path in places if path.exists()}
            if there and all(_allowed(path, allowed) for path in there):
                continue
            raise InputError(
                "a file that runs code" if code else "a file that reaches out of its folder",
                expected=f"registered parts and data {'only' if code else 'of its own folder'}, or --trust {named}",
                got=repr(text),
                remedy=f"if you trust that {'code' if code else 'file'}, give --trust {named} "
                f'(in Python harness.trusting("{named}"))',
                file=file,
                place=where or None,
            )
        if options and (address := ADDRESS.fullmatch(text)) and _importable(address[1], folder):
            raise InputError(
                "a file that imports code",
                expected="the id of a registered part, or --trust for the whole file",
                got=repr(text),
                remedy=f"if you trust all that it names, give --trust {file}",
                file=file,
                place=where or None,
            )


def _texts(content: Any, place: str) -> Iterator[tuple[str, str]]:
    """Yield every text with its place, the names of tables' keys among them."""
    if isinstance(content, str):
        yield place, content
    elif isinstance(content, Mapping):
        for key, value in content.items():
            inside = f"{place}.{key}".strip(".")
            yield inside, str(key)
            yield from _texts(value, inside)
    elif isinstance(content, list | tuple):
        for number, value in enumerate(content):
            if not isinstance(value, int | float):
                yield from _texts(value, f"{place}[{number}]")


def _file_of(text: str) -> str:
    """Return the file of ``FILE.py:NAME``, and any other text as it is."""
    return text.rpartition(":")[0] if ".py:" in text else text


def _allowed(path: Path, allowed: frozenset[Path]) -> bool:
    """Return True if a file is trusted, or a folder that holds it."""
    return not allowed.isdisjoint((path, *path.parents))


def _resolved(path: Path) -> Path | None:
    """Return a path without links; None if no file can be called so."""
    try:
        return path.resolve() if len(str(path)) < LONGEST else None
    except (OSError, ValueError, RuntimeError):  # too long a name, a NUL, links in a circle
        return None


def _leaves(text: str, folder: Path) -> bool:
    """Return True if a text, read as a path, leads out of the folder of its file and out of the working folder."""
    if len(text) >= LONGEST or "\0" in text or not Path(text).name:
        return False
    for base in (folder, Path.cwd()):
        found = _resolved(base / text)
        if found is not None and not found.is_relative_to(base.resolve()):
            return True
    return False


def _is_code(path: Path) -> bool:
    """Return True for a library, an FMU or a package of FMUs, packed or not, by what it is and not by its name."""
    try:
        if path.is_dir():
            return any((path / name).is_file() for name in DESCRIPTIONS)
        if not path.is_file():
            return False
        with path.open("rb") as stream:
            head = stream.read(4)
        if head.startswith(LIBRARIES):
            return True
        if not zipfile.is_zipfile(path):
            return False
        with zipfile.ZipFile(path) as archive:
            return any(name in DESCRIPTIONS for name in archive.namelist())
    except UNZIPPING:
        return False  # unreadable, so it loads no library; whoever reads the file says what is wrong with it


def names_fmu(name: str | Path) -> bool:
    """Return True if a name is that of an FMU file; FMI 2.0.4, section 2.3: a zip file with the extension ``fmu``.

    Examples
    --------
    >>> names_fmu("tank.fmu"), names_fmu("TANK.FMU"), names_fmu("tank")
    (True, True, False)
    """
    return Path(name).suffix.lower() == ".fmu"


def _importable(module: str, folder: Path) -> bool:
    """Return True if there is a module of this name, installed or beside the file; it is not imported."""
    beside = [base / name for base in (folder, Path.cwd()) for name in (module, f"{module}.py")]
    try:
        return any(path.exists() for path in beside) or importlib.util.find_spec(module) is not None
    except (ImportError, ValueError, OSError):
        return False
