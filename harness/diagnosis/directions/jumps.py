"""Where a latent force jumps: the instants at which something happened in a record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.stats import norm

from harness.diagnosis.directions.trace import Trace
from harness.diagnosis.effort import EFFORT
from harness.diagnosis.policy import Policy
from harness.diagnosis.search.fit import Jump
from harness.signals import FloatArray

_MEDIAN = float(norm.ppf(0.75))
"""Median of the absolute value of a normal variable over its standard deviation."""


def instants(traces: Sequence[Trace], port: str) -> list[float]:
    """Return the times at which a smoothed latent force changes fastest [s], the fastest of a port first.

    Of a force that remembers, the change from sample to sample is the smoothed disturbance that drives it: the
    auxiliary residual that shows a step (Harvey & Koopman 1992, *J. Business & Economic Statistics* 10:377, section 2).
    The columns of a score test need the instant within some tenths of a second: beside it, a force that remembers has
    taken the step up.

    - ``port``: where it acts; what acts elsewhere, on an input say, is looked for in all of them
    """
    trace = max(traces, key=lambda trace: len(trace.record))
    rows = [k for k, name in enumerate(trace.ports) if name == port] or list(range(trace.passes.nl))
    return [time for row in rows for time, _, _ in _fastest(trace, row)]


def jumps(traces: Mapping[str, Sequence[Trace]], force_scale: FloatArray, policy: Policy) -> list[Jump]:
    """Return the changes of latent forces that are too fast for what they are taken for, a Gauss-Markov process.

    - ``traces``: by use, a trace for each record
    - ``force_scale`` (nl,): the typical force of every port
    - ``policy``: says how many standard deviations are too fast
    """
    return [
        Jump(trace.ports[row], use, number, time, size, step / float(force_scale[row]))
        for use, parts in traces.items()
        for number, trace in enumerate(parts)
        for row in range(trace.passes.nl)
        for time, size, step in _fastest(trace, row)
        if size > policy.shaken
    ]


def _fastest(trace: Trace, row: int) -> list[tuple[float, float, float]]:
    """Return the fastest changes of a force: time [s], change over its standard deviation, and the step around it."""
    force = trace.x[:, trace.passes.start_size + row]
    change = np.abs(np.diff(force))
    usual = float(np.median(change)) / _MEDIAN if len(change) else 0.0
    apart = max(len(change) // EFFORT.instants, 1)
    found = []
    for _ in range(EFFORT.lines):
        k = int(np.argmax(change)) if len(change) else 0
        if not len(change) or change[k] <= 0.0:
            break
        step = float(np.ptp(force[max(k - apart // 2, 0) : k + apart // 2 + 2]))
        found.append((float(trace.record.t[k + 1]), float(change[k]) / max(usual, 1e-300), step))
        change[max(k - apart, 0) : k + apart + 1] = 0.0
    return found
