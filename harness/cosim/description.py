"""A coupling written down in TOML: parts, connections, external inputs, outputs, and how the parts are stepped."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec

from harness.cosim.master import Coupled
from harness.cosim.watched import made
from harness.cosim.wiring import Connection
from harness.errors import HarnessError, InputError, refuse_unknown
from harness.fmi.terminals import Terminal, joined, read_terminals
from harness.protocols import Plant
from harness.toml_file import read_toml
from harness.trust import registered_only


def expanded(
    connections: Sequence[Connection], parts: Mapping[str, Plant], files: Mapping[str, Path]
) -> list[Connection]:
    """Return connections with those of terminals written out, variable by variable.

    Raises InputError if a terminal is connected to what is none, the two do not fit, or two variables are no output and
    input.

    - ``connections``: one whose ends are ``"part.terminal"`` joins two terminals; which end drives which is told by the
      variables
    - ``files``: the FMUs among the parts
    """
    known: dict[str, dict[str, Terminal]] = {}

    def terminal(end: str, side: str) -> Terminal | None:
        name, _, tail = end.partition(".")
        if name not in files or tail in _names(parts[name], side):
            return None
        if name not in known:
            known[name] = read_terminals(files[name])
        return known[name].get(tail)

    found: list[Connection] = []
    for one in connections:
        first, second = terminal(one.source, "outputs"), terminal(one.target, "inputs")
        if first is None and second is None:
            found.append(one)
            continue
        place = f"{one.source} -> {one.target}"
        if first is None or second is None:
            raise InputError(
                "connection of a terminal",
                expected="a terminal at both ends",
                got=f"a variable or an unknown name at {one.source if first is None else one.target}",
                remedy="connect terminal with terminal, or the variables one by one",
                place=place,
            )
        if one.gain != 1.0 or one.offset != 0.0 or one.add or one.gain_unit != "1":
            raise InputError(
                "connection of a terminal",
                expected="no gain, offset or add: it holds for all of its variables",
                got="one of them",
                remedy="connect the variables one by one",
                place=place,
            )
        ends = one.source.partition(".")[0], one.target.partition(".")[0]
        pairs = joined(first, second)
        if not pairs:
            raise InputError(
                "connection of a terminal",
                expected="a member that both ends have",
                got="none",
                remedy="connect the variables one by one",
                place=place,
            )
        for pair in pairs:
            there, back = (
                ((ends[0], pair.first), (ends[1], pair.second)),
                ((ends[1], pair.second), (ends[0], pair.first)),
            )
            way = next((way for way in (there, back) if _drives(parts, *way)), None)
            if way is None:
                raise InputError(
                    f"variables of a terminal ({pair.place})",
                    expected="an output at one end and an input at the other",
                    got=f"{ends[0]}.{pair.first} and {ends[1]}.{pair.second}",
                    remedy="connect the variables one by one, or choose them (options: inputs, outputs)",
                    place=place,
                )
            (source, name), (target, other) = way
            found += [
                Connection(f"{source}.{a}", f"{target}.{b}", pair.gain, one.delay)
                for a, b in zip(
                    _elements(parts[source], name, "outputs"), _elements(parts[target], other, "inputs"), strict=True
                )
            ]
    return found


def _drives(parts: Mapping[str, Plant], source: tuple[str, str], target: tuple[str, str]) -> bool:
    """Return True if a variable is an output, the other an input, and both of one size."""
    out, into = _elements(parts[source[0]], source[1], "outputs"), _elements(parts[target[0]], target[1], "inputs")
    return bool(out) and len(out) == len(into)


def _elements(plant: Plant, name: str, side: str) -> list[str]:
    """Return the channels of a variable: itself, or the elements of an array; none if it is not on this side."""
    return [one for one in _names(plant, side) if one == name or one.startswith(f"{name}[")]


def _names(plant: Plant, side: str) -> list[str]:
    """Return the numbers and texts that a part has on one side."""
    texts = getattr(plant, "text_outputs" if side == "outputs" else "text_inputs", {})
    return [*(channel.name for channel in getattr(plant.spec, side)), *texts]


Make = Callable[[str, dict[str, Any]], Plant]
"""Makes a part from a plant's id and its options; ``"fmu"`` takes a path, ``"mockup"`` a name."""

CHANGEABLE = ("sample_time", "order", "loops", "iterations", "tolerance", "hold", "error")


