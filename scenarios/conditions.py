"""What every scenario has: length of a run, sensors, process noise, initial state."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from harness.errors import InputError
from harness.protocols import Controller, Experiment
from harness.rng import Streams
from harness.signals import Channel, FloatArray, PlantSpec
from scenarios.noise import PerChannel, process_disturbance, sensor

Initial = Mapping[str, float | Sequence[float]]
"""Initial states by name: a number, or ``[low, high]`` to draw it anew for each run."""


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """Options that all scenarios share.

    Parameters
    ----------
    samples : int, optional
        Length of a run; or give ``duration``. Without either a run has 20 s.
    duration : float, optional
        Length of a run [s], rounded to whole samples.
    noise : float or mapping, optional
        Standard deviation of white sensor noise, in the unit of each output; a mapping goes by output name.
    quantisation : float or mapping, optional
        Step of the sensor, in the unit of each output.
    process_noise : float or mapping, optional
        Standard deviation of noise that enters with the inputs unrecorded, in the unit of each input.
    process_noise_ratio : float or mapping, optional
        The same, relative to the standard deviation of the excitation.
    process_noise_bandwidth : float, optional
        Corner frequency [Hz] of the process noise (first order, stationary); white without it.
    x0 : mapping, optional
        Initial states by name: a number, or ``[low, high]``, drawn uniformly anew for each run.
    """

    samples: int | None = None
    duration: float | None = None
    noise: PerChannel | None = None
    quantisation: PerChannel | None = None
    process_noise: PerChannel | None = None
    process_noise_ratio: PerChannel | None = None
    process_noise_bandwidth: float | None = None
    x0: Initial | None = None

    def __post_init__(self) -> None:
        if self.samples is not None and self.duration is not None:
            raise InputError(
                "length of a run",
                expected="samples or duration",
                got=f"samples {self.samples} and duration {self.duration}",
                remedy="give one of the two",
            )
        too_short = self.samples is not None and (not isinstance(self.samples, int) or self.samples < 2)
        if too_short or (self.duration is not None and not 0 < self.duration < math.inf):
            raise InputError(
                "length of a run",
                expected="at least 2 samples, or a positive duration in s",
                got=f"samples {self.samples}, duration {self.duration}",
                remedy="correct the option",
            )

    def length(self, spec: PlantSpec) -> int:
        """Return the samples of a run of a plant with this sample time."""
        if self.samples is not None:
            return self.samples
        return max(2, round((20.0 if self.duration is None else self.duration) / spec.sample_time))

    def experiment(
        self,
        spec: PlantSpec,
        excitation: FloatArray,
        *,
        streams: Streams,
        role: str,
        controller: Controller | None = None,
        x0: Mapping[str, float] | None = None,
    ) -> Experiment:
        """Return the experiment of this excitation (N, nu) with the sensors, noise and initial state drawn.

        ``x0`` is what the scenario itself wants where the user gave nothing for that state.
        """
        measure = sensor(
            spec,
            excitation.shape[0],
            noise=self.noise,
            quantisation=self.quantisation,
            rng=streams(f"{role}/noise"),
        )
        disturbance = process_disturbance(
            spec,
            excitation,
            rms=self.process_noise,
            ratio=self.process_noise_ratio,
            bandwidth=self.process_noise_bandwidth,
            rng=streams(f"{role}/process"),
        )
        start = {**(x0 or {}), **draw_initial(self.x0 or {}, streams(f"{role}/x0"))}
        common = {"controller": controller, "disturbance": disturbance, "x0": start or None}
        if measure is None:
            return Experiment(excitation, **common)  # type: ignore[arg-type]
        return Experiment(excitation, measure=measure, **common)  # type: ignore[arg-type]


def draw_initial(x0: Initial, rng: np.random.Generator) -> dict[str, float]:
    """Return initial states by name, drawing those that are given as a range.

    Raises InputError if a value is neither a number nor ``[low, high]``.

    Examples
    --------
    >>> draw_initial({"theta": 1.0}, np.random.default_rng(0))
    {'theta': 1.0}
    """
    drawn = {}
    for name in sorted(x0):
        value = x0[name]
        ends = [value, value] if isinstance(value, int | float) else list(value)
        if len(ends) != 2 or not all(isinstance(end, int | float) and math.isfinite(end) for end in ends):
            raise InputError(
                f"initial value of {name!r}",
                expected="a number, or [low, high]",
                got=repr(value),
                remedy="correct the option x0",
                place=f"x0.{name}",
            )
        drawn[name] = float(ends[0]) if ends[0] == ends[1] else float(rng.uniform(min(ends), max(ends)))
    return drawn


def half_range(channel: Channel) -> tuple[float, float] | None:
    """Return the middle and half the width of a channel's limits, or None where it has none.

    Examples
    --------
    >>> half_range(Channel("u", "V", 0.0, 10.0)), half_range(Channel("u", "V"))
    ((5.0, 5.0), None)
    """
    if not (math.isfinite(channel.minimum) and math.isfinite(channel.maximum)):
        return None
    return 0.5 * (channel.minimum + channel.maximum), 0.5 * (channel.maximum - channel.minimum)
