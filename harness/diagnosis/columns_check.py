"""Columns that the model cannot mean: a unit wrong by 1000, two columns exchanged. Only a model can see these.

Where the rough fit explains next to nothing, it is repeated with one column scaled by 1000 or two exchanged; a repair
that explains nearly everything is no accident.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from harness.errors import HarnessError, InputError
from harness.signals import Dataset, FloatArray, Trajectory

__all__ = ["Repair", "check_columns", "check_scale", "likely_repair", "repairs"]

NOTHING = 0.5
"""Above this error, relative to the motion of the output within a window, the rough fit explains next to nothing."""
BETTER = 0.2
"""A repair must bring the error below this share of it."""
CLEAR = 0.03
"""A repair that leaves no more than this needs no comparison with others."""
SAMPLES = 1500


@dataclass(frozen=True)
class Repair:
    """One thing that may be wrong with the columns: words for it, and the record as it would be without it."""

    words: str
    remedy: str
    record: Trajectory


def check_columns(system: Any, dataset: Dataset) -> None:
    """Refuse columns that fit the model only when scaled by 1000 or exchanged.

    Parameters
    ----------
    system : System
        The nominal model, its parameters at what is known of them.
    dataset : Dataset

    Raises
    ------
    InputError
        Naming the column and what is probably wrong with it.
    """
    found = likely_repair(system, max(dataset.estimation, key=len), dataset.intersample)
    if found is None:
        return
    repair, before, after = found
    raise InputError(
        repair.words,
        expected=f"columns that {system.name} can follow",
        got=f"an error of {before:.2g} of the motion as declared, of {after:.2g} otherwise",
        remedy=f"{repair.remedy}; if the columns are right, give the model's parameters start values of their size",
    )


def check_scale(system: Any, values: Mapping[str, float]) -> list[str]:
    """Say so if the fitted parameters are the start values, some of them times 1000: then an input's unit is.

    A force in N mm read as N m scales inertia, damping and stiffness alike, so that the model fits as well as before.

    Parameters
    ----------
    system : System
        With start values.
    values : mapping
        The fitted ones.

    Examples
    --------
    >>> from harness.physics.models import pendulum
    >>> check_scale(pendulum().system(), {"J": 103.0, "b": 48.0, "mgl": 1010.0})[0][:54]
    'J, b, mgl come out about 1000 times their start values'
    """
    free = [one for one in system.parameters if not one.fixed and one.value and values.get(one.name)]
    ratios = np.array([abs(values[one.name] / one.value) for one in free])
    for factor, other in ((1e3, "large"), (1e-3, "small")):
        scaled = np.abs(np.log10(ratios / factor)) < 1.0 if ratios.size else np.zeros(0, dtype=bool)
        others = np.abs(np.log10(ratios[~scaled])) < 1.0 if ratios.size else scaled
        typical = float(np.median(ratios[scaled])) / factor if scaled.any() else 0.0
        if scaled.sum() >= 2 and others.all() and 0.5 < typical < 2.0:
            names = ", ".join(one.name for one, on in zip(free, scaled, strict=True) if on)
            inputs = ", ".join(channel.name for channel in system.inputs) or "the outputs"
            return [
                f"{names} come out about {factor:g} times their start values: is column {inputs} 1000 times too "
                f"{other} for its unit? (if the plant is that size, give start values)"
            ]
    return []


def likely_repair(system: Any, record: Trajectory, intersample: Any = "zoh") -> tuple[Repair, float, float] | None:
    """Return the repair that makes the model fit, with the relative error before and after; None if none is needed."""
    cut = _plain(record)
    before = _error(system, cut, intersample)
    if not before > NOTHING:
        return None
    after, best = np.inf, None
    for one in repairs(cut):
        error = _error(system, one.record, intersample)
        if error < after:
            after, best = error, one
        if error < CLEAR:
            break
    return None if best is None or after > BETTER * min(before, 1.0) else (best, before, after)


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
    from harness.physics.output_error import fit_output_error

    dt, n = record.spec.sample_time, len(record)
    samples = int(np.clip(n // 10, 50, n))
    plain = replace(system, outputs=tuple(replace(channel, period=None) for channel in system.outputs))
    moved = _motion(record.y, samples)
    if not (moved > 0).all():
        return float("inf")
    noise = {channel.name: float(size) for channel, size in zip(system.outputs, moved, strict=True)}
    try:
        with np.errstate(all="ignore"):
            found = fit_output_error(
                plain, [record], horizon=samples * dt, continuation=(), noise=noise, intersample=intersample,
                max_iterations=20,
            )  # fmt: skip
    except (HarnessError, ArithmeticError, np.linalg.LinAlgError):
        return float("inf")
    error = float(np.sqrt(np.mean((found.rms / moved) ** 2)))
    return error if np.isfinite(error) else float("inf")


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
