"""The record of an estimate: parameters with units, covariance, intervals and how they came, rank, convergence.

Every identifier leaves one in ``model.notes["estimate"]``; :func:`estimate_of` reads it, reports print it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from harness.errors import InputError, as_described, refuse_unknown
from harness.signals import FloatArray
from harness.units import behind

SHARE = 0.05
"""A parameter whose share in a null direction (columns at unit length) is below this is left out of its words."""

SHOWN = 3  # Null directions that are printed; all are kept.


@dataclass(frozen=True)
class RankDecision:
    """How many directions of the parameters the data determine, and which they do not.

    Examples
    --------
    >>> print(RankDecision(2, 3, ("I grows by 0.0153 for each 1 of r",), ("I", "r"), "1.5 times the noise"))
    rank 2 of 3 (1.5 times the noise); not determined: I grows by 0.0153 for each 1 of r
    """

    # Directions determined, of how many parameters
    rank: int
    columns: int
    null_directions: tuple[str, ...] = ()
    """In words: what can change together without anything that the data could show."""
    undetermined: tuple[str, ...] = ()  # Names of the parameters that have a part in one
    rule: str = ""  # What decided: ``"1.5 times the noise in the regressor"``

    @classmethod
    def of(
        cls, names: Sequence[str], null: FloatArray, lengths: FloatArray, loose: Sequence[Any] | FloatArray, rule: str
    ) -> RankDecision:
        """Return the decision that a null space (k, d) and a flag for each of k names make, as :func:`null_words`."""
        undetermined = tuple(name for name, one in zip(names, loose, strict=True) if one)
        return cls(len(names) - null.shape[1], len(names), null_words(names, null, lengths), undetermined, rule)

    @property
    def full(self) -> bool:
        """True if every parameter is determined."""
        return self.rank == self.columns

    def __str__(self) -> str:
        text = f"rank {self.rank} of {self.columns}" + (f" ({self.rule})" if self.rule else "")
        if not self.null_directions:
            return text
        more = len(self.null_directions) - SHOWN
        said = "; ".join(self.null_directions[:SHOWN]) + (f"; and {more} more" if more > 0 else "")
        return f"{text}; not determined: {said}"


@dataclass(frozen=True, eq=False)
class Estimate:
    """Parameters that were estimated, and how far they can be believed.

    Raises InputError if the sizes do not fit, a name is used twice, or an interval is upside down.

    Examples
    --------
    >>> one = Estimate(("m",), ("kg",), np.array([2.0]), np.array([[0.01]]), np.array([[1.8, 2.2]]), method="normal")
    >>> print(one)
    m = 2 kg [1.8, 2.2] (95 %: normal)
    >>> Estimate.from_dict(one.to_dict()).interval("m")
    (1.8, 2.2)
    """

    # One for each parameter
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: FloatArray  # (k,): In these units
    covariance: FloatArray | None = None
    """(k, k): None where none was computed; infinite variances of what is not determined."""
    intervals: FloatArray | None = None
    """(k, 2): Low and high of each parameter; NaN where there is none. None: no interval is claimed."""
    level: float = 0.95  # Probability with which an interval holds the truth
    method: str = ""  # How the intervals were computed, or why there is none
    rank: RankDecision | None = None
    condition: float = math.nan
    """Condition number of the regressor, columns at unit length; NaN where there is no regressor."""
    converged: bool = True  # False if the search did not end at a minimum inside the bounds
    message: str = ""  # One line on how it went
    on_bound: tuple[str, ...] = field(default=())  # Parameters that ended on a bound

    def __post_init__(self) -> None:
        k = len(self.names)
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "units", tuple(self.units))
        object.__setattr__(self, "values", np.array(self.values, dtype=float).reshape(-1))
        for name, shape in (("covariance", (k, k)), ("intervals", (k, 2))):
            given = getattr(self, name)
            if given is not None:
                object.__setattr__(self, name, np.array(given, dtype=float))
                if getattr(self, name).shape != shape:
                    _refuse(f"{name} of an estimate", f"shape {shape}", str(np.shape(given)))
        if len(self.units) != k or self.values.size != k or len(set(self.names)) != k:
            _refuse(
                "names, units and values of an estimate",
                "one of each for each parameter, names that differ",
                f"{k} names, {len(self.units)} units, {self.values.size} values",
            )
        if self.intervals is not None and np.any(self.intervals[:, 0] > self.intervals[:, 1]):
            _refuse("intervals of an estimate", "low <= high", "one upside down")
        if not 0 < self.level < 1:
            _refuse("level of an estimate", "a probability between 0 and 1", f"{self.level:g}")

    def value(self, name: str) -> float:
        """Return one value."""
        return float(self.values[self._index(name)])

    def interval(self, name: str) -> tuple[float, float] | None:
        """Return low and high of one parameter, or None where no interval is claimed."""
        if self.intervals is None:
            return None
        low, high = self.intervals[self._index(name)]
        return (float(low), float(high)) if math.isfinite(low) and math.isfinite(high) else None

    def deviation(self, name: str) -> float | None:
        """Return the standard deviation of one parameter; infinite if it is not determined, None if unknown."""
        row = self._index(name)
        return None if self.covariance is None else float(np.sqrt(max(self.covariance[row, row], 0.0)))

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description."""
        return {
            "names": list(self.names),
            "units": list(self.units),
            "values": _finite(self.values),
            "covariance": None if self.covariance is None else _finite(self.covariance),
            "intervals": None if self.intervals is None else _finite(self.intervals),
            "level": self.level,
            "method": self.method,
            "rank": None
            if self.rank is None
            else {
                "rank": self.rank.rank,
                "columns": self.rank.columns,
                "null_directions": list(self.rank.null_directions),
                "undetermined": list(self.rank.undetermined),
                "rule": self.rank.rule,
            },
            "condition": self.condition if math.isfinite(self.condition) else None,
            "converged": self.converged,
            "message": self.message,
            "on_bound": list(self.on_bound),
        }

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Estimate:
        """Return the estimate of a description.

        Raises
        ------
        InputError
            If it is none.
        """
        with as_described("an estimate", remedy="fit the model anew"):
            rank = content["rank"]
            decision = (
                None
                if rank is None
                else RankDecision(
                    int(rank["rank"]),
                    int(rank["columns"]),
                    tuple(rank["null_directions"]),
                    tuple(rank["undetermined"]),
                    str(rank["rule"]),
                )
            )
            # JSON has no infinity: an unknown variance is that of something not determined
            covariance = None if content["covariance"] is None else _array(content["covariance"], math.inf)
            intervals = None if content["intervals"] is None else _array(content["intervals"], math.nan)
            return cls(
                tuple(content["names"]),
                tuple(content["units"]),
                _array(content["values"], math.nan),
                covariance,
                intervals,
                float(content["level"]),
                str(content["method"]),
                decision,
                math.nan if content["condition"] is None else float(content["condition"]),
                bool(content["converged"]),
                str(content["message"]),
                tuple(map(str, content["on_bound"])),
            )

    def __str__(self) -> str:
        parts = []
        for row, (name, unit) in enumerate(zip(self.names, self.units, strict=True)):
            found = self.interval(name)
            text = f"{name} = {self.values[row]:.6g}{behind(unit)}"
            parts.append(text + (f" [{found[0]:.6g}, {found[1]:.6g}]" if found else ""))
        how = f"{100 * self.level:g} %: {self.method}" if self.intervals is not None else self.method
        lines = [", ".join(parts) + (f" ({how})" if how else "")]
        if self.rank is not None and not self.rank.full:
            lines.append(str(self.rank))
        if not self.converged:
            lines.append("not converged" + (f": {self.message}" if self.message else ""))
        if self.on_bound:
            lines.append(f"on a bound: {', '.join(self.on_bound)}")
        return "; ".join(lines)

    def _index(self, name: str) -> int:
        refuse_unknown("parameter of an estimate", name, self.names)
        return self.names.index(name)


