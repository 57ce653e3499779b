"""The recursion of recursive least squares over many samples: compiled, or in numpy where there is no C compiler."""

from __future__ import annotations

import ctypes
import functools
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.signals import FloatArray
from identifiers.common.native import declared, pointers

# Numbers of the head: seen, rows, order, p, ny, nu, burn-in, forgetting, prior.
_HEAD = 9


@dataclass(frozen=True)
class RlsLayout:
    """Where things stand in the memory of a recursion; ``rls_loop.c`` has the same order.

    Parameters
    ----------
    order, ny, nu : int
    offset : bool
    burn_in : int
        Equations before the first prediction is made by them.
    forgetting, prior : float
        As of :class:`identifiers.online.rls.RecursiveLeastSquares`.
    """

    order: int
    ny: int
    nu: int
    offset: bool
    burn_in: int
    forgetting: float
    prior: float

    @functools.cached_property
    def p(self) -> int:
        """Number of parameters of each output."""
        return self.order * (self.ny + self.nu) + int(self.offset)

    @functools.cached_property
    def _starts(self) -> tuple[int, ...]:
        """Where the sample, free response, gain, row, triangle, coefficients and work begin, and the size of it all."""
        ny, nu, p = self.ny, self.nu, self.p
        return tuple(np.cumsum((_HEAD, nu + ny, ny, nu * ny, p, p * (p + ny), p * ny, p + ny)).tolist())

    @functools.cached_property
    def sample(self) -> tuple[slice, slice]:
        """Where the input and the output of a sample stand."""
        first, last = self._starts[:2]
        return slice(first, first + self.nu), slice(first + self.nu, last)

    @functools.cached_property
    def ahead(self) -> tuple[slice, slice, tuple[int, int]]:
        """Where free response and gain stand, and the shape of the gain: the next output is free + u gain."""
        return slice(*self._starts[1:3]), slice(*self._starts[2:4]), (self.nu, self.ny)

    def blank(self) -> FloatArray:
        """Return a memory (size,) before any data."""
        memory = np.zeros(self._starts[-1])
        memory[2:_HEAD] = self.order, self.p, self.ny, self.nu, self.burn_in, self.forgetting, self.prior
        return memory

    def row(self, memory: FloatArray) -> FloatArray:
        """Return the regressors of the next output (p,), a view; the input to come is not known yet."""
        return memory[self._starts[3] : self._starts[4]]

    def triangle(self, memory: FloatArray) -> FloatArray:
        """Return ``[R z]`` (p, p + ny), a view."""
        return memory[self._starts[4] : self._starts[5]].reshape(self.p, self.p + self.ny)

    def theta(self, memory: FloatArray) -> FloatArray:
        """Return the coefficients (p, ny), a view; zeros during the burn-in."""
        return memory[self._starts[5] : self._starts[6]].reshape(self.p, self.ny)


def learn(layout: RlsLayout, memory: FloatArray) -> None:
    """Learn from the sample that stands in the memory (size,), in place."""
    call = _compiled()
    if call is None:
        u, y = (memory[part].reshape(1, -1) for part in layout.sample)
        _plain(layout, memory, u, y, np.empty(y.shape))
        return
    call.sysid_rls_step(ctypes.c_double.from_buffer(memory.data))


def run(
    layout: RlsLayout, memory: FloatArray, u: FloatArray, y: FloatArray, guesses: FloatArray, *, native: bool = True
) -> None:
    """Learn from samples of one record, in place.

    - ``memory`` (size,): changed in place
    - ``u, y`` (n, nu), (n, ny): inputs and the outputs that they led to, contiguous. With n = 0 only the next
      prediction is prepared.
    - ``guesses`` (n, ny): receives the predictions, each made before its output was seen
    - ``native``: False computes in numpy even where the compiled recursion is there
    """
    call = _compiled() if native else None
    if call is None:
        _plain(layout, memory, u, y, guesses)
        return
    call.sysid_rls_run(*pointers(memory), len(y), *pointers(u, y, guesses))


