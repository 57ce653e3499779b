"""Columns that the model cannot mean: a unit wrong by 1000, two columns exchanged. Only a model can see these.

Where the rough fit explains next to nothing, it is repeated with one column scaled by 1000 or two exchanged; a repair
that explains nearly everything is no accident, and the record is refused. Where it explains the record, but with
parameters more than 100 times off what the model declares, and within 10 times of it once a column is scaled by 1000,
the units are doubted in a warning: the declared values may be placeholders.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from harness.diagnosis.policy import DATA_POLICY
from harness.errors import HarnessError, InputError
from harness.signals import Dataset, FloatArray, Trajectory

__all__ = ["Repair", "check_columns", "doubtful_units", "likely_repair", "repairs"]

SAMPLES = 1500


@dataclass(frozen=True, eq=False)
class Repair:
    """One thing that may be wrong with the columns: words, the record without it, and the factor if it is a scale."""

    words: str
    remedy: str
    record: Trajectory
    factor: float | None = None


def check_columns(system: Any, dataset: Dataset) -> list[str]:
    """Refuse columns that fit the model only when scaled by 1000 or exchanged; say where a unit may be wrong.

    Parameters
    ----------
    system : System
        The nominal model, its parameters at what is known of them.
    dataset : Dataset

    Returns
    -------
    list of str
        See :func:`doubtful_units`.

    Raises
    ------
    InputError
        Naming the column and what is probably wrong with it.
    """
    record = max(dataset.estimation, key=len)
    cut = _plain(record)
    before, values = _fit(system, cut, dataset.intersample)
    found = likely_repair(system, record, dataset.intersample) if before > DATA_POLICY.unexplained else None
    if found is None:
        return _doubtful(system, cut, values, before, dataset.intersample)
    repair, before, after = found
    raise InputError(
        repair.words,
        expected=f"columns that {system.name} can follow",
        got=f"an error of {before:.2g} of the motion as declared, of {after:.2g} otherwise",
        remedy=f"{repair.remedy}; if the columns are right, give the model's parameters start values of their size",
    )


def doubtful_units(system: Any, record: Trajectory, intersample: Any = "zoh") -> list[str]:
    """Return a warning if a column scaled by 1000 would bring the parameters to what the model declares.

    The declared values and the inputs predict the size of every output, and a unit wrong by 1000 leaves that by a power
    of 1000: as a force in N mm read as N m does, which scales inertia, damping and stiffness alike, so that the model
    fits as well as before. So the rough fit is repeated with the parameters held within a factor 100 of the declared
    ones. Where it fails, and does not fail within a factor 10 with a column scaled, that column is named. Parameters
    of declared value 0 are free; a declared value wrong by 100 alone says nothing.

    Parameters
    ----------
    system : System
        With declared values.
    record : Trajectory
    intersample : str

    Returns
    -------
    list of str
        Empty, or one sentence with the channels and the factors.
    """
    cut = _plain(record)
    before, values = _fit(system, cut, intersample)
    return _doubtful(system, cut, values, before, intersample)


def likely_repair(system: Any, record: Trajectory, intersample: Any = "zoh") -> tuple[Repair, float, float] | None:
    """Return the repair that makes the model fit, with the relative error before and after; None if none is needed."""
    cut = _plain(record)
    before = _error(system, cut, intersample)
    if not before > DATA_POLICY.unexplained:
        return None
    after, best = np.inf, None
    for one in repairs(cut):
        error = _error(system, one.record, intersample)
        if error < after:
            after, best = error, one
        if error < DATA_POLICY.repair_clear:
            break
    return None if best is None or after > DATA_POLICY.repaired * min(before, 1.0) else (best, before, after)


def repairs(record: Trajectory) -> Iterator[Repair]:
    """Yield every column scaled by a thousandth and by a thousand, and every pair of columns of one kind exchanged."""
    spec = record.spec
    for kind, channels in (("u", spec.inputs), ("y", spec.outputs)):
        values = getattr(record, kind)
        for k, channel in enumerate(channels):
            for factor, word in ((1e-3, "large"), (1e3, "small")):
                scaled = values.copy()
                scaled[:, k] *= factor
                yield Repair(
                    f"column {channel.name} is 1000 times too {word} for {channel.unit}",
                    f"correct the unit of {channel.name}, or give it scale = {factor:g}",
                    replace(record, **{kind: scaled}),
                    factor,
                )
        for a, b in combinations(range(len(channels)), 2):
            order = list(range(len(channels)))
            order[a], order[b] = b, a
            names = f"{channels[a].name} and {channels[b].name}"
            yield Repair(
                f"columns {names} are swapped", f"exchange {names}", replace(record, **{kind: values[:, order].copy()})
            )
    if spec.nu == spec.ny == 1:
        names = f"{spec.inputs[0].name} and {spec.outputs[0].name}"
        yield Repair(
            f"columns {names} are swapped", f"exchange {names}", replace(record, u=record.y.copy(), y=record.u.copy())
        )


def _doubtful(system: Any, cut: Trajectory, values: Mapping[str, float], free: float, intersample: Any) -> list[str]:
    """Return the warning of :func:`doubtful_units` from the free fit of a plain record and its error."""
    told = {one.name: one.value for one in system.parameters if not one.fixed and one.value}
    off = [
        name
        for name, value in told.items()
        if not 1 / DATA_POLICY.far < values.get(name, np.nan) / value < DATA_POLICY.far
    ]
    if not off:
        return []
    held = _fit(_held(system, DATA_POLICY.far), cut, intersample, declared=True)[0]
    good = max(1.5 * free, DATA_POLICY.repair_clear)
    if held <= good:  # the data say nothing about what is off
        return []
    system = _held(system, DATA_POLICY.near)
    found = {
        one: _fit(system, one.record, intersample, declared=True)[0] for one in repairs(cut) if one.factor is not None
    }
    likely = [one for one, error in found.items() if error <= min(good, DATA_POLICY.repaired * held)]
    if not likely:
        return []
    words = " or ".join(one.words.removeprefix("column ") for one in likely)
    moved = ", ".join(f"{name} {told[name]:.3g} -> {values[name]:.3g}" for name in off)
    return [
        f"check the units: perhaps {words}. The record as it is needs parameters more than {DATA_POLICY.far:g} times "
        f"off the declared ones ({moved}), and would not with that column scaled; if the plant is that size, give the "
        "model such values"
    ]


def _held(system: Any, factor: float) -> Any:
    """Return the system with its free parameters held within a factor of their declared values."""

    def held(one: Any) -> Any:
        low, high = sorted((one.value / factor, one.value * factor))
        return replace(one, minimum=max(low, one.minimum), maximum=min(high, one.maximum))

    parts = tuple(held(one) if not one.fixed and one.value else one for one in system.parameters)
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


def _error(system: Any, record: Trajectory, intersample: Any) -> float:
    """Return the error of a rough fit over windows, relative to the motion within them; infinite if it fails."""
    return _fit(system, record, intersample)[0]


def _fit(
    system: Any, record: Trajectory, intersample: Any, *, declared: bool = False
) -> tuple[float, dict[str, float]]:
    """Return the same with the parameters, those declared if it fails; ``declared``: start from these."""
    from harness.physics.output_error import fit_output_error

    dt, n = record.spec.sample_time, len(record)
    samples = int(np.clip(n // 10, 50, n))
    plain = replace(system, outputs=tuple(replace(channel, period=None) for channel in system.outputs))
    moved = _motion(record.y, samples)
    if not (moved > 0).all():
        return float("inf"), system.values()
    noise = {channel.name: float(size) for channel, size in zip(system.outputs, moved, strict=True)}
    try:
        with np.errstate(all="ignore"):
            found = fit_output_error(
                plain, [record], horizon=samples * dt, continuation=(), noise=noise, intersample=intersample,
                max_iterations=20, start=plain.values() if declared else None,
            )  # fmt: skip
    except (HarnessError, ArithmeticError, np.linalg.LinAlgError):
        return float("inf"), system.values()
    error = float(np.sqrt(np.mean((found.rms / moved) ** 2)))
    return (error if np.isfinite(error) else float("inf")), dict(found.parameters)


def _motion(y: FloatArray, samples: int) -> FloatArray:
    """Return the rms motion of each output about a straight line through each window (ny,)."""
    total, count = np.zeros(y.shape[1]), 0
    for first in range(0, len(y) - samples + 1, samples):
        part = y[first : first + samples]
        x = np.column_stack([np.ones(samples), np.arange(samples)])
        rest = part - x @ np.linalg.lstsq(x, part, rcond=None)[0]
        total += (rest**2).sum(axis=0)
        count += samples
    return np.asarray(np.sqrt(total / max(count, 1)))
