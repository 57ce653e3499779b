"""Noise as composable parts of an experiment: sensors (white noise, quantisation) and process noise (coloured)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from harness.errors import InputError, refuse_unknown
from harness.signals import Channel, FloatArray, PlantSpec

PerChannel = float | Mapping[str, float]
"""One number for every channel, in the channel's own unit, or numbers by channel name (others: none)."""


def per_channel(
    value: PerChannel | None, channels: tuple[Channel, ...], option: str, *, default: float = 0.0
) -> FloatArray:
    """Return one number for each channel.

    Raises InputError if a name is unknown or a value is no finite number.

    - ``value``: one number for all, or numbers by name; a channel that is not named gets ``default``
    - ``channels``: in order
    - ``option``: name of the option, for the message
    - ``default``: for channels that are not named
    - returns (len(channels),)

    Examples
    --------
    >>> per_channel({"b": 2.0}, (Channel("a"), Channel("b")), "noise").tolist()
    [0.0, 2.0]
    """
    names = [channel.name for channel in channels]
    given: Mapping[str, object]
    if value is None:
        given = {}
    elif isinstance(value, Mapping):
        given = value
    else:
        given = dict.fromkeys(names, value)
    refuse_unknown(f"channel in option {option!r}", given, names, place=option)
    for number in given.values():
        if isinstance(number, bool) or not isinstance(number, int | float) or not math.isfinite(number):
            raise InputError(
                f"option {option!r}",
                expected="a finite number, or one by channel name",
                got=repr(number),
                remedy="correct the value",
                place=option,
            )
    return np.array([float(given.get(name, default)) for name in names])  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class Sensor:
    """What the sensors make of the outputs of one run: noise is added first, then the value is rounded.

    Examples
    --------
    >>> Sensor(np.zeros((1, 2)), np.array([0.0, 0.5]))(0, np.array([1.3, 1.3])).tolist()
    [1.3, 1.5]
    """

    noise: FloatArray  # (N, ny): Drawn beforehand, so that measuring a sample twice gives the same value
    resolution: FloatArray  # (ny,): Width of a quantisation step; 0 where there is none

    def __call__(self, k: int, y: FloatArray) -> FloatArray:
        """Return the measured output (ny,) at sample k."""
        measured = np.asarray(y, dtype=float) + self.noise[k]
        width = np.where(self.resolution > 0, self.resolution, 1.0)
        return np.asarray(np.where(self.resolution > 0, np.round(measured / width) * width, measured), dtype=float)


def sensor(
    spec: PlantSpec,
    n: int,
    *,
    noise: PerChannel | None = None,
    quantisation: PerChannel | None = None,
    rng: np.random.Generator,
) -> Sensor | None:
    """Return the sensors of a run, or None where they are perfect.

    Parameters
    ----------
    spec : PlantSpec
        Whose outputs are measured.
    n : int
        Samples.
    noise : float or mapping, optional
        Standard deviation of white Gaussian noise, in the unit of each output.
    quantisation : float or mapping, optional
        Width of a step, in the unit of each output.
    rng : numpy.random.Generator
        Draws the noise.

    Raises
    ------
    InputError
        If a value is negative, a name unknown, or an output is a category.

    Examples
    --------
    >>> spec = PlantSpec((), (Channel("q", "m"),), 0.1)
    >>> sensor(spec, 10, rng=np.random.default_rng(0)) is None
    True
    """
    deviations = not_negative(per_channel(noise, spec.outputs, "noise"), spec.outputs, "noise")
    widths = not_negative(per_channel(quantisation, spec.outputs, "quantisation"), spec.outputs, "quantisation")
    if not deviations.any() and not widths.any():
        return None
    return Sensor(rng.standard_normal((n, spec.ny)) * deviations, widths)


def coloured_noise(n: int, sample_time: float, bandwidth: float | None, *, rng: np.random.Generator) -> FloatArray:
    """Return Gaussian first-order noise of standard deviation one, stationary from the first sample.

    Raises InputError if the bandwidth is not positive.

    - ``n, sample_time``: samples, and seconds between them
    - ``bandwidth``: corner frequency [Hz] of the first-order spectrum; None is white
    - ``rng``: draws it
    - returns (n,): AR(1) with pole ``a = exp(-2 pi bandwidth dt)``; its autocorrelation is ``a**lag``

    Examples
    --------
    >>> w = coloured_noise(20000, 0.01, 1.0, rng=np.random.default_rng(0))
    >>> bool(abs(np.corrcoef(w[1:], w[:-1])[0, 1] - np.exp(-2 * np.pi * 0.01)) < 0.01)
    True
    """
    white = rng.standard_normal(n)
    if bandwidth is None:
        return white
    if not bandwidth > 0:
        raise InputError(
            "bandwidth of the process noise",
            expected="a positive frequency in Hz, or none for white noise",
            got=repr(bandwidth),
            remedy="correct the option process_noise_bandwidth",
        )
    pole = math.exp(-2 * math.pi * bandwidth * sample_time)
    drive = math.sqrt(1 - pole * pole) * white
    drive[0] = white[0]
    return np.fromiter(itertools.accumulate(drive.tolist(), lambda state, new: pole * state + new), float, n)


def process_disturbance(
    spec: PlantSpec,
    excitation: FloatArray,
    *,
    rms: PerChannel | None = None,
    ratio: PerChannel | None = None,
    bandwidth: float | None = None,
    rng: np.random.Generator,
) -> FloatArray | None:
    """Return noise that enters with the inputs and is never recorded, or None where there is none.

    Raises InputError if a value is negative, a name unknown, an input not real, or a ratio is given to an input at
    rest.

    - ``spec``: whose inputs are disturbed
    - ``excitation`` (N, nu): the known part of the input; ``ratio`` refers to its rms about its mean
    - ``rms``: standard deviation in the unit of each input
    - ``ratio``: standard deviation relative to the excitation's; adds to ``rms`` in squares
    - ``bandwidth``: corner frequency [Hz] of the first-order spectrum; white without it
    - ``rng``: draws it
    - returns (N, nu) or None
    """
    absolute = not_negative(per_channel(rms, spec.inputs, "process_noise"), spec.inputs, "process_noise")
    relative = not_negative(per_channel(ratio, spec.inputs, "process_noise_ratio"), spec.inputs, "process_noise_ratio")
    if not absolute.any() and not relative.any():
        return None
    level = excitation.std(axis=0)
    still = [c.name for c, part, own in zip(spec.inputs, relative, level, strict=True) if part > 0 and own == 0]
    if still:
        raise InputError(
            "process noise relative to an input at rest",
            expected="an excitation that moves",
            got=f"no excitation of {', '.join(still)}",
            remedy="give process_noise in the input's unit instead of process_noise_ratio",
            place="process_noise_ratio",
        )
    n = excitation.shape[0]
    draws = np.column_stack([coloured_noise(n, spec.sample_time, bandwidth, rng=rng) for _ in spec.inputs])
    return np.asarray(draws * np.sqrt(absolute**2 + (relative * level) ** 2), dtype=float)


def not_negative(values: FloatArray, channels: tuple[Channel, ...], option: str, *, real: bool = True) -> FloatArray:
    """Return the values, refusing a negative one, and (``real``) any at all on a channel that is not real."""
    for channel, value in zip(channels, values, strict=True):
        if value < 0 or (real and value > 0 and channel.kind != "real"):
            raise InputError(
                f"option {option!r} for channel {channel.name!r}",
                expected="zero or a positive number" if value < 0 else f"none on a {channel.kind} channel",
                got=f"{value:g}",
                remedy="correct or remove it",
                place=option,
            )
    return values
