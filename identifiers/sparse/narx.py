"""Polynomial NARX identification: few terms chosen by error reduction ratios, and judged by free runs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import comb
from typing import Any

import numpy as np

from harness.algebra import column_norms, least_squares
from harness.errors import FitError
from harness.judgement import refuse_undetermined
from harness.models.estimate import Estimate, RankDecision
from harness.models.whiteness import DOUBT
from harness.options import check_options
from harness.signals import FloatArray, PlantSpec, Trajectory
from harness.units import quotient
from identifiers.common.excitation import refuse_feedback_of_records
from identifiers.common.judge.excited import Excited
from identifiers.common.judge.told import told
from identifiers.common.lag_state import Standardisation
from identifiers.common.library import Library
from identifiers.common.normal import NormalEquations
from identifiers.common.one_step_estimate import EXACT, LARGEST, LEVEL
from identifiers.common.records import lagged, missing_notes, moving, real_signals, usable
from identifiers.common.scaling import sizes
from identifiers.sparse.narx_model import NarxModel, argument_names
from identifiers.sparse.orthogonal import Criterion, criterion_value, frols
from identifiers.sparse.pruning import LONGEST, ScaledWindows, pruned

__all__ = ["Narx", "NarxModel"]

_DEGREE = 3
"""Largest degree that is chosen without being asked for: a cubic bends both ways, and free runs of more run away."""
_CANDIDATES = 1000
"""Terms of a dictionary at most: its Gram matrix and one Cholesky factorisation take a tenth of a second."""
_MOST = 30  # Terms of an output that the criterion is asked about at most.
_LEVEL = 10.0
"""A signal whose mean is so many times its spread is counted from that mean: its powers are one column otherwise."""
_BLOCK = 8192  # Rows of a block of regressors.
_NOISE_ROUNDS, _SETTLED = 30, 1e-6
"""Rounds of extended least squares, and the change of the coefficients, relative, at which it has settled."""
_AGAIN = 2  # How often terms are chosen anew, the moving average of the errors taken off the outputs.
_SHORTER, _HALF = (LONGEST, 50, 10), 0.5
"""Samples of the free runs that judge: shorter ones where long ones leave half of the motion, as of a plant that is
unstable or chaotic, or carried off by disturbances."""


@dataclass(frozen=True)
class Narx(Excited):
    """Polynomial NARX model with structure selection.

    ``y[k+1]`` is a sum of monomials of the last outputs and inputs. Forward regression takes, one by one, the term of
    the largest error reduction ratio (FROLS: Chen, Billings & Luo 1989, Int. J. Control 50:1873; Billings 2013,
    *Nonlinear System Identification*, ch. 3); a criterion says how many; then terms stay only if free runs are worse
    without them, and are exchanged for those with which they are better (Piroddi & Spinelli 2003, Int. J. Control
    76:1767). Units decide nothing, nor does the order of terms.

    Parameters
    ----------
    lags : int
        Past samples of outputs and inputs that terms are made of, at least 1: ``y[k] .. y[k-lags+1]``.
    degree : int, optional
        Of the monomials. Without it 3, or what leaves no more than 1000 terms to choose from, nor more than there are
        equations.
    criterion : {"ebic", "bic", "aic"}
        How many terms: :func:`identifiers.sparse.orthogonal.criterion_value`.
    terms : int, optional
        Terms of each output at most, in place of the criterion; pruning may leave fewer.
    prune : bool
        Judge terms by free runs. Without it the terms are those of the criterion, and a model that diverges is only
        warned of.
    noise : int
        Samples of the equation's own error that it remembers (the moving average of a NARMAX model): then past errors
        are regressors too, as they are estimated in turn (extended least squares; Billings 2013, ch. 3), and noise
        on the outputs does not bias the terms as far as it is of that kind. Predictions do not use it.

    Examples
    --------
    >>> from harness.signals import Channel
    >>> spec, rng = PlantSpec((Channel("u"),), (Channel("y"),), 1.0), np.random.default_rng(0)
    >>> u, y = rng.uniform(-1, 1, (600, 1)), np.zeros((600, 1))
    >>> for k in range(1, 599):
    ...     y[k + 1] = 0.5 * y[k] - 0.3 * y[k - 1] * u[k] + 0.8 * u[k - 1] ** 2 + 0.01 * rng.normal()
    >>> model = Narx(lags=2).fit([Trajectory(np.arange(600.0), u, y, spec)], rng=rng)
    >>> sorted(model.terms[0])
    ['u[k-1]^2', 'y[k-1] u[k]', 'y[k]']
    """

    lags: int = 3
    degree: int | None = None
    criterion: Criterion = "ebic"
    terms: int | None = None
    prune: bool = True
    noise: int = 0

    @told
    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> NarxModel:
        """Return the model; its equations, error reduction ratios and free-run errors stand in its notes."""
        what = "narx"
        check_options(self, what, lags=">= 1", degree=">= 1", terms=">= 1", noise=">= 0")
        measured, spec = usable(trajectories, samples=2 * self.lags + 2, what=what)
        real_signals(spec, what)
        _no_angles(spec, what)
        moving(measured, what)
        refuse_undetermined(measured, what, self.least_excitation)
        refuse_feedback_of_records(measured, self.lags, self.least_excitation, what)
        scaling = self._scaling(measured)
        records = [_scaled(record, scaling) for record in measured]
        rows = sum(len(record) - self.lags for record in records)
        library = Library(argument_names(spec, self.lags), self._degree(spec, rows, what))
        equations = NormalEquations.of(_blocks(records, library, self.lags), len(library), spec.ny)
        supports, notes = self._chosen(equations, library, records, what)
        for _ in range(_AGAIN if self.noise else 0):
            coloured = _coloured(records, library, supports, self.lags, self.noise)
            equations = NormalEquations.of(_blocks(records, library, self.lags, coloured), len(library), spec.ny)
            supports, notes = self._chosen(equations, library, records, what)
        coefficients = np.zeros((spec.ny, len(library)))
        inside: list[FloatArray] = []
        std, white = np.zeros(spec.ny), []
        moved: list[list[float]] = []
        for output, support in enumerate(supports):
            found = last_fit(records, library, support, output, self.lags, self.noise)
            coefficients[output, support] = found.theta
            inside.append(found.covariance)
            std[output] = found.rms * scaling.y_std[output]
            white.append(found.white)
            moved.append(found.noise)
        notes |= {"degree": library.degree, "candidates": len(library), "samples": rows}
        if self.noise:
            notes["moving_average"] = moved
        model = NarxModel(spec, self.lags, scaling, library, coefficients, std)
        estimate = _estimate(model, supports, inside, white, rows)
        if estimate is not None:
            notes["estimate"] = estimate.to_dict()
        return replace(model, notes={**notes, **missing_notes(trajectories, measured)})

    def _degree(self, spec: PlantSpec, rows: int, what: str) -> int:
        """Return the degree: as it was asked for, or the largest that leaves few enough terms."""
        count = self.lags * (spec.ny + spec.nu)
        fits = [d for d in range(1, _DEGREE + 1) if comb(count + d, d) <= min(_CANDIDATES, rows)]
        degree = self.degree or max(fits, default=1)
        if comb(count + degree, degree) > _CANDIDATES:
            raise FitError(
                f"{what}: too many terms to choose from",
                expected=f"at most {_CANDIDATES}",
                got=f"{comb(count + degree, degree)} of degree {degree} in {count} signals",
                remedy="lower lags or degree, or leave signals out",
            )
        return degree

    def _scaling(self, records: Sequence[Trajectory]) -> Standardisation:
        """Return sizes of the signals, and the levels of those far from zero."""
        y, u = ([getattr(record, name) for record in records] for name in "yu")
        levels, spreads = [], []
        for parts in (y, u):
            spread = sizes(parts)
            mean = np.concatenate(parts).mean(axis=0)
            levels.append(np.where(np.abs(mean) > _LEVEL * spread, mean, 0.0))
            spreads.append(spread)
        x_mean, x_std = (np.concatenate([np.tile(side, self.lags) for side in both]) for both in (levels, spreads))
        return Standardisation(x_mean, x_std, levels[0], spreads[0])

    def _chosen(
        self, equations: NormalEquations, library: Library, records: Sequence[Trajectory], what: str
    ) -> tuple[list[list[int]], dict[str, Any]]:
        """Return the terms of each output, and the notes on how they were chosen."""
        supports, ratios = [], []
        most = self.terms or _MOST
        for output in range(equations.right.shape[1]):
            path = frols(equations, output, min(most, equations.rows // 2))
            values = [
                criterion_value(path.lost(k), k, equations.rows, len(library), self.criterion)
                for k in range(len(path.order) + 1)
            ]
            count = len(path.order) if self.terms else int(np.argmin(values))
            supports.append(list(path.order[:count]) or [0])
            ratios.append({library.names[j]: float(r) for j, r in zip(path.order[:count], path.ratios, strict=False)})
        notes: dict[str, Any] = {"error_reduction": ratios}
        first = [last_fit(records, library, one, i, self.lags, self.noise) for i, one in enumerate(supports)]
        known = [fit.white or fit.rms <= EXACT for fit in first]
        alive = np.array([fit.rms**2 < _HALF for fit in first])
        for longest in _SHORTER:
            windows = ScaledWindows.of(records, self.lags, longest)
            found, errors = pruned(equations, library, windows, supports, 0, self.criterion, known)
            if longest != _SHORTER[-1] and not np.all(errors[alive] < _HALF):
                continue  # it does not follow the record so far, as none does a chaotic one, and tells nothing
            if self.prune:
                found, errors = pruned(equations, library, windows, supports, most, self.criterion, known)
            if np.isfinite(errors).all():
                notes["simulation"] = {"samples": longest, "nrmse": np.sqrt(errors).tolist()}
                return [sorted(one) for one in found], notes
        if not self.prune:
            notes["warning"] = "free runs of the estimation records diverge"
            return [sorted(one) for one in supports], notes
        raise FitError(
            f"{what}: every model diverges",
            expected=f"a free run that stays near the data for {_SHORTER[-1]} samples",
            got="runs that leave them a hundredfold",
            remedy="lower degree or lags, excite the plant over its whole range, or use prune=false for one-step use",
        )


@dataclass(frozen=True, eq=False)
class TermFit:
    """Coefficients (k,) of chosen terms, their covariance (k, k), rms, and whether the errors are white.

    ``noise`` is their moving average, ``coloured`` (N,) what it makes of the targets.
    """

    theta: FloatArray
    covariance: FloatArray
    rms: float
    white: bool
    noise: list[float]
    coloured: FloatArray


def _no_angles(spec: PlantSpec, what: str) -> None:
    """Refuse outputs that wrap, whose powers jump."""
    names = [channel.name for channel in spec.outputs if channel.period is not None]
    if names:
        raise FitError(
            f"{what}: angles",
            expected="outputs without a period",
            got=", ".join(names),
            remedy="use stlsq, whose terms are sines and cosines, or record sine and cosine",
        )


def _scaled(record: Trajectory, scaling: Standardisation) -> Trajectory:
    """Return a record of signals about 1."""
    ny, nu = record.spec.ny, record.spec.nu
    level, size = scaling.x_mean[len(scaling.x_mean) - nu :], scaling.x_std[len(scaling.x_std) - nu :]
    return replace(record, u=(record.u - level) / size, y=(record.y - scaling.x_mean[:ny]) / scaling.x_std[:ny])


def _blocks(
    records: Sequence[Trajectory], library: Library, lags: int, coloured: Sequence[FloatArray] | None = None
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield functions (p, n) and next outputs (ny, n), record by record; without what is coloured, if that is given."""
    for number, record in enumerate(records):
        rows, after = lagged(record, lags).T, record.y[lags:].T
        if coloured is not None:
            after = after - coloured[number]
        for low in range(0, rows.shape[1], _BLOCK):
            part = slice(low, low + _BLOCK)
            yield library.rows(list(rows[:, part])), after[:, part]


