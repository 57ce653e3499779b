"""The files of a system: entries of an SSP archive, or files of a folder, read and never left."""

from __future__ import annotations

import os
import posixpath
import shlex
import shutil
import tempfile
import zipfile
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, unquote, urlparse

from harness.errors import InputError
from harness.fmi.archive import check_entries, has_document_type
from harness.trust import UNZIPPING

LARGEST_TEXT = 64 << 20  # bytes of an XML file
DESCRIPTIONS = (".ssd", ".ssv", ".ssm", ".ssb")


PROXIES = ("proxyfmu", "fmu-proxy", "proxy-fmu")  # Schemes by which OSP names FMUs that another process runs.
HERE = ("localhost", "127.0.0.1", "::1")  # How such a URI calls this machine.
PROXIED = "FMUs that the file runs by a proxy on this machine are run without it"  # What is said of them.


def on_this_machine(source: str) -> str:
    """Return the file that a URI of OSP's proxies means where its host is this machine; any other URI as it is.

    Examples
    --------
    >>> on_this_machine("proxyfmu://localhost?file=../tank.fmu"), on_this_machine("proxyfmu://10.0.0.2:9?file=a.fmu")
    ('../tank.fmu', 'proxyfmu://10.0.0.2:9?file=a.fmu')
    """
    uri = urlparse(source)
    files = parse_qs(uri.query).get("file", [])
    return files[0] if uri.scheme in PROXIES and uri.hostname in HERE and len(files) == 1 else source


class Readable(ABC):
    """What holds files that can be read by their names."""

    path: Path

    @abstractmethod
    def read(self, name: str, largest: int = LARGEST_TEXT) -> bytes:
        """Return the content of a file."""


class Package(Readable):
    """Files by their names relative to the top of a system; ``close`` removes what was unpacked."""

    read_files: frozenset[Path] = frozenset()  # Files of the file system that were read.

    @abstractmethod
    def has(self, name: str) -> bool:
        """Return True if there is such a file."""

    @abstractmethod
    def file(self, name: str) -> Path:
        """Return a file as one of the file system."""

    def close(self) -> None:
        """Remove what was unpacked."""

    def named(self, source: str, beside: str, what: str) -> str:
        """Return the name of the file that a URI in the file ``beside`` means.

        Raises InputError if it is not inside, or not there.
        """
        uri = urlparse(source)
        if uri.scheme or uri.netloc or not uri.path:
            raise self._missing(source, what)
        for text in (uri.path, unquote(uri.path)):
            name = posixpath.normpath(posixpath.join(posixpath.dirname(beside), text))
            if not name.startswith("/") and self.has(name):
                return name
        raise self._missing(source, what)

    def _missing(self, source: str, what: str) -> InputError:
        return InputError(
            f"source of {what}",
            expected="a file inside the package, such as an FMU in resources/",
            got=repr(source),
            remedy="put it into the package and export it again",
            file=self.path,
        )


