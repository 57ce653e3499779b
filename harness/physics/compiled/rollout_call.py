"""Calls of the compiled roll-out: what it takes and gives, as C sees it."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from harness.signals import FloatArray

_COUNTS = ("m", "n", "substeps", "every", "chosen")
_INPUTS = ("p", "x0", "u", "d", "t0", "columns")
_ROWS = ("x", "y", "s")
_SUMS = ("measured", "sigma", "period", "limit", "cost", "squares", "gram", "gradient")


class Given(NamedTuple):
    """Windows of one length, as :meth:`harness.physics.compiled.simulator.Simulator.windows` takes them.

    Parameters (M, np), starts (M, nx), inputs (M, N, nu) as the equations see them, their derivatives by the delays
    (M, N, nu, delays) or None, and times of the first samples (M,).
    """

    p: FloatArray
    x0: FloatArray
    u: FloatArray
    input_jacobian: FloatArray | None
    t0: FloatArray


class Asked(NamedTuple):
    """What :class:`harness.physics.compiled.windows.Windows` asks beside the runs; see its ``trial``."""

    data: tuple[FloatArray, FloatArray, FloatArray]
    """Readings (M, N, ny), the weights' sigma (ny,) and the periods (ny,), 0 for an output that does not wrap."""
    columns: npt.NDArray[np.intp] | None
    """Which of (p, x0) are asked for; the sums of the others are 0. All of them without."""
    limits: FloatArray | None
    """A window (M,) whose cost exceeds its limit is pruned, its cost infinite (negative: not simulated)."""
    budget: float  # All of them are once they together exceed it.
    keep: bool  # Give states and residuals too.
    sensitivities: bool  # Give the sensitivities by all columns too.


@dataclass(eq=False)
class Sums:
    """What the windows of one length gave, summed in the roll-out: see :mod:`harness.physics.compiled.windows`."""

    costs: FloatArray
    squares: FloatArray
    gram: FloatArray
    gradient: FloatArray
    budget: float  # What the costs have left of it; negative once it is used up or a window diverged, if it was finite.
    states: FloatArray | None
    residuals: FloatArray | None
    sensitivities: FloatArray | None
    """(M, N, nx), (M, N, ny) and (M, N, ny, np + nx), NaN where a window was not simulated; None if not asked for."""


class _Job(ctypes.Structure):
    """The struct ``job`` of the C source, field by field."""

    _fields_ = (
        *((name, ctypes.c_long) for name in _COUNTS),
        ("dt", ctypes.c_double),
        ("budget", ctypes.c_double),
        ("foh", ctypes.c_long),
        *((name, ctypes.c_void_p) for name in (*_INPUTS, *_ROWS, *_SUMS)),
    )
    kept: Any
    """Arrays that must live as long as the job, if somebody has to see to it."""


def call_rollout(
    library: ctypes.CDLL, dt: float, substeps: int, foh: bool, every: int, budget: float, **arrays: FloatArray | Any
) -> float:
    """Simulate windows of equal length; returns what is left of the budget.

    - ``library``: of :func:`harness.physics.compiled.rollout_source.rollout_source`
    - ``dt``: time from one row of the inputs to the next [s]
    - ``substeps``: runge-Kutta steps from one row to the next
    - ``foh``: inputs move on straight lines
    - ``every``: outputs are taken at every so many rows
    - ``budget``: once the costs of all windows together exceed it the rest is not simulated; infinite for no limit
    - ``**arrays``: C-contiguous or None: ``p`` (M, np), ``x0`` (M, nx), ``u`` (M, N, nu), ``d`` (M, N, nu, delays),
      ``t0`` (M,), ``columns`` of C int, the chosen ones of (p, x0); results ``x`` (M, K, nx), ``y`` (M, K, ny), ``s``
      (M, K, ny, chosen). With ``measured`` (M, K, ny), ``sigma`` (ny,), ``period`` (ny,) (0: none) and ``limit`` (M,)
      or None, ``y`` are residuals and the sums go to ``cost`` (M,), ``squares`` (ny,), ``gram`` (M, ns, ns) and
      ``gradient`` (M, ns): entries of columns that are not chosen, and squares, are added to or left as they are.
    """
    job = _job(dt, substeps, foh, every, budget, arrays)
    library.sysid_rollout(ctypes.byref(job))
    return float(job.budget)


def repeated_rollout(library: ctypes.CDLL, dt: float, substeps: int, **arrays: FloatArray) -> Callable[[], None]:
    """Return a function that simulates from and into the same arrays at every call, input held.

    For one sample at a time, where packing the arguments would cost more than the simulation.

    - ``library, dt, substeps, **arrays``: as :func:`call_rollout` takes them: ``p``, ``x0``, ``u``, ``t0``, ``x`` and
      ``y``
    """
    job = _job(dt, substeps, False, 1, np.inf, arrays)
    job.kept = arrays
    return partial(library.sysid_rollout, ctypes.byref(job))


def _job(
    dt: float, substeps: int, foh: bool, every: int, budget: float, arrays: Mapping[str, FloatArray | Any]
) -> _Job:
    """Return the arguments as C sees them; the arrays must live as long as it is used."""
    m, n = arrays["u"].shape[:2]
    columns = arrays.get("columns")
    pointers = {name: array.ctypes.data for name, array in arrays.items() if array is not None}
    chosen = 0 if columns is None else len(columns)
    return _Job(m=m, n=n, substeps=substeps, every=every, chosen=chosen, dt=dt, budget=budget, foh=int(foh), **pointers)


def all_columns(count: int) -> Any:
    """Return the numbers of all columns as C ints."""
    return np.arange(count, dtype=np.intc)