def _coloured(
    records: Sequence[Trajectory], library: Library, supports: list[list[int]], lags: int, memory: int
) -> list[FloatArray]:
    """Return what past errors make of the next outputs of every record (ny, N - lags)."""
    fits = [last_fit(records, library, support, i, lags, memory) for i, support in enumerate(supports)]
    edges = np.cumsum([len(record) - lags for record in records])[:-1]
    return list(np.split(np.stack([fit.coloured for fit in fits]), edges, axis=1))


def last_fit(
    records: Sequence[Trajectory], library: Library, support: list[int], output: int, lags: int, memory: int
) -> TermFit:
    """Return the least-squares fit of chosen terms, with past errors of the equation beside them where asked for.

    Covariance ``s^2 (Phi' Phi)^-1`` (Ljung 1999, eq. 9.42), and a test of whether the errors are foretold by as many
    before as there are lags, and the regressors (Breusch 1978; Godfrey 1978), without which it would claim too much.
    """
    from scipy.stats import chi2

    parts = [library.rows(list(lagged(record, lags).T), support).T for record in records]
    targets = [record.y[lags:, output] for record in records]
    phi, y = np.concatenate(parts), np.concatenate(targets)
    first = np.zeros(len(y), dtype=bool)
    first[np.concatenate([[0], np.cumsum([len(part) for part in parts])[:-1]])] = True

    def before(errors: FloatArray, many: int) -> FloatArray:
        """Return the errors of so many samples before (N, many), 0 beyond the start of a record."""
        columns, moved = [], errors
        for _ in range(many):
            moved = np.where(first, 0.0, np.concatenate([[0.0], moved[:-1]]))
            columns.append(moved)
        return np.column_stack(columns) if columns else np.zeros((len(y), 0))

    full = phi
    theta = least_squares(phi, y, 1e-12)
    errors = y - phi @ theta
    for _ in range(_NOISE_ROUNDS if memory else 0):
        last, full = theta, np.hstack([phi, before(errors, memory)])
        theta = least_squares(full, y, 1e-12)
        errors = y - full @ theta
        if last.size == theta.size and np.linalg.norm(theta - last) <= _SETTLED * np.linalg.norm(theta):
            break
    count = len(support)
    free = max(len(y) - full.shape[1], 1)
    size = column_norms(full)
    inverse = np.linalg.pinv(full / size, rcond=1e-12) / size[:, None]
    covariance = float(errors @ errors) / free * (inverse @ inverse.T)[:count, :count]
    rms = float(np.sqrt(errors @ errors / free))
    again = np.hstack([full, before(errors, lags)])
    left = errors - again @ least_squares(again, errors, 1e-12)
    share = 1.0 - float(left @ left) / max(float(errors @ errors), 1e-300)
    white = rms > EXACT and float(chi2.sf(len(y) * max(share, 0.0), lags)) >= DOUBT
    return TermFit(theta[:count], covariance, rms, white, theta[count:].tolist(), full[:, count:] @ theta[count:])


