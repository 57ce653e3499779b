"""Where the size of an effect changes between dates: a step, a drift, one record; which machine is not as the others.

A size that stays the same scatters by its interval, or by more where records differ otherwise: what a shape leaves of
the sizes tells how much. Against that scatter three shapes are tested.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from harness.fleet.row import FleetRow
from harness.fleet.trends import NORMAL, Series, fitted, series_of
from harness.signals import FloatArray
from harness.units import behind

LEVEL = 0.01
"""Probability with which, in a fleet where nothing changes, something is named all the same, over all that is tried."""
FEWEST = 4  # Machines, or records of one, from which their scatter is told: of three, two may agree by chance.
KNOWN = 2.0
"""Degrees of freedom that the width of intervals is worth: of 4 to 20 records that scatter once, twice and five times
as widely as theirs, and do not change, .0, .6 and 4 % at most are said to (1500 draws each)."""
MAD = 1.4826  # Median absolute deviation to standard deviation, of a normal distribution.


@dataclass(frozen=True)
class Change:
    """A size that did not stay the same on one machine."""

    machine: str
    series: Series
    shape: str  # {"step", "drift", "outlier"}
    row: FleetRow  # The first record after a step, the last of a drift, the one that stands out
    # Levels before and after a step, at the ends of the line of a drift; all others and the one that stands out
    before: float
    after: float
    p: float
    """Probability of so much in a machine that stays the same, times the number of places, shapes, machines and sizes
    that were tried (Bonferroni)."""

    def __str__(self) -> str:
        unit = behind(self.series.unit)
        where = f" on {self.machine}" if self.machine else ""
        name = f"{self.series.effect} {self.series.parameter}{where}"
        how = {"step": "steps from", "drift": "drifts from", "outlier": "is elsewhere"}[self.shape]
        when = {"step": "at", "drift": "up to", "outlier": "only in"}[self.shape]
        return (
            f"{name} {how} {self.before:.4g} to {self.after:.4g}{unit} {when} {self.row.record} ({self.row.day}), "
            f"p {chance(self.p)}"
        )


@dataclass(frozen=True)
class Odd:
    """A machine that is not as the others."""

    machine: str
    effect: str  # ``effect@place``
    what: str  # The size and that of the others, or in how many records the effect is
    p: float  # As of :class:`Change`

    def __str__(self) -> str:
        return f"{self.machine} is not as the others: {self.effect} {self.what}, p {chance(self.p)}"


def chance(p: float) -> str:
    """Return a probability in words; below what a normal distribution is known to, that.

    Examples
    --------
    >>> chance(0.00123), chance(0.0)
    ('0.0012', 'below 1e-16')
    """
    return f"{p:.2g}" if p >= 1e-16 else "below 1e-16"


def changes(rows: Sequence[FleetRow]) -> list[Change]:
    """Return the changes of sizes, the surest first; at most one shape for each machine and size, the likeliest.

    Notes
    -----
    A step lies at any place where the records can be parted, a drift is a line over the date, an outlier any record:
    the size of each over its error by the intervals, larger by Birge's ratio where it leaves more than these say
    (Bevington & Robinson 2003, sec. 4.2), by Student's distribution, times the places tried.
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


def odd_machines(rows: Sequence[FleetRow]) -> list[Odd]:
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
                unit = behind(own.unit)
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


def _dated(series: Series) -> dict[str, list[tuple[FleetRow, float, float, float]]]:
    """Return by machine the records that have a date, a size and an interval: row, instant [s], size, deviation."""
    machines: dict[str, list[tuple[FleetRow, float, float, float]]] = {}
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
    """Return shape, record, levels before and after, and probability of the shape that leaves least.

    Each shape is one column beside a level, fitted by weighted least squares, and is judged against what it leaves.
    """
    n = len(size)
    weight = deviation**-2
    shapes = [("step", cut, (np.arange(n) >= cut).astype(float), n - 1) for cut in range(1, n)]
    if n > 2 and np.ptp(when) > 0:
        shapes.append(("drift", n - 1, (when - when[0]) / np.ptp(when), 1))
    shapes += [("outlier", k, (np.arange(n) == k).astype(float), n) for k in range(n) if n >= FEWEST]
    found = []
    for shape, place, column, tried in shapes:
        before, by, error, left = fitted(column, size, weight)
        found.append((left, _chance(by / error, left, n, 3 * tried), shape, place, before, before + by))
    _, p, shape, place, before, after = min(found)
    return shape, place, before, after, p


def _chance(z: float, left: float, n: int, tried: int) -> float:
    """Return the probability of a factor so many errors large, on either side, where so much is left of n sizes.

    The scatter is the largest of what the intervals say, what is left, and both together (moderated t: Smyth 2004,
    *Stat. Appl. Genet. Mol. Biol.* 3, eq. 7); of fewer than four sizes that of their intervals.
    """
    from scipy.stats import norm, t

    if n < FEWEST:
        return min(1.0, tried * 2.0 * float(norm.sf(abs(z))))
    freedom = n - 2 + KNOWN
    scatter = max(1.0, left / (n - 2), (left + KNOWN) / freedom)
    return min(1.0, tried * 2.0 * float(t.sf(abs(z) / np.sqrt(scatter), freedom)))
