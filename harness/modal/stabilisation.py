"""Which poles stay where they are as the order grows: the rule behind a stabilisation diagram."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from harness.errors import InputError
from harness.modal.poles import Pole, mac

GAP = 3
"""Orders that a mode may be missing from before what follows counts as another."""


@dataclass(frozen=True)
class Criteria:
    """When a pole counts as the same as one of an order before, and when a row of them counts as a mode.

    The values are those in common use (Peeters & De Roeck 1999, sec. 5; Reynders, Houbrechts & De Roeck 2012, Mech.
    Syst. Signal Process. 29:228, sec. 3).

    Parameters
    ----------
    frequency : float
        Largest change, as a share of the frequency.
    damping : float
        Largest change, as a share of the damping ratio; a change within one standard deviation counts as none.
    mac : float
        Least modal assurance criterion of the two shapes.
    share : float
        Share of the orders, from the first at which it is found, at which a mode must be stable.
    least : int
        Orders at which it must be stable, at least.

    Raises
    ------
    InputError
        If a number is out of its range.

    Examples
    --------
    >>> Criteria(frequency=0.02).text
    'frequency within 2 %, damping within 10 % or its deviation, MAC from 0.95; at half of the orders from its first on'
    """

    frequency: float = 0.01
    damping: float = 0.1
    mac: float = 0.95
    share: float = 0.5
    least: int = 3

    def __post_init__(self) -> None:
        right = self.frequency > 0 and self.damping > 0 and 0 <= self.mac <= 1 and 0 < self.share <= 1
        if not (right and self.least >= 1):
            raise InputError(
                "criteria of stabilisation",
                expected="frequency > 0, damping > 0, 0 <= mac <= 1, 0 < share <= 1, least >= 1",
                got=f"{self.frequency}, {self.damping}, {self.mac}, {self.share}, {self.least}",
                remedy="correct them",
            )

    @property
    def text(self) -> str:
        """The rule in words."""
        share = "half" if self.share == 0.5 else f"{100 * self.share:g} %"
        return (
            f"frequency within {100 * self.frequency:g} %, damping within {100 * self.damping:g} % or its deviation, "
            f"MAC from {self.mac:g}; at {share} of the orders from its first on"
        )

    def near(self, first: Pole, second: Pole) -> float | None:
        """Return the relative difference of two frequencies plus 1 - MAC; None where the poles are not of one mode."""
        apart = abs(first.frequency - second.frequency) / max(first.frequency, second.frequency)
        likeness = mac(first.shape, second.shape)
        return apart + 1.0 - likeness if apart <= self.frequency and likeness >= self.mac else None

    def equally_damped(self, first: Pole, second: Pole) -> bool:
        """Return True if two poles have the same damping ratio."""
        change = abs(first.damping - second.damping)
        chance = [p.damping_deviation for p in (first, second) if np.isfinite(p.damping_deviation)]
        return change <= max(self.damping * max(abs(first.damping), abs(second.damping)), min(chance, default=0.0))


@dataclass(eq=False)
class Track:
    """Poles of one mode at several orders, and which of them are stable."""

    poles: list[Pole] = field(default_factory=list)
    stable: list[bool] = field(default_factory=list)

    def holds(self, criteria: Criteria, orders: Sequence[int]) -> bool:
        """Return True if the poles are stable at orders enough to be a mode."""
        follow = sum(order >= self.poles[0].order for order in orders)
        return sum(self.stable) >= max(criteria.share * (follow - 1), min(criteria.least, len(orders) - 1))

    @property
    def best(self) -> Pole:
        """The stable pole that stands for the mode: of the deviation that a quarter of them fall below.

        The least would be one that chance made small, and the median comes from orders that split the mode. Without
        deviations the pole in the middle of the frequencies.
        """
        stable = [pole for pole, kept in zip(self.poles, self.stable, strict=True) if kept] or self.poles
        known = all(np.isfinite(pole.frequency_deviation) for pole in stable)
        if known:
            return sorted(stable, key=lambda pole: pole.frequency_deviation)[(len(stable) - 1) // 4]
        return sorted(stable, key=lambda pole: pole.frequency)[(len(stable) - 1) // 2]


def tracks_of(ladder: Mapping[int, Sequence[Pole]], criteria: Criteria) -> list[Track]:
    """Return the poles of all orders, sorted into modes; each pole belongs to one.

    Every pole is compared with the last of each mode so far, and takes the nearest that no other pole is nearer to: two
    poles of one order are two modes, however close they are.

    - ``ladder``: poles by order, orders rising

    Examples
    --------
    >>> import numpy as np
    >>> pole = lambda order, frequency: Pole(order, 0.9j, frequency, 0.01, np.ones(1, complex))
    >>> ladder = {2: [pole(2, 1.0)], 4: [pole(4, 1.001), pole(4, 1.8)], 6: [pole(6, 1.002), pole(6, 2.2)]}
    >>> [(len(track.poles), sum(track.stable)) for track in tracks_of(ladder, Criteria())]
    [(3, 2), (1, 0), (1, 0)]
    """
    orders = list(ladder)
    tracks: list[Track] = []
    for place, order in enumerate(orders):
        earlier = set(orders[max(place - GAP, 0) : place])
        live = [track for track in tracks if track.poles[-1].order in earlier]
        pairs = [
            (apart, i, j)
            for i, track in enumerate(live)
            for j, pole in enumerate(ladder[order])
            if (apart := criteria.near(track.poles[-1], pole)) is not None
        ]
        taken: set[int] = set()
        found: set[int] = set()
        for _, i, j in sorted(pairs):
            if i in taken or j in found:
                continue
            taken.add(i)
            found.add(j)
            pole = ladder[order][j]
            live[i].stable.append(criteria.equally_damped(live[i].poles[-1], pole))
            live[i].poles.append(pole)
        tracks += [Track([pole], [False]) for j, pole in enumerate(ladder[order]) if j not in found]
    return tracks
