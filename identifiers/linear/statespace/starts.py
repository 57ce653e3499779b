"""Where the search begins: long one-step regressions of several lengths, reduced to the states that count."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from harness.algebra import divisor, least_squares
from harness.signals import FloatArray
from identifiers.linear.statespace.model import Piece, StateSpace

LAGS = (4, 6, 9, 13, 20, 30, 50)  # Lengths of the regressions that are tried.
EQUATIONS = 6  # Equations for each regressor, at least.
FURTHEST = 0.9995  # Largest modulus of a pole of a model that is reduced: those beyond are moved inside, all together.
NOTHING = 1e-9  # Hankel singular values below this share of the largest: directions that are not reached, or not seen.
INSIDE = 0.98  # Largest modulus of the poles that signals are filtered with.

SAME = 1e-9  # Poles so near to each other are those of one mode.


@dataclass(frozen=True, eq=False)
class _Rows:
    """Regressors ``[1, u[k] (with feedthrough), y[k-1], u[k-1], y[k-2], ...]`` and y[k], as one triangle."""

    triangle: FloatArray
    rows: int
    ny: int
    nu: int
    direct: bool

    def fitted(self, lags: int) -> tuple[FloatArray, FloatArray]:
        """Return coefficients (1 + lags (ny + nu), ny) and mean squares (ny,) of a regression on so many lags."""
        count = 1 + self.nu * self.direct + lags * (self.ny + self.nu)
        target = self.triangle[:, -self.ny :]
        theta = least_squares(self.triangle[:, :count], target, 1e-10)
        return theta, np.sum((target - self.triangle[:, :count] @ theta) ** 2, axis=0) / max(self.rows, 1)


def long_models(pieces: Sequence[Piece], direct: bool, *, predictor: bool = False) -> list[StateSpace]:
    """Return long one-step models as plants of many states: of the length that Akaike's rule prefers, half and twice.

    A long regression takes noise of any colour and holds under feedback; its plant is that of the data but for chance
    (Ljung & Wahlberg 1992), which the reduction and the search then take away.

    - ``pieces``: of inputs and outputs; rows with a missing reading are left out
    - ``direct``: an output answers the input of the same sample
    - ``predictor``: return what foretells the outputs, with them as further inputs, and not the plant
    """
    made = _predictor if predictor else _plant
    ny, nu = pieces[0].y.shape[1], pieces[0].u.shape[1]
    total, longest = sum(len(piece.u) for piece in pieces), max(len(piece.u) for piece in pieces)
    most = int(max(1, min(LAGS[-1], total // (EQUATIONS * (ny + nu)), longest // 4)))
    lengths = [one for one in LAGS if one < most] + [most]
    rows = _rows(pieces, most, direct)
    while rows.rows <= 2 * (1 + lengths[-1] * (ny + nu)) and len(lengths) > 1:  # holes take many rows of a long past
        lengths.pop()
        rows = _rows(pieces, lengths[-1], direct)
    most = lengths[-1]
    judged = []
    for lags in lengths:
        _, squares = rows.fitted(lags)
        judged.append(rows.rows / 2 * float(np.sum(np.log(squares + 1e-24))) + lags * (ny + nu) * ny)
    chosen = lengths[int(np.argmin(judged))]
    wanted = sorted({chosen, min(most, 2 * chosen), max(lengths[0], chosen // 2)})
    found = []
    for lags in wanted:
        theta, _ = rows.fitted(lags)
        found.append(made(theta[1:].T, lags, ny, nu, direct))
    return found


def filtered_model(model: StateSpace, pieces: Sequence[Piece], direct: bool, lags: int) -> StateSpace | None:
    """Return the one-step model of some lags, of signals that a plant's poles have filtered.

    White noise on the outputs, whitened by the plant's own denominator in the regression, weighs a fast sampled plant
    where it does nothing; the filter takes that away (Steiglitz & McBride 1965, IEEE Trans. AC 10:461). None where the
    pieces are too short, or readings are missing.
    """
    from scipy.signal import sosfilt, zpk2sos

    poles: Any = np.linalg.eigvals(model.a)
    moduli = np.abs(poles)
    poles = np.where(moduli > INSIDE, poles * INSIDE / divisor(moduli), poles)
    both = sum(one.shape[1] for one in (pieces[0].u, pieces[0].y))
    enough = sum(max(len(piece.u) - lags, 0) for piece in pieces) > EQUATIONS * lags * both
    if not enough or any(piece.read is not None for piece in pieces):
        return None
    sections = zpk2sos(np.zeros(len(poles)), poles, 1.0)
    through = [
        Piece(sosfilt(sections, piece.u, axis=0), sosfilt(sections, piece.y - model.level, axis=0)) for piece in pieces
    ]
    rows = _rows(through, lags, direct)
    theta, _ = rows.fitted(lags)
    return _plant(theta[1:].T, lags, rows.ny, rows.nu, direct) if np.isfinite(theta).all() else None


def reduced(model: StateSpace, orders: Sequence[int]) -> dict[int, StateSpace]:
    """Return balanced truncations to some orders, as far as the model has so many states that are reached and seen.

    Square root method (Moore 1981; Laub et al. 1987); a model that is not stable is shrunk before.

    Examples
    --------
    >>> a, one = np.diag([0.9, 0.1]), np.ones((2, 1))
    >>> plant = StateSpace(a, one * [[1.0], [0.01]], one.T, np.zeros((1, 1)), np.zeros(1), np.zeros((1, 0)))
    >>> reduced(plant, [1])[1].a.round(2).tolist()
    [[0.9]]
    """
    from scipy.linalg import solve_discrete_lyapunov

    a, b, c = model.a, model.b, model.c
    if model.radius > FURTHEST:
        a = a * (FURTHEST / model.radius)
    reached = _root(np.asarray(solve_discrete_lyapunov(a, b @ b.T), dtype=np.float64))
    seen = _root(np.asarray(solve_discrete_lyapunov(a.T, c.T @ c), dtype=np.float64))
    left, values, right = np.linalg.svd(seen.T @ reached)
    count = int(np.sum(values > NOTHING * values.max(initial=0.0))) if values.max(initial=0.0) > 0 else 0
    found = {}
    for n in orders:
        if n > count:
            break
        size = np.sqrt(values[:n])
        into, out = reached @ right[:n].T / size, (seen @ left[:, :n] / size).T
        found[n] = StateSpace(out @ a @ into, out @ b, c @ into, model.d, model.level, model.noise)
    return found


def without_each_mode(model: StateSpace) -> list[StateSpace]:
    """Return the model without each of its modes, a real pole or a pair, the others as they are.

    Examples
    --------
    >>> a, one = np.diag([0.9, 0.1]), np.ones((2, 1))
    >>> plant = StateSpace(a, one, one.T, np.zeros((1, 1)), np.zeros(1), np.zeros((1, 0)))
    >>> [round(one.radius, 2) for one in without_each_mode(plant)]
    [0.1, 0.9]
    """
    from scipy.linalg import schur, solve_sylvester

    found = []
    poles: Any = np.linalg.eigvals(model.a)
    for pole in poles[poles.imag >= 0]:

        def others(real: float, imaginary: float, pole: complex = pole) -> bool:
            return abs(complex(real, abs(imaginary)) - pole) > SAME

        a, basis, n = schur(model.a, sort=others)
        if 0 < n < model.order:
            apart = solve_sylvester(a[:n, :n], -a[n:, n:], -a[:n, n:])
            into = basis[:, :n].T - apart @ basis[:, n:].T
            found.append(replace(model, a=a[:n, :n], b=into @ model.b, c=model.c @ basis[:, :n]))
    return found


def _rows(pieces: Sequence[Piece], lags: int, direct: bool) -> _Rows:
    """Return the rows of all pieces for so many lags, those with missing readings left out."""
    ny, nu = pieces[0].y.shape[1], pieces[0].u.shape[1]
    width = 1 + nu * direct + lags * (ny + nu) + ny
    triangle, count = np.zeros((0, width)), 0
    for piece in pieces:
        index = np.arange(lags, len(piece.u))
        columns = [np.ones((index.size, 1))] + ([piece.u[index]] if direct else [])
        for j in range(1, lags + 1):
            columns += [piece.y[index - j], piece.u[index - j]]
        block = np.hstack([*columns, piece.y[index]])
        if piece.read is not None:
            block = block[np.all([piece.read[index - j].all(axis=1) for j in range(lags + 1)], axis=0)]
        count += len(block)
        triangle = np.asarray(np.linalg.qr(np.vstack([triangle, block]), mode="r"), dtype=np.float64)
    return _Rows(triangle, count, ny, nu, direct)


def _plant(theta: FloatArray, lags: int, ny: int, nu: int, direct: bool) -> StateSpace:
    """Return the plant of coefficients (ny, nu direct + lags (ny + nu)): its state is what the regression looks at."""
    d = theta[:, :nu] if direct else np.zeros((ny, nu))
    c = theta[:, nu * direct :]
    both, n = ny + nu, lags * (ny + nu)
    a, b = np.zeros((n, n)), np.zeros((n, nu))
    a[:ny], b[:ny], b[ny:both] = c, d, np.eye(nu)
    a[both:, : n - both] = np.eye(n - both)
    return StateSpace(a, b, c, d, np.zeros(ny), np.zeros((ny, 0)))


def _predictor(theta: FloatArray, lags: int, ny: int, nu: int, direct: bool) -> StateSpace:
    """Return what the same coefficients foretell from inputs and outputs, ``[u, y]``."""
    d = np.zeros((ny, nu + ny))
    if direct:
        d[:, :nu] = theta[:, :nu]
    both, n = ny + nu, lags * (ny + nu)
    a, b = np.zeros((n, n)), np.zeros((n, nu + ny))
    b[:ny, nu:], b[ny:both, :nu] = np.eye(ny), np.eye(nu)
    a[both:, : n - both] = np.eye(n - both)
    return StateSpace(a, b, theta[:, nu * direct :], d, np.zeros(ny), np.zeros((ny, 0)))


def _root(gramian: FloatArray) -> FloatArray:
    """Return R with ``R R'`` the Gramian."""
    values, vectors = np.linalg.eigh((gramian + gramian.T) / 2)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)), dtype=np.float64)
