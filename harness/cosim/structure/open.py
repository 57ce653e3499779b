"""Which files and folders are systems, and how each is opened."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from harness.cosim.structure.model import Component, SystemDescription, SystemElement
from harness.cosim.structure.osp import OSP, read_osp
from harness.cosim.structure.package import FolderPackage, Package, ZipPackage
from harness.cosim.structure.ssd import SSD, SsdReader
from harness.errors import InputError


class Opened:
    """A system that was read; :meth:`close` removes what was unpacked for it."""

    def __init__(self, description: SystemDescription, packages: list[Package]) -> None:
        self.description = description
        self._packages = packages

    def close(self) -> None:
        """Remove what was unpacked."""
        for package in self._packages:
            package.close()

    @property
    def experiment(self) -> dict[str, float | None]:
        """The system's own experiment [s], by the names that FMI gives to an FMU's."""
        d = self.description
        return {"startTime": d.start, "stopTime": d.stop, "stepSize": d.step}

    def sources(self) -> list[Path]:
        """Return the descriptions and values that were read from a folder."""
        return [file for package in self._packages for file in sorted(package.read_files)]

    def components(self) -> Iterator[tuple[str, Component]]:
        """Yield the components with their hierarchical names."""
        waiting = [("", self.description.system)]
        while waiting:
            before, system = waiting.pop()
            for element in system.elements:
                if isinstance(element, SystemElement):
                    waiting.append((f"{before}{element.name}.", element))
                elif isinstance(element, Component):
                    yield f"{before}{element.name}", element

    def files(self) -> Iterator[Path]:
        """Yield the FMUs."""
        for _, component in self.components():
            if component.fmu is not None:
                yield component.fmu


def open_structure(path: str | Path, *, within: str | Path | None = None) -> Opened:
    """Read a system; the caller closes what comes back.

    Raises InputError if the file is missing, unsafe to unpack, breaks its standard, or uses what is not understood.

    - ``path``: an ``.ssp`` package, an ``.ssd`` file, an OSP structure, or a folder that holds one of them
    - ``within``: folder that the files of an unpacked system may lie in; by default the one that holds the description
    """
    path = Path(path)
    name = path.name
    if path.is_dir():
        name = SSD if (path / SSD).is_file() else f"{OSP}.xml"
    if not path.exists():
        raise InputError("no such package", expected="an .ssp file", got="no file", remedy="check the path", file=path)
    reach = None if within is None else Path(within)
    packages: list[Package] = []
    try:
        if path.suffix.lower() == ".ssp" and path.is_file():
            package: Package = ZipPackage(path)
            packages.append(package)
            if not package.has(SSD):
                raise InputError("not an SSP package", expected=SSD, got="none", remedy="export it again", file=path)
            return Opened(SsdReader(package, SSD, opened=packages).read(), packages)
        folder = FolderPackage(path, path if path.is_dir() else path.parent, reach)
        packages.append(folder)
        if name.lower().endswith(".xml"):
            return Opened(read_osp(folder, name), packages)
        return Opened(SsdReader(folder, name, opened=packages).read(), packages)
    except BaseException:
        for package in packages:
            package.close()
        raise


@contextmanager
def opened(path: str | Path, *, within: str | Path | None = None) -> Iterator[Opened]:
    """Open a system for as long as a block lasts."""
    found = open_structure(path, within=within)
    try:
        yield found
    finally:
        found.close()
