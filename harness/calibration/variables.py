"""What of an FMU or a system of FMUs can be free: its variables with units, bounds and start values, in SI."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from harness.errors import InputError, did_you_mean, refuse_unknown
from harness.parts.files import describe_fmu, is_system
from harness.physics.definition.parameters import Parameter

REALS = ("Real", "Float64", "Float32")
PARAMETERS = ("parameter", "structuralParameter")


@dataclass(frozen=True)
class Variable:
    """A variable of an FMU, in SI."""

    name: str  # ``p``, in a system ``component.p``
    key: str  # How the plant calls it
    unit: str
    start: float | None  # None where it has none, or is no real scalar
    # As declared
    minimum: float
    maximum: float
    parameter: bool  # A parameter; otherwise a state or another variable
    settable: bool  # Whether it may be set before a run
    integrated: bool  # Whether it looks like a state: continuous, starting exactly where it says


@dataclass(frozen=True)
class ModelContents:
    """What a model file holds: ``kind`` is ``"fmu"`` or ``"system"``; the tolerance is that of an FMU's experiment."""

    path: Path
    name: str
    kind: str
    variables: Mapping[str, Variable]
    start_time: float
    tolerance: float | None = None
    derivatives: Mapping[str, str] = field(default_factory=dict)
    """Of an FMU with directional derivatives: by state the variable that is its derivative."""

    def variable(self, name: str, what: str) -> Variable:
        """Return one of the real scalars that can be set, or refuse the name with the nearest ones."""
        found = self.variables.get(name)
        if found is not None and found.settable and found.start is not None:
            return found
        able = [one.name for one in self.variables.values() if one.settable and one.start is not None]
        listed = ", ".join([one for one in able if self.variables[one].parameter][:12])
        raise InputError(
            what,
            expected=f"a real scalar that can be set before a run ({listed or 'this model has none'}, ...)",
            got=repr(name)
            if found is None
            else f"{name!r}, which cannot be set, has no start value or is no real scalar",
            remedy=did_you_mean(name, able if found is None else (), f"sysid list {self.path}"),
            file=self.path,
        )


def contents_of(path: str | Path) -> ModelContents:
    """Return what can be set in an FMU or a system of FMUs.

    Raises InputError if the file cannot be read.

    Examples
    --------
    >>> from plants.mockups import mockup
    >>> found = contents_of(mockup("pendulum"))
    >>> found.variables["J"].unit, found.variables["J"].start, found.variables["J"].minimum
    ('kg m^2', 0.05, 0.0)
    """
    path = Path(path)
    if not path.exists():
        raise InputError(
            "no such model", expected="an FMU or an SSP", got="no file", remedy="check the path", file=path
        )
    if not is_system(str(path)):
        described = describe_fmu(path)
        rows = [_variable(row, row["name"], row["name"], None) for row in described["variables"] if not row["alias"]]
        experiment = described["experiment"]
        named = {one.name: one for one in rows}
        start, tolerance = float(experiment["startTime"] or 0.0), experiment["tolerance"]
        offered = any(kind["directional derivatives"] for kind in described["kinds"].values())
        derived: dict[str, str] = {}
        for row in described["variables"]:  # the first: a state that is another one's rate tells that by the way
            if row["derivative_of"]:
                derived.setdefault(row["derivative_of"], row["name"])
        told = derived if offered else {}
        return ModelContents(path, str(described["model"]), "fmu", named, start, tolerance, told)
    from harness.cosim.structure import opened
    from harness.cosim.structure.flatten import flatten

    with opened(path) as found:
        description = found.description
        flat = flatten(description, describe_fmu)
        variables = {}
        for component in flat.components:
            given = {**component.parameters, **component.start}
            for row in component.rows.values():
                if not row["alias"]:
                    name, key = (f"{head}.{row['name']}" for head in (component.label, component.name))
                    variables[name] = _variable(row, name, key, given.get(row["name"]))
    return ModelContents(path, description.name, "system", variables, float(description.start or 0.0))


