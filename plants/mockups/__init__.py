"""Our own FMUs, in C by hand: found in the wheel, else built once with a C compiler and kept in a cache."""

from __future__ import annotations

import hashlib
import platform
from pathlib import Path

from harness.errors import InputError
from harness.fmi import build
from harness.fmi.compiled import build_once

__all__ = ["FOLDER", "mockup", "models"]

FOLDER = Path(__file__).resolve().parent


def models() -> tuple[str, ...]:
    """Return the names of the mockups: the folders with a modelDescription.xml."""
    return tuple(sorted(path.parent.name for path in FOLDER.glob("*/modelDescription.xml")))


def mockup(model: str, version: int = 2) -> Path:
    """Return the path of one of our own FMUs.

    Parameters
    ----------
    model : str
        Name of a folder here: ``"pendulum"``, ``"cart_pole"``, ...
    version : {2, 3}
        FMI version.

    Returns
    -------
    Path
        The FMU that the wheel carries; in a source checkout one that is built at the first call (about 0.2 s) and
        kept under ``$SYSID_HARNESS_CACHE`` or the user's cache folder.

    Raises
    ------
    InputError
        If there is no such model, or it must be built and there is no C compiler.

    Examples
    --------
    >>> mockup("pendulum").name
    'pendulum-fmi2.fmu'
    """
    if model not in models() or version not in (2, 3):
        raise InputError(
            "unknown mockup",
            expected=f"one of {', '.join(models())}, FMI version 2 or 3",
            got=f"{model!r}, version {version!r}",
            remedy="correct the name",
        )
    name = f"{model}-fmi{version}.fmu"
    carried = FOLDER / "built" / name
    if carried.is_file():
        return carried
    digest = hashlib.sha256()
    for file in sorted([*build.FOLDER.glob("fmi*.[ch]"), Path(build.__file__), *(FOLDER / model).iterdir()]):
        if file.is_file():
            digest.update(file.name.encode() + b"\0" + file.read_bytes())
    digest.update(repr((version, platform.machine(), platform.system(), build.FLAGS)).encode())

    def make(target: Path) -> None:
        build.build_fmu(FOLDER / model, version, target)

    try:
        return build_once(digest.hexdigest()[:24], name, make)
    except build.BuildError as error:
        raise InputError(
            f"the FMU of {model!r} cannot be built",
            expected="a C compiler, or a wheel that carries the FMU",
            got=str(error),
            remedy="install gcc",
        ) from error
