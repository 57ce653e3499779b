"""The triangle scenario: slow motion through standstill, at one amplitude or at several."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.errors import InputError
from harness.signals import FloatArray, PlantSpec
from scenarios.open_loop import OpenLoop


def triangle(n: int, sample_time: float, frequency: float, *, levels: int = 1, start: float = 0.0) -> FloatArray:
    """Return a triangle wave within [-1, 1] whose amplitude climbs in equal steps over the record.

    Raises InputError if the frequency is not above 0 and at most an eighth of the sampling frequency, or there is no
    level.

    - ``n, sample_time``: samples, and seconds between them
    - ``frequency``: hz
    - ``levels``: amplitudes 1/levels, 2/levels, ... 1, each for an equal part of the record; they change at a zero
      crossing.
    - ``start``: part of a period by which the wave is ahead; at 0 it starts at 0 and rises

    Examples
    --------
    >>> np.round(triangle(9, 1.0, 0.125), 12).tolist()
    [0.0, 0.5, 1.0, 0.5, 0.0, -0.5, -1.0, -0.5, 0.0]
    >>> float(np.abs(triangle(16, 1.0, 0.125, levels=2)[:8]).max())
    0.5
    """
    if not 0 < frequency <= 0.125 / sample_time or levels < 1:
        raise InputError(
            "triangle",
            expected=f"a frequency above 0 and at most {0.125 / sample_time:g} Hz, levels >= 1",
            got=f"{frequency:g} Hz, {levels} levels",
            remedy="correct the option",
        )
    phase = np.arange(n) * sample_time * frequency + start
    wave = np.abs((4 * phase - 1) % 4 - 2) - 1
    # half periods: each has one amplitude, so that it never jumps
    half = np.floor(2 * phase) - np.floor(2 * start)
    count = max(float(half[-1]) + 1, 1.0)
    level = np.minimum(np.floor(half / count * levels), levels - 1) + 1
    return np.asarray(wave * level / levels, dtype=float)


@dataclass(frozen=True, kw_only=True)
class Triangle(OpenLoop):
    """Slow triangle, at one amplitude or at several in turn: through standstill, and back over the same path.

    Each run starts elsewhere in the period. With no amplitude given, the peak is half of what the input's limits allow
    (1 in its unit if it has none). With several inputs they are apart by equal parts of a period. Other options:
    ``OpenLoop`` and ``Conditions``.

    Parameters
    ----------
    frequency : float, optional
        Hz; by default ten periods a run.
    levels : int
        Amplitudes: with 3 a third, two thirds and all of the peak, each for a third of the run.

    Examples
    --------
    >>> from harness.rng import Streams
    >>> from harness.signals import Channel
    >>> spec = PlantSpec((Channel("u", "N m", -2.0, 2.0),), (Channel("theta", "rad"),), 0.01)
    >>> made = Triangle(samples=400, levels=2).prepare(spec, streams=Streams("p", "s", 0), role="estimation/0")
    >>> bool(np.abs(made.excitation[:200]).max() <= 0.5), bool(np.abs(made.excitation).max() > 0.9)
    (True, True)
    """

    frequency: float | None = None
    levels: int = 1

    def shapes(self, n: int, spec: PlantSpec, *, rng: np.random.Generator) -> FloatArray:
        """Return the signals (n, nu)."""
        frequency = 10 / (n * spec.sample_time) if self.frequency is None else self.frequency
        start = float(rng.uniform())
        return np.column_stack(
            [
                triangle(n, spec.sample_time, frequency, levels=self.levels, start=start + i / spec.nu)
                for i in range(spec.nu)
            ]
        )
