"""Where the search for a polynomial model begins: regressions, filtered again and again, and realizations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from harness.errors import FitError
from harness.signals import FloatArray
from identifiers.linear.ho_kalman import realize
from identifiers.linear.polynomials.model import Orders, OutputRecord, Polynomials, errors_and_gradients
from identifiers.linear.polynomials.search import best, search, settled_inside

# Memory of the long regression that a start is realized from, at least.
_MEMORY = 12
# Starts whose denominators are nearer than this are one.
_SAME = 1e-3
# Refinements of a starting model by filtering with its own denominator.
_STEIGLITZ = 12
# Rounds over the inputs, each with a denominator of its own.
_SWEEPS = 3

Inputs = tuple[FloatArray, ...]


def starting_models(parts: Sequence[OutputRecord], orders: Orders, offset: bool) -> list[Polynomials]:
    """Return where the search begins: several, of which the best end is taken.

    - ``parts``: missing readings filled with what lies between their neighbours: only a start depends on it
    """
    read = [np.delete(part.y, part.holes) if part.holes else part.y for part in parts]
    level = float(np.concatenate(read).mean()) if offset else 0.0
    none = np.zeros(0)
    if not orders.nf:
        firsts = [_hannan(parts, orders, level)]
        for f, b in _realized(parts, orders, level, orders.na):  # white noise on the output: C is A
            c = np.zeros(orders.nc)
            c[: min(f.size, orders.nc)] = settled_inside(f)[: orders.nc]
            firsts.append(Polynomials(orders, f, b, settled_inside(c), none, (), level))
        return firsts
    quiet = replace(orders, nc=0, nd=0)
    firsts = _apart(parts, quiet, level) if len(orders.nf) > 1 else _together(parts, quiet, level)
    if not (orders.nc or orders.nd):
        return firsts
    # The best model with white noise on the output comes first: with a noise model it can only become better.
    found = best([search(first, parts, offset) for first in firsts]).model
    return [_with_noise(first, orders, parts) for first in _distinct([found, *firsts])]


def settled(model: Polynomials) -> Polynomials:
    """Return the model with its poles inside the unit circle: a start among the stable ones."""
    a, d = settled_inside(model.a), settled_inside(model.d)
    return replace(model, a=a, d=d, f=tuple(map(settled_inside, model.f)))


def _together(parts: Sequence[OutputRecord], orders: Orders, level: float) -> list[Polynomials]:
    """Return starts with one denominator for all inputs."""
    found = [_steiglitz(parts, orders, level, refine) for refine in (True, False)]
    found += _realized(parts, orders, level, orders.nf[0])
    none = np.zeros(0)
    return [Polynomials(orders, none, b, none, none, (settled_inside(f),), level) for f, b in found]


def _apart(parts: Sequence[OutputRecord], orders: Orders, level: float) -> list[Polynomials]:
    """Return starts with a denominator for each input: what each is seen to do, the others' share taken away."""
    none, every = np.zeros(0), zip(orders.nb, orders.nk, orders.nf, strict=True)
    alone = [replace(orders, nb=(nb,), nk=(nk,), nf=(nf,)) for nb, nk, nf in every]
    markov = _markov(parts, orders, level, max(orders.nf))
    pairs = []
    for i, own in enumerate(alone):
        seen = None if markov is None else _realization(markov[:, i : i + 1], own, orders.nf[i])
        pairs.append((seen[0], seen[1][0]) if seen else (np.zeros(orders.nf[i]), np.zeros(orders.nb[i])))
    blank = Polynomials(orders, none, tuple(b for _, b in pairs), none, none, tuple(f for f, _ in pairs), level)
    model = blank
    for _ in range(_SWEEPS):
        for i, own in enumerate(alone):
            if not own.nb[0]:
                continue
            left = [OutputRecord(part.u[:, i : i + 1], part.y - level - _free(model, part, i)) for part in parts]
            f, b = _steiglitz(left, own, 0.0, True)
            fs, bs = list(model.f), list(model.b)
            fs[i], bs[i] = settled_inside(f) if own.nf[0] else np.zeros(0), b[0]
            model = replace(model, f=tuple(fs), b=tuple(bs))
    return [model, blank] if markov is not None else [model]


