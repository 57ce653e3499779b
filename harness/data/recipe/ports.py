"""The ports of a nominal model, as far as data need them: names, units, ranges; and which signal sits on which."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from harness.data.tables.headers import split_header
from harness.errors import InputError, did_you_mean
from harness.signals import Channel
from harness.trust import names_fmu
from harness.units import fits

ANY_PORTS = "linear"  # The built-in model that takes its ports from the data.

_SUFFIX = {0: "", 1: "_rate", 2: "_acceleration"}


@dataclass(frozen=True)
class Ports:
    """What a model can be driven by, and what can be measured of it."""

    # Outputs first, then what else can be measured (coordinates, states)
    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    model: str = "the model"  # For messages
    units_fixed: bool = True  # False where the model takes over the units of the data
    joints: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    """Input and output port of each joint by the name that the robot's file gives it."""
    untold: frozenset[str] = frozenset()
    """Ports of which a model does not tell the unit, as an FMU may: they take over that of the data as it stands."""
    rates: bool = True
    """False where the rates of the outputs cannot be measured too: a fitted model has the outputs that it has."""

    def named(self, port: str, role: str) -> str:
        """Return the name of a port that goes by its joint's name.

        Examples
        --------
        >>> ports = Ports((Channel("tau1", "N m"),), (Channel("q1", "rad"),), joints={"elbow": ("tau1", "q1")})
        >>> ports.named("elbow", "output")
        'q1'
        """
        if port not in self.joints or role == "reference":
            return port
        return self.joints[port][role == "output"]

    def find(self, port: str, role: str) -> Channel:
        """Return the channel of a port.

        Raises InputError if there is no such port in this role; near names are listed.
        """
        channels = self.inputs if role == "input" else self.outputs
        for channel in channels:
            if channel.name == port:
                return channel
        others = self.outputs if role == "input" else self.inputs
        names = [channel.name for channel in channels]
        if any(channel.name == port for channel in others):
            remedy = f"{port} is an {'output' if role == 'input' else 'input'} of {self.model}: correct the role"
        else:
            remedy = did_you_mean(port, names, "set port = ... to one of these", 2)
        raise InputError(
            f"{self.model} has no {role} {port!r}",
            expected=f"one of {', '.join(map(str, channels)) or '(none)'}",
            got=repr(port),
            remedy=remedy,
        )

    @staticmethod
    def channel_name(port: str, derivative: int) -> str:
        """Return the name of a measured port or rate, as the physics room calls it.

        Examples
        --------
        >>> Ports.channel_name("theta", 1)
        'theta_rate'
        """
        return port + _SUFFIX[derivative]


def rate_unit(unit: str, derivative: int) -> str:
    """Return the unit of a port's time derivative.

    Examples
    --------
    >>> rate_unit("rad", 1), rate_unit("1", 1), rate_unit("m", 2)
    ('rad/s', '1/s', 'm/s^2')
    """
    return unit if derivative == 0 else f"{unit}/s" if derivative == 1 else f"{unit}/s^2"


def ports_of(model: str, options: Mapping[str, Any], *, analogy: bool = False) -> Ports | None:
    """Return the ports of a nominal model; None for a model that takes any.

    Raises InputError if the model is unknown or cannot be read.

    - ``model``: built-in name, an arm (``FILE.urdf``, ``FILE.xml``), ``FILE.py:NAME`` or ``FILE.fmu``
    - ``options``: options of the model's definition
    - ``analogy``: True where only the equations count and units come from the data
    """
    if model == ANY_PORTS:
        return None
    if names_fmu(model):
        return _fmu_ports(model, analogy=analogy)
    from harness.physics import load_model
    from harness.physics.arms.arm import is_arm, load_arm

    arm = load_arm(model) if is_arm(model) else None
    system: Any = load_model(model, **options) if arm is None else arm
    outputs = {channel.name: channel for channel in (*system.states, *system.outputs)}
    first = [channel.name for channel in system.outputs]
    ordered = [*first, *(name for name in outputs if name not in first)]
    joints = {}
    if arm is not None:
        pairs = zip(arm.arm.moving, arm.inputs, arm.positions, strict=True)
        joints = {joint.name: (drive.name, angle.name) for joint, drive, angle in pairs}
    return Ports(system.inputs, tuple(outputs[name] for name in ordered), model, not analogy, joints)


