"""Linear dynamics with hysteresis inside, fitted to free runs: a start from measured outputs, and the descent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.linalg import block_diag, solve_discrete_lyapunov

from harness.errors import FitError
from harness.models.damped import Damping, damped_descent
from harness.models.lqr import spectral_radius
from harness.signals import FloatArray
from identifiers.blocks.hysteresis_pass import HysteresisLayout, played

Pair = tuple[FloatArray, FloatArray]  # Inputs (N, nu) and outputs (N, ny) of a record, scaled.
_LAGS = 3  # Outputs of the first regression for each state: its modes are then cut to those that count.
_RIDGE = 1e-8  # Of the regressions, in mean squares of their columns.
_STABLE = 0.9995  # Radius of the poles to start from, at most.
_SWINGING = 0.9
"""Size of a negative real pole, at most: nothing that was sampled has one near -1 (Ljung 1999, sec. 13.3)."""
_KNOWN = 1e-3  # Cost of the squares of initial states, which have unit size, in squared errors of scaled outputs.
_STEEP = 1e30  # Sums of squared derivatives beyond which no step rests on them: rounding leaves nothing of the others.
_BLOCK = 8192  # Rows of the regression that are in memory at once.


@dataclass(frozen=True, eq=False)
class HysteresisPoint:
    """Coefficients (p,) and the initial state of every record (R, nx)."""

    theta: FloatArray
    starts: FloatArray


def started(
    layout: HysteresisLayout,
    pairs: Sequence[Pair],
    radii: FloatArray,
    *,
    by: Literal["inputs", "outputs"],
    direct: bool,
) -> FloatArray:
    """Return coefficients to descend from.

    Inputs and outputs are measured, so their stops are known signals: a regression of high order on past outputs,
    inputs and stops is linear. Of its states the balanced ones that count most are kept (Moore 1981, IEEE TAC 26:17).

    - ``pairs`` sequence of (u, y)
    - ``radii`` (nz, m): of the stops
    - ``by`` {"inputs", "outputs"}: what the hystereses are drawn by: the signals themselves, and of more hystereses
      weighted sums of them
    - ``direct``: outputs answer the input of the same sample
    """
    width = layout.nu if by == "inputs" else layout.ny
    mixing = np.eye(layout.nz, width)
    mixing[width:] = np.random.default_rng(0).normal(size=(max(layout.nz - width, 0), width)) / width**0.5
    lags = max(-(-_LAGS * layout.nx // layout.ny), 2)
    coefficients, now = _regression(layout, pairs, radii, mixing, by, lags, direct)
    a, b, c = _cut(*_realised(coefficients, now, layout, lags), layout.nx)
    modes, blocks = _modal(a)
    b, c = np.asarray(np.linalg.solve(modes, b), dtype=np.float64), c @ modes
    size = np.sqrt(np.maximum(np.diag(_reached(block_diag(*blocks), b)), 1e-30))
    theta = np.zeros(layout.count)
    t = layout.tables(theta)
    scaled = block_diag(*blocks) * size / size[:, None]
    t["A"][:] = np.concatenate([scaled[i : i + 2, i : i + 2].ravel() for i in range(0, layout.nx, 2)])
    t["B"][:], t["E"][:] = np.split(b / size[:, None], [layout.nu], axis=1)
    t["C"][:], t["D"][:] = c * size, now
    if by == "inputs":
        t["H"][:] = mixing
    else:
        t["G"][:], t["H"][:] = mixing @ t["C"], mixing @ t["D"]
    t["W"][:] = 1.0 / layout.stops
    return theta


def stopped(z: FloatArray, radii: FloatArray) -> FloatArray:
    """Return the stops (N, nz, m) of signals (N, nz), whose plays begin at rest.

    Examples
    --------
    >>> stopped(np.array([[0.2], [2.0], [1.8]]), np.array([[0.5]])).ravel().round(3).tolist()
    [0.2, 0.5, 0.3]
    """
    memory, out = np.zeros(radii.shape), np.empty((len(z), *radii.shape))
    for k, now in enumerate(z):
        memory, _ = played(memory, now, radii)
        out[k] = now[:, None] - memory
    return out


def _regression(
    layout: HysteresisLayout,
    pairs: Sequence[Pair],
    radii: FloatArray,
    mixing: FloatArray,
    by: str,
    lags: int,
    direct: bool,
) -> tuple[FloatArray, FloatArray]:
    """Return the coefficients (lags, ny + nu + nz, ny) of past outputs, inputs and stops, and those (ny, nu) of now."""
    each = layout.ny + layout.nu + layout.nz
    wide = lags * each + (layout.nu if direct else 0)
    gram, right = np.zeros((wide, wide)), np.zeros((wide, layout.ny))
    for u, y in pairs:
        both = np.hstack([y, u, stopped((u if by == "inputs" else y) @ mixing.T, radii).mean(axis=2)])
        for low in range(lags, len(u), _BLOCK):
            high = min(low + _BLOCK, len(u))
            view = np.lib.stride_tricks.sliding_window_view(both[low - lags : high - 1], lags, axis=0)
            past = view[:, :, ::-1].transpose(0, 2, 1).reshape(high - low, -1)
            rows = np.hstack([past, u[low:high]]) if direct else past
            gram += rows.T @ rows
            right += rows.T @ y[low:high]
    size = np.maximum(np.diag(gram), 1e-300) ** 0.5
    found = np.linalg.solve(gram / np.outer(size, size) + _RIDGE * np.eye(wide), right / size[:, None]) / size[:, None]
    now = found[lags * each :].T if direct else np.zeros((layout.ny, layout.nu))
    return found[: lags * each].reshape(lags, each, layout.ny), now


def _realised(
    coefficients: FloatArray, now: FloatArray, layout: HysteresisLayout, lags: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return A, B, C of the states in observer form, shrunk to be stable."""
    ny, own = layout.ny, coefficients[:, : layout.ny].transpose(0, 2, 1)
    n = ny * lags
    a = np.zeros((n, n))
    a[: n - ny, ny:] = np.eye(n - ny)
    a[:, :ny] = own.reshape(n, ny)
    radius = spectral_radius(a)
    if radius >= _STABLE:
        shrink = (_STABLE / radius) ** np.arange(1, lags + 1)
        a[:, :ny] = (own * shrink[:, None, None]).reshape(n, ny)
    b = coefficients[:, ny:].transpose(0, 2, 1).reshape(n, -1)
    b[:, : layout.nu] += a[:, :ny] @ now
    return a, b, np.eye(ny, n)


