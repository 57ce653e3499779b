"""Columns that the model cannot mean: a wrong unit or zero, two columns exchanged. Only a model can see these.

The model and its declared parameters predict the records. Where they do not, the rough fit is repeated with one column
repaired (scaled by 1000 or by 180/pi, turned by half a turn, exchanged with another) and the parameters near the
declared ones. All are tried; the best one is named if it leaves far less than the records as they are do with any
parameters within a factor of 100. Where the declared values say nothing, and the records as they are cannot be followed
at all, the same is asked with free parameters. Degrees for radians are a factor of 57 only, which a linear model
follows with other parameters: they are named if they alone bring all parameters to what was declared.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from harness.diagnosis.policy import DATA_POLICY
from harness.diagnosis.records.stretches import about_lines
from harness.errors import HarnessError
from harness.physics.compiled.simulator import Intersample
from harness.physics.compiled.system import System
from harness.physics.definition.parameters import Parameter
from harness.signals import Dataset, Trajectory

DEGREE = float(np.pi / 180)
ANGULAR = ("rad", "rad/s", "rad/s^2")
SAMPLES = 1500
"""Samples of a record that tell what is wrong with a column, and how late an input is."""


@dataclass(frozen=True, eq=False)
class Repair:
    """One thing that may be wrong with the columns: words, what to do about it, and the record without it.

    ``angle``: degrees and radians are taken for each other.
    """

    words: str
    remedy: str
    record: Trajectory
    angle: bool = False


@dataclass(frozen=True)
class Doubt:
    """What is probably wrong with the columns."""

    words: str
    certain: bool
    """False where the model fits the columns as they are just as well, and only its declared values speak against them:
    the plant may be of that size."""


def check_columns(system: System, dataset: Dataset) -> list[Doubt]:
    """Say which columns of a data set are probably wrong: see :func:`doubts`, for its longest estimation record.

    - ``system``: the nominal model, its parameters at what is known of them
    - returns none, or one
    """
    return doubts(system, max(dataset.estimation, key=len), dataset.intersample)


def doubts(system: System, record: Trajectory, intersample: Intersample = "zoh") -> list[Doubt]:
    """Return what is probably wrong with the columns, if a repair brings the record to what the model declares.

    The declared values and the inputs predict the size of every output, and a wrong unit leaves that far behind, even
    where the model fits as well as before: a force in N mm read as N m scales inertia, damping and stiffness alike. So
    every repair is fitted with the parameters held within a factor 10 of the declared ones; the best one is named if it
    leaves a fifth at most of what the record as it is leaves with parameters within a factor 100. Repairs that do as
    well are named beside it. Parameters of declared value 0 are free; a declared value wrong by 100 alone says nothing,
    unless it is by the factor between degrees and radians that all are off.

    - ``system``: with declared values
    - returns none, or one with the channels and what to do
    """
    cut = _plain(record)
    before, values = _fit(system, cut, intersample)
    lost = not before <= DATA_POLICY.unexplained
    off = _off(system, values, DATA_POLICY.near)
    if not lost and not off:
        return []
    near = _held(system, DATA_POLICY.near)
    good = max(1.5 * before, DATA_POLICY.repair_clear)
    least, known = _fit(near, cut, intersample, declared=True)
    if least < before:  # a free fit may have lost its way
        before, values = least, known
    elif not lost and least <= good:  # the data say nothing about what is off
        return []
    reference, grain = before, _grain(cut)
    if _off(system, values, DATA_POLICY.far):
        reference = max(before, _fit(_held(system, DATA_POLICY.far), cut, intersample, declared=True)[0])
    elif not _clear(grain, before, grain):  # nothing can be far better than that
        return [] if lost else _by_angle(system, cut, values, before, intersample)
    possible = list(repairs(cut))
    errors = [_fit(near, repair.record, intersample, declared=True)[0] for repair in possible]
    clear = min(errors) <= good and _clear(min(errors), reference, grain)
    if lost and not clear:  # declared values that are placeholders
        values = {}
        errors = [_fit(system, repair.record, intersample)[0] for repair in possible]
        clear = _clear(min(errors), before, grain)
    if not clear:
        return [] if lost else _by_angle(system, cut, values, before, intersample)
    likely = [repair for repair, error in zip(possible, errors, strict=True) if error <= 1.5 * min(errors)]
    certain = not before <= max(1.5 * min(errors), DATA_POLICY.repair_clear)
    return [Doubt(_sentence(system, likely, values, before, min(errors)), certain)]


def _by_angle(
    system: System, cut: Trajectory, values: Mapping[str, float], before: float, intersample: Intersample
) -> list[Doubt]:
    """Return the doubt that an angle is in the other unit, if then all parameters are as declared; else nothing.

    A linear model follows the record either way: what it leaves tells nothing, and the parameters tell.
    """
    as_declared = _held(system, DATA_POLICY.declared)
    errors = [(repair, _fit(as_declared, repair.record, intersample, declared=True)[0])
              for repair in repairs(cut) if repair.angle]  # fmt: skip
    least = min((error for _, error in errors), default=np.inf)
    if not least <= max(1.5 * before, DATA_POLICY.repair_clear):
        return []
    likely = [repair for repair, error in errors if error <= 1.5 * least]
    return [Doubt(_sentence(system, likely, values, before, least, DATA_POLICY.declared), certain=False)]


def repairs(record: Trajectory) -> Iterator[Repair]:
    """Yield what may be wrong: degrees and radians, half a turn, a factor of 1000, columns of one kind exchanged."""
    spec = record.spec
    for kind, channels in (("u", spec.inputs), ("y", spec.outputs)):
        angles = [k for k, channel in enumerate(channels) if channel.unit in ANGULAR]
        for columns in [[k] for k in angles] + ([angles] if len(angles) > 1 else []):
            names = " and ".join(channels[k].name for k in columns)
            verb = "is" if len(columns) == 1 else "are"
            yield Repair(
                f"{names} {verb} in degrees, not in radians",
                f"declare {names} in deg",
                _scaled(record, kind, columns, DEGREE),
                angle=True,
            )
            yield Repair(
                f"{names} {verb} in radians, and read as degrees",
                f"declare {names} in rad",
                _scaled(record, kind, columns, 1 / DEGREE),
                angle=True,
            )
        for k in angles if kind == "y" else ():
            if channels[k].unit == "rad":
                values = record.y.copy()
                values[:, k] += np.pi
                name = channels[k].name
                words = f"{name} is half a turn off: 0 where the model's is 180 deg, as upright instead of hanging"
                yield Repair(
                    words, f"add half a turn to {name}: offset = 3.14159, or 180 in deg", replace(record, y=values)
                )
        for k, channel in enumerate(channels):
            for factor, word in ((1e-3, "large"), (1e3, "small")):
                yield Repair(
                    f"{channel.name} is 1000 times too {word} for {channel.unit}",
                    f"correct the unit of {channel.name}, or give it scale = {factor:g}",
                    _scaled(record, kind, [k], factor),
                )
        for a, b in combinations(range(len(channels)), 2):
            order = list(range(len(channels)))
            order[a], order[b] = b, a
            names = f"{channels[a].name} and {channels[b].name}"
            values = getattr(record, kind)[:, order].copy()
            yield Repair(f"{names} are swapped", f"exchange {names}", replace(record, **{kind: values}))
    if spec.nu == spec.ny == 1:
        names = f"{spec.inputs[0].name} and {spec.outputs[0].name}"
        yield Repair(f"{names} are swapped", f"exchange {names}", replace(record, u=record.y.copy(), y=record.u.copy()))


def _scaled(record: Trajectory, kind: str, columns: Sequence[int], factor: float) -> Trajectory:
    """Return the record with some columns scaled."""
    values = getattr(record, kind).copy()
    values[:, columns] *= factor
    return replace(record, **{kind: values})


def _off(system: System, values: Mapping[str, float], factor: float) -> list[str]:
    """Return the free parameters that are more than a factor off their declared values."""
    told = {
        parameter.name: parameter.value for parameter in system.parameters if not parameter.fixed and parameter.value
    }
    return [name for name, value in told.items() if not 1 / factor < values.get(name, np.nan) / value < factor]


def _clear(after: float, before: float, grain: float) -> bool:
    """Return True if a repair leaves far less than there was, the noise of the readings taken off both."""
    noise = min(grain, 0.98 * after)  # it is no more than what the best fit leaves
    return after**2 - noise**2 <= DATA_POLICY.repaired**2 * (min(before, 1.0) ** 2 - noise**2)


def _grain(cut: Trajectory) -> float:
    """Return the noise of the readings over the motion within windows, as the errors of the fits are."""
    from harness.physics.fitting.likelihood_fit import sensor_noise

    moved = np.sqrt(about_lines([cut.y], _window(cut)))
    return float(np.sqrt(np.mean((sensor_noise([cut]) / np.maximum(moved, 1e-300)) ** 2)))


def _window(cut: Trajectory) -> int:
    """Return the samples of a window of the rough fits."""
    return int(np.clip(len(cut) // 10, 50, len(cut)))


def _sentence(
    system: System, likely: Sequence[Repair], values: Mapping[str, float], before: float, after: float,
    within: float = DATA_POLICY.near,
) -> str:  # fmt: skip
    """Return what is to be checked, and why."""
    words = " or ".join(repair.words for repair in likely)
    text = f"check the units and the order of the columns: perhaps {words} ({'; or '.join(o.remedy for o in likely)})"
    text += f". The model then errs by {100 * after:.3g} % of the motion"
    off = _off(system, values, DATA_POLICY.near) if values else []
    if before > DATA_POLICY.unexplained or not off:
        return f"{text}, and by {100 * min(before, 1.0):.3g} % as the columns are"
    moved = ", ".join(f"{name} {system.parameter(name).value:.3g} -> {values[name]:.3g}" for name in off)
    return (
        f"{text} with parameters within {within:g} times of the declared ones; as the columns are, it needs "
        f"{moved}, and errs by {100 * before:.3g} %. If the plant is that size, give the model such values"
    )


def _held(system: System, factor: float) -> System:
    """Return the system with its free parameters held within a factor of their declared values."""

    def held(parameter: Parameter) -> Parameter:
        low, high = sorted((parameter.value / factor, parameter.value * factor))
        return replace(parameter, minimum=max(low, parameter.minimum), maximum=min(high, parameter.maximum))

    parts = tuple(
        held(parameter) if not parameter.fixed and parameter.value else parameter for parameter in system.parameters
    )
    return replace(system, parameters=parts)


def _plain(record: Trajectory) -> Trajectory:
    """Return the first samples, angles unwrapped and without a period: a wrapped error would always look small."""
    cut = record.measured()[: min(len(record), SAMPLES)]
    y = cut.y.copy()
    for k, channel in enumerate(cut.spec.outputs):
        if channel.period is not None and np.ptp(y[:, k]) <= 1.05 * channel.period:
            y[:, k] = np.unwrap(y[:, k], period=channel.period)
    outputs = tuple(replace(channel, period=None) for channel in cut.spec.outputs)
    return replace(cut, y=y, spec=replace(cut.spec, outputs=outputs))


def _fit(
    system: System, record: Trajectory, intersample: Intersample, *, declared: bool = False
) -> tuple[float, dict[str, float]]:
    """Return the error of a rough fit over windows, relative to the motion within them, and the parameters.

    The error is infinite and the parameters are those declared if the fit fails; ``declared``: start from these.
    """
    from harness.physics.fitting.output_error import fit_output_error

    dt, samples = record.spec.sample_time, _window(record)
    plain = replace(system, outputs=tuple(replace(channel, period=None) for channel in system.outputs))
    moved = np.sqrt(about_lines([record.y], samples))
    if not (moved > 0).all():
        return float("inf"), system.values()
    noise = {channel.name: float(size) for channel, size in zip(system.outputs, moved, strict=True)}
    try:
        with np.errstate(all="ignore"):
            fitted = fit_output_error(
                plain, [record], horizon=samples * dt, continuation=(), noise=noise, intersample=intersample,
                max_iterations=20, start=plain.values() if declared else None,
            )  # fmt: skip
    except (HarnessError, ArithmeticError, np.linalg.LinAlgError):
        return float("inf"), system.values()
    error = float(np.sqrt(np.mean((fitted.rms / moved) ** 2)))
    return (error if np.isfinite(error) else float("inf")), dict(fitted.parameters)
