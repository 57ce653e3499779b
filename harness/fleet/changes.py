"""Where the size of an effect changes between dates: a step, a drift, one record; which machine is not as the others.

A size that stays the same scatters by its interval, or by more where records differ otherwise: neighbouring records in
the order of their dates tell how much, whatever their level does. Against that scatter three shapes are tested.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from harness.fleet.row import Row
from harness.fleet.trends import NORMAL, Series, series_of
from harness.signals import FloatArray

__all__ = ["LEVEL", "Change", "Odd", "changes", "odd_machines"]

LEVEL = 0.01
"""Probability with which, in a fleet where nothing changes, something is named all the same, over all that is tried."""
FEWEST = 4
"""Machines, or records of one, from which their scatter is told: of three, two may agree by chance."""
MAD = 1.4826
"""Median absolute deviation to standard deviation, of a normal distribution."""


@dataclass(frozen=True)
class Change:
    """A size that did not stay the same on one machine.

    Parameters
    ----------
    machine : str
    series : Series
    shape : {"step", "drift", "outlier"}
    row : Row
        The first record after a step, the last of a drift, the one that stands out.
    before, after : float
        Levels before and after a step, at the ends of the line of a drift; all others and the one that stands out.
    p : float
        Probability of so much in a machine that stays the same, times the number of places, shapes, machines and sizes
        that were tried (Bonferroni).
    """

    machine: str
    series: Series
    shape: str
    row: Row
    before: float
    after: float
    p: float

    def __str__(self) -> str:
        unit = "" if self.series.unit == "1" else f" {self.series.unit}"
        where = f" on {self.machine}" if self.machine else ""
        name = f"{self.series.effect} {self.series.parameter}{where}"
        how = {"step": "steps from", "drift": "drifts from", "outlier": "is elsewhere"}[self.shape]
        when = {"step": "at", "drift": "up to", "outlier": "only in"}[self.shape]
        return (
            f"{name} {how} {self.before:.4g} to {self.after:.4g}{unit} {when} {self.row.record} ({self.row.day}), "
            f"p {self.p:.2g}"
        )


@dataclass(frozen=True)
class Odd:
    """A machine that is not as the others.

    Parameters
    ----------
    machine : str
    effect : str
        ``effect@place``.
    what : str
        The size and that of the others, or in how many records the effect is.
    p : float
        As of :class:`Change`.
    """

    machine: str
    effect: str
    what: str
    p: float

    def __str__(self) -> str:
        return f"{self.machine} is not as the others: {self.effect} {self.what}, p {self.p:.2g}"


def changes(rows: Sequence[Row]) -> list[Change]:
    """Return the changes of sizes, the surest first; at most one shape for each machine and size, the likeliest.

    Notes
    -----
    With sizes x over their standard deviations (of the intervals, larger where neighbours differ by more): a step is
    the largest difference of two means over all places where the records can be parted, a drift the slope over the
    date, an outlier the largest distance from the median; each by the normal distribution, or Student's where the
    scatter had to be taken from the records, times the places tried.
    """
    lines = [(machine, own, points) for own in series_of(rows) for machine, points in _dated(own).items()]
    lines = [line for line in lines if len(line[2]) > 1]
    found = []
    for machine, own, points in lines:
        when, size, deviation = np.array([point[1:] for point in points]).T
        shape, place, before, after, p = _likeliest(when, size, deviation)
        p = min(1.0, p * len(lines))
        if p < LEVEL:
            found.append(Change(machine, own, shape, points[place][0], before, after, p))
    return sorted(found, key=lambda change: change.p)


def odd_machines(rows: Sequence[Row]) -> list[Odd]:
    """Return machines whose sizes, or whose having an effect at all, differ from those of the others.

    Sizes: the distance of a machine's mean from the median of all, over its error and the scatter of the machines.
    Having it: Fisher's exact test of the machine's records against those of the others.
    """
    from scipy.stats import fisher_exact, t

    machines = sorted({row.machine for row in rows if row.ok})
    if len(machines) < FEWEST:
        return []
    every = series_of(rows)
    names = list(dict.fromkeys(own.effect for own in every))
    tried = len(machines) * (len(every) + len(names))
    found = []
    for own in every:
        means = {machine: _mean(own, machine) for machine in machines}
        told = {machine: mean for machine, mean in means.items() if mean is not None}
        if len(told) < FEWEST:
            continue
        values = np.array([mean for mean, _ in told.values()])
        errors = np.array([error for _, error in told.values()])
        centre = float(np.median(values))
        between = MAD * float(np.median(np.abs(values - centre)))
        for machine, (value, error) in told.items():
            spread = np.hypot(error, max(between, float(np.median(errors))))
            p = 2.0 * float(t.sf(abs(value - centre) / spread, len(told) - 1)) * tried
            if p < LEVEL:
                unit = "" if own.unit == "1" else f" {own.unit}"
                found.append(
                    Odd(machine, own.effect, f"{own.parameter} {value:.4g}{unit}, others {centre:.4g}{unit}", p)
                )
    counts = {machine: [row for row in rows if row.ok and row.machine == machine] for machine in machines}
    for name in names:
        having = {m: sum(name in {e.name for e in row.effects} for row in own) for m, own in counts.items()}
        for machine in machines:
            inside, of = having[machine], len(counts[machine])
            elsewhere, others = sum(having.values()) - inside, sum(map(len, counts.values())) - of
            p = float(fisher_exact(np.array([[inside, of - inside], [elsewhere, others - elsewhere]]))[1]) * tried
            if p < LEVEL:
                found.append(
                    Odd(machine, name, f"in {inside} of {of} records, of the others in {elsewhere} of {others}", p)
                )
    return sorted(found, key=lambda odd: odd.p)


def _dated(series: Series) -> dict[str, list[tuple[Row, float, float, float]]]:
    """Return by machine the records that have a date, a size and an interval: row, instant [s], size, deviation."""
    machines: dict[str, list[tuple[Row, float, float, float]]] = {}
    for row, effect in series.rows:
        if row.date is None or effect.size is None or effect.low is None or effect.high is None:
            continue
        if effect.high > effect.low:
            when = datetime.fromisoformat(row.date).timestamp()
            point = (row, when, effect.size, (effect.high - effect.low) / (2 * NORMAL))
            machines.setdefault(row.machine, []).append(point)
    return machines


def _mean(series: Series, machine: str) -> tuple[float, float] | None:
    """Return the mean size on a machine and its standard error, as its records scatter; None without intervals."""
    own = [effect for row, effect in series.rows if row.machine == machine]
    sizes = [(e.size, (e.high - e.low) / (2 * NORMAL)) for e in own
             if e.size is not None and e.low is not None and e.high is not None and e.high > e.low]  # fmt: skip
    if not sizes:
        return None
    values, deviations = np.array(sizes).T
    weight = deviations**-2
    error = float(weight.sum()) ** -0.5
    mean = float(np.average(values, weights=weight))
    if len(values) > 1:
        error *= max(1.0, float(np.sqrt(weight @ (values - mean) ** 2 / (len(values) - 1))))
    return mean, error


def _likeliest(when: FloatArray, size: FloatArray, deviation: FloatArray) -> tuple[str, int, float, float, float]:
    """Return shape, record, levels before and after, and probability of the shape that is least by chance."""
    from scipy.stats import norm, t

    n = len(size)
    factor = 1.0
    if n >= FEWEST:
        steps = np.diff(size) / np.hypot(deviation[1:], deviation[:-1])
        factor = max(1.0, MAD * float(np.median(np.abs(steps))))
    sure = deviation * factor

    def chance(z: float, tried: int) -> float:
        tail = norm.sf(z) if factor == 1.0 else t.sf(z, n - 2)
        return min(1.0, 3.0 * tried * 2.0 * float(tail))  # 3 shapes, on either side

    weight = sure**-2
    found = []
    for cut in range(1, n):
        parts = [(np.average(size[part], weights=weight[part]), weight[part].sum() ** -0.5)
                 for part in (slice(None, cut), slice(cut, None))]  # fmt: skip
        (before, one), (after, two) = parts
        found.append(
            ("step", cut, float(before), float(after), chance(abs(after - before) / np.hypot(one, two), n - 1))
        )
    if n > 2 and np.ptp(when) > 0:
        centre = np.average(when, weights=weight)
        spread = float(weight @ (when - centre) ** 2)
        level = float(np.average(size, weights=weight))
        slope = float(weight @ ((when - centre) * size)) / spread
        ends = [level + slope * (end - centre) for end in (when[0], when[-1])]
        found.append(("drift", n - 1, float(ends[0]), float(ends[1]), chance(abs(slope) * spread**0.5, 1)))
    for k in range(n) if n >= FEWEST else ():
        others = np.delete(np.arange(n), k)
        middle = float(np.median(size[others]))
        error = np.hypot(sure[k], 1.2533 * float(np.median(sure[others])) / np.sqrt(n - 1))  # of a median
        found.append(("outlier", k, middle, float(size[k]), chance(abs(size[k] - middle) / error, n)))
    return min(found, key=lambda one: (_left(one, when, size, weight), one[4]))


def _left(found: tuple[str, int, float, float, float], when: FloatArray, size: FloatArray, weight: FloatArray) -> float:
    """Return what a shape leaves unexplained: the shapes are compared by it, as each adds one number to a level."""
    shape, place, before, after, _ = found
    told = np.full(len(size), before)
    if shape == "step":
        told[place:] = after
    elif shape == "outlier":
        told[place] = after
        kept = np.delete(np.arange(len(size)), place)
        told[kept] = np.average(size[kept], weights=weight[kept])
    else:
        told = before + (after - before) * (when - when[0]) / (when[-1] - when[0])
    return float(weight @ (size - told) ** 2)
