"""How much an effect changes of what a model does along its smoothed motion, in the plant's own quantities."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from harness.diagnosis.directions.trace import Trace
from harness.physics.compiled.rollout_code import Functions
from harness.physics.compiled.sampled import SampledBlocks
from harness.physics.compiled.system import System
from harness.signals import FloatArray

LOOKED_AT = 1000
"""Samples of a record, evenly spread, along which what two models do is compared: an rms needs no more."""


def changed_share(
    traces: Sequence[Trace], whole: System, less: System, states: Sequence[str], own: Sequence[Trace] | None = None
) -> float:
    """Return what a part of a model changes, over all that happens: of the largest, rates or readings.

    From each smoothed state one sample is simulated with and without the part. The rms of the difference stands over
    the rms of what a rate changes by in a sample, and that of the readings over their scatter. What is left unchanged
    is the same however exact the sensors are, so this tells what matters from what can be seen.

    - ``traces``: smoothed records of the whole model
    - ``whole, less``: with and without the part
    - ``states``: states that forces act on: rates of coordinates, levels of a process, a motor's speed behind an
      elastic joint. Those that both systems have are looked at.
    - ``own``: the same records as the system without the part has smoothed them, for its own values and hidden states:
      what a hidden state remembers shows in no single sample. By default it has those of the whole.
    - returns 0 where nothing changes, about 1 where it makes the motion
    """
    names, others = ([channel.name for channel in system.states] for system in (whole, less))
    both = [name for name in states if name in names and name in others]
    mine, theirs = [names.index(name) for name in both], [others.index(name) for name in both]
    plant = sum("@" not in channel.name for channel in less.states)  # hidden states come last
    kept = [] if own is not None else [names.index(channel.name) for channel in less.states]
    known = [] if own is not None else [whole.parameter_names.index(name) for name in less.parameter_names]
    moved, apart, read, off = [], [], [], []
    for number, trace in enumerate(traces):
        x, p = trace.x[:, : whole.nx], trace.p
        after, readings = _stepped(trace, whole, x, p)
        if own is None:
            without, bare = _stepped(trace, less, x[:, kept], p[known])
        else:
            hidden = own[number].x[:, plant : less.nx]
            without, bare = _stepped(trace, less, np.hstack([x[:, :plant], hidden]), own[number].p)
        moved.append((after - x[: -1 : _apart(len(x))])[:, mine])
        apart.append(after[:, mine] - without[:, theirs])
        read.append(readings - readings.mean(axis=0))
        off.append(readings - bare)
    return max(_ratio(apart, moved), _ratio(off, read))


def _stepped(trace: Trace, system: System, x: FloatArray, p: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the states one sample later, from evenly spread ones of a record's (K, nx), and its readings (K, ny)."""
    functions, sampled = (
        Functions(system),
        SampledBlocks(system, trace.dt, held=trace.passes.simulator.intersample == "zoh"),
    )
    simulator = trace.passes.simulator
    u = sampled.inputs(trace.record.u[None], p[None], False)[0][0]
    n, t = len(x), trace.record.t
    held = u[:-1] if simulator.intersample == "zoh" else 0.5 * (u[:-1] + u[1:])
    each = _apart(n)
    starts, inputs, times = x[:-1:each], held[::each], t[:-1:each]
    step = functions.step(trace.dt / simulator.substeps, simulator.substeps).map(len(starts))
    after = step(starts.T, inputs.T, np.tile(p[:, None], len(starts)), times).full().T
    y = functions.output.map(n)(x.T, u.T, np.tile(p[:, None], n), t).full().T
    return after, sampled.outputs(y[None], None, p[None])[0][0]


def _apart(samples: int) -> int:
    """Return how many samples lie between those that are looked at."""
    return max(1, samples // LOOKED_AT)


def _ratio(part: Sequence[FloatArray], whole: Sequence[FloatArray]) -> float:
    """Return the largest rms of a column over that of the whole; 0 where nothing moves."""
    sizes = [_rms(np.concatenate(list(records))) for records in (part, whole)]
    return float(np.max(np.divide(sizes[0], sizes[1], out=np.zeros_like(sizes[0]), where=sizes[1] > 0), initial=0.0))


def _rms(values: FloatArray) -> FloatArray:
    """Return the rms of every column of what was measured; 0 where nothing was."""
    known = np.isfinite(values)
    squares = np.where(known, values, 0.0) ** 2
    return np.asarray(np.sqrt(squares.sum(axis=0) / np.maximum(known.sum(axis=0), 1)))