def _estimate(
    model: NarxModel, supports: list[list[int]], inside: list[FloatArray], white: list[bool], rows: int
) -> Estimate | None:
    """Return the record of the terms in the units of the signals, None beyond 200."""
    from scipy.stats import t

    chosen = [(output, j) for output, support in enumerate(supports) for j in support]
    if len(chosen) > LARGEST:
        return None
    spec = model.spec
    sides = [c.unit for side in (spec.outputs, spec.inputs) for _ in range(model.lags) for c in side]
    names, units = model.names, model.library.units(sides)
    natural = model.natural
    values = np.array([natural[output, j] for output, j in chosen])
    scaled = np.array([model.coefficients[output, j] for output, j in chosen])
    grown = np.where(scaled != 0.0, values / np.where(scaled != 0.0, scaled, 1.0), 0.0)
    covariance, place = np.zeros((len(chosen), len(chosen))), 0
    for own in inside:
        covariance[place : place + len(own), place : place + len(own)] = own
        place += len(own)
    covariance = covariance * np.outer(grown, grown)
    half = float(t.ppf(0.5 + LEVEL / 2, max(rows - len(chosen), 1))) * np.sqrt(np.clip(np.diag(covariance), 0.0, None))
    sure = all(white)
    return Estimate(
        tuple(f"{spec.outputs[output].name} on {names[j]}" for output, j in chosen),
        tuple(quotient(spec.outputs[output].unit, units[j]) for output, j in chosen),
        values,
        covariance,
        np.column_stack([values - half, values + half]) if sure else None,
        LEVEL,
        "least squares of the chosen terms, white residuals; that other terms might be the true ones is not counted"
        if sure
        else "no interval: the residuals are correlated in time, or rounding; noise on the outputs asks for noise=1",
        RankDecision(len(chosen), len(chosen), rule="each term beyond what the others explain"),
    )