def estimate_of(model: Any) -> Estimate | None:
    """Return the estimate that a fitted model carries in its notes, or None if it has none.

    Parameters
    ----------
    model : Model
        Any fitted model.
    """
    notes = getattr(model, "notes", None)
    found = notes.get("estimate") if isinstance(notes, Mapping) else None
    return Estimate.from_dict(found) if isinstance(found, Mapping) else None


def null_words(names: Sequence[str], basis: FloatArray, lengths: FloatArray | None = None) -> tuple[str, ...]:
    """Return the directions of a null space in words, one for each.

    - ``names``: of the k parameters
    - ``basis`` (k, d): columns span the null space, in parameters times ``lengths``
    - ``lengths`` (k,): length of each column of the regressor; 1 by default. Those at 0 belong to parameters without
      any effect.

    Examples
    --------
    >>> null_words(["m", "I", "r"], np.array([[0.0], [1.0], [1.0]]), np.array([1.0, 65.4, 1.0]))
    ('I and r only in proportion: I may grow by 0.0153 for each 1 of r',)
    >>> null_words(["m", "I"], np.array([[0.0], [1.0]]))
    ('I has no effect',)
    """
    k = len(names)
    size = np.ones(k) if lengths is None else np.where(np.asarray(lengths) > 0, lengths, 1.0)
    rows = np.array(basis, dtype=float).reshape(k, -1).T.copy()
    words, free = [], list(range(rows.shape[0]))
    order: list[tuple[int, int]] = []
    # Reduced row echelon form with the largest pivot first: each direction then has a parameter of its own.
    while free:
        block = np.abs(rows[free])
        block[:, [column for _, column in order]] = 0.0
        place = np.unravel_index(int(np.argmax(block)), block.shape)
        row, column = free[int(place[0])], int(place[1])
        if rows[row, column] == 0.0:
            break
        rows[row] /= rows[row, column]
        for other in range(rows.shape[0]):
            if other != row:
                rows[other] -= rows[other, column] * rows[row]
        order.append((row, column))
        free.remove(row)
    for row, column in sorted(order, key=lambda one: one[1]):
        part = [c for c in range(k) if c != column and abs(rows[row, c]) > SHARE]
        if not part:
            words.append(f"{names[column]} has no effect")
        elif len(part) == 1:
            ratio = (rows[row, column] / size[column]) / (rows[row, part[0]] / size[part[0]])
            verb = "grow" if ratio > 0 else "fall"
            words.append(
                f"{names[column]} and {names[part[0]]} only in proportion: "
                f"{names[column]} may {verb} by {abs(ratio):.3g} for each 1 of {names[part[0]]}"
            )
        else:
            own = size[column]
            others = ", ".join(f"{names[c]} by {rows[row, c] / size[c] * own:+.3g}" for c in part)
            words.append(f"{names[column]} may grow by 1 while {others}")
    return tuple(words)


def _finite(numbers: FloatArray) -> list[Any]:
    """Return nested lists with None for what JSON cannot hold."""
    if numbers.ndim > 1:
        return [_finite(row) for row in numbers]
    return [float(one) if math.isfinite(one) else None for one in numbers]


def _array(rows: Any, missing: float) -> FloatArray:
    """Return an array of nested lists, None replaced."""
    return np.array(
        [
            [missing if x is None else x for x in one] if isinstance(one, list) else (missing if one is None else one)
            for one in rows
        ],
        dtype=float,
    )


def _refuse(what: str, expected: str, got: str) -> None:
    raise InputError(what, expected=expected, got=got, remedy="correct the record")