def rotated(
    triangle: FloatArray, rows: FloatArray, *, group: int = 1, forgetting: float = 1.0, native: bool = True
) -> FloatArray:
    """Return ``[R z]`` (p, p + 1) after equations (n, p + 1), regressors and target, were rotated in one by one.

    - ``triangle`` (p, p + 1): zeros before any data; ``R theta = z``
    - ``rows`` (n, p + 1)
    - ``group``: equations of one instant, which are forgotten together
    - ``forgetting``: weight of all that came before, for every group
    - ``native``: False computes in numpy even where the compiled recursion is there

    Examples
    --------
    >>> rows = np.array([[1.0, 0.0, 2.0], [1.0, 1.0, 5.0], [1.0, 2.0, 8.0]])
    >>> found = rotated(np.zeros((2, 3)), rows)
    >>> np.linalg.solve(found[:, :2], found[:, 2]).round(12)
    array([2., 3.])
    """
    p = len(triangle)
    found = np.ascontiguousarray(triangle, dtype=np.float64).copy()
    wanted = np.ascontiguousarray(rows, dtype=np.float64)
    call = _compiled() if native else None
    root = float(np.sqrt(forgetting))
    if call is None:
        for first in range(0, len(wanted), group):
            both = np.vstack([found * root, wanted[first : first + group]])
            found = np.asarray(np.linalg.qr(both, mode="r"), dtype=np.float64)[:p]
        return found
    work = np.empty(p + 1)
    call.sysid_rotate_rows(*pointers(found, work), p, len(wanted), group, root, *pointers(wanted))
    return found


@functools.cache
def _compiled() -> Any:
    """Return the compiled recursion over the sample in the memory and over many, and the rotation of rows; or None."""
    return declared(
        "rls_loop",
        sysid_rls_step=(None, [ctypes.POINTER(ctypes.c_double)]),  # three times faster than the address of an array
        sysid_rls_run=(None, [ctypes.c_void_p, ctypes.c_long, *[ctypes.c_void_p] * 3]),
        sysid_rotate_rows=(None, [*[ctypes.c_void_p] * 2, *[ctypes.c_long] * 3, ctypes.c_double, ctypes.c_void_p]),
    )


def _plain(layout: RlsLayout, memory: FloatArray, u: FloatArray, y: FloatArray, guesses: FloatArray) -> None:
    """Do what the compiled recursion does."""
    ny, nu, first = layout.ny, layout.nu, layout.order * layout.ny
    row, triangle, theta = layout.row(memory), layout.triangle(memory), layout.theta(memory)
    free, gain, shape = layout.ahead
    if not len(y):
        _prepare(layout, memory)
    for k in range(len(y)):
        guesses[k] = memory[free] + u[k] @ memory[gain].reshape(shape)
        row[first : first + nu] = u[k]
        if memory[0] >= layout.order:
            old = triangle * np.sqrt(layout.forgetting)
            triangle[:] = np.linalg.qr(np.vstack([old, np.concatenate([row, y[k]])]), mode="r")[: layout.p]
            memory[1] += 1
            if memory[1] == layout.burn_in:
                typical = np.linalg.norm(triangle[:, : layout.p], axis=0) / np.sqrt(memory[1])
                typical = np.where(typical > 0, typical, 1.0)
                prior = np.hstack([np.sqrt(layout.prior) * np.diag(typical), np.zeros((layout.p, ny))])
                triangle[:] = np.linalg.qr(np.vstack([triangle, prior]), mode="r")[: layout.p]
            if memory[1] >= layout.burn_in:
                theta[:] = np.linalg.solve(triangle[:, : layout.p], triangle[:, layout.p :])
        row[ny:first] = row[: first - ny].copy()
        row[:ny] = y[k]
        row[first + nu : first + layout.order * nu] = row[first : first + (layout.order - 1) * nu].copy()
        memory[0] += 1
        _prepare(layout, memory)


def _prepare(layout: RlsLayout, memory: FloatArray) -> None:
    """Write down what the next prediction is made of: the last output while there is nothing to predict by."""
    row, theta, first = layout.row(memory), layout.theta(memory), layout.order * layout.ny
    free, gain, _ = layout.ahead
    now = slice(first, first + layout.nu)
    if memory[0] < layout.order or memory[1] < layout.burn_in:
        memory[free], memory[gain] = row[: layout.ny], 0.0
        return
    memory[gain] = theta[now].ravel()
    memory[free] = row @ theta - row[now] @ theta[now]
