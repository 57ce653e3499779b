"""Plants by id or by file: a registered plant, an FMU, a coupling written in TOML, an SSP package."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

from harness import registry
from harness.errors import InputError
from harness.protocols import Plant
from harness.trust import trusted, trusting

__all__ = ["PLANT_FILES", "fingerprint", "is_plant_file", "make_coupled", "make_part", "make_plant"]

PLANT_FILES = (".fmu", ".toml", ".ssp")
"""Endings of files that are plants."""


def is_plant_file(id: str) -> bool:
    """Return True if what names a plant is a file.

    Examples
    --------
    >>> is_plant_file("loop.toml"), is_plant_file("pendulum-fmu")
    (True, False)
    """
    return id.endswith(PLANT_FILES)


def make_plant(id: str, options: dict[str, Any]) -> Plant:
    """Return a plant.

    Parameters
    ----------
    id : str
        Id of a registered plant, or a file: ``.fmu``, ``.toml`` (see :func:`harness.cosim.couple`) or ``.ssp``.
    options : dict
        Its options. An FMU file runs in a process of its own, where a crash cannot end this one, unless
        ``isolated`` is false; ``timeout`` is then the longest time [s] for one call. The FMUs of a coupling or package
        share one such process with what steps them.

    Raises
    ------
    InputError
        If there is no such plant or file, or an option does not fit it.

    Examples
    --------
    >>> with make_plant("pendulum-ode", {"sample_time": 0.02}) as plant:
    ...     print(plant.spec)
    u [N m] -> theta [rad] every 0.02 s
    """
    if not is_plant_file(id):
        return cast(Plant, registry.create("plants", id, **options))
    if id.endswith(".fmu") and not Path(id).is_file():
        raise InputError("no such FMU", expected="an FMU file", got="no file", remedy="check the path", file=id)
    inside = {key: value for key, value in options.items() if key not in ("isolated", "timeout")}
    limit = {"timeout": options["timeout"]} if "timeout" in options else {}
    apart = options.get("isolated", os.name == "posix")
    if id.endswith(".fmu"):
        if apart:
            return cast(Plant, registry.create("plants", "isolated", plant="fmu", path=id, **limit, **inside))
        return cast(Plant, registry.create("plants", "fmu", path=id, **limit, **inside))
    if apart and _holds_fmus(id):
        given = {"path": id, "changes": inside, "trust": trusted()}
        return cast(Plant, registry.load("tools", "isolate")("harness.plant_files:make_coupled", given, **limit))
    return make_coupled(id, inside)


def make_coupled(path: str, changes: dict[str, Any], trust: Sequence[str] = ()) -> Plant:
    """Return the plant of a coupling or a package, in this process; ``trust`` as :func:`harness.trust.trusting`."""
    from harness import cosim

    with trusting(*trust):
        return (cosim.couple if path.endswith(".toml") else cosim.couple_ssp)(path, make_part, changes=changes)


def _holds_fmus(path: str) -> bool:
    """Return True for a package, and for a coupling that names files of FMUs."""
    if not path.endswith(".toml"):
        return True
    from harness.cosim.description import read_coupling

    return any(part.fmu is not None or part.plant == "fmu" for part in read_coupling(path).parts.values())


def make_part(id: str, options: dict[str, Any]) -> Plant:
    """Return a part of a coupling: a registered plant, or one of our own FMUs (``mockup``) by its name."""
    if id == "mockup":
        path = registry.load("plants", "fmu").mockup(options.pop("name"))
        return cast(Plant, registry.create("plants", "fmu", path=path, **options))
    return cast(Plant, registry.create("plants", id, **options))


def fingerprint(path: str | Path) -> str:
    """Return a hash of a plant's file and of the FMUs that a coupling names: the plant is another if it changes.

    Raises
    ------
    InputError
        If the file cannot be read.
    """
    files = [Path(path)]
    if files[0].suffix == ".toml":
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
