"""Free runs of linear models with stops inside, with derivatives: compiled, or in numpy without a C compiler."""

from __future__ import annotations

import ctypes
import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.signals import FloatArray
from identifiers.common import native
from identifiers.common.native import pointers

FAR = 1e3  # A state beyond it has diverged: states are scaled to about 1.
_COLUMNS = 64  # As in ``hysteresis_loop.c``.


@functools.cache
def library() -> Any:
    """Return the compiled run, or None where there is no C compiler."""
    run = [ctypes.c_long] * 6 + [ctypes.c_void_p] * 5 + [ctypes.c_double] + [ctypes.c_void_p] * 6
    slopes = [ctypes.c_long] * 6 + [ctypes.c_void_p] * 8
    return native.declared(
        "hysteresis_loop", sysid_hysteresis_run=(ctypes.c_long, run), sysid_hysteresis_slopes=(None, slopes)
    )


@dataclass(frozen=True, eq=False)
class HysteresisRun:
    """A free run and what was inside of it.

    Parameters
    ----------
    y : array (N, ny)
    states : array (N, nx)
        Before each sample.
    stops : array (N, nz, m)
    loops : array (N, nz)
        Weighted sums of the stops.
    drawn : array (N, nz, m) of uint8
        Which of them are at their limit and draw their play along.
    end, memory : array (nx,), (nz, m)
        State and plays behind the last sample.
    """

    y: FloatArray
    states: FloatArray
    stops: FloatArray
    loops: FloatArray
    drawn: npt.NDArray[np.uint8]
    end: FloatArray
    memory: FloatArray


