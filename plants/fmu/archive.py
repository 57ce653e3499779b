"""FMU files: unpacked only where that is safe, described by fmpy, refused in one line where they cannot be used."""

from __future__ import annotations

import functools
import json
import re
import shutil
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

from harness.errors import InputError
from harness.fmi.archive import STARTS, check_entries, has_document_type, plain_name
from harness.trust import UNZIPPING
from plants.temporary import release, temporary_folder

MAX_ENTRIES = 20_000
MAX_TOTAL = 2 << 30  # bytes, unpacked
MAX_RATIO = 200  # unpacked to packed, for large entries
MAX_DESCRIPTION = 256 << 20

Kind = Literal["cs", "me"]


@dataclass(frozen=True, eq=False)
class FmuFile:
    """An FMU that was read and found safe to unpack."""

    path: Path  # The file
    description: Any  # As fmpy reads it
    version: int  # Major version of FMI
    problems: tuple[str, ...]  # Where the description breaks the standard without being unusable
    renamed: tuple[str, ...] = ()  # Which variables were given names of their own

    @functools.cached_property
    def variables(self) -> dict[str, Any]:
        """The variables of the description by name."""
        return {variable.name: variable for variable in self.description.modelVariables}

    @functools.cached_property
    def changed_starts(self) -> dict[str, float]:
        """Start values, in the FMU's own units, that its description has and its binary may not know."""
        with zipfile.ZipFile(self.path) as archive:
            if STARTS not in archive.namelist():
                return {}
            text = archive.read(STARTS)
        try:
            names = [name for name in json.loads(text)["names"] if name in self.variables]
            return {name: float(self.variables[name].start) for name in names}
        except (ValueError, KeyError, TypeError) as error:
            remedy = "calibrate it again"
            raise _refuse(self.path, STARTS, "names of real start values", str(error), remedy, STARTS) from error

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """What the FMU offers among co-simulation and model exchange, in order of preference."""
        d = self.description
        return (*(("cs",) if d.coSimulation is not None else ()), *(("me",) if d.modelExchange is not None else ()))

    def interface(self, kind: Kind) -> Any:
        """Return fmpy's record of abilities of one kind."""
        return self.description.coSimulation if kind == "cs" else self.description.modelExchange

    def offers_slopes(self, kind: Kind) -> bool:
        """Return True if the FMU offers directional derivatives."""
        if self.version == 1:
            return False
        if self.version == 2:
            return bool(self.interface(kind).providesDirectionalDerivative)
        # FMI 3.0 writes the attribute in the plural, which fmpy does not read
        with zipfile.ZipFile(self.path) as archive:
            root = ElementTree.fromstring(archive.read("modelDescription.xml"))
        element = root.find("CoSimulation" if kind == "cs" else "ModelExchange")
        return element is not None and element.get("providesDirectionalDerivatives") in ("true", "1")

    @property
    def platforms(self) -> tuple[str, ...]:
        """Systems that the FMU brings a binary for, by the names of their folders; ``c-code`` for sources."""
        with zipfile.ZipFile(self.path) as archive:
            parts = [plain_name(entry).split("/") for entry in archive.infolist() if not entry.is_dir()]
        found = {part[1] for part in parts if part[0] == "binaries" and len(part) > 2 and part[2]}
        sources = any(part[0] == "sources" and part[-1].endswith((".c", ".cpp", ".cc")) for part in parts)
        return (*sorted(found), *(("c-code",) if sources else ()))

    def unpack(self) -> Path:
        """Extract what running needs into a new temporary folder, which the caller removes.

        Raises InputError if there is no binary for this system, or an entry is damaged.
        """
        import fmpy

        # some tools name the folder of an FMI 2.0 binary as FMI 3.0 does; it also tells processors apart
        asked = [fmpy.platform_tuple, *([fmpy.platform] if self.version < 3 else [])]
        with zipfile.ZipFile(self.path) as archive:
            names = [plain_name(entry) for entry in archive.infolist() if not entry.is_dir()]
        folders = [f"binaries/{place}/" for place in asked]
        library = next((one for one in folders if any(name.startswith(one) for name in names)), None)
        if library is None:
            raise InputError(
                "the FMU has no binary for this system",
                expected=" or ".join(folders),
                got=", ".join(self.platforms) or "no binaries",
                remedy=f"fmpy compile {self.path} (needs cmake and a C compiler)"
                if "c-code" in self.platforms
                else "export it for this system",
                file=self.path,
            )
        folder = temporary_folder("sysid-fmu-")
        wanted = (library, "resources/", "modelDescription.xml")
        try:
            with zipfile.ZipFile(self.path) as archive:
                for entry in archive.infolist():
                    name = plain_name(entry)
                    if name.startswith(wanted) and not name.endswith("/"):
                        # where fmpy looks for it
                        place = (
                            f"binaries/{asked[-1]}/{name.removeprefix(library)}" if name.startswith(library) else name
                        )
                        target = folder / place
                        target.parent.mkdir(parents=True, exist_ok=True)
                        with archive.open(entry) as packed, target.open("wb") as file:
                            shutil.copyfileobj(packed, file)
        except Exception as error:
            release(folder)
            raise InputError(
                "the FMU cannot be unpacked",
                expected="a sound zip archive",
                got=f"{type(error).__name__}: {error}",
                remedy="copy or export it again",
                file=self.path,
            ) from error
        except BaseException:
            release(folder)
            raise
        return folder


