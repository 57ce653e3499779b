"""Write a grey-box or linear model as co-simulation FMUs, FMI 2.0 and FMI 3.0, each with its C source."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from harness.errors import UNREADABLE, InputError, no_file
from harness.export.c_model import description, model_source
from harness.export.linear import Linear, linear_description, linear_source
from harness.export.packed import packed
from harness.parts.stored import MODEL, read_model
from harness.trust import names_fmu, registered_only

if TYPE_CHECKING:
    from harness.physics.compiled.simulator import Simulator


def export(source: str | Path, *, out: str | Path, fmi: Literal["2", "3", "both"] = "both") -> list[Path]:
    """Write a model as co-simulation FMUs; an identified arm as its URDF or MJCF.

    Parameters
    ----------
    source : path or str
        A folder that ``sysid close-loop`` wrote, the ``model.json`` of ``sysid identify`` or of such a folder, or the
        name of a built-in model (``sysid list models``; its nominal parameters, sample time 0.01 s); or a coupling of
        FMUs in TOML.
    out : path
        ``model.fmu``. With ``fmi="both"`` this is FMI 2.0 and ``model-fmi3.fmu`` beside it is FMI 3.0. For a loop
        closed around an FMU ``model.ssp``: a package of that FMU and of one with the effects; also for a coupling.
        For an arm ``arm.urdf`` or ``arm.xml``, as the file that it was read from.
    fmi : {"2", "3", "both"}
        Version.

    Raises
    ------
    InputError
        If the source is missing or is neither a grey-box nor a linear model, or there is no C compiler.
    """
    target = Path(out)
    if Path(source).suffix.lower() == ".toml":
        return [_coupling(Path(source), target)]
    other = _other_kind(source, target, fmi)
    if other is not None:
        return [other]
    if not names_fmu(target):
        raise InputError("output", expected="a name that ends in .fmu", got=str(out), remedy="rename it")
    write = _load(source)
    names = {"2": [(2, target)], "3": [(3, target)]}
    both = [(2, target), (3, target.with_name(f"{target.stem}-fmi3.fmu"))]
    return [write(path, version=version) for version, path in names.get(fmi, both)]


def _coupling(path: Path, target: Path) -> Path:
    """Write a coupling as an SSP package."""
    from harness.export.coupling import write_coupling

    if target.suffix != ".ssp":
        remedy = f"--out {target.stem}.ssp"
        raise InputError("output", expected="a name that ends in .ssp for a coupling", got=target.name, remedy=remedy)
    return write_coupling(path, target)


def _other_kind(source: str | Path, target: Path, fmi: str) -> Path | None:
    """Write a repaired FMU as a package, an arm as its own kind of file; None for any other kind of model."""
    path = Path(source)
    path = path / MODEL if path.is_dir() else path
    if not path.is_file():
        return None
    try:
        content: Any = json.loads(path.read_text(encoding="utf-8"))
    except UNREADABLE:
        return None
    if not isinstance(content, dict) or content.get("kind") not in ("fmu", "arm"):
        return None
    registered_only(content, file=path)
    if content["kind"] == "arm":
        from harness.export.robot import write_robot

        return write_robot(content, target)
    if target.suffix != ".ssp":
        raise InputError(
            "output",
            expected="a name that ends in .ssp: a repaired FMU is a co-simulation of it and of its effects",
            got=target.name,
            remedy=f"--out {target.stem}.ssp",
        )
    from harness.export.package import write_package

    return write_package(content, path.parent, target, version=3 if fmi == "3" else 2)


def write_fmu(
    simulator: Simulator,
    parameters: Mapping[str, float],
    target: str | Path,
    *,
    version: Literal[2, 3] | int = 2,
    x0: Mapping[str, float] | None = None,
) -> Path:
    """Write one FMU that repeats a simulator's roll-outs at its sample time, its input held over each step.

    Parameters
    ----------
    simulator : Simulator
        Of the system, at the sample time and with the substeps wanted. Where its input moves on a line from one sample
        to the next (``foh``), that of the FMU is held all the same, as FMI has it: small steps come near.
    parameters : mapping
        Values by name, in SI units; they become tunable parameters.
    target : path
        The ``.fmu`` to write.
    version : {2, 3}
        FMI version.
    x0 : mapping, optional
        Start values of the states; they are the start values of the local variables ``state.NAME``.

    Raises
    ------
    InputError
        If there is no C compiler, a name is unknown, or the simulator needs the rows around each sample (``smooth``).
    """
    if simulator.intersample == "smooth":
        raise InputError(
            "export to an FMU",
            expected="a model whose input is held or moves on a line from sample to sample (intersample 'zoh', 'foh')",
            got=repr(simulator.intersample),
            remedy="fit the model with intersample 'zoh': FMI co-simulation holds its inputs over a step",
        )
    if simulator.intersample == "foh":
        system: Any = simulator.system
        simulator = system.simulator(simulator.dt, substeps=simulator.substeps)
    return packed(model_source(simulator, x0 or ()), description(simulator, parameters, x0), Path(target), version)


def write_linear_fmu(
    model: Linear, target: str | Path, *, version: Literal[2, 3] | int = 2, x0: Mapping[str, float] | None = None
) -> Path:
    """Write one FMU of a linear model in discrete time; see :func:`write_fmu`.

    Parameters
    ----------
    model : LinearModel
        Its matrices are constants of the FMU.
    x0 : mapping, optional
        Start values of the states ``x1``, ``x2``, ...; in the FMU they are called ``state.x1``, ...
    target, version
        As of :func:`write_fmu`.

    Raises
    ------
    InputError
        If there is no C compiler, or a state is unknown.
    """
    return packed(linear_source(model), linear_description(model, x0), Path(target), version)


def _load(source: str | Path) -> Callable[..., Path]:
    """Return what writes a stored or built-in model."""
    from harness import registry

    path = Path(source)
    if path.is_dir():
        path = path / MODEL
    if path.is_file():
        return _stored(path)
    if path.suffix or "/" in str(source) or path.parent != Path():
        raise InputError(
            "nothing to export",
            expected="a folder of sysid close-loop, a model.json, or the name of a model",
            got=f"a folder without {MODEL}" if Path(source).is_dir() else no_file(source),
            remedy="run sysid close-loop or sysid identify first",
            file=source,
        )
    registry.entry("models", str(source))
    from harness.physics.models import load_model

    system = load_model(str(source))
    return functools.partial(write_fmu, system.simulator(0.01), system.values())


def _stored(path: Path) -> Callable[..., Path]:
    """Return what writes the model of a file."""
    model: Any = read_model(path, kinds=("grey-box", "linear"), use="exported to an FMU")
    if hasattr(model, "simulator"):
        return functools.partial(write_fmu, model.simulator, dict(model.parameters))
    return functools.partial(write_linear_fmu, model)