def _reached(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the covariance of the states under white inputs."""
    return np.asarray(solve_discrete_lyapunov(a, b @ b.T), dtype=np.float64)


def _cut(a: FloatArray, b: FloatArray, c: FloatArray, order: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the balanced states that count most."""

    def root(square: FloatArray) -> FloatArray:
        values, vectors = np.linalg.eigh((square + square.T) / 2)
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))

    reach, watch = root(_reached(a, b)), root(_reached(a.T, c.T))
    left, values, right = np.linalg.svd(watch.T @ reach)
    kept = np.maximum(values[:order], 1e-12 * values[0]) ** 0.5
    down, up = (left[:, :order] / kept).T @ watch.T, reach @ right[:order].T / kept
    return down @ a @ up, down @ b, c @ up


def _modal(a: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
    """Return the modes as columns, and the blocks of A in them: pairs, and of an odd number of states one alone."""
    values, vectors = np.linalg.eig(a)
    pairs = [k for k, value in enumerate(values) if value.imag > 0]
    alone = [k for k, value in enumerate(values) if value.imag == 0]
    columns, blocks = [], []
    for k in pairs:
        columns += [vectors[:, k].real, vectors[:, k].imag]
        re, im = values[k].real, values[k].imag
        blocks.append(np.array([[re, im], [-im, re]]))
    for k in range(0, len(alone), 2):
        few = alone[k : k + 2]
        columns += [vectors[:, i].real for i in few]
        blocks.append(np.diag(values[few].real))
    return np.column_stack(columns), blocks


def descended(
    layout: HysteresisLayout,
    point: HysteresisPoint,
    pairs: Sequence[Pair],
    radii: FloatArray,
    rounds: int,
    *,
    direct: bool,
    positive: bool,
) -> tuple[HysteresisPoint, float]:
    """Return where no damped step lowers the squared error of free runs any more, and its root mean square.

    Raises FitError if the run to begin with diverges.

    - ``pairs`` sequence of (u, y)
    - ``radii`` (nz, m): of the stops
    - ``rounds``: steps, at most
    - ``direct``: outputs answer the input of the same sample; without, D and F stay 0
    - ``positive``: keep the weights of the stops at 0 and above
    """
    total = sum(y.size for _, y in pairs)
    rest = np.zeros(radii.shape)
    weights = layout.slices["W"]
    free = np.ones(layout.count, dtype=bool)
    if not direct:
        free[layout.slices["D"]] = free[layout.slices["F"]] = False

    def cost(now: HysteresisPoint) -> float:
        if not spectral_radius(layout.a_matrix(now.theta)) < 1.0:
            return np.inf
        value = 0.0
        for (u, y), x in zip(pairs, now.starts, strict=True):
            run = layout.run(now.theta, radii, x, rest, u)
            if run is None:
                return np.inf
            value += float(np.sum((run.y - y) ** 2)) + _KNOWN * float(x @ x)
        return value / total

    def linearised(now: HysteresisPoint) -> list[FloatArray] | None:
        p, nx, cut = layout.count, layout.nx, layout.moving
        order = np.concatenate([np.arange(cut), np.arange(cut + nx, p + nx), np.arange(cut, cut + nx)])
        gram, right, starts = np.zeros((p, p)), np.zeros(p), []
        for (u, y), x in zip(pairs, now.starts, strict=True):
            run = layout.run(now.theta, radii, x, rest, u)
            if run is None:
                return None
            whole = layout.slopes(now.theta, u, run).reshape(-1, p + nx)
            with np.errstate(over="ignore", invalid="ignore"):
                sums = (whole.T @ whole)[np.ix_(order, order)]
                wrong = (whole.T @ (y - run.y).ravel())[order]
            if not (np.isfinite(sums).all() and sums.max() < _STEEP):  # a motion within the stops that grows
                return None
            own = sums[p:, p:] + _KNOWN * np.eye(nx)
            aim = wrong[p:] - _KNOWN * x
            left = np.linalg.lstsq(own, np.column_stack([sums[p:, :p], aim]))[0]
            gram += sums[:p, :p] - sums[:p, p:] @ left[:, :p]
            right += wrong[:p] - sums[:p, p:] @ left[:, -1]
            starts.append(left)
        return [gram, right, *starts]

    def moved(now: HysteresisPoint, system: list[FloatArray], damp: float) -> HysteresisPoint:
        gram, right, *starts = system
        part = gram[np.ix_(free, free)]
        size = np.diag(part)
        damping = np.diag(damp * np.maximum(size, 1e-9 * size.max()))
        step = np.zeros(layout.count)
        step[free] = np.linalg.lstsq(part + damping, right[free])[0]
        theta = now.theta + step
        if positive:
            theta[weights] = np.maximum(theta[weights], 0.0)
        _hold(layout.tables(theta)["A"])
        each = [x + left[:, -1] - left[:, :-1] @ step for x, left in zip(now.starts, starts, strict=True)]
        return HysteresisPoint(theta, np.array(each))

    if not np.isfinite(cost(point)):
        raise FitError(
            "prandtl-ishlinskii: no start", expected="a stable linear model", got="one that diverges",
            remedy="lower the order, or excite the plant more",
        )  # fmt: skip
    damping = Damping(start=1e-3, growth=4.0, fall=0.25, enough=1e-4, rounds=rounds, most=1e6)
    found = damped_descent(point, cost, linearised, moved, damping)
    return found, float(np.sqrt(cost(found)))


def _hold(blocks: FloatArray) -> None:
    """Shrink blocks of A whose poles are too near the unit circle, or swing from sample to sample; in place."""
    for at in range(0, len(blocks), 4):
        block = blocks[at : at + 4]
        poles = np.linalg.eigvals(block.reshape(2, 2)) if len(block) == 4 else block
        most = _SWINGING if np.isreal(poles).all() and poles.real.min() < 0 else _STABLE
        block *= min(1.0, most / max(float(np.abs(poles).max()), 1e-12))