class PartDescription(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A part: the id of a registered plant, an FMU file, or one of our own FMUs.

    Files, also those that options of a plant name, are relative to the TOML file.
    """

    plant: str | None = None
    fmu: str | None = None
    mockup: str | None = None
    options: dict[str, Any] = {}


class Wiring(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A connection, see :class:`harness.cosim.Connection`; of two terminals of FMUs by their names."""

    source: str = msgspec.field(name="from")
    target: str = msgspec.field(name="to")
    gain: float = 1.0
    gain_unit: str = "1"
    delay: int = 0
    add: bool = False
    offset: float = 0.0


class CouplingDescription(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The whole of a coupling's TOML file; the keys are the arguments of :class:`harness.cosim.Coupled`."""

    parts: dict[str, PartDescription]
    outputs: tuple[str, ...]
    connections: tuple[Wiring, ...] = ()
    inputs: dict[str, str] | tuple[str, ...] = ()
    description: str = ""
    initial: dict[str, float] = {}
    sample_time: float | None = None
    order: Literal["gauss-seidel", "jacobi"] = "gauss-seidel"
    sequence: tuple[str, ...] | None = None
    loops: Literal["solve", "refuse"] = "solve"
    iterations: int = 1
    tolerance: float = 1e-10
    hold: Literal["constant", "linear"] = "constant"
    error: float | None = None


def read_coupling(path: str | Path) -> CouplingDescription:
    r"""Read the TOML file of a coupling.

    Parameters
    ----------
    path : path
        The file.

    Raises
    ------
    InputError
        If the file is missing or no TOML, a key is unknown or missing, a value has the wrong type, or it names code
        that is not trusted (:func:`harness.trust.trusting`).

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "pair.toml"
    ...     _ = file.write_text('outputs = ["arm.theta"]\n[parts.arm]\nplant = "pendulum-ode"\n')
    ...     read_coupling(file).parts["arm"].plant
    'pendulum-ode'
    """
    path = Path(path)
    if not path.is_file():
        raise InputError("no such coupling", expected="a TOML file", got="no file", remedy="check the path", file=path)
    read = read_toml(path, CouplingDescription)
    for name, part in read.parts.items():
        named = {"plant": part.plant, "fmu": part.fmu, "mockup": part.mockup}
        registered_only(named, file=path, place=f"parts.{name}")
        registered_only(part.options, file=path, place=f"parts.{name}.options", options=True)
        given = [key for key in ("plant", "fmu", "mockup") if getattr(part, key) is not None]
        if len(given) != 1:
            raise InputError(
                "what the part is",
                expected="one of plant = ID, fmu = FILE, mockup = NAME",
                got=" and ".join(given) or "none of them",
                remedy="keep one",
                file=path,
                place=f"parts.{name}",
            )
    return read


def own_steps(path: str | Path, *, within: str | Path | None = None) -> list[str]:
    r"""Return the parts of a coupling or a system whose steps are their own, whatever the step of the exchange.

    Parameters
    ----------
    path : path
        A coupling in TOML, or a system of another tool.
    within : path, optional
        Folder that the files of an unpacked system may lie in.
    """
    path = Path(path)
    if path.suffix.lower() == ".toml":
        parts = read_coupling(path).parts
        return [name for name, part in parts.items() if part.plant is not None or "sample_time" in part.options]
    from harness.cosim.structure import opened

    with opened(path, within=within) as found:
        return [name for name, component in found.components() if component.step is not None]


def couple(path: str | Path, make: Make, *, changes: Mapping[str, Any] | None = None) -> Coupled:
    """Build the plant that a coupling's TOML file describes.

    Parameters
    ----------
    path : path
        The file; FMU files in it are relative to its folder.
    make : callable
        ``make(id, options) -> Plant``.
    changes : mapping, optional
        Values that go before those of the file: sample_time, order, loops, iterations, tolerance, hold, error.

    Raises
    ------
    InputError
        If the file or something in it cannot be used; the file is named.

    Notes
    -----
    FMUs (``fmu``, ``mockup``) without a ``sample_time`` of their own get the coupling's.
    """
    path = Path(path)
    read = read_coupling(path)
    refuse_unknown("option of a coupling", changes or (), CHANGEABLE, remedy="change the rest in the file", file=path)
    chosen = {key: (changes or {}).get(key, getattr(read, key)) for key in CHANGEABLE}
    parts: dict[str, Plant] = {}
    files: dict[str, Path] = {}
    try:
        for name, part in read.parts.items():
            id, options = _order_of(part, path.parent, chosen["sample_time"])
            if id == "fmu" and "path" in options:
                files[name] = Path(options["path"])
            try:
                parts[name] = made(make, id, options, name)
            except InputError as error:
                raise error.located(file=path, place=f"parts.{name}") from error
        wires = [
            Connection(w.source, w.target, w.gain, w.delay, w.add, w.gain_unit, w.offset) for w in read.connections
        ]
        try:
            return Coupled(
                parts,
                expanded(wires, parts, files),
                inputs=read.inputs,
                outputs=read.outputs,
                sequence=read.sequence,
                initial=read.initial,
                **chosen,
            )
        except InputError as error:
            raise error.located(file=path) from error
    except HarnessError:
        for plant in parts.values():
            plant.close()
        raise


def _order_of(part: PartDescription, folder: Path, sample_time: float | None) -> tuple[str, dict[str, Any]]:
    """Return id and options for the factory."""
    if part.plant is not None:
        return part.plant, {key: _beside(value, folder) for key, value in part.options.items()}
    shared = {} if sample_time is None else {"sample_time": sample_time}
    if part.fmu is not None:
        return "fmu", {"path": str(folder / part.fmu), **shared, **part.options}
    return "mockup", {"name": part.mockup, **shared, **part.options}


def _beside(value: Any, folder: Path) -> Any:
    """Return the path of a file beside the TOML file (an MJCF, a URDF) where an option names one."""
    names_a_file = isinstance(value, str) and bool(Path(value).suffix) and (folder / value).is_file()
    return str(folder / value) if names_a_file else value
