"""Lines in the spectra of latent forces: over time, and along the coordinate that a force acts on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from harness.diagnosis.directions.trace import Trace
from harness.diagnosis.effort import EFFORT
from harness.effects.effect import EffectParameter
from harness.signals import FloatArray

if TYPE_CHECKING:
    from harness.physics.compiled.system import System

_LOBES = 12
"""Bins about a line that belong to it."""
_FINEST = 1e5
"""Wave number times travel beyond which no line is looked for along a coordinate: a joint that turns on and on."""


def frequencies(traces: Sequence[Trace], nominal: System) -> list[float]:
    """Return the angular frequencies [rad/s] of the strongest lines: of latent forces, or of free runs' errors."""
    trace = max(traces, key=lambda trace: len(trace.record))
    n, dt = len(trace.record), trace.record.spec.sample_time
    window = np.hanning(n)
    omega = 2 * np.pi * np.arange(2 * n + 1) / (4 * n * dt)
    found: list[float] = []
    forces = [force for row in range(trace.passes.nl) for force in _forces(trace, nominal, row)]
    for force in forces or _changes(trace):
        power = np.abs(np.fft.rfft((force - force.mean()) * window, 4 * n)) ** 2
        power[omega * n * dt < 2 * 2 * np.pi] = 0.0
        found += _strongest(power, omega, np.pi / (n * dt), found)
    return found


def waves(values: FloatArray, parameter: EffectParameter) -> list[float]:
    """Return values of a wave number of what repeats along these values, close enough that none is missed."""
    low, high = np.quantile(values, [0.02, 0.98])
    step = np.pi / max(float(high - low), 1e-9)
    return [
        float(number)
        for number in np.arange(parameter.minimum, min(parameter.maximum, parameter.minimum + 24 * step), step)
    ]


def short_waves(traces: Sequence[Trace], nominal: System, row: int, *, beyond: float) -> list[float]:
    """Return the wave numbers above ``beyond`` of the strongest lines of a latent force along its coordinate.

    Teeth and poles that are passed many times are too many to be tried one by one. Waves that are shorter than the way
    from sample to sample are not seen.
    """
    trace = max(traces, key=lambda trace: len(trace.record))
    coordinate = nominal.coordinates[row]
    q = trace.x[:, coordinate.q] - trace.x[:, coordinate.q].min()
    travel, way = float(np.ptp(q)), float(np.sqrt(np.mean(trace.x[:, coordinate.v] ** 2))) * trace.dt
    if not (travel > 0.0 and way > 0.0) or not beyond < np.pi / way < _FINEST / travel:
        return []
    highest = np.pi / way
    bins = 1 << int(np.ceil(np.log2(max(2.0 * highest * travel / np.pi, 2.0))))
    width = travel / (bins - 1)
    where = np.rint(q / width).astype(int)
    wave = 2 * np.pi * np.arange(2 * bins + 1) / (4 * bins * width)
    found: list[float] = []
    for force in _forces(trace, nominal, row):
        power = np.abs(np.fft.rfft(np.bincount(where, force - force.mean(), bins), 4 * bins)) ** 2
        power[(wave <= beyond) | (wave > highest)] = 0.0
        found += _strongest(power, wave, np.pi / travel, found)
    return found


def _strongest(
    power: FloatArray, at: npt.NDArray[np.floating[Any]], apart: float, known: Sequence[float]
) -> list[float]:
    """Return where a spectrum of a record filled up to four times its length is largest, away from what is known."""
    found: list[float] = []
    for _ in range(EFFORT.lines):
        peak = int(np.argmax(power))
        if power[peak] > 0 and not any(abs(at[peak] - other) < apart for other in (*known, *found)):
            found.append(float(at[peak]))
        power[max(peak - _LOBES, 0) : peak + _LOBES + 1] = 0.0
    return found


def _forces(trace: Trace, nominal: System, row: int) -> tuple[FloatArray, FloatArray]:
    """Return a latent force that remembers (K,), and with its white part: where that is larger, it may be nothing."""
    coloured = trace.x[:, trace.passes.start_size + row]
    return coloured, coloured + _white_forces(trace, nominal)[:, row]


def _changes(trace: Trace) -> list[FloatArray]:
    """Return how the error of every output changes from sample to sample (K,), 0 where a reading is missing.

    A plant without latent forces adds up what pushes it, so the force is nearer to the change than to the error.
    """
    change = np.gradient(trace.record.y - trace.expected, axis=0)
    return list(np.where(np.isfinite(change), change, 0.0).T)


def _white_forces(trace: Trace, nominal: System) -> FloatArray:
    """Return what the smoothed motion asks of forces from sample to sample (K, nl), beyond those that remember.

    The change of the speed that the equations do not give, over what a force of one does to it; found once.
    """
    known: FloatArray | None = trace.__dict__.get("_white_forces")
    if known is not None:
        return known
    function, n = trace.passes.simulator.functions.derivative.map(len(trace.record)), len(trace.record)
    p = np.tile(trace.p[:, None], n)

    def rate(x: FloatArray, u: FloatArray) -> FloatArray:
        return np.asarray(function(x.T, u.T, p, trace.record.t).full())

    here = rate(trace.x, trace.record.u)
    there = rate(trace.x, trace.record.u[np.maximum(np.arange(n) - 1, 0)])  # at its end a sample still has its input
    forces = np.zeros((n, trace.passes.nl))
    for row in range(trace.passes.nl):
        v = nominal.coordinates[row].v
        pushed = trace.x.copy()
        pushed[:, trace.passes.start_size + row] += 1.0
        forces[:-1, row] = np.diff(trace.x[:, v]) / trace.dt - 0.5 * (here[v, :-1] + there[v, 1:])
        forces[:, row] /= rate(pushed, trace.record.u)[v] - here[v]
    trace.__dict__["_white_forces"] = forces
    return forces
