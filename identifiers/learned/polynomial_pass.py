"""Free runs of polynomial state-space models with derivatives: compiled, or in numpy where there is no C compiler."""

from __future__ import annotations

import ctypes
import functools
import itertools
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.signals import FloatArray
from identifiers.common import native
from identifiers.common.native import pointers

FAR = 1e3  # A scaled state beyond it has diverged, as in :mod:`identifiers.learned.recurrent_pass`.

Counts = npt.NDArray[np.int64]


@functools.cache
def library() -> Any:
    """Return the compiled run, or None where there is no C compiler."""
    arguments = [ctypes.c_long] * 7 + [ctypes.c_void_p] * 6 + [ctypes.c_double] + [ctypes.c_void_p] * 4
    return native.declared("polynomial_loop", sysid_polynomial_run=(ctypes.c_long, arguments))


@functools.cache
def exponents(variables: int, degree: int, bent: int) -> Counts:
    """Return the exponents (m, variables) of the monomials up to a total degree, by degree: the constant, then linear.

    - ``bent``: so many variables, the first ones, enter the monomials of degree 2 and more; the others are linear

    Examples
    --------
    >>> exponents(2, 2, 2).tolist()
    [[0, 0], [1, 0], [0, 1], [2, 0], [1, 1], [0, 2]]
    >>> exponents(2, 2, 1).tolist()
    [[0, 0], [1, 0], [0, 1], [2, 0]]
    """
    rows = []
    for total in range(degree + 1):
        for chosen in itertools.combinations_with_replacement(range(variables if total < 2 else bent), total):
            rows.append([chosen.count(v) for v in range(variables)])
    found = np.array(rows, dtype=np.int64).reshape(len(rows), variables)
    found.setflags(write=False)
    return found