def _free(model: Polynomials, part: OutputRecord, but: int) -> FloatArray:
    """Return the free run (N,) under all inputs but one."""
    quiet = tuple(b * (i != but) for i, b in enumerate(model.b))
    start = (np.zeros(model.orders.start_x), np.zeros(model.orders.start_z))
    silent = replace(part, y=np.zeros(part.y.size))
    errors, _ = errors_and_gradients(replace(model, b=quiet, level=0.0), [start], [silent])
    return np.clip(np.nan_to_num(-errors), -1e9, 1e9)


def _distinct(models: Sequence[Polynomials]) -> list[Polynomials]:
    """Return the models without those that begin where an earlier one does."""
    kept: list[Polynomials] = []
    for model in models:
        own = np.concatenate(model.f)
        if all(np.abs(own - np.concatenate(other.f)).max(initial=0.0) > _SAME for other in kept):
            kept.append(model)
    return kept


def _with_noise(quiet: Polynomials, orders: Orders, parts: Sequence[OutputRecord]) -> Polynomials:
    """Return an output-error model with the C and D that its residuals tell (Hannan & Rissanen 1982)."""
    blank = [(np.zeros(quiet.orders.start_x), np.zeros(quiet.orders.start_z)) for _ in parts]
    residual, gradients = errors_and_gradients(quiet, blank, parts)
    starts = gradients[:, quiet.orders.count :]
    if starts.shape[1]:  # what happened before the records is not noise
        residual = residual - starts @ np.linalg.lstsq(starts, residual, rcond=1e-9)[0]
    pieces = np.split(residual, np.cumsum([part.y.size for part in parts])[:-1])
    silent = [OutputRecord(np.zeros((piece.size, 0)), piece) for piece in pieces]
    noise = _hannan(silent, Orders(na=orders.nd, nc=orders.nc), 0.0)
    return replace(quiet, orders=orders, c=noise.c, d=settled_inside(noise.a))


def _realized(parts: Sequence[OutputRecord], orders: Orders, level: float, n: int) -> list[tuple[FloatArray, Inputs]]:
    """Return F and B by input of the system of this order that a long one-step regression shows (OKID, Ho-Kalman).

    Steiglitz and McBride's iteration may end anywhere where sampling is fast; a realization of the response does not
    depend on a start. Empty where the records are too short for it, or do not excite so much.
    """
    markov = _markov(parts, orders, level, n)
    found = None if markov is None else _realization(markov, orders, n)
    return [found] if found else []


