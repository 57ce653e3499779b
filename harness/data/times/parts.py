"""One time from columns that each hold a part of it: year, month, day, hour, minute, second, and parts of a second."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from harness.signals import FloatArray

PARTS = ("year", "month", "day", "h", "min", "s", "ms", "us", "ns")  # From the coarsest to the finest.
_SIZE = {"day": 86400.0, "h": 3600.0, "min": 60.0, "s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_RANGE = {
    "year": (1970, 2100), "month": (1, 12), "day": (1, 31), "h": (0, 24), "min": (0, 60), "s": (0, 60),
    "ms": (0, 1000), "us": (0, 1e6), "ns": (0, 1e9),
}  # fmt: skip
"""Values of a part below a coarser one; months and days reach their upper end, the others stay below."""


def of_parts(columns: Mapping[str, FloatArray]) -> FloatArray | None:
    """Return the times [s] from the first row that parts make together; None where they are no parts of one time.

    A coarsest part below the day begins anew with the next coarser one (after 23 comes 0); the finest may hold a
    fraction. A finer part that leaves its range (a count of milliseconds beyond 999) is a clock of its own.

    - ``columns`` mapping of str to array (N,): by name in :data:`PARTS`, from the coarsest to the finest without one
      left out

    Examples
    --------
    >>> of_parts({"h": np.array([23.0, 0.0]), "min": np.array([59.0, 0.0]), "s": np.array([59.5, 0.5])}).tolist()
    [0.0, 1.0]
    >>> of_parts({"s": np.array([7.0, 8.0]), "ms": np.array([990.0, 10.0])}).round(3).tolist()
    [0.0, 0.02]
    >>> of_parts({"s": np.array([0.0, 1.0]), "ms": np.array([0.0, 1000.0])}) is None
    True
    """
    names = [name for name in PARTS if name in columns]
    for name in names:
        values = columns[name]
        low, high = _RANGE[name]
        inside = (values >= low) & ((values <= high) if name in ("month", "day") else (values < high))
        whole = values == np.round(values)
        coarsest_count = name == names[0] and name not in ("year", "month", "day")  # hours or seconds since the start
        if not (inside.all() or coarsest_count) or not (whole.all() or name == names[-1]):
            return None
    within = np.zeros(len(columns[names[0]]))
    for name in reversed([name for name in names if name not in ("year", "month")]):
        within = within + _SIZE[name] * (columns[name] - columns[name][0])
    if "year" in names or "month" in names:
        year = columns["year"] if "year" in names else np.full(len(within), 2000.0)
        month = columns["month"] if "month" in names else np.ones(len(within))
        begin = ((year - 1970) * 12 + month - 1).astype("int64").astype("datetime64[M]").astype("datetime64[D]")
        within = within + _SIZE["day"] * (begin - begin[0]).astype("int64").astype(np.float64)
    elif names[0] in ("h", "min") and (columns[names[0]] < _RANGE[names[0]][1]).all():
        period = 86400.0 if names[0] == "h" else 3600.0
        within = within + period * np.cumsum(np.diff(within, prepend=within[0]) < -period / 2)
    return np.asarray(within)
