"""Tubes of a stated width around a reference: how far a run may be off in value and in time."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from harness.errors import InputError
from harness.signals import FloatArray

_PART = re.compile(r"^([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)(%?)$")
EVERY = "*"


@dataclass(frozen=True)
class Tube:
    """Half the width of a tube.

    Parameters
    ----------
    absolute : float
        In the unit of the reference.
    relative : float
        Of the range of the reference, greatest less smallest value.
    time : float
        [s]; a run may be early or late by so much.

    Examples
    --------
    >>> Tube.read("0.01+0.5%@0.02")
    Tube(absolute=0.01, relative=0.005, time=0.02)
    """

    absolute: float = 0.0
    relative: float = 0.0
    time: float = 0.0

    @classmethod
    def read(cls, text: str) -> Tube:
        """Read ``0.01``, ``0.5%``, ``0.01+0.5%``, each with ``@0.02`` for a width in time [s].

        Raises
        ------
        InputError
            If it is none of these.
        """
        width, at, late = text.replace(" ", "").partition("@")
        numbers = {"": 0.0, "%": 0.0}
        parts = re.split(r"(?<![eE])\+", width) if width else []
        matches = [_PART.match(part) for part in parts]
        time = _PART.match(late) if at else None
        negative = [m for m in (*matches, time) if m is not None and float(m[1]) < 0]
        wrong = any(m is None for m in matches) or (at and (time is None or time[2])) or not (parts or at) or negative
        if wrong:
            raise InputError(
                "tube",
                expected="a width such as 0.01, 0.5% (of the range), 0.01+0.5%, 0.01@0.02 (and 0.02 s in time)",
                got=repr(text),
                remedy="correct it",
                place="--tube",
            )
        for match in matches:
            assert match is not None
            numbers[match[2]] += float(match[1])
        return cls(numbers[""], numbers["%"] / 100.0, 0.0 if time is None else float(time[1]))

    def limits(self, t: FloatArray, y: FloatArray, at: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the lower and the upper limit at instants ``at`` (N,).

        The reference runs straight from point to point; where two points share an instant it jumps, and the tube holds
        both. A tube that is wide in time holds every value of the reference within that time.

        Parameters
        ----------
        t, y : array (M,)
            The reference, ``t`` not falling.
        at : array (N,)
        """
        half = self.absolute + self.relative * float(np.ptp(y))
        low, high = np.empty(len(at)), np.empty(len(at))
        for sign, into in ((1.0, high), (-1.0, low)):
            ends = [_one_sided(t, sign * y, at + shift, side) for shift in (-self.time, self.time) for side in (-1, 1)]
            first = np.searchsorted(t, at - self.time, "left")
            last = np.searchsorted(t, at + self.time, "right")
            most = np.maximum.reduce([*ends, _greatest(sign * y, first, last)])
            into[:] = sign * (most + half)
        return low, high


def _one_sided(t: FloatArray, y: FloatArray, at: FloatArray, side: int) -> FloatArray:
    """Return the reference just before (-1) or just after (1) instants; beyond its ends it stays."""
    if side < 0:
        row = np.clip(np.searchsorted(t, at, "left") - 1, 0, len(t) - 1)
    else:
        row = np.clip(np.searchsorted(t, at, "right") - 1, 0, len(t) - 1)
    after = np.minimum(row + 1, len(t) - 1)
    span = t[after] - t[row]
    share = np.clip(np.divide(at - t[row], span, out=np.zeros_like(at), where=span > 0), 0.0, 1.0)
    return np.asarray(y[row] + share * (y[after] - y[row]))


def _greatest(y: FloatArray, first: np.ndarray, last: np.ndarray) -> FloatArray:
    """Return the greatest of ``y[first:last]`` for every pair; minus infinity where it is empty."""
    padded = np.append(y, -np.inf)
    edges = np.column_stack([first, np.maximum(last, first)]).ravel()
    found = np.maximum.reduceat(padded, edges)[::2]
    return np.where(last > first, found, -np.inf)


def read_tubes(given: Mapping[str, str] | Sequence[tuple[str, str]]) -> dict[str, Tube]:
    """Return tubes by name; ``*`` is that of all others."""
    pairs = given.items() if isinstance(given, Mapping) else given
    return {name: Tube.read(text) for name, text in pairs}


def tube_of(tubes: Mapping[str, Tube], name: str) -> Tube | None:
    """Return the tube of a channel, None where none is said."""
    return tubes.get(name, tubes.get(EVERY))
