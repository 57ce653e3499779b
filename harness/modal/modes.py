"""Modes of a structure from its records: orders fitted, stable poles kept, each with what the records say of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from harness.errors import FitError, InputError
from harness.judgement import feedback_of
from harness.modal.fits import fitted, jackknifed
from harness.modal.poles import ComplexArray, Mode, Pole, mac, poles_of
from harness.modal.result import LEVEL, STRONG, VAGUE, Modes, Undetermined
from harness.modal.stabilisation import Criteria, Track, tracks_of
from harness.modal.subspace import FEWEST, Ladder, ladder_of
from harness.signals import FloatArray, PlantSpec, Trajectory

FAINT = 1e-3
"""Power of an input at a frequency, over its largest, below which the input does not count as exciting there."""
TONE = 5e-4
"""Damping ratio below which a mode without input is taken for a steady tone: no structure has so little."""


def notes_of(
    records: Sequence[Trajectory], shown: Ladder, identifier: str | None, passing: int, modes: Sequence[Mode]
) -> list[str]:
    """Return sentences on inputs, lengths and modes that the records leave undetermined.

    - ``shown``: of the records
    - ``identifier``: None for the subspace fit of this room
    - ``passing``: rows of poles that are no modes
    """
    spec = records[0].spec
    notes = []
    if len({channel.unit for channel in spec.outputs}) > 1:
        notes.append("the outputs have several units: shapes are over the standard deviation of each")
    if identifier is None and not shown.known:
        notes.append(
            f"no intervals: the records make {len(shown.shifted)} stretches of several windows, fewer than "
            f"{FEWEST + 1}; record longer, or give a smaller window"
        )
    if identifier is not None:
        notes.append(
            "the intervals hold what chance does to this identifier, not what it leaves out: dmdc takes noise of the "
            "outputs for motion"
        )
    if identifier is not None and any(not np.isfinite(mode.pole.frequency_deviation) for mode in modes):
        notes.append("a mode without an interval was not found again when a stretch was left out")
    if spec.nu:
        low, high = _excited(records)
        notes.append(
            f"the inputs hold power from {low:.3g} to {high:.3g} Hz: a mode outside, or one that no input reaches, is "
            "found only if something else moves it"
        )
        if identifier is None and feedback_of(records).found:
            notes.append(
                "past outputs predict the input (feedback): frequencies and damping here have the bias of noise, "
                "which no interval holds"
            )
    else:
        notes.append(
            "no input: shapes have no scale, a mode that the surroundings do not excite or no sensor sees is not here, "
            "and a resonance or a tone of the excitation passes for a mode"
        )
        tones = [f"{mode.frequency:.4g}" for mode in modes if mode.damping_interval[1] < TONE]
        if tones:
            notes.append(f"at {', '.join(tones)} Hz nothing is damped: a tone of a machine rather than a mode")
    if passing:
        notes.append(f"{passing} rows of poles changed with the order and count as no modes (grey in the diagram)")
    return notes


def _excited(records: Sequence[Trajectory]) -> tuple[float, float]:
    """Return between which frequencies [Hz] any of the inputs has power."""
    from scipy.signal import welch

    longest = max(records, key=len)
    low, high = np.inf, 0.0
    for column in longest.u.T:
        length = min(max(len(column) // 8, 64), len(column))
        frequency, power = welch(column, 1.0 / longest.spec.sample_time, nperseg=length)
        held = frequency[power > FAINT * power.max()] if power.max() > 0 else frequency[:0]
        if held.size:
            low, high = min(low, float(held[0])), max(high, float(held[-1]))
    return (low, high) if high > 0 else (0.0, 0.0)


System = tuple[FloatArray, FloatArray]
"""A and C of a linear model."""
SSI = "ssi"
"""Name of the subspace fit of this room."""
STEP = 2
"""Orders rise by a pair of poles."""
MOST = 40
"""The largest order by default: twenty modes."""


def identify_modes(
    records: Sequence[Trajectory],
    *,
    name: str = "data",
    identifier: str | None = None,
    orders: Sequence[int] | None = None,
    criteria: Criteria | None = None,
    window: int | None = None,
    options: Mapping[str, Any] | None = None,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Modes:
    """Return the modes that records determine: frequencies, damping ratios and shapes with 95 % intervals.

    Records without inputs are taken as the answer to unknown white excitation (operational modal analysis), others as
    driven by their inputs.

    Parameters
    ----------
    records : sequence of Trajectory
    name : str
        For titles.
    identifier : str, optional
        Id of an identifier of linear models, whose poles are taken: their intervals come from leaving out stretches.
        By default ``"ssi"``, a subspace fit with its covariance (:mod:`harness.modal.subspace`), which is refused where
        past outputs predict the input; named, it is made even so.
    orders : sequence of int, optional
        Numbers of states, two for each mode; by default 2, 4, ... 40, as far as the data reach.
    criteria : Criteria, optional
        Of stabilisation.
    window : int, optional
        Samples of past and future in the subspace fit.
    options : mapping, optional
        Of the identifier.
    seed : int
        For identifiers that draw random numbers.
    progress : callable, optional
        Called with orders done and their number.

    Raises
    ------
    InputError
        If an option cannot be used.
    FitError
        If the records are too short, or no order can be fitted.

    Examples
    --------
    >>> from scipy.signal import lfilter
    >>> from harness.signals import Channel
    >>> e = np.random.default_rng(0).normal(size=20_000)
    >>> y = lfilter([1.0], [1.0, -2 * 0.98 * np.cos(0.3), 0.98**2], e)
    >>> spec = PlantSpec((), (Channel("y", "m/s2"),), 0.01)
    >>> record = Trajectory(np.arange(20_000) * 0.01, np.zeros((20_000, 0)), y[:, None], spec)
    >>> identify_modes([record], name="hum", orders=range(2, 11, 2))
    <Modes of hum: 4.768 Hz>
    """
    criteria = criteria or Criteria()
    records = _moved([record.measured() for record in records])
    spec = records[0].spec
    named, identifier = identifier is not None, None if identifier == SSI else identifier
    _refuse(spec, orders, window, options, identifier)
    if not named:
        _refuse_feedback(records)
    shown = ladder_of(records, window)
    size = _sizes(records) if len({channel.unit for channel in spec.outputs}) > 1 else None
    wanted = sorted(set(orders)) if orders is not None else range(STEP, min(MOST, shown.most) + 1, STEP)
    systems: dict[int, System] = {}
    ladder: dict[int, Sequence[Pole]] = {}
    for a, c in _systems(shown, wanted, identifier, options or {}, records, seed, progress):
        systems[len(a)] = a, c
        ladder[len(a)] = (
            shown.poles(len(a), size)
            if identifier is None
            else poles_of(a, c if size is None else c / size[:, None], spec.sample_time)
        )
    tracks = tracks_of(ladder, criteria)
    taken, passing = _chosen(tracks, criteria, list(ladder))
    if identifier is not None and taken:
        taken = _with_deviations(taken, identifier, options or {}, records, seed)
    modes: list[Mode] = []
    missed: list[Undetermined] = []
    waves: dict[Pole, ComplexArray] = {}
    for track, pole in taken:
        share, waves[pole] = _part(shown, records, *systems[pole.order], pole)
        found = _mode(track, pole, share)
        if isinstance(found, Mode):
            modes.append(found)
        else:
            missed.append(found)
    modes, doubles = _told_apart(modes, criteria)
    missed += doubles
    notes = notes_of(records, shown, identifier, passing, modes)
    coordinates = np.stack([waves[mode.pole] for mode in modes], axis=1) if modes else np.zeros((0, 0), complex)
    time = records[0].t[shown.window : shown.window + len(coordinates)]
    return Modes(
        name,
        spec,
        identifier or SSI,
        tuple(modes),
        tuple(sorted(missed, key=lambda one: one.band)),
        tuple(notes),
        criteria,
        ladder,
        tuple(tracks),
        time,
        coordinates,
        size is not None,
    )


def _systems(
    shown: Ladder,
    wanted: Sequence[int],
    identifier: str | None,
    options: Mapping[str, Any],
    records: Sequence[Trajectory],
    seed: int,
    progress: Callable[[int, int], None] | None,
) -> Iterator[System]:
    """Yield A and C of every order that the data reach, or that the identifier does not refuse; at least one."""
    refused: FitError | None = None
    found = False
    for done, order in enumerate(wanted):
        if progress is not None:
            progress(done, len(wanted))
        if identifier is None and order > shown.most:
            break
        try:
            yield shown.matrices(order) if identifier is None else fitted(identifier, order, options, records, seed)
            found = True
        except FitError as error:
            refused = refused or error
    if not found:
        raise refused or FitError(
            "modes: orders",
            expected=f"up to {shown.most}, the rank of the data",
            got=f"from {min(wanted, default=0)}",
            remedy="lower the orders, or give a larger window",
        )


def _refuse(
    spec: PlantSpec,
    orders: Sequence[int] | None,
    window: int | None,
    options: Mapping[str, Any] | None,
    identifier: str | None,
) -> None:
    """Refuse options that make no sense, and channels that are no signals."""
    if orders is not None and (not orders or min(orders) < 2):
        raise InputError(
            "orders", expected="from 2 on: two states make a mode", got=str(list(orders)), remedy="correct them"
        )
    if window is not None and window < 2:
        raise InputError("window", expected="at least 2 samples", got=str(window), remedy="correct it")
    if options and identifier is None:
        raise InputError(
            "options",
            expected="none without --identifier",
            got=", ".join(options),
            remedy="name the identifier that they are for",
        )
    for channel in (*spec.inputs, *spec.outputs):
        if channel.kind == "category":
            raise InputError(
                f"modes of {channel.name!r}", expected="numbers", got="a category", remedy="leave the channel out"
            )


def _moved(records: Sequence[Trajectory]) -> list[Trajectory]:
    """Return the records without inputs that never move: nothing is known of what drove them."""
    spec = records[0].spec
    moves = np.ptp(np.concatenate([record.u for record in records]), axis=0) > 0
    if moves.all():
        return list(records)
    kept = tuple(channel for channel, moving in zip(spec.inputs, moves, strict=True) if moving)
    spec = replace(spec, inputs=kept)
    return [replace(record, u=record.u[:, moves], spec=spec) for record in records]


def _refuse_feedback(records: Sequence[Trajectory]) -> None:
    """Refuse inputs that answer the outputs: noise that comes back through the loop would pass for motion."""
    if records[0].spec.nu and feedback_of(records).found:
        raise FitError(
            "modes: past outputs predict the input (feedback)",
            expected="inputs that do not answer the outputs",
            got="a controller in the loop, or inputs that follow the motion",
            remedy="--identifier n4sid, which allows for it; --identifier ssi takes frequencies and damping with the "
            "bias of noise",
        )


def _sizes(records: Sequence[Trajectory]) -> FloatArray:
    """Return the standard deviations of the outputs (ny,)."""
    size = np.concatenate([record.y for record in records]).std(axis=0)
    return np.where(size > 0, size, 1.0)


def _chosen(tracks: Sequence[Track], criteria: Criteria, orders: Sequence[int]) -> tuple[list[tuple[Track, Pole]], int]:
    """Return the tracks that are modes, each with the pole that stands for it, and how many tracks are none."""
    if len(orders) == 1:  # nothing to compare with: what is not known well is refused later
        return [(track, track.poles[0]) for track in tracks if track.poles[0].damping > 0], 0
    kept = [track for track in tracks if track.holds(criteria, orders)]
    return [(track, track.best) for track in kept], len(tracks) - len(kept)


def _with_deviations(
    taken: list[tuple[Track, Pole]],
    identifier: str,
    options: Mapping[str, Any],
    records: Sequence[Trajectory],
    seed: int,
) -> list[tuple[Track, Pole]]:
    """Return modes with deviations; of the orders that have all of them the middle one is refitted.

    A smaller one may be too small for the weaker modes, and bend the others.
    """
    common = set.intersection(*({pole.order for pole in track.poles} for track, _ in taken))
    if common:
        order = sorted(common)[len(common) // 2]
        taken = [(track, next(pole for pole in track.poles if pole.order == order)) for track, _ in taken]
    found: list[tuple[Track, Pole]] = []
    for order in sorted({pole.order for _, pole in taken}):
        tracks = [track for track, pole in taken if pole.order == order]
        poles = [pole for _, pole in taken if pole.order == order]
        found += zip(tracks, jackknifed(identifier, poles, options, records, seed), strict=True)
    return found


def _part(
    shown: Ladder, records: Sequence[Trajectory], a: FloatArray, c: FloatArray, pole: Pole
) -> tuple[float, ComplexArray]:
    """Return the share of the motion that a mode carries, and its coordinate in the first record."""
    values, right = np.linalg.eig(a)
    place = int(np.argmin(np.abs(values - pole.value)))
    row, shape = np.linalg.pinv(right)[place], c @ right[:, place]
    scale = complex(np.vdot(pole.shape, shape) / np.vdot(pole.shape, pole.shape))
    size = _sizes(records)
    common = power = 0.0
    first: ComplexArray = np.zeros(0, complex)
    for number, record in enumerate(records):
        wave = shown.states(record, a, c) @ row
        part = 2.0 * np.real(wave[:, None] * shape) / size
        moved = record.y[shown.window : shown.window + len(wave)] / size
        moved = moved - moved.mean(axis=0) if len(moved) else moved
        common += float(np.sum(part * moved))
        power += float(np.sum(moved**2))
        if number == 0:
            first = np.asarray(wave * scale, dtype=np.complex128)
    return max(common, 0.0) / max(power, 1e-300), first


def _told_apart(modes: Sequence[Mode], criteria: Criteria) -> tuple[list[Mode], list[Undetermined]]:
    """Return modes by frequency, without those that may be one that is known better (same shape, in the interval)."""
    kept: list[Mode] = []
    doubles: list[Undetermined] = []
    for mode in sorted(modes, key=lambda one: one.frequency_interval[1] - one.frequency_interval[0]):
        low, high = mode.frequency_interval
        if any(low <= one.frequency <= high and mac(one.shape, mode.shape) >= criteria.mac for one in kept):
            doubles.append(Undetermined((mode.frequency, mode.frequency), "double"))
        else:
            kept.append(mode)
    return sorted(kept, key=lambda one: one.frequency), doubles


def _mode(track: Track, pole: Pole, share: float) -> Mode | Undetermined:
    """Return a mode with its intervals, or why it is none."""
    from scipy.stats import t

    wide = float(t.ppf(0.5 + LEVEL / 2, pole.freedom))
    ends = [one.frequency for one in track.poles]
    half = wide * pole.frequency_deviation
    spread = wide * pole.damping_deviation
    known = np.isfinite(half)
    band = (min(ends), max(ends))
    if known and half > VAGUE * pole.frequency:
        return Undetermined(band, "frequency")
    damped = not known or pole.damping > spread
    if pole.damping + (spread if known else 0.0) < 0:
        return Undetermined(band, "growing")
    if not damped and share < STRONG:
        return Undetermined(band, "damping")
    if pole.shape_deviation is None:
        bound, seen = np.full(len(pole.shape), np.nan), np.ones(len(pole.shape), bool)
    else:
        chance = wide * np.abs(pole.shape_deviation)
        bound, seen = np.abs(pole.shape) + chance, np.abs(pole.shape) > chance
    return Mode(
        pole,
        tuple(one.order for one in track.poles),
        (pole.frequency - half, pole.frequency + half),
        (pole.damping - spread, pole.damping + spread),
        bool(damped),
        seen,
        bound,
        share,
    )