@dataclass(frozen=True)
class HysteresisLayout:
    """``x+ = A x + B u + E w``, ``y = C x + D u + F w``, ``w`` hysteresis of ``z = G x + H u``, in one vector.

    Parameters
    ----------
    nx, nu, ny, nz : int
        States, inputs, outputs, hystereses.
    stops : int
        Stop operators of each hysteresis.
    """

    nx: int
    nu: int
    ny: int
    nz: int
    stops: int

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """The tables in the order of the vector; ``A`` holds blocks of two states, and of one at the end."""
        nx, nu, ny, nz = self.nx, self.nu, self.ny, self.nz
        return {
            "A": (4 * (nx // 2) + nx % 2,),
            "B": (nx, nu),
            "E": (nx, nz),
            "G": (nz, nx),
            "H": (nz, nu),
            "W": (nz, self.stops),
            "C": (ny, nx),
            "D": (ny, nu),
            "F": (ny, nz),
        }

    @property
    def count(self) -> int:
        """Number of coefficients."""
        return sum(int(np.prod(shape)) for shape in self.shapes.values())

    @property
    def moving(self) -> int:
        """How many of them, the first ones, act on the state."""
        return int(self.slices["C"].start)

    @property
    def slices(self) -> dict[str, slice]:
        """Where each table is in the vector."""
        found, at = {}, 0
        for name, shape in self.shapes.items():
            found[name] = slice(at, at + int(np.prod(shape)))
            at = found[name].stop
        return found

    def tables(self, theta: FloatArray) -> dict[str, FloatArray]:
        """Return views of the tables in a vector (p,).

        Examples
        --------
        >>> layout = HysteresisLayout(3, 1, 1, 1, 2)
        >>> {name: table.shape for name, table in layout.tables(np.zeros(layout.count)).items()}["A"]
        (5,)
        """
        return {name: theta[at].reshape(self.shapes[name]) for name, at in self.slices.items()}

    def a_matrix(self, theta: FloatArray) -> FloatArray:
        """Return A (nx, nx)."""
        blocks = theta[self.slices["A"]]
        a = np.zeros((self.nx, self.nx))
        for i in range(0, self.nx - 1, 2):
            a[i : i + 2, i : i + 2] = blocks[2 * i : 2 * i + 4].reshape(2, 2)
        if self.nx % 2:
            a[-1, -1] = blocks[-1]
        return a

    def ends(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return A where every stop is at its limit, and where all stick: that of small motions."""
        a, t = self.a_matrix(theta), self.tables(theta)
        return a, a + t["E"] * t["W"].sum(axis=1) @ t["G"]

    def run(
        self, theta: FloatArray, radii: FloatArray, x: FloatArray, memory: FloatArray, u: FloatArray
    ) -> HysteresisRun | None:
        """Return the free run from state x (nx,) and plays (nz, m) under inputs (N, nu), or None where it diverges."""
        n = len(u)
        found = HysteresisRun(
            np.empty((n, self.ny)), np.empty((n, self.nx)), np.empty((n, self.nz, self.stops)),
            np.empty((n, self.nz)), np.empty((n, self.nz, self.stops), np.uint8), np.array(x, dtype=np.float64),
            np.array(memory, dtype=np.float64),
        )  # fmt: skip
        code = library()
        if code is None:
            return found if self._stepped(theta, radii, found, u) else None
        u, work = np.ascontiguousarray(u, dtype=np.float64), np.empty(self.nx + self.nz)
        held = pointers(theta, np.ascontiguousarray(radii), found.end, found.memory, u)
        inside = pointers(found.y, found.states, found.stops, found.loops, found.drawn, work)
        sizes = (self.nx, self.nu, self.ny, self.nz, self.stops)
        return found if code.sysid_hysteresis_run(n, *sizes, *held, FAR, *inside) == n else None

    def _stepped(self, theta: FloatArray, radii: FloatArray, found: HysteresisRun, u: FloatArray) -> bool:
        """Fill a run in numpy; return False where it diverges."""
        t, a = self.tables(theta), self.a_matrix(theta)
        for k, v in enumerate(u):
            x = found.end
            z = t["G"] @ x + t["H"] @ v
            memory, moved = played(found.memory, z, radii)
            stops = z[:, None] - memory
            w = np.sum(t["W"] * stops, axis=1)
            found.states[k], found.stops[k], found.loops[k], found.drawn[k] = x, stops, w, moved
            found.y[k] = t["C"] @ x + t["D"] @ v + t["F"] @ w
            found.end[:] = a @ x + t["B"] @ v + t["E"] @ w
            found.memory[:] = memory
            if not np.all(np.abs(found.end) <= FAR):
                return False
        return True

    def slopes(self, theta: FloatArray, u: FloatArray, run: HysteresisRun) -> FloatArray:
        """Return the derivatives (N, ny, p + nx) of a run: by A to W, by the initial state, and by C, D and F."""
        found = np.empty((len(u), self.ny, self.count + self.nx))
        code = library()
        if code is None:
            self._carried(theta, u, run, found)
        else:
            u = np.ascontiguousarray(u, dtype=np.float64)
            work = np.empty((2 * self.nx + self.nz * (self.stops + 2)) * _COLUMNS)
            sizes = (self.nx, self.nu, self.ny, self.nz, self.stops)
            held = pointers(theta, u, run.states, run.stops, run.loops, run.drawn, found, work)
            code.sysid_hysteresis_slopes(len(u), *sizes, *held)
        return found

    def _carried(self, theta: FloatArray, u: FloatArray, run: HysteresisRun, found: FloatArray) -> None:
        """Fill the derivatives in numpy: by what moves the state, by the initial state, by C, D and F."""
        t, a, at, nx = self.tables(theta), self.a_matrix(theta), self.slices, self.nx
        cut = self.moving + nx
        d, dp = np.zeros((nx, cut)), np.zeros((self.nz, self.stops, cut))
        d[:, self.moving :] = np.eye(nx)
        paired = [(i, i - i % 2 + c) for i in range(nx - nx % 2) for c in (0, 1)]
        entries = np.array(paired + [(nx - 1, nx - 1)] * (nx % 2))
        rows = np.arange(max(nx, self.nz, self.ny))
        for k, v in enumerate(u):
            x, held, w = run.states[k], run.stops[k], run.loops[k]
            dz = t["G"] @ d
            dz[:, at["G"]].reshape(self.nz, self.nz, nx)[rows[: self.nz], rows[: self.nz]] += x
            dz[:, at["H"]].reshape(self.nz, self.nz, self.nu)[rows[: self.nz], rows[: self.nz]] += v
            dp = np.where(run.drawn[k][..., None] != 0, dz[:, None], dp)
            dw = np.einsum("ij,ijc->ic", t["W"], dz[:, None] - dp)
            dw[:, at["W"]].reshape(self.nz, self.nz, self.stops)[rows[: self.nz], rows[: self.nz]] += held
            found[k, :, :cut] = t["C"] @ d + t["F"] @ dw
            static = found[k, :, cut:]
            static[:] = 0.0
            begin = 0
            for values in (x, v, w):
                for o in range(self.ny):
                    static[o, begin + o * len(values) : begin + (o + 1) * len(values)] = values
                begin += self.ny * len(values)
            d = a @ d + t["E"] @ dw
            d[entries[:, 0], np.arange(len(entries))] += x[entries[:, 1]]
            for name, values in (("B", v), ("E", w)):
                for i in range(nx):
                    first = at[name].start + i * len(values)
                    d[i, first : first + len(values)] += values


def played(memory: FloatArray, z: FloatArray, radii: FloatArray) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Return plays (..., nz, m) after their signals (..., nz) came, and which of them were drawn.

    Examples
    --------
    >>> played(np.array([[0.0, 0.0]]), np.array([2.0]), np.array([[0.5, 3.0]]))
    (array([[1.5, 0. ]]), array([[ True, False]]))
    """
    now = np.minimum(np.maximum(memory, z[..., None] - radii), z[..., None] + radii)
    return now, now != memory