def _variable(row: Mapping[str, Any], name: str, key: str, given: Any) -> Variable:
    """Return a row of an FMU's table; ``given`` is the value that a system sets, in SI."""
    real = row["type"] in REALS and not row["shape"]
    start: float | None = None
    if real and isinstance(given, int | float):
        start = float(given)
    elif real and row["start"] is not None:
        try:
            start = float(row["start"]) * (row["scale"] or 1.0) + (row["offset"] or 0.0)
        except ValueError:
            start = None
    parameter = row["causality"] in PARAMETERS
    exact = row["initial"] in ("exact", "approx")
    settable = row["variability"] != "constant" and (parameter or (row["causality"] in ("local", "output") and exact))
    low, high = row["minimum"], row["maximum"]
    return Variable(
        name,
        key,
        row["si_unit"] or "1",
        start,
        -np.inf if low is None else float(low),
        np.inf if high is None else float(high),
        parameter,
        settable,
        real and not parameter and settable and row["variability"] == "continuous" and row["initial"] == "exact",
    )


def start_values(contents: ModelContents, given: Mapping[str, float]) -> dict[str, float]:
    """Return given start values (SI), or refuse a name or a number."""
    for name, value in given.items():
        contents.variable(name, "start value")
        if not np.isfinite(value):
            raise InputError(
                f"start value of {name}", expected="a finite number", got=f"{value}", remedy="correct it", place="start"
            )
    return {name: float(value) for name, value in given.items()}


def free_parameters(
    contents: ModelContents,
    free: Sequence[str],
    bounds: Mapping[str, tuple[float, float]],
    start: Mapping[str, float],
) -> tuple[Parameter, ...]:
    """Return the free parameters: where they start, and the bounds of the file narrowed by those given.

    A positive start value without a lower bound stays positive, and is searched through its logarithm. Raises
    InputError if a name is unknown, twice or no parameter, a bound is none, or a start value lies outside.

    Examples
    --------
    >>> from plants.mockups import mockup
    >>> free_parameters(contents_of(mockup("pendulum")), ["b"], {"b": (0.001, 1.0)}, {})
    (Parameter(name='b', unit='N m s/rad', value=0.02, minimum=0.001, maximum=1.0, fixed=False),)
    """
    if not free:
        listed = [one.name for one in contents.variables.values() if one.parameter and one.start is not None]
        raise InputError(
            "nothing is free",
            expected=f"names of parameters ({', '.join(listed[:12]) or 'this model has none'})",
            got="none",
            remedy="--free NAME,NAME",
            file=contents.path,
        )
    for name in free:
        if list(free).count(name) > 1:
            raise InputError("free parameter", expected="each name once", got=f"{name!r} twice", remedy="remove one")
    refuse_unknown("bound of a parameter that is not free", bounds, free, remedy="make it free, or remove the bound")
    return tuple(_parameter(contents, name, bounds.get(name), start.get(name)) for name in free)


def _parameter(contents: ModelContents, name: str, bound: tuple[float, float] | None, given: float | None) -> Parameter:
    """Return one free parameter."""
    variable = contents.variable(name, "free parameter")
    if not variable.parameter:
        raise InputError(
            "free parameter",
            expected="a parameter (start values of states are estimated record by record by themselves)",
            got=f"{name!r}, a variable of the motion",
            remedy="leave it out of --free",
            file=contents.path,
        )
    assert variable.start is not None
    low, high = variable.minimum, variable.maximum
    if bound is not None:
        low, high = max(low, bound[0]), min(high, bound[1])
        if not low < high:
            raise InputError(
                f"bounds of {name}",
                expected=f"a range that overlaps with the model's own, {variable.minimum:g} to {variable.maximum:g}",
                got=f"{bound[0]:g}:{bound[1]:g}",
                remedy="correct it (SI units)",
                file=contents.path,
            )
    value = variable.start if given is None else float(given)
    if given is None and np.isfinite([low, high]).all() and not low <= value <= high:
        value = float(np.sqrt(low * high)) if low > 0 else 0.5 * (low + high)
    elif given is None:
        value = min(max(value, low), high)
    if np.isinf(low) and value > 0.0:
        low = 0.0
    if value == 0.0 and low == 0.0:
        raise InputError(
            f"start value of {name}",
            expected="a positive number (it cannot be negative, so it is searched through its logarithm)",
            got="0",
            remedy=f"--start {name}=0.1 or the like",
            file=contents.path,
        )
    try:
        return Parameter(name, variable.unit, value, low, high)
    except InputError as error:
        raise error.located(file=contents.path) from error