def read_fmu(path: str | Path) -> FmuFile:
    """Read and check an FMU without unpacking or loading anything.

    Its ``problems`` tell where the description breaks the standard.

    Raises InputError if it is not a zip archive, an entry is unsafe (path escape, link, duplicate, bomb), the
    description is missing or unreadable, the FMI version is unknown, or it offers neither co-simulation nor model
    exchange.

    Examples
    --------
    >>> from plants.mockups import mockup
    >>> read_fmu(mockup("pendulum")).kinds
    ('cs',)
    """
    path = Path(path)
    if not path.is_file():
        raise InputError("no such FMU", expected="a file", got=repr(str(path)), remedy="correct the path")
    try:
        with zipfile.ZipFile(path) as archive:
            _check_entries(path, archive)
    except UNZIPPING as error:
        raise InputError(
            "not an FMU",
            expected="a zip archive with modelDescription.xml",
            got=str(error) or type(error).__name__,
            remedy="export or download it again",
            file=path,
        ) from error
    description, problems = _describe(path)
    renamed = _named_apart(description)
    problems += _without_number(description)
    version = int(str(description.fmiVersion).split(".")[0])
    file = FmuFile(path, description, version, tuple(problems), tuple(renamed))
    _check_description(file)
    return file


def _refuse(path: Path, what: str, expected: str, got: str, remedy: str, place: str | None = None) -> InputError:
    return InputError(what, expected=expected, got=got, remedy=remedy, file=path, place=place)


def _check_entries(path: Path, archive: zipfile.ZipFile) -> None:
    """Refuse entries that must not be unpacked, and say which."""
    entries = check_entries(path, archive, entries=MAX_ENTRIES, total=MAX_TOTAL, ratio=MAX_RATIO, windows=True)
    described = [entry for entry in entries if entry.filename == "modelDescription.xml"]
    if not described:
        raise _refuse(path, "not an FMU", "modelDescription.xml at the top of the archive", "none", "export it again")
    if described[0].file_size > MAX_DESCRIPTION:
        size = f"{described[0].file_size >> 20} MiB"
        raise _refuse(path, "modelDescription.xml", f"at most {MAX_DESCRIPTION >> 20} MiB", size, "shrink it")
    if has_document_type(archive.read(described[0])):
        raise _refuse(path, "modelDescription.xml", "no document type", "a DOCTYPE", "do not trust it")


def _describe(path: Path) -> tuple[Any, list[str]]:
    """Return fmpy's description; what breaks the standard but can be read is returned as problems."""
    import fmpy
    from fmpy.model_description import ValidationError

    problems: list[str] = []
    for validate in (True, False):
        try:
            with path.open("rb") as archive:  # given the path, fmpy leaves the file open when it fails
                return fmpy.read_model_description(archive, validate=validate), problems
        except ValidationError as error:
            problems = [str(problem) for problem in error.problems]
        except Exception as error:
            if not validate:
                raise _unreadable(path, error) from error
            problems = [f"the check of the description broke off: {type(error).__name__}: {error!s:.80}"]
    raise _unreadable(path, ValueError("; ".join(problems)))


def _unreadable(path: Path, error: Exception) -> InputError:
    """Return the one line for a description that fmpy cannot read."""
    got = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
    return _refuse(path, "modelDescription.xml", "a valid description, FMI 1.0 to 3.0", got, "export it again")


def _check_description(file: FmuFile) -> None:
    """Refuse what would be run wrongly."""
    d = file.description
    if file.version not in (1, 2, 3):
        raise _refuse(file.path, "FMI version", "1.0, 2.0 or 3.0", repr(d.fmiVersion), "export it as FMI 2.0 or 3.0")
    if not file.kinds:
        got = "scheduled execution only" if d.scheduledExecution is not None else "neither"
        raise _refuse(
            file.path, "nothing to run", "co-simulation or model exchange", got, "export it for co-simulation"
        )
    for kind in file.kinds:
        identifier = str(file.interface(kind).modelIdentifier)
        # it becomes part of a path; some tools write signs that no C identifier has, and name the library so
        if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,200}", identifier):
            expected = "letters, digits, '_', '-' and '.', as in the library's name"
            raise _refuse(
                file.path, "modelIdentifier", expected, repr(identifier), "do not trust it", "modelIdentifier"
            )
    beyond = next((v for v in d.modelVariables if not 0 <= int(v.valueReference or 0) < 2**32), None)
    if beyond is not None:  # the call would be of another variable
        got = f"{beyond.valueReference} of {beyond.name!r}"
        raise _refuse(file.path, "valueReference", "a number of 32 bits", got, "export it again", "modelVariables")


def _without_number(description: Any) -> list[str]:
    """Leave aside what the description writes where a number belongs, and say so; none of it is needed for a run."""
    places = [(description.defaultExperiment, "DefaultExperiment", name)
              for name in ("startTime", "stopTime", "stepSize", "tolerance")]  # fmt: skip
    places.append((description.coSimulation, "CoSimulation", "fixedInternalStepSize"))
    problems = []
    for element, where, name in places:
        text = getattr(element, name, None)
        try:
            if text is not None:
                float(text)
        except ValueError:
            setattr(element, name, None)
            problems.append(f"{name} of {where} is no number and is left aside: {text!r:.40}")
    return problems


def _named_apart(description: Any) -> list[str]:
    """Give variables that share a name names of their own, after their value references; returns what was done."""
    taken: set[str] = set()
    renamed = []
    for variable in description.modelVariables:
        if variable.name in taken:
            variable.name, old = f"{variable.name}#{variable.valueReference}", variable.name
            while variable.name in taken:
                variable.name += "'"
            renamed.append(f"{old!r}: the second is {variable.name!r}")
        taken.add(variable.name)
    return [f"two variables share the name {', '.join(renamed[:5])}"] if renamed else []
