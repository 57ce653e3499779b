"""What a fleet tells that a record does not: where an effect is new, and whether it grows with time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from harness.fleet.row import FleetRow, FoundEffect
from harness.signals import FloatArray

LEAST = 3  # Records of a line: with two, its slope has no error.
NORMAL = 1.959964  # Half width of a 95 % interval in standard deviations.


@dataclass(frozen=True)
class Series:
    """The sizes of one effect over the records that have it."""

    effect: str  # ``effect@place``
    parameter: str
    unit: str
    rows: tuple[tuple[FleetRow, FoundEffect], ...]
    """Tuple of (Row, Found): By date, those without one last, in the order of the records."""


@dataclass(frozen=True)
class Trend:
    """How a size changes with the date on one machine.

    ``slope`` is in units a day, ``low`` and ``high`` its 95 % interval; ``records`` counts what it rests on.
    """

    machine: str
    series: Series
    slope: float
    low: float
    high: float
    records: int

    @property
    def word(self) -> str:
        """``grows``, ``shrinks`` or ``no trend``."""
        return "grows" if self.low > 0 else "shrinks" if self.high < 0 else "no trend"


@dataclass(frozen=True)
class New:
    """A record in which a machine shows an effect that no earlier record of it shows, nor was tied with.

    ``before`` are the effects that earlier records of the machine show at the same place: where there are some, the
    law has another name, and what it describes may be the same.
    """

    machine: str
    row: FleetRow
    effect: FoundEffect
    before: tuple[str, ...] = ()


def series_of(rows: Sequence[FleetRow]) -> list[Series]:
    """Return the sizes by effect and parameter, the most frequent first."""
    grouped: dict[tuple[str, str, str], list[tuple[FleetRow, FoundEffect]]] = {}
    for row in _by_date(rows):
        for effect in row.effects:
            grouped.setdefault((effect.name, effect.parameter, effect.unit), []).append((row, effect))
    made = [Series(*key, tuple(pairs)) for key, pairs in grouped.items()]
    return sorted(made, key=lambda series: -len(series.rows))


def new_effects(rows: Sequence[FleetRow]) -> list[New]:
    """Return the records in which effects begin, machine by machine; its first dated record only shows what is there.

    An effect that an earlier record was tied with is another name for the same thing, and not new. Records without an
    answer say nothing either way.
    """
    machines: dict[str, list[FleetRow]] = {}
    for row in _by_date(rows):
        if row.ok and row.date is not None:
            machines.setdefault(row.machine, []).append(row)
    found = []
    for machine, own in machines.items():
        seen: set[str] | None = None
        places: dict[str, list[str]] = {}
        for row in own:
            names = {name for effect in row.effects for name in (effect.name, *effect.ties)}
            if seen is not None:
                found += [
                    New(machine, row, effect, tuple(dict.fromkeys(places.get(effect.at, ()))))
                    for effect in row.effects
                    if not seen & {effect.name, *effect.ties}
                ]
            seen = names | (seen or set())
            for effect in row.effects:
                places.setdefault(effect.at, []).append(effect.name)
    return found


def trends(series: Sequence[Series]) -> list[Trend]:
    """Return the slope of each size against the date, machine by machine, where three dated intervals are there.

    Weighted least squares with the intervals of the records; where the records scatter more than their intervals say,
    the error of the slope is larger by that factor (Bevington & Robinson 2003, *Data Reduction and Error Analysis*,
    sec. 4.2 and 6.4, Birge's ratio), and the quantile is Student's.
    """
    found = []
    for own in series:
        machines: dict[str, list[tuple[float, float, float]]] = {}
        for row, effect in own.rows:
            if row.date is None or effect.size is None or effect.low is None or effect.high is None:
                continue
            day = datetime.fromisoformat(row.date).timestamp() / 86400.0
            deviation = (effect.high - effect.low) / (2 * NORMAL)
            if deviation > 0:
                machines.setdefault(row.machine, []).append((day, effect.size, deviation))
        for machine, points in machines.items():
            line = _slope(np.array(points))
            if line is not None:
                found.append(Trend(machine, own, *line, len(points)))
    return found


def fitted(column: FloatArray, size: FloatArray, weight: FloatArray) -> tuple[float, float, float, float]:
    """Return a level, the factor of a column beside it, its error by the weights, and the sum of squares left."""
    centre = float(np.average(column, weights=weight))
    spread = float(weight @ (column - centre) ** 2)
    by = float(weight @ ((column - centre) * size)) / spread
    before = float(np.average(size, weights=weight)) - by * centre
    return before, by, spread**-0.5, float(weight @ (size - before - by * column) ** 2)


def _slope(points: np.ndarray) -> tuple[float, float, float] | None:
    """Return slope and its 95 % interval of sizes (day, size, deviation); None with too few days."""
    day, size, deviation = points.T
    if len(day) < LEAST or np.ptp(day) == 0:
        return None
    from scipy.stats import t

    _, slope, error, left = fitted(day, size, deviation**-2)
    freedom = len(day) - 2
    half = float(t.ppf(0.975, freedom)) * max(1.0, np.sqrt(left / freedom)) * error
    return slope, slope - half, slope + half


def _by_date(rows: Sequence[FleetRow]) -> list[FleetRow]:
    """Return rows by date, those without one last; the order of the records decides ties."""
    return sorted(rows, key=lambda row: (row.date is None, datetime.fromisoformat(row.date) if row.date else 0))
