"""Time stamps without a unit: taken for seconds only where nothing speaks for another one."""

from __future__ import annotations

import numpy as np

from harness.errors import InputError
from harness.signals import FloatArray

SLOWEST_UNSTATED = 1.0
"""Steps [s] from which a time column without a unit is asked for one: whole numbers at 1 kHz count milliseconds, and a
log of seconds that is as slow is told apart by nothing but its title."""

SMALLER = (("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9))
"""Units of time that loggers count in, and their sizes [s]."""

SERIALS = ((36526.0, 69807.0), (730486.0, 748749.0), (2451544.5, 2469807.5))
"""Days of the years 2000 to 2049 as Excel counts them (and to 2090, with those of the modified Julian date, which
begin there too), as MATLAB does, and as the Julian date."""

DAY = 86400.0  # Seconds.

USUAL = (1.0, 1.2, 1.5, 1.8, 2.0, 2.5, 3.0, 3.6, 4.0, 5.0, 6.0, 7.2, 9.0)
"""Leading digits of the sample times [s] that people choose, up to hours."""

NEAR = 5e-3
"""Relative distance within which a step is one of these; those of usual rates in seconds are 4 % and more off."""


def refuse_unlikely_seconds(time: FloatArray, title: str) -> None:
    """Refuse time stamps without a unit whose steps would be rare ones in seconds, or are those of a count of days.

    Raises InputError if the median step is :data:`SLOWEST_UNSTATED` or more, or the stamps are days of this century at
    a step that is a usual number of seconds.

    - ``time`` (N,): stamps as they were read

    Examples
    --------
    >>> refuse_unlikely_seconds(np.arange(5) * 0.01, "time")
    >>> try:
    ...     refuse_unlikely_seconds(45382.0 + np.arange(5) / 86400, "time")
    ... except InputError as error:
    ...     print(error.what)
    the time column 'time' may count days
    """
    stamps = time[np.isfinite(time)]
    steps = np.diff(stamps)
    typical = float(np.median(steps)) if steps.size else 0.0
    if typical >= SLOWEST_UNSTATED:
        raise InputError(
            f"the time column {title!r} states no unit",
            expected=f"a unit where rows are {SLOWEST_UNSTATED:g} or more apart",
            got=f"steps of {typical:g}: {', '.join(f'{typical * size:.4g} s in {unit}' for unit, size in SMALLER)}",
            remedy=f'title it "{title} [UNIT]" with the one that is right, or declare [time] unit in a dataset.toml '
            "(sysid: --unit time=UNIT)",
            place="time.unit",
        )
    if steps.size and any(low <= stamps[0] <= high for low, high in SERIALS):
        step = float(stamps[-1] - stamps[0]) / steps.size * DAY
        leading = step / 10.0 ** np.floor(np.log10(step)) if step > 0.0 else 0.0
        if any(abs(leading / usual - 1.0) < NEAR for usual in (*USUAL, 10.0)):
            raise InputError(
                f"the time column {title!r} may count days",
                expected="a stated unit, as Excel and MATLAB count days by such numbers",
                got=f"{stamps[0]:.10g} and steps of {typical:.4g}, which in days are {float(f'{step:.3g}'):g} s",
                remedy=f'title it "{title} [d]" or "{title} [s]", or declare [time] unit in a dataset.toml '
                "(sysid: --unit time=d, or s)",
                place="time.unit",
            )
