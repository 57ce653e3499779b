"""Effects that act on samples: delays and rounding, as filters of a whole record and sample by sample."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from harness.signals import FloatArray


def delay(values: FloatArray, tau: float, dt: float) -> FloatArray:
    """Return a sampled signal, delayed.

    A delay of d whole samples and a fraction f blends neighbours: ``(1 - f) x[k - d] + f x[k - d - 1]``. For a held
    input that is the mean over one sample of the delayed input; for an output it is linear interpolation.

    Parameters
    ----------
    values : array (N,) or (N, n)
        Time is the first axis; the first value holds before the record.
    tau : float
        Delay [s], not negative.
    dt : float
        Sample time [s].

    Examples
    --------
    >>> delay(np.array([0.0, 1.0, 2.0, 3.0]), 1.5, 1.0).tolist()
    [0.0, 0.0, 0.5, 1.5]
    """
    x = np.asarray(values, dtype=float)
    whole, fraction = _split(tau, dt)
    rows = np.arange(x.shape[0])
    newer, older = x[np.maximum(rows - whole, 0)], x[np.maximum(rows - whole - 1, 0)]
    return np.asarray((1.0 - fraction) * newer + fraction * older)


def _split(tau: float, dt: float) -> tuple[int, float]:
    """Return a delay as whole samples and a fraction; a rounding error short of a whole sample counts as whole."""
    samples = max(tau, 0.0) / dt
    whole = int(np.floor(samples + 1e-9))
    return whole, float(max(samples - whole, 0.0))


def quantise(values: FloatArray | float, step: float) -> FloatArray:
    """Return values rounded to multiples of a step; unchanged where the step is 0.

    Examples
    --------
    >>> quantise(np.array([0.26, -0.1]), 0.25).tolist()
    [0.25, -0.0]
    """
    x = np.asarray(values, dtype=float)
    return x if step == 0 else np.asarray(step * np.round(x / step))


@dataclass
class DelayLine:
    """The same delay, sample by sample.

    Parameters
    ----------
    tau, dt : float
        Delay and sample time [s].

    Examples
    --------
    >>> line = DelayLine(1.5, 1.0)
    >>> [line.step(x) for x in (0.0, 1.0, 2.0, 3.0)]
    [0.0, 0.0, 0.5, 1.5]
    """

    tau: float
    dt: float
    _past: list[float] = field(default_factory=list)

    def reset(self) -> None:
        """Forget the past."""
        self._past = []

    def peek(self, x: float) -> float:
        """Return the output of :meth:`step` without remembering ``x``."""
        past = self._past or [x]
        whole, fraction = _split(self.tau, self.dt)
        line = [*past, x] if self._past else [x]
        newer = line[max(len(line) - 1 - whole, 0)]
        older = line[max(len(line) - 2 - whole, 0)]
        return (1.0 - fraction) * newer + fraction * older

    def step(self, x: float) -> float:
        """Take the next sample in and return the delayed one."""
        delayed = self.peek(x)
        whole, _ = _split(self.tau, self.dt)
        self._past = [*self._past, x][-(whole + 1) :]
        return delayed

    def get_state(self) -> tuple[float, ...]:
        """Return the samples on the line."""
        return tuple(self._past)

    def set_state(self, state: tuple[float, ...]) -> None:
        """Hold what it held."""
        self._past = list(state)