class ZipPackage(Package):
    """An ``.ssp`` archive; files are unpacked one by one, when they are asked for."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with zipfile.ZipFile(path) as archive:
                check_entries(path, archive)
                self._entries = {posixpath.normpath(entry.filename): entry for entry in archive.infolist()}
                for entry in archive.infolist():
                    if entry.filename.endswith(DESCRIPTIONS):
                        _refuse_large(path, entry.filename, entry.file_size, LARGEST_TEXT)
                        _refuse_doctype(path, entry.filename, archive.read(entry))
        except UNZIPPING as error:
            raise InputError(
                "not an SSP package",
                expected="a zip archive with SystemStructure.ssd",
                got=str(error) or type(error).__name__,
                remedy="export or download it again",
                file=path,
            ) from error
        self._folder: Path | None = None

    def has(self, name: str) -> bool:
        """Return True if there is such an entry."""
        return name in self._entries and not self._entries[name].is_dir()

    def read(self, name: str, largest: int = LARGEST_TEXT) -> bytes:
        """Return the content of an entry."""
        entry = self._entries[name]
        _refuse_large(self.path, name, entry.file_size, largest)
        try:
            with zipfile.ZipFile(self.path) as archive:
                return archive.read(entry)
        except UNZIPPING as error:
            raise self._damaged(name, error) from error

    def file(self, name: str) -> Path:
        """Unpack an entry, once."""
        if self._folder is None:
            self._folder = Path(tempfile.mkdtemp(prefix="sysid-ssp-"))
        target = self._folder / name
        if not target.exists():
            try:
                with zipfile.ZipFile(self.path) as archive:
                    archive.extract(self._entries[name], self._folder)
            except UNZIPPING as error:
                raise self._damaged(name, error) from error
        return target

    def close(self) -> None:
        """Remove what was unpacked."""
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None

    def _damaged(self, name: str, error: Exception) -> InputError:
        return InputError(
            f"entry {name!r} of the package",
            expected="a sound zip archive",
            got=f"{type(error).__name__}: {error}",
            remedy="copy or export the package again",
            file=self.path,
        )


class FolderPackage(Package):
    """An unpacked system; ``within`` is the folder that its files may lie in, by default its own."""

    def __init__(self, path: Path, folder: Path, within: Path | None = None) -> None:
        self.path = path
        self._folder = folder.resolve()
        self._within = self._folder if within is None else within.resolve()

    def has(self, name: str) -> bool:
        """Return True if there is such a file inside."""
        place = (self._folder / name).resolve()
        return place.is_relative_to(self._within) and place.is_file()

    def read(self, name: str, largest: int = LARGEST_TEXT) -> bytes:
        """Return the content of a file."""
        place = self.file(name)
        self.read_files |= {place}
        _refuse_large(self.path, name, place.stat().st_size, largest)
        return place.read_bytes()

    def file(self, name: str) -> Path:
        """Return the file itself."""
        return (self._folder / name).resolve()

    def _missing(self, source: str, what: str) -> InputError:
        plain = urlparse(source)
        place = (self._folder / unquote(plain.path)).resolve()
        outside = not plain.scheme and place.is_file()
        return InputError(
            f"source of {what}",
            expected=f"a file inside {self._within}",
            got=repr(source),
            remedy="if you trust it, say which folder its files may lie in: --option within="
            + shlex.quote(os.path.commonpath([self._within, place.parent]))
            if outside
            else "put it there, or correct the source",
            file=self.path,
        )


class InFmu(Readable):
    """The files of an FMU, for what lies in it: a URI counts from the top of the archive."""

    def __init__(self, fmu: Path, path: Path) -> None:
        self.path, self._fmu = path, fmu

    def read(self, name: str, largest: int = LARGEST_TEXT) -> bytes:
        """Return the content of the entry that a URI means."""
        uri = urlparse(name)
        texts = [] if uri.scheme or uri.netloc else [uri.path, unquote(uri.path)]
        try:
            with zipfile.ZipFile(self._fmu) as archive:
                entries = {entry.filename: entry for entry in archive.infolist() if not entry.is_dir()}
                found = next((entries[place] for text in texts if (place := posixpath.normpath(text)) in entries), None)
                if found is None:
                    raise KeyError(name)
                if found.file_size > largest:
                    raise ValueError(f"{found.file_size >> 20} MiB")
                return archive.read(found)
        except (KeyError, *UNZIPPING) as error:
            raise InputError(
                "a file inside an FMU",
                expected=f"a file of at most {largest >> 20} MiB inside {self._fmu.name}",
                got=repr(name) if isinstance(error, KeyError) else f"{name!r} ({error})",
                remedy="correct the source",
                file=self.path,
            ) from error


def _refuse_large(path: Path, name: str, size: int, largest: int) -> None:
    if size > largest:
        raise InputError(
            name, expected=f"at most {largest >> 20} MiB", got=f"{size >> 20} MiB", remedy="shrink it", file=path
        )


def _refuse_doctype(path: Path, name: str, text: bytes) -> None:
    """Refuse XML that could define entities."""
    if has_document_type(text):
        raise InputError(name, expected="no document type", got="a DOCTYPE", remedy="do not trust it", file=path)


def parsed(package: Readable, name: str) -> Any:
    """Return the root element of an XML file of a package.

    Raises InputError if it is too large, declares a document type (which can define entities), or is no XML.
    """
    from lxml import etree

    text = package.read(name)
    _refuse_doctype(package.path, name, text)
    parser = etree.XMLParser(resolve_entities=False, no_network=True, remove_comments=True, remove_pis=True)
    try:
        return etree.fromstring(text, parser)
    except etree.XMLSyntaxError as error:
        raise InputError(
            name,
            expected="well-formed XML",
            got=" ".join(str(error).split())[:300],
            remedy="export it again",
            file=package.path,
        ) from error
