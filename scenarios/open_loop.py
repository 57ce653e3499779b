"""Open-loop scenarios: the input is decided before the run starts.

Levels: ``amplitude`` is in the unit of each input; ``relative_amplitude`` is a fraction of half the width of its
limits. With neither, an input with limits gets the fraction that the scenario's docstring states, and an input
without limits gets 1 in its own unit. The signal is centred on ``offset``, by default the middle of the limits, or 0.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from harness.errors import InputError
from harness.protocols import Experiment
from harness.rng import Streams
from harness.signals import Channel, FloatArray, PlantSpec
from scenarios import signals
from scenarios.conditions import Conditions, half_range
from scenarios.noise import PerChannel, not_negative, per_channel


@dataclass(frozen=True, kw_only=True)
class OpenLoop(Conditions, ABC):
    """Options of the scenarios that scale a signal; see :class:`scenarios.conditions.Conditions` for the others.

    Parameters
    ----------
    amplitude : float or mapping, optional
        Peak (rms for filtered noise) in the unit of each input; a mapping goes by name, others rest. Default: a
        fraction of the limits (see each scenario), or 1 in the input's own unit where it has no limits.
    relative_amplitude : float or mapping, optional
        The same as a fraction of half the width of the input's limits.
    offset : float or mapping, optional
        Centre of the signal; the middle of the limits, or 0, where it is not given.
    """

    amplitude: PerChannel | None = None
    relative_amplitude: PerChannel | None = None
    offset: PerChannel | None = None

    default_fraction: ClassVar[float] = 0.5
    default_amplitude: ClassVar[float] = 1.0
    clips: ClassVar[bool] = False

    @abstractmethod
    def shapes(self, n: int, spec: PlantSpec, *, rng: np.random.Generator) -> FloatArray:
        """Return the signals (n, nu) before they are scaled."""

    def prepare(self, spec: PlantSpec, *, streams: Streams, role: str) -> Experiment:
        """Return the experiment of one role; raises InputError if the scenario does not fit the plant."""
        wrong = [channel for channel in spec.inputs if channel.kind != "real"]
        if wrong or not spec.inputs:
            raise InputError(
                f"{type(self).__name__} does not fit the plant",
                expected="real inputs",
                got=f"{wrong[0].kind} input {wrong[0].name!r}" if wrong else "a plant without inputs",
                remedy="use random-policy" if wrong else "use free-swing",
            )
        amplitude, offset = self._levels(spec)
        raw = self.shapes(self.length(spec), spec, rng=streams(f"{role}/excitation"))
        excitation = offset + amplitude * raw
        low = np.array([channel.minimum for channel in spec.inputs])
        high = np.array([channel.maximum for channel in spec.inputs])
        if self.clips:
            excitation = np.clip(excitation, low, high)
        return self.experiment(spec, excitation, streams=streams, role=role)

    def _levels(self, spec: PlantSpec) -> tuple[FloatArray, FloatArray]:
        """Return amplitude and offset of each input (nu,), refusing what the limits do not allow."""
        if self.amplitude is not None and self.relative_amplitude is not None:
            raise InputError(
                "amplitude",
                expected="amplitude or relative_amplitude",
                got="both",
                remedy="give one of the two",
                place="amplitude",
            )
        ranges = [half_range(channel) for channel in spec.inputs]
        middle = np.array([0.0 if limits is None else limits[0] for limits in ranges])
        if self.amplitude is not None:
            given = per_channel(self.amplitude, spec.inputs, "amplitude")
            amplitude = not_negative(given, spec.inputs, "amplitude", real=False)
        else:
            fraction = self.default_fraction if self.relative_amplitude is None else self.relative_amplitude
            given = per_channel(fraction, spec.inputs, "relative_amplitude")
            fractions = not_negative(given, spec.inputs, "relative_amplitude", real=False)
            free = [c for c, limits, f in zip(spec.inputs, ranges, fractions, strict=True) if limits is None and f]
            if free and self.relative_amplitude is not None:
                raise _no_limits(free[0])
            pairs = zip(fractions, ranges, strict=True)
            amplitude = np.array([self.default_amplitude if r is None else f * r[1] for f, r in pairs])
        offset = middle
        if self.offset is not None:
            given = per_channel(self.offset, spec.inputs, "offset", default=math.nan)
            offset = np.where(np.isnan(given), middle, given)
        for channel, size, centre in zip(spec.inputs, amplitude, offset, strict=True):
            slack = 1e-12 * max(1.0, abs(centre) + abs(size))
            reach = 0.0 if self.clips else abs(size)
            if centre - reach < channel.minimum - slack or centre + reach > channel.maximum + slack:
                raise InputError(
                    f"amplitude of input {channel.name!r}",
                    expected=f"values within [{channel.minimum:g}, {channel.maximum:g}] {channel.unit}",
                    got=f"{centre:g} -+ {reach:g} {channel.unit}",
                    remedy="lower the amplitude or move the offset",
                    place="amplitude",
                )
        return amplitude, offset


@dataclass(frozen=True, kw_only=True)
class Multisine(OpenLoop):
    """Random-phase multisine: equal amplitudes on chosen lines, exact periods, new phases for each run.

    With no amplitude given, the peak is half of what the input's limits allow (1 in its unit if it has none).
    Other options: ``OpenLoop`` and ``Conditions``.

    Parameters
    ----------
    band : (low, high), optional
        Hz; by default from the first line to a twentieth of the sampling frequency.
    periods : int
        Periods in a run; the number of samples must be a multiple of it.
    grid : {"full", "odd"}
        All lines of the band, or the odd ones.
    crest : float, optional
        Crest factor wanted.
    zippered : bool
        With several inputs, deal the lines out in turn, so that the inputs are orthogonal over a period.

    Examples
    --------
    >>> spec = PlantSpec((Channel("u", "N m", -2.0, 2.0),), (Channel("theta", "rad"),), 0.01)
    >>> made = Multisine(samples=400, periods=2).prepare(spec, streams=Streams("p", "s", 0), role="estimation/0")
    >>> made.excitation.shape, float(np.abs(made.excitation).max())
    ((400, 1), 1.0)
    """

    band: tuple[float, float] | None = None
    periods: int = 1
    grid: Literal["full", "odd"] = "full"
    crest: float | None = None
    zippered: bool = False

    def shapes(self, n: int, spec: PlantSpec, *, rng: np.random.Generator) -> FloatArray:
        """Return the signals (n, nu)."""
        if self.periods < 1 or n % self.periods:
            raise InputError(
                "periods of a multisine",
                expected="a number that divides the samples of a run",
                got=f"{self.periods} periods in {n} samples",
                remedy="change samples, duration or periods",
                place="periods",
            )
        period = n // self.periods
        band = _band(self.band, (1 / (period * spec.sample_time), 0.05 / spec.sample_time))
        lines = signals.lines_of_band(period, spec.sample_time, band, self.grid)
        columns = []
        for i in range(spec.nu):
            own = lines[i :: spec.nu] if self.zippered else lines
            columns.append(signals.multisine(n, period, own, rng=rng, crest=self.crest))
        return np.column_stack(columns)


@dataclass(frozen=True, kw_only=True)
class Prbs(OpenLoop):
    """Pseudo-random binary sequence of maximal length; each run starts elsewhere in it.

    With no amplitude given, the levels are half of what the input's limits allow (1 in its unit if it has none).
    With several inputs each takes the same sequence, shifted by an equal part of its period.
    Other options: ``OpenLoop`` and ``Conditions``.

    Parameters
    ----------
    order : int, optional
        Bits of the shift register, 2 to 32; by default the least (from 5 up) that does not repeat within a run.
    hold : int
        Samples that each bit is held.

    Examples
    --------
    >>> spec = PlantSpec((Channel("u", "V", -1.0, 1.0),), (Channel("y", "V"),), 0.1)
    >>> made = Prbs(samples=50).prepare(spec, streams=Streams("p", "s", 0), role="estimation/0")
    >>> np.unique(made.excitation).tolist()
    [-0.5, 0.5]
    """

    order: int | None = None
    hold: int = 5

    def shapes(self, n: int, spec: PlantSpec, *, rng: np.random.Generator) -> FloatArray:
        """Return the signals (n, nu)."""
        order = self.order
        if order is None:
            order = max(5, math.ceil(math.log2(n / max(self.hold, 1) + 1)))
        period = 2**order - 1
        if order > 20:  # far too long to walk to a shifted start: independent starts are as good
            return np.column_stack([signals.prbs(n, order, rng=rng, hold=self.hold) for _ in spec.inputs])
        start = int(rng.integers(1, 2**31))
        columns = []
        for i in range(spec.nu):
            own = np.random.default_rng(start)
            columns.append(signals.prbs(n, order, rng=own, hold=self.hold, shift=i * period // spec.nu))
        return np.column_stack(columns)


@dataclass(frozen=True, kw_only=True)
class Chirp(OpenLoop):
    """Swept sine over the whole run, with a new starting phase for each run.

    With no amplitude given, the peak is half of what the input's limits allow (1 in its unit if it has none).
    With several inputs the sweeps are rotated by equal parts of the run.
    Other options: ``OpenLoop`` and ``Conditions``.

    Parameters
    ----------
    band : (first, last), optional
        Hz; by default from one cycle a run to a twentieth of the sampling frequency.
    law : {"linear", "logarithmic"}
        How the frequency moves.

    Examples
    --------
    >>> spec = PlantSpec((Channel("u", "V", -1.0, 1.0),), (Channel("y", "V"),), 0.1)
    >>> Chirp(samples=50).prepare(spec, streams=Streams("p", "s", 0), role="estimation/0").excitation.shape
    (50, 1)
    """

    band: tuple[float, float] | None = None
    law: Literal["linear", "logarithmic"] = "linear"

    def shapes(self, n: int, spec: PlantSpec, *, rng: np.random.Generator) -> FloatArray:
        """Return the signals (n, nu)."""
        dt = spec.sample_time
        band = _band(self.band, (1 / (n * dt), 0.05 / dt))
        phases = rng.uniform(0, 2 * np.pi, spec.nu)
        return np.column_stack(
            [
                signals.chirp(n, dt, band, law=self.law, phase=float(phases[i]), rotate=i / spec.nu)
                for i in range(spec.nu)
            ]
        )


@dataclass(frozen=True, kw_only=True)
class Steps(OpenLoop):
    """Steps between random levels, or an even staircase up and down.

    With no amplitude given, the levels span half of what the input's limits allow. Other options: ``OpenLoop`` and
    ``Conditions``.

    Parameters
    ----------
    dwell : float, optional
        Mean time on a level [s]; by default a twentieth of the run.
    levels : int, optional
        Number of equidistant levels; by default uniform random levels (9 for a staircase).
    order : {"random", "staircase"}
        Random levels held for random times, or all levels in turn, up and down, once over the run.

    Examples
    --------
    >>> spec = PlantSpec((Channel("u", "V", 0.0, 10.0),), (Channel("y", "V"),), 0.1)
    >>> made = Steps(samples=60, order="staircase", levels=3).prepare(spec, streams=Streams("p", "s", 0), role="test/0")
    >>> np.unique(made.excitation).tolist()
    [2.5, 5.0, 7.5]
    """

    dwell: float | None = None
    levels: int | None = None
    order: Literal["random", "staircase"] = "random"

    def shapes(self, n: int, spec: PlantSpec, *, rng: np.random.Generator) -> FloatArray:
        """Return the signals (n, nu)."""
        if self.order == "staircase":
            one = signals.staircase(n, 9 if self.levels is None else self.levels)
            return np.column_stack([np.roll(one, i * n // spec.nu) for i in range(spec.nu)])
        if self.order != "random":
            raise InputError(
                "order of the steps",
                expected="random or staircase",
                got=repr(self.order),
                remedy="correct the word",
                place="order",
            )
        dwell = max(1, n // 20 if self.dwell is None else round(self.dwell / spec.sample_time))
        return np.column_stack([signals.steps(n, dwell, rng=rng, levels=self.levels) for _ in spec.inputs])


@dataclass(frozen=True, kw_only=True)
class FilteredNoise(OpenLoop):
    """Gaussian noise limited to a band, stationary from the first sample.

    Here ``amplitude`` is the rms. With none given it is a quarter of half the width of the input's limits; values
    beyond the limits are clipped (1 in 16000 at that level). Other options: ``OpenLoop`` and ``Conditions``.

    Parameters
    ----------
    band : (low, high), optional
        Hz; by default up to a twentieth of the sampling frequency.

    Examples
    --------
    >>> spec = PlantSpec((Channel("u", "V"),), (Channel("y", "V"),), 0.1)
    >>> made = FilteredNoise(samples=50, amplitude=1.0).prepare(spec, streams=Streams("p", "s", 0), role="test/0")
    >>> made.excitation.shape
    (50, 1)
    """

    band: tuple[float, float] | None = None

    default_fraction: ClassVar[float] = 0.25
    clips: ClassVar[bool] = True

    def shapes(self, n: int, spec: PlantSpec, *, rng: np.random.Generator) -> FloatArray:
        """Return the signals (n, nu)."""
        band = _band(self.band, (0.0, 0.05 / spec.sample_time))
        return np.column_stack([signals.band_noise(n, spec.sample_time, band, rng=rng) for _ in spec.inputs])


@dataclass(frozen=True, kw_only=True)
class FreeSwing(Conditions):
    """No input at all: the plant moves from its initial state.

    Inputs rest at 0. A state that ``x0`` does not name starts at a value drawn uniformly within -+ ``spread``, in the
    state's own unit, where the plant names its states; where it names none, ``x0`` must be given.

    Parameters
    ----------
    spread : float
        Half width of the draw; 0 leaves the plant's own start.

    Examples
    --------
    >>> spec = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"),), 0.01)
    >>> FreeSwing(x0={"theta": 1.0}).prepare(spec, streams=Streams("p", "s", 0), role="test/0").x0
    {'theta': 1.0}
    """

    spread: float = 0.5

    def prepare(self, spec: PlantSpec, *, streams: Streams, role: str) -> Experiment:
        """Return the experiment of one role."""
        if not spec.states and not self.x0 and self.spread:
            raise InputError(
                "free swing from an unknown state",
                expected="initial values x0, or a plant that names its states",
                got="neither",
                remedy="give x0 = {name = value}",
                place="x0",
            )
        rng = streams(f"{role}/spread")
        start = {state.name: float(rng.uniform(-self.spread, self.spread)) for state in spec.states if self.spread}
        excitation = np.zeros((self.length(spec), spec.nu))
        return self.experiment(spec, excitation, streams=streams, role=role, x0=start)


@dataclass(frozen=True, kw_only=True)
class RandomPolicy(Conditions):
    """Uniformly random actions for category, integer and boolean inputs.

    Without ``samples`` or ``duration`` a run has 2000 samples.

    Examples
    --------
    >>> spec = PlantSpec((Channel("action", maximum=3, minimum=0, kind="category"),), (Channel("cell"),), 1.0)
    >>> made = RandomPolicy(samples=100).prepare(spec, streams=Streams("p", "s", 0), role="test/0")
    >>> np.unique(made.excitation).tolist()
    [0.0, 1.0, 2.0, 3.0]
    """

    def prepare(self, spec: PlantSpec, *, streams: Streams, role: str) -> Experiment:
        """Return the experiment of one role."""
        unfit = [c for c in spec.inputs if c.kind == "real" or (c.kind == "integer" and half_range(c) is None)]
        if unfit or not spec.inputs:
            raise InputError(
                "random policy does not fit the plant",
                expected="category, boolean or bounded integer inputs",
                got=f"{unfit[0].kind} input {unfit[0].name!r}" if unfit else "no input",
                remedy="use multisine, prbs or steps for real inputs",
            )
        n = self.length(spec) if self.samples or self.duration else 2000
        rng = streams(f"{role}/excitation")
        columns = [rng.integers(*_choices(channel), size=n, endpoint=True) for channel in spec.inputs]
        return self.experiment(spec, np.column_stack(columns).astype(float), streams=streams, role=role)


def _band(given: tuple[float, float] | None, default: tuple[float, float]) -> tuple[float, float]:
    """Return the band given, or the default, refusing what is no pair of numbers."""
    if given is None:
        return default
    pair = tuple(given)
    if len(pair) != 2 or not all(isinstance(f, int | float) and 0 <= f < math.inf for f in pair):
        raise InputError("band", expected="[low, high] in Hz", got=repr(given), remedy="correct it", place="band")
    return float(pair[0]), float(pair[1])


def _choices(channel: Channel) -> tuple[int, int]:
    """Return the least and the greatest value of a discrete channel."""
    if channel.kind == "boolean":
        return 0, 1
    low = 0 if channel.kind == "category" and not math.isfinite(channel.minimum) else math.ceil(channel.minimum)
    return low, math.floor(channel.maximum)


def _no_limits(channel: Channel) -> InputError:
    """Return the refusal of an input whose range nobody stated."""
    return InputError(
        f"amplitude of input {channel.name!r}",
        expected="declared limits that relative_amplitude can refer to",
        got="none",
        remedy=f"give amplitude in {channel.unit} instead, e.g. amplitude = {{{channel.name} = 1.0}}",
        place="relative_amplitude",
    )
