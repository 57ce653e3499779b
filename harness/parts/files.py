"""Plants by id or by file: a registered plant, an FMU, a coupling written in TOML, an SSP package."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from harness import registry
from harness.errors import InputError
from harness.protocols import Plant
from harness.supervision.processes import APART
from harness.trust import names_fmu, trusted, trusting

PLANT_FILES = (".fmu", ".toml", ".ssp", ".ssd")  # Endings of files that are plants.
OSP = "OspSystemStructure"
FOLDER = ("SystemStructure.ssd", f"{OSP}.xml")  # What makes a folder a system.


def is_plant_file(id: str) -> bool:
    """Return True if what names a plant is a file, or a folder that holds a system.

    Examples
    --------
    >>> is_plant_file("TANK.FMU"), is_plant_file("crane/OspSystemStructure.xml"), is_plant_file("pendulum-fmu")
    (True, True, False)
    """
    return Path(id).suffix.lower() in PLANT_FILES or is_system(id)


def is_system(id: str) -> bool:
    """Return True for a system of another tool: ``.ssp``, ``.ssd``, an OSP structure, or a folder that holds one.

    Examples
    --------
    >>> is_system("loop.ssp"), is_system("loop.toml")
    (True, False)
    """
    path = Path(id)
    if path.suffix.lower() in (".ssp", ".ssd"):
        return True
    if path.suffix == ".xml":
        return path.name.startswith(OSP)
    return path.is_dir() and any((path / name).is_file() for name in FOLDER)


def make_plant(id: str, options: dict[str, Any]) -> Plant:
    """Return a plant.

    Raises InputError if there is no such plant or file, or an option does not fit it.

    - ``id``: id of a registered plant, or a file: ``.fmu``, ``.toml`` (see :func:`harness.cosim.couple`), or a system
      (see :func:`is_system`)
    - ``options``: its options. An FMU file runs in a process of its own, where a crash cannot end this one, unless
      ``isolated`` is false; ``timeout`` is then the longest time [s] for one call. The FMUs of a coupling or package
      share one such process with what steps them.

    Examples
    --------
    >>> with make_plant("pendulum-ode", {"sample_time": 0.02}) as plant:
    ...     print(plant.spec)
    u [N m] -> theta [rad] every 0.02 s
    """
    if not is_plant_file(id):
        return cast(Plant, registry.create("plants", id, **options))
    if names_fmu(id) and not Path(id).is_file():
        raise InputError("no such FMU", expected="an FMU file", got="no file", remedy="check the path", file=id)
    inside = {key: value for key, value in options.items() if key not in ("isolated", "timeout")}
    limit = {"timeout": options["timeout"]} if "timeout" in options else {}
    apart = options.get("isolated", APART)
    if names_fmu(id):
        if apart:
            return cast(Plant, registry.create("plants", "isolated", plant="fmu", path=id, **limit, **inside))
        return cast(Plant, registry.create("plants", "fmu", path=id, **limit, **inside))
    if "within" in inside:  # a process of its own has a folder of its own
        inside["within"] = str(Path(inside["within"]).absolute())
    if apart and _holds_fmus(id):
        given = {"path": id, "changes": inside, "trust": trusted()}
        return cast(Plant, registry.load("tools", "isolate")("harness.parts.files:make_coupled", given, **limit))
    return make_coupled(id, inside)


def make_coupled(path: str, changes: dict[str, Any], trust: Sequence[str] = ()) -> Plant:
    """Return the plant of a coupling or a package, in this process; ``trust`` as :func:`harness.trust.trusting`."""
    from harness import cosim

    with trusting(*trust):
        if path.lower().endswith(".toml"):
            return cosim.couple(path, make_part, changes=changes)
        return cosim.couple_ssp(path, make_part, describe_fmu, changes=changes)


def describe_fmu(path: str | Path) -> dict[str, Any]:
    """Return the variables, units and abilities of an FMU.

    Raises
    ------
    InputError
        If the file is missing or no FMU.
    """
    content: dict[str, Any] = registry.load("plants", "fmu").describe(path)
    return content


def describe_system(path: str | Path) -> dict[str, Any]:
    """Return what is in a system of FMUs: components, connections, values, experiment (``sysid list FILE.ssp``).

    Raises
    ------
    InputError
        If it cannot be read, or needs what is not understood.
    """
    from harness.cosim.structure import describe_structure

    return describe_structure(path, describe_fmu)


def make_hiding(plant: str, options: dict[str, Any], hide: Sequence[tuple[str, str, Mapping[str, float]]]) -> Plant:
    """Return a plant by id or file, with effects hidden inside where it takes them, else around it."""
    wrong = [one for one in hide if isinstance(one, str) or len(one) != 3]
    if wrong:
        raise InputError(
            "what is hidden",
            expected='effects as (name, port, {parameter: value}), such as ("coulomb_friction", "theta", {"Fc": 0.05})',
            got=repr(wrong[0]),
            remedy="name the three (on the command line it is one text: --hide)",
            place="hide",
        )
    effects = [(name, port, dict(parameters)) for name, port, parameters in hide]
    if effects and not is_plant_file(plant) and registry.takes_option("plants", plant, "effects"):
        return cast(Plant, registry.create("plants", plant, effects=effects, **options))
    made = make_plant(plant, options)
    if effects:
        from harness.effects import WrappedPlant

        found = [(registry.load("effects", name), port, parameters) for name, port, parameters in effects]
        return cast(Plant, WrappedPlant(made, found))
    return made


def _holds_fmus(path: str) -> bool:
    """Return True for a system of another tool, and for a coupling that names files of FMUs."""
    if not path.lower().endswith(".toml"):
        return True
    from harness.cosim.description import read_coupling

    return any(part.fmu is not None or part.plant == "fmu" for part in read_coupling(path).parts.values())


def make_part(id: str, options: dict[str, Any]) -> Plant:
    """Return a part of a coupling: a registered plant, or one of our own FMUs (``mockup``) by its name."""
    if id == "mockup":
        path = registry.load("plants", "fmu").mockup(options.pop("name"))
        return cast(Plant, registry.create("plants", "fmu", path=path, **options))
    return cast(Plant, registry.create("plants", id, **options))


def stream_key(id: str) -> str:
    """Return the key of a plant's random streams: its id, or the content of its file however the path is spelt.

    Examples
    --------
    >>> stream_key("pendulum-ode")
    'pendulum-ode'
    """
    return fingerprint(id) if is_plant_file(id) else id


def fingerprint(path: str | Path) -> str:
    """Return a hash of a plant's file and of the FMUs that a coupling names: the plant is another if it changes.

    Raises InputError if the file cannot be read.
    """
    files = [Path(path)]
    if is_system(str(path)) and files[0].suffix.lower() != ".ssp":
        from harness.cosim.structure import opened

        with opened(path) as found:
            files = [*found.sources(), *found.files()]
    elif files[0].suffix.lower() == ".toml":
        from harness.cosim.description import read_coupling

        parts = read_coupling(files[0]).parts.values()
        files += [files[0].parent / part.fmu for part in parts if part.fmu is not None]
    digest = hashlib.sha256()
    for file in files:
        try:
            digest.update(hashlib.sha256(file.read_bytes()).digest())
        except OSError as error:
            raise InputError(
                "no such plant", expected="a file", got=error.strerror or "none", remedy="check the path", file=file
            ) from error
    return digest.hexdigest()