def located_model(model: str | Path, folder: Path) -> str:
    """Return a model's name with its file made findable from any folder (relative to the data set first).

    Examples
    --------
    >>> located_model("pendulum", Path("."))
    'pendulum'
    """
    if not isinstance(model, str | Path):
        raise InputError(
            "model",
            expected="the name of a model, or a file",
            got=type(model).__name__,
            remedy="give FILE.py:NAME of the function that makes it; harness.diagnosis.close_loop takes it as it is",
        )
    model = str(model)
    name, colon, attribute = model.rpartition(":") if ".py:" in model else (model, "", "")
    if Path(name).suffix.lower() not in (".py", ".fmu", ".urdf", ".xml", ".mjcf", ".eqs"):
        return model
    beside = folder / name
    return f"{beside if beside.is_file() else Path(name)}{colon}{attribute}"


def model_options(
    model: str, options: Mapping[str, Any], inputs: Sequence[str], outputs: Sequence[str]
) -> dict[str, Any]:
    """Return the options of a model, with the names of the ports where it takes them from the data."""
    result = dict(options)
    if model == ANY_PORTS:
        result.setdefault("inputs", list(inputs))
        result.setdefault("outputs", list(outputs))
        result["order"] = max(int(result.get("order", 2)), len(outputs))
    return result


def _fmu_ports(path: str, *, analogy: bool) -> Ports:
    """Return the ports of an FMU from its modelDescription."""
    if not Path(path).is_file():
        raise InputError("no such FMU", expected="an FMU file", got="no file", remedy="check the path", file=path)
    from fmpy import read_model_description

    try:
        description = read_model_description(path, validate=False)  # what breaks the standard is said where it is run
    except Exception as error:
        raise InputError(
            "not an FMU",
            expected="a zip archive with a modelDescription.xml",
            got=f"{type(error).__name__}: {error}"[:200],
            remedy="export the FMU anew",
            file=path,
        ) from error

    untold: set[str] = set()

    def channel(variable: Any) -> Channel:
        declared = getattr(variable, "declaredType", None)
        unit = variable.unit or (getattr(declared, "unit", None) if declared is not None else None)
        if unit is None and variable.type in ("Real", "Float64", "Float32"):
            untold.add(str(variable.name))
        return Channel(str(variable.name), str(unit or "1"))

    groups = {
        kind: tuple(channel(v) for v in description.modelVariables if v.causality == kind and v.type != "String")
        for kind in ("input", "output", "local")
    }
    return Ports(
        groups["input"], (*groups["output"], *groups["local"]), Path(path).name, not analogy, untold=frozenset(untold)
    )


def nearest(channel: Channel, titles: Sequence[str]) -> list[str]:
    """Return the titles that may be meant by a channel: of like name first, then of like unit, at most six.

    Examples
    --------
    >>> nearest(Channel("u", "N m"), ["temperature [K]", "u_motor [V]", "torque [N mm]"])
    ['u_motor [V]', 'torque [N mm]', 'temperature [K]']
    """

    def distance(title: str) -> tuple[float, bool]:
        name, unit = split_header(title)
        alike = difflib.SequenceMatcher(None, name.lower(), channel.name.lower()).ratio()
        starts = name.lower().startswith(channel.name.lower())
        try:
            other = unit is None or not fits(unit, channel.unit)
        except InputError:
            other = True
        return -alike - 0.5 * starts - 0.3 * (not other), other

    return sorted(titles, key=distance)[:6]