def _markov(parts: Sequence[OutputRecord], orders: Orders, level: float, n: int) -> FloatArray | None:
    """Return the response (4 lags, nu) that a long one-step regression shows; None where it tells none."""
    nu = parts[0].u.shape[1]
    lags = int(min(max(4 * n, _MEMORY, max(orders.nk, default=0) + n), min(p.y.size for p in parts) // (4 * (nu + 1))))
    if not n or lags <= n:
        return None
    blocks = [_long_rows(part, lags, level) for part in parts]
    x, y = np.concatenate([rows for rows, _ in blocks]), np.concatenate([target for _, target in blocks])
    theta = np.linalg.lstsq(x, y, rcond=1e-10)[0]
    seen, pushed = theta[:lags], theta[lags:].reshape(lags + 1, nu)
    markov = np.zeros((4 * lags, nu))
    for k in range(len(markov)):
        markov[k] = pushed[k] if k <= lags else 0.0
        few = min(k, lags)
        markov[k] += seen[:few] @ markov[k - 1 :: -1][:few] if few else 0.0
    return markov if (np.abs(markov) < 1e9).all() else None


def _realization(markov: FloatArray, orders: Orders, n: int) -> tuple[FloatArray, Inputs] | None:
    """Return F and B by input of a response (M, nu); None where it has no such order."""
    f = np.zeros(0)
    if n:
        least = min(orders.nk)  # before that nothing happens, which would ask for poles at 0
        try:
            a = realize(markov[max(least, 1) :, None, :], order=n)[0]
        except FitError:
            return None
        f = settled_inside(np.real(np.poly(np.linalg.eigvals(a)))[1:])
    bottom = np.concatenate([[1.0], f])
    b = tuple(
        np.convolve(bottom, markov[: nk + nb, i])[nk : nk + nb]
        for i, (nb, nk) in enumerate(zip(orders.nb, orders.nk, strict=True))
    )
    return (f, b) if all(one.size == nb for one, nb in zip(b, orders.nb, strict=True)) else None


def _long_rows(part: OutputRecord, lags: int, level: float) -> tuple[FloatArray, FloatArray]:
    """Return the rows ``[y[k-1], ..., y[k-p], u[k], u[k-1], ..., u[k-p]]`` and ``y[k]`` of one record."""
    y, index = part.y - level, np.arange(lags, part.y.size)
    columns = [y[index - j] for j in range(1, lags + 1)]
    columns += [part.u[index - j, i] for j in range(lags + 1) for i in range(part.u.shape[1])]
    return np.column_stack(columns), y[lags:]


def _reach(orders: Orders) -> int:
    """Return the samples that the inputs reach back."""
    return max((nb + nk - 1 for nb, nk in zip(orders.nb, orders.nk, strict=True)), default=0)


def _late(u: FloatArray, orders: Orders, index: npt.NDArray[np.int_]) -> list[FloatArray]:
    """Return the inputs that a model regresses on, input by input."""
    every = enumerate(zip(orders.nb, orders.nk, strict=True))
    return [u[index - nk - j, i] for i, (nb, nk) in every for j in range(nb)]


def _split(b: FloatArray, orders: Orders) -> Inputs:
    """Return coefficients by input."""
    return tuple(np.split(b, np.cumsum(orders.nb)[:-1])) if orders.nb else ()


def _steiglitz(parts: Sequence[OutputRecord], orders: Orders, level: float, refine: bool) -> tuple[FloatArray, Inputs]:
    """Return F and B by least squares on signals filtered by 1/F, again and again (Steiglitz & McBride 1965)."""
    from scipy.signal import lfilter

    n = orders.nf[0]
    f, b = np.zeros(n), np.zeros(sum(orders.nb))
    first = max(n, _reach(orders))
    for _ in range(_STEIGLITZ if refine else 1):
        bottom = np.concatenate([[1.0], settled_inside(f)])
        rows, targets = [], []
        for part in parts:
            y = lfilter([1.0], bottom, part.y - level)
            u = lfilter([1.0], bottom, part.u, axis=0)
            index = np.arange(first, y.size)
            lagged = [-y[index - j] for j in range(1, n + 1)] + _late(u, orders, index)
            rows.append(np.column_stack(lagged) if lagged else np.zeros((index.size, 0)))
            targets.append(y[first:])
        theta = np.linalg.lstsq(np.concatenate(rows), np.concatenate(targets), rcond=1e-10)[0]
        f, b = theta[:n], theta[n:]
    return f, _split(b, orders)


def _hannan(parts: Sequence[OutputRecord], orders: Orders, level: float) -> Polynomials:
    """Return A, B, C by two regressions, a long one for the innovations first (Hannan & Rissanen 1982)."""
    shortest = min(part.y.size for part in parts)
    most = max(orders.na, orders.nc, 1)
    long = max(orders.na, orders.nc, min(6 * most, shortest // 4, 40))
    innovations: list[FloatArray] = []
    theta = np.zeros(0)
    for lags, with_noise in ((long, False), (orders.na, True)):
        rows, targets, places = [], [], []
        first = max(long + orders.nc if with_noise else lags, _reach(orders), 1)
        wide = orders
        if not with_noise:
            each = zip(orders.nb, orders.nk, strict=True)
            wide = replace(orders, nb=tuple(max(nb, min(lags, first - nk + 1)) if nb else 0 for nb, nk in each))
        for number, part in enumerate(parts):
            y = part.y - level
            if y.size <= first:
                continue
            index = np.arange(first, y.size)
            columns = [-y[index - j] for j in range(1, lags + 1)] + _late(part.u, wide, index)
            if with_noise:
                columns += [innovations[number][index - j] for j in range(1, orders.nc + 1)]
            rows.append(np.column_stack(columns) if columns else np.zeros((index.size, 0)))
            targets.append(y[first:])
            places.append(number)
        if not rows:
            theta = np.zeros(orders.na + sum(orders.nb) + orders.nc)
            break
        theta = np.linalg.lstsq(np.concatenate(rows), np.concatenate(targets), rcond=1e-10)[0]
        if not with_noise:
            innovations = [np.zeros(part.y.size) for part in parts]
            for number, row, target in zip(places, rows, targets, strict=True):
                innovations[number][first:] = target - row @ theta
    a, b, c = np.split(theta, [orders.na, orders.na + sum(orders.nb)])
    return Polynomials(orders, a, _split(b, orders), settled_inside(c), np.zeros(0), (), level)
