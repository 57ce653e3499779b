"""Looking at every channel of every run, and leaving out of the fits what is no reading."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
from scipy.ndimage import maximum_filter1d

from harness.data.oddities.between import mismatched
from harness.data.oddities.bursts import bursts_of
from harness.data.oddities.dropouts import dropouts_of
from harness.data.oddities.filtered import filter_of
from harness.data.oddities.held import filled_readings, held_readings, scatters, stuck_rows
from harness.data.oddities.hum import hum_of
from harness.data.oddities.leaps import POSITIONS, SIDE, STRIDES, leaps_of
from harness.data.oddities.levels import coarse_step, saturated, stuck
from harness.data.oddities.numbers import ODD
from harness.data.oddities.pace import band_of, line_share, trend_of
from harness.data.oddities.rows import slips_of
from harness.data.oddities.spikes import Spikes, alike, spikes_of, unfelt
from harness.errors import InputError
from harness.judgement import reached_at_once
from harness.resolution import resolution
from harness.signals import Channel, Dataset, FloatArray, Oddity, Trajectory
from harness.units import behind, own_unit, own_values, told

_SHOWN = 4  # Rows that a sentence names.
_OWN = ", or the state itself jumps (impacts, switches: identify has hybrid-automaton for it)"
"""What leaps of a position in several places may be too."""
_ONE_TURN = 1.05  # Range of an angle over its period up to which its sensor may count one turn.


def examined(dataset: Dataset) -> Dataset:
    """Return a data set with what is odd about its records, and without the readings that are none.

    Spikes, words for "nothing" and repeated readings count as missing (:attr:`harness.signals.Trajectory.missing`); a
    row of an input that no output felt is what its neighbours foretell. Everything else is only said.

    Parameters
    ----------
    dataset : Dataset
        One that was examined is returned as it is.

    Returns
    -------
    Dataset
        With ``oddities``.

    Examples
    --------
    >>> from harness.signals import PlantSpec, Run
    >>> rng = np.random.default_rng(0)
    >>> y = np.sin(0.1 * np.arange(400.0)) + 0.01 * rng.standard_normal(400)
    >>> y[200] = 9999.0
    >>> spec = PlantSpec((), (Channel("q", "m"),), 0.5)
    >>> found = examined(Dataset("x", (Run(Trajectory(np.arange(400) * 0.5, np.zeros((400, 0)), y[:, None], spec)),)))
    >>> print(found.oddities[0].words)
    q reads 9999 m in row 200, where its neighbours predict 0.91 m: counted as missing
    >>> bool(np.isnan(found.runs[0].trajectory.readings[200, 0]))
    True
    """
    if dataset.oddities is not None:
        return dataset
    runs, found = [], []
    for number, run in enumerate(dataset.runs):
        looked = _Look(number, run.trajectory, dataset.recorded)
        looked.look()
        runs.append(replace(run, trajectory=looked.mended()))
        found += looked.oddities
    found += mismatched(runs)
    return replace(dataset, runs=tuple(runs), oddities=tuple(found))


def lines(oddities: Sequence[Oddity], names: Sequence[str] = (), *, faults: bool = True) -> list[str]:
    """Return the oddities as text, a line each; faults alone unless asked otherwise.

    Parameters
    ----------
    oddities : sequence of Oddity
    names : sequence of str
        What to call the runs; by default ``run 0`` and so on.
    faults : bool
        False for what is worth knowing too.

    Examples
    --------
    >>> lines([Oddity("step", 0, "q", (), "q moves in steps of 0.1 m", fault=False)])
    []
    >>> lines([Oddity("spike", 1, "q", (3,), "q has a spike")]), lines([Oddity("spike", 0, "q", (3,), "a")], ["a.csv"])
    (['run 1: q has a spike'], ['a.csv: a'])
    """
    return [
        f"{names[odd.run] if names else f'run {odd.run}'}: {odd.words}" for odd in oddities if odd.fault or not faults
    ]


@dataclass(eq=False)
class _Look:
    """One run while it is looked at."""

    run: int
    record: Trajectory
    recorded: Mapping[str, str] = field(default_factory=dict)
    oddities: list[Oddity] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.u, self.y = self.record.u.copy(), self.record.y.copy()
        known = self.record.missing
        self.missing = np.zeros(self.y.shape, dtype=bool) if known is None else known.copy()
        self.resting = np.zeros(self.y.shape, dtype=bool)
        self.uneven = np.zeros(self.y.shape[1], dtype=bool)
        self.spec, self.n = self.record.spec, len(self.record)

    def look(self) -> None:
        """Look at everything."""
        self._beyond_all()
        for column, channel in enumerate(self.spec.inputs):
            if channel.kind == "real" and self.n >= ODD.fewest:
                self._input(column, channel)
        for column, channel in enumerate(self.spec.outputs):
            if channel.kind == "real" and np.ptp(self.y[:, column]) > 0:
                self._output(column, channel)
        if self.n >= ODD.fewest:
            self._slips()
            self._crosstalk()

    def _beyond_all(self) -> None:
        """Leave out numbers so large that their squares are none: a damaged row, which no average survives.

        Raises InputError if they are no exceptions.
        """
        for u_or_y, channels in ((self.u, self.spec.inputs), (self.y, self.spec.outputs)):
            for column, channel in enumerate(channels):
                values = u_or_y[:, column]
                rows = np.flatnonzero(np.abs(values) > ODD.beyond)
                if not rows.size:
                    continue
                if 2 * rows.size > self.n:
                    raise InputError(
                        f"{channel.name} is too large to count with", expected=f"sizes up to {ODD.beyond:g}",
                        got=f"{values[rows[0]]:.3g} in row {rows[0]}, and {rows.size} such rows of {self.n}",
                        remedy="choose another column, correct its unit, or scale it (scale in a dataset.toml)",
                    )  # fmt: skip
                where = np.flatnonzero(np.abs(values) <= ODD.beyond)
                remark = "read as their neighbours" if u_or_y is self.u else "counted as missing"
                words = (
                    f"{channel.name} reads {values[rows[0]]:.3g} in row {_listed(rows)}, which no sensor does: {remark}"
                )
                values[rows] = np.interp(rows, where, values[where])
                self._add("spike", channel, rows, words, used=True)
                if u_or_y is self.y:
                    self.missing[rows, column] = True
        if self.oddities:
            self.record = replace(self.record, u=self.u.copy(), y=self.y.copy())

    def mended(self) -> Trajectory:
        """Return the record with what is no reading marked as missing."""
        same = np.array_equal(self.u, self.record.u) and np.array_equal(self.y, self.record.y)
        if same and not self.missing.any():
            return self.record
        return replace(self.record, u=self.u, y=self.y, missing=self.missing)

    def _own(self, channel: Channel, *values: FloatArray) -> tuple[Channel, list[FloatArray]]:
        """Return a channel and readings of it (N,) in the unit in which it was recorded: what sentences tell."""
        shown = [own_values(one[:, None], (channel,), self.recorded)[:, 0] for one in values]
        return Channel(channel.name, own_unit(channel, self.recorded)), shown

    def _size(self, channel: Channel, size: float, digits: str) -> str:
        """Return a difference of readings in the unit in which the channel was recorded, as text."""
        own, unit = told(float(size), channel.unit, self.recorded.get(channel.name, channel.unit))
        return f"{own:{digits}}{behind(unit)}"

    def _add(self, kind: str, channel: Channel, rows: npt.NDArray[np.intp], words: str, **how: bool) -> None:
        self.oddities.append(Oddity(kind, self.run, channel.name, tuple(map(int, rows)), words, **how))

    # ---- outputs ---------------------------------------------------------------------------------------------------

    def _output(self, column: int, channel: Channel) -> None:
        """Look at one output."""
        y = self.record.y[:, column]
        plain = y if channel.period is None else _unwrapped(y, channel.period)
        self._stands(column, channel, plain)
        own, (shown,) = self._own(channel, y)
        for limit, words in saturated(own, shown).items():
            limits = np.flatnonzero(shown == limit)
            self.resting[limits, column] = True
            self._add("rail", channel, limits, words)
        if self.n < ODD.fewest:
            return
        fresh = ~self.missing[:, column]
        self._spikes(column, channel, plain, fresh)
        self._leaps(column, channel, plain)
        self._hum(column, channel)
        self._filter(column, channel)
        self._bursts(column, channel)
        step = coarse_step(y[fresh])
        if step:
            turn = f", {2 * np.pi / step:.4g} a turn" if channel.unit == "rad" else ""
            words = f"{channel.name} is read in steps of {self._size(channel, step, '.4g')}{turn}, more than its noise"
            self._add("step", channel, np.zeros(0, dtype=np.intp), words, fault=False)
        self._pace(column, channel)

    def _stands(self, column: int, channel: Channel, plain: FloatArray) -> None:
        """Find readings that only repeat."""
        held = held_readings(plain, self.record.u)
        if held is not None:
            rows = np.flatnonzero(~held.fresh)
            how = (
                f"is refreshed every {_th(held.every)} row"
                if held.every
                else f"repeats the reading before in {len(rows)} of {self.n} rows, and then catches up"
            )
            words = f"{channel.name} {how}: only fresh readings count"
            self._leave(column, held.fresh, plain)
            self.uneven[column] = held.every is None
            self._add("held", channel, rows, words, used=True)
            return
        found = stuck_rows(self.record.y[:, column])
        if not found:
            self._filled(column, channel, plain)
            return
        typical = float(np.median(np.abs(np.diff(plain))))
        noisy = scatters(plain) and typical > ODD.above_step * resolution([plain])
        fresh = np.ones(self.n, dtype=bool)
        for first, length in found:
            self.resting[first : first + length, column] = True
            after = abs(plain[first + length] - plain[first])
            # a plant that stands still starts slowly, and the noise of its sensor does not stand
            if noisy or after > ODD.catch_up * length * typical:
                before = np.abs(np.diff(plain[max(first - SIDE - 1, 0) : first + 1]))
                fell = before[-1] > STRIDES * before[:-1].max(initial=np.inf if len(before) < 2 else 0.0)
                fresh[first + int(not fell) : first + length] = False  # a drop-out to 0 is no reading from the start
        if not fresh.all():
            self._leave(column, fresh, plain)
        rows = np.concatenate([np.arange(first, first + length) for first, length in found])
        own, (shown,) = self._own(channel, self.record.y[:, column])
        for words in stuck(own, shown, self.spec.sample_time):
            self._add("stuck", channel, rows, words, used=not fresh.all())

    def _filled(self, column: int, channel: Channel, plain: FloatArray) -> None:
        """Find readings that lie on straight lines between others."""
        found = filled_readings(plain, self.record.u)
        if found is None:
            return
        rows = np.flatnonzero(~found.fresh)
        how = f"between every {_th(found.every)} row" if found.every else f"in rows {rows[0]} to {rows[-1]}"
        if not found.every and rows[-1] - rows[0] >= len(rows):
            how = f"in {len(rows)} rows (first {rows[0]})"
        words = f"{channel.name} lies on straight lines {how}, as a log that was filled in: those rows are no readings"
        self._leave(column, found.fresh, plain)
        self._add("filled", channel, rows, words, used=True)

    def _spikes(self, column: int, channel: Channel, plain: FloatArray, fresh: npt.NDArray[np.bool_]) -> None:
        """Find readings that their neighbours contradict."""
        whole = bool(fresh.all())
        if not whole and self.uneven[column]:
            return  # a prediction needs readings at one distance
        where = np.flatnonzero(fresh)
        values = plain[where]
        found = spikes_of(values, self.u if whole else np.zeros((len(values), 0)))
        # where a signal comes to rest and goes on from there no prediction holds
        near = maximum_filter1d(self.resting[where, column], 2 * ODD.order + 1)
        kept = found.rows[~near[found.rows]]
        found = Spikes(kept, np.where(np.isin(np.arange(len(values)), kept), found.mended, values))
        for value, places in alike(self.record.y[where, column], found.rows):
            rows = where[places]
            words = self._reads(channel, value, rows, self.record.y[rows, column], found.mended[places])
            self._add("spike" if value is None else "word", channel, rows, f"{words}: counted as missing", used=True)
        if found.rows.size:
            good = fresh.copy()
            good[where[found.rows]] = False
            mended = plain.copy()
            mended[where] = found.mended
            if whole:
                self.y[:, column] += np.where(good, 0.0, mended - plain)
                self.missing[:, column] |= ~good
            else:
                self._leave(column, good, mended)

    def _leaps(self, column: int, channel: Channel, plain: FloatArray) -> None:
        """Find rows between which a position leaps, all of a channel in one sentence."""
        if channel.unit not in POSITIONS or self.missing[:, column].mean() > ODD.most:
            return
        step = resolution([self.record.y[~self.missing[:, column], column]])
        rows, sizes = leaps_of(np.where(self.missing[:, column], self.y[:, column], plain), step)
        if not rows.size:
            return
        size = self._size(channel, sizes[np.argmax(np.abs(sizes))], ".3g")
        where = f"before row {rows[0]} (t = {self.record.t[rows[0]]:g} s)"
        if len(rows) > 1:
            size = f"up to {self._size(channel, np.abs(sizes).max(), '.3g')}"
            where = f"in {len(rows)} places, before rows {_listed(rows)}"
        words = (
            f"{channel.name} leaps by {size} {where}, where the motion before and after would have to meet: rows were "
            f"lost, or the sensor slipped{_OWN if len(rows) > 1 else ''}; close-loop takes what follows as a record of "
            "its own"
        )
        self._add("leap", channel, rows, words)

    def _hum(self, column: int, channel: Channel) -> None:
        """Find a line above the motion and take it out."""
        if self.missing[:, column].mean() > ODD.most or self.resting[:, column].any():
            return
        found = hum_of(self.y[:, column], self.u)
        if found is None:
            return
        dt = self.spec.sample_time
        size = self._size(channel, 0.5 * float(np.ptp(found.sine)), ".3g")
        words = (
            f"{channel.name} holds a line of {size} at {found.frequency / dt:.4g} Hz, above all its motion, and no "
            "input has it: hum of the mains, as it is or aliased, or something that turns near by; it is taken out"
        )
        self._add("hum", channel, np.zeros(0, dtype=np.intp), words, used=True)
        self.y[:, column] -= found.sine

    def _filter(self, column: int, channel: Channel) -> None:
        """Find a filter by what it takes away."""
        if self.missing[:, column].any() or self.resting[:, column].any():
            return
        found = filter_of(self.y[:, column], self.u)
        if found is None:
            return
        how = f"a mean over {found.every} rows" if found.mean else "a digital low-pass"
        words = (
            f"{channel.name} was filtered before it was written: at {found.null / self.spec.sample_time:.4g} Hz "
            f"nothing is left of it, as behind {how}. It may come late, and readings side by side err alike: "
            f"close-loop counts every {_th(found.every)} row and looks for the filter, but for arms; better write what "
            "was read"
        )
        self._add("filtered", channel, np.flatnonzero(np.arange(self.n) % found.every), words)

    def _bursts(self, column: int, channel: Channel) -> None:
        """Find stretches in which the sensor scatters more than elsewhere."""
        if self.missing[:, column].mean() > ODD.most:
            return
        found = bursts_of(self.y[:, column], self.u)
        if not found:
            return
        first, last, size = max(found, key=lambda one: one[2])
        begins, ends = self.record.t[[first, last]]
        many = f"in {len(found)} places, most " if len(found) > 1 else ""
        words = (
            f"{channel.name} scatters more than elsewhere {many}in rows {first} to {last} "
            f"(t = {begins:g} to {ends:g} s), by {self._size(channel, size, '.2g')}: a burst of noise, a loose contact?"
        )
        rows = np.concatenate([np.arange(first, last + 1) for first, last, _ in found])
        self._add("burst", channel, rows, words)

    def _slips(self) -> None:
        """Find places where rows are missing or written twice, none of which the clock shows."""
        real = [k for k, one in enumerate(self.spec.outputs) if one.kind == "real" and not self.uneven[k]]
        if not real or self.missing[:, real].mean() > ODD.most:
            return
        plain = [
            self.y[:, k] if (period := self.spec.outputs[k].period) is None else _unwrapped(self.y[:, k], period)
            for k in real
        ]
        known = {row for odd in self.oddities if odd.kind == "leap" for row in odd.rows}
        for slip in slips_of(np.column_stack(plain), self.u, np.asarray(self.missing[:, real].any(axis=1))):
            if any(abs(slip.row - row) <= ODD.order for row in known):
                continue
            when = f"row {slip.row} (t = {self.record.t[slip.row]:g} s)"
            rows = "a row is" if slip.lost == 1 else f"{slip.lost} rows are"
            words = (
                f"{when} repeats the one before in every channel, and what follows goes on as if it were not there"
                if slip.lost < 0
                else f"{rows} missing before {when}: with unknown ones, the rest is predicted as well as elsewhere"
            )
            words += "; close-loop takes what follows as a record of its own"
            self._add("leap", self.spec.outputs[real[0]], np.array([slip.row]), words)

    def _crosstalk(self) -> None:
        """Find outputs that hold the inputs of the same sample."""
        for column, channel in enumerate(self.spec.outputs):
            if channel.kind != "real" or self.missing[:, column].mean() > ODD.most:
                continue
            spec = replace(self.spec, outputs=(channel,))
            if reached_at_once([replace(self.record, u=self.u, y=self.y[:, [column]], spec=spec, missing=None)]):
                words = (
                    f"{channel.name} responds to held inputs within the same row: crosstalk into its reading, inputs "
                    "that were written a row late, a relay that it switches, or a direct path (feedthrough = true)"
                )
                self._add("crosstalk", channel, np.zeros(0, dtype=np.intp), words, fault=False)

    def _leave(self, column: int, fresh: npt.NDArray[np.bool_], plain: FloatArray) -> None:
        """Count readings as missing, with what those beside them foretell in their place."""
        from scipy.interpolate import PchipInterpolator

        where = np.flatnonzero(fresh)
        filled = PchipInterpolator(where, plain[where], extrapolate=False)(np.arange(self.n))
        filled = np.where(np.isfinite(filled), filled, plain[where[-1]])
        self.y[:, column] = np.where(fresh, self.record.y[:, column], filled)
        self.missing[:, column] |= ~fresh

    def _pace(self, column: int, channel: Channel) -> None:
        """Compare the motion with the sampling, and with a line."""
        y = self.y[:, column]
        band = 0.0 if line_share(y) >= ODD.power else band_of(y)  # what a speed that rises does besides is a hundredth
        dt = self.spec.sample_time
        nothing = np.zeros(0, dtype=np.intp)
        if band > ODD.slow:
            words = (
                f"{channel.name} moves up to {0.5 * band / dt:.3g} Hz, {1 / dt:.4g} samples a second are few for it: "
                "what happens between two rows is not in the record"
            )
            self._add("slow", channel, nothing, words, fault=False)
        elif 0.0 < band < ODD.fast:
            words = (
                f"{channel.name} moves below {0.5 * band / dt:.3g} Hz, {1 / dt:.4g} samples a second are many for it: "
                "neighbouring rows say the same, and models of a step ahead learn noise"
            )
            self._add("fast", channel, nothing, words, fault=False)
        share = trend_of(y, self.u)
        if share:
            words = f"{channel.name} drifts: a straight line is {share:.0%} of its motion, and no input has one"
            self._add("trend", channel, nothing, words, fault=False)

    def _reads(
        self, channel: Channel, value: float | None, rows: npt.NDArray[np.intp], read: FloatArray, foretold: FloatArray
    ) -> str:
        """Return the sentence about odd readings of a channel."""
        own, (read, foretold) = self._own(channel, read, foretold)
        return _reads(own, value is not None, rows, read, foretold, self.record.t)

    # ---- inputs ----------------------------------------------------------------------------------------------------

    def _input(self, column: int, channel: Channel) -> None:
        """Find rows of a logged input that the plant did not feel."""
        u = self.record.u[:, column]
        for rows, bridge, sure in dropouts_of(self.y, self.u, column):
            own, (read, across) = self._own(channel, u[rows], bridge)
            words = (
                f"{channel.name} reads {read[0]:.6g}{behind(own.unit)} in rows {rows[0]} to {rows[-1]}, between "
                f"{across[0]:.3g} and {across[-1]:.3g}: "
            )
            if sure:
                words += "the outputs go on as if it did not, a drop-out of the log; close-loop leaves these rows out"
                self._add("dropout", channel, rows, words, used=True)
                self.u[rows, column] = bridge
            else:
                self._add(
                    "word", channel, rows, f"{words}the outputs do not tell whether the plant felt it", fault=False
                )
        u = self.u[:, column].copy()
        found = spikes_of(u, np.zeros((self.n, 0)))
        if not found.rows.size:
            return
        rows, open_rows = unfelt(self.y, self.u, column, found)
        self._said(channel, u, found, rows, "no output felt it; the row is read as its neighbours predict", used=True)
        self._said(channel, u, found, open_rows, "the outputs do not tell whether the plant felt it", fault=False)
        self.u[rows, column] = found.mended[rows]

    def _said(
        self, channel: Channel, u: FloatArray, found: Spikes, rows: npt.NDArray[np.intp], remark: str, **how: bool
    ) -> None:
        """Add what is to be said of odd rows of an input."""
        for value, places in alike(u, rows) if rows.size else ():
            words = self._reads(channel, value, places, u[places], found.mended[places])
            self._add("spike" if value is None else "word", channel, places, f"{words}: {remark}", **how)


def _unwrapped(y: FloatArray, period: float) -> FloatArray:
    """Return an angle without the jumps of a sensor that counts one turn; readings that are no such angle stay.

    Examples
    --------
    >>> y = (0.1 * np.arange(100) + np.pi) % (2 * np.pi) - np.pi
    >>> y[60] = 9999.0
    >>> _unwrapped(y, 2 * np.pi)[[30, 60, 99]].round(1).tolist()
    [3.0, 9999.0, 9.9]
    """
    low, high = np.percentile(y, [2, 98])
    inside = np.abs(y - 0.5 * (low + high)) <= period
    if high - low > _ONE_TURN * period or inside.sum() < 2:
        return y
    plain = y.copy()
    plain[inside] = np.unwrap(y[inside], period=period)
    return plain


def _reads(
    channel: Channel, word: bool, rows: npt.NDArray[np.intp], read: FloatArray, foretold: FloatArray, t: FloatArray
) -> str:
    """Return the sentence about odd readings, each different or all one ``word``."""
    unit = behind(channel.unit)
    if len(rows) == 1:
        when = f"row {rows[0]}" + ("" if word else f" (t = {t[rows[0]]:g} s)")
        near = f"where its neighbours predict {foretold[0]:.3g}{unit}"
        return f"{channel.name} reads {read[0]:.6g}{unit} in {when}, {near}"
    named = _listed(rows)
    if word:
        return (
            f"{channel.name} reads {read[0]:.6g}{unit} in {len(rows)} rows ({named}) that their neighbours contradict"
        )
    return (
        f"{channel.name} has {len(rows)} spikes of up to {np.abs(read - foretold).max():.3g}{unit} (rows {named}), "
        "which their neighbours contradict"
    )


def _listed(rows: npt.NDArray[np.intp]) -> str:
    """Return the first numbers of rows as text."""
    return ", ".join(map(str, rows[:_SHOWN])) + (", ..." if len(rows) > _SHOWN else "")


def _th(number: int) -> str:
    """Return an ordinal."""
    return f"{number}{ {2: 'nd', 3: 'rd'}.get(number % 10, 'th') if number not in (12, 13) else 'th' }"