@dataclass(frozen=True)
class PolynomialTables:
    """``x+ = x + p(x, u) W``, ``y = q(x, u) V``: p and q are all monomials up to a degree, W and V in one vector.

    The form of Paduart et al. 2010 (Automatica 46, eq. 2), with constants, for signals that are scaled about a mean.
    """

    # States, inputs, outputs
    nx: int
    nu: int
    ny: int
    # Of the polynomials of the state, and of those of the output; 1 is linear
    degree: int
    outside: int
    direct: bool = False  # The output depends on the input of the same sample
    crossed: bool = True  # Inputs enter the monomials of degree 2 and more

    @property
    def inner(self) -> Counts:
        """Exponents (mx, nx + nu) of the monomials of the next state."""
        nz = self.nx + self.nu
        return exponents(nz, self.degree, nz if self.crossed else self.nx)

    @property
    def outer(self) -> Counts:
        """Exponents (my, nx + nu) of the monomials of the output."""
        nz = self.nx + self.nu
        if self.direct:
            return exponents(nz, self.outside, nz if self.crossed else self.nx)
        alone = exponents(self.nx, self.outside, self.nx)
        return np.hstack([alone, np.zeros((len(alone), self.nu), dtype=np.int64)])

    @property
    def count(self) -> int:
        """Number of coefficients."""
        return len(self.inner) * self.nx + len(self.outer) * self.ny

    def tables(self, theta: FloatArray) -> dict[str, FloatArray]:
        """Return views of W (mx, nx) and V (my, ny) in a vector (p,).

        Examples
        --------
        >>> layout = PolynomialTables(2, 1, 1, 3, 1)
        >>> {name: table.shape for name, table in layout.tables(np.zeros(layout.count)).items()}
        {'W': (20, 2), 'V': (3, 1)}
        """
        cut = len(self.inner) * self.nx
        return {"W": theta[:cut].reshape(-1, self.nx), "V": theta[cut:].reshape(-1, self.ny)}

    def nonlinear(self) -> npt.NDArray[np.bool_]:
        """Return which coefficients (p,) belong to monomials of degree 2 and more."""
        parts = ((self.inner, self.nx), (self.outer, self.ny))
        return np.concatenate([np.repeat(one.sum(axis=1) > 1, columns) for one, columns in parts])

    def grown(self, theta: FloatArray, layout: PolynomialTables) -> FloatArray:
        """Return the coefficients of the same functions in a layout of higher degrees, of the same states.

        Examples
        --------
        >>> line, curve = PolynomialTables(1, 1, 1, 1, 1), PolynomialTables(1, 1, 1, 2, 1)
        >>> line.grown(np.array([0.1, -0.5, 1.0, 0.0, 2.0]), curve)
        array([ 0.1, -0.5,  1. ,  0. ,  0. ,  0. ,  0. ,  2. ])
        """
        new = np.zeros(layout.count)
        for name, table in layout.tables(new).items():
            old = self.tables(theta)[name]
            table[: len(old)] = old
        return new

    def step(self, theta: FloatArray, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next states (..., nx); NaN once one is far outside the data."""
        with np.errstate(over="ignore", invalid="ignore"):
            new = x + self._values(self.inner, x, u) @ self.tables(theta)["W"]
            return np.where(np.abs(new).max(axis=-1, keepdims=True) <= FAR, new, np.nan)

    def output(self, theta: FloatArray, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the outputs (..., ny)."""
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(self._values(self.outer, x, u) @ self.tables(theta)["V"])

    def jacobians(self, theta: FloatArray, x: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives (nx, nx) of the next state and (ny, nx) of the output by the state x (nx,)."""
        t = self.tables(theta)
        by_x, out_by_x = self._slopes(self.inner, x, u), self._slopes(self.outer, x, u)
        return np.eye(self.nx) + t["W"].T @ by_x, t["V"].T @ out_by_x

    def run(
        self, theta: FloatArray, start: FloatArray, u: FloatArray, *, sensitivities: bool, native: bool = True
    ) -> tuple[FloatArray, FloatArray | None]:
        """Return the outputs (N, ny) of a free run, and their derivatives (N, ny, p + nx) by theta and start.

        A run that diverges, and its derivatives, end in NaN.
        """
        table = np.full((len(u), self.ny, self.count + self.nx), np.nan) if sensitivities else None
        return self._filled(theta, start, u, None, table, native), table

    def states(self, theta: FloatArray, start: FloatArray, u: FloatArray) -> FloatArray:
        """Return the states (N, nx) of a free run, NaN where it has diverged."""
        states = np.full((len(u), self.nx), np.nan)
        self._filled(theta, start, u, states, None, True)
        return states

    def to_dict(self) -> dict[str, int]:
        """Return its sizes and switches by name."""
        return {name: int(value) for name, value in asdict(self).items()}

    @classmethod
    def of(cls, content: dict[str, Any]) -> PolynomialTables:
        """Return the layout of a description."""
        nx, nu, ny, degree, outside = (int(content[name]) for name in ("nx", "nu", "ny", "degree", "outside"))
        return cls(nx, nu, ny, degree, outside, bool(content["direct"]), bool(content["crossed"]))

    def _filled(
        self,
        theta: FloatArray,
        start: FloatArray,
        u: FloatArray,
        states: FloatArray | None,
        table: FloatArray | None,
        native: bool,
    ) -> FloatArray:
        """Return outputs (N, ny), and fill in states and derivatives where they are asked for."""
        y = np.full((len(u), self.ny), np.nan)
        compiled = library() if native else None
        if compiled is None:
            self._plain(theta, start, u, y, states, table)
            return y
        ex, ey = (np.ascontiguousarray(one) for one in (self.inner, self.outer))
        theta, u = (np.ascontiguousarray(one, dtype=float) for one in (theta, u))
        x = np.array(start, dtype=float)
        mx, my, nx, nz = len(ex), len(ey), self.nx, self.nx + self.nu
        top = max(self.degree, self.outside)
        d = np.hstack([np.zeros((nx, mx * nx)), np.eye(nx)])
        work = np.empty(nz * (top + 1) + (mx + my) * (1 + nx) + nx * (1 + nx + mx * nx + nx))
        sizes = (len(u), nx, self.nu, self.ny, top, mx, my)
        ends = [None if one is None else one.ctypes.data for one in (states, table)]
        given = pointers(ex, ey, theta, x, d, u)
        compiled.sysid_polynomial_run(*sizes, *given, FAR, *pointers(y), *ends, *pointers(work))
        return y

    def _values(self, powers: Counts, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the monomials (..., m)."""
        z = np.concatenate([x, np.broadcast_to(u, (*x.shape[:-1], self.nu))], axis=-1)
        return np.asarray(np.prod(z[..., None, :] ** powers, axis=-1))

    def _slopes(self, powers: Counts, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the derivatives (m, nx) of the monomials by the states x (nx,)."""
        z = np.concatenate([x, u])
        columns = []
        for i in range(self.nx):
            lower = powers.copy()
            lower[:, i] = np.maximum(lower[:, i] - 1, 0)
            columns.append(powers[:, i] * np.prod(z**lower, axis=1))
        return np.column_stack(columns)

    def _plain(
        self,
        theta: FloatArray,
        x: FloatArray,
        u: FloatArray,
        y: FloatArray,
        states: FloatArray | None,
        table: FloatArray | None,
    ) -> None:
        """Fill in outputs, states and derivatives, in numpy."""
        t, nx, p = self.tables(theta), self.nx, self.count
        wide = len(self.inner) * nx
        d = np.hstack([np.zeros((nx, p)), np.eye(nx)])
        for k in range(len(u)):
            if states is not None:
                states[k] = x
            inner, outer = self._values(self.inner, x, u[k]), self._values(self.outer, x, u[k])
            y[k] = outer @ t["V"]
            if table is not None:
                turn, out_by_x = self.jacobians(theta, x, u[k])
                table[k] = out_by_x @ d
                table[k, :, wide:p] += np.kron(outer, np.eye(self.ny))
            with np.errstate(over="ignore", invalid="ignore"):
                new = x + inner @ t["W"]
            if not (np.abs(new) <= FAR).all():
                return
            if table is not None:
                d = turn @ d
                d[:, :wide] += np.kron(inner, np.eye(nx))
            x = new
