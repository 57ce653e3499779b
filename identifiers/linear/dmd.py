"""Dynamic mode decomposition with control: a linear map between snapshots of many outputs, on few directions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from harness.errors import FitError
from harness.judgement import refuse_law
from harness.models.determined import KEY, determined_bands
from harness.models.lqr import spectral_radius
from harness.models.spread import Matrices
from harness.scoring import predict
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.common.excitation import Columns, refuse_feedback
from identifiers.common.judge.told import told
from identifiers.common.linear_model import LinearModel
from identifiers.common.named import wrong_options
from identifiers.common.neighbours import spread_of, stacked, triangles_without
from identifiers.common.one_step_estimate import least_squares_estimate
from identifiers.common.records import learnable, missing_notes
from identifiers.common.regression import Solution, solve
from identifiers.common.scaling import Scaling, lively, noise_levels, sizes
from identifiers.common.stability import clip_eigenvalues, nearest_stable, stable_lags, told_of_stable
from identifiers.linear.arx import lag_model, one_step, operating_point, solution_notes, with_lag_neighbours
from identifiers.linear.state_space_estimate import state_space_estimate

# Rows of a block when many snapshots are reduced to a triangle.
_BLOCK = 16_384
# The automatic rank looks no further than this many directions.
_MOST = 60
# A smaller rank is taken if its validated error is within this factor of the least.
_NEAR = 1.02
# Columns of the pairs beyond which no fit without a stretch is made: sixty triangles of that size.
_WIDE = 100
# Errors below this fraction of the outputs are rounding, not information about the rank.
_EXACT = 1e-9


@dataclass(frozen=True)
class Dmdc:
    """Dynamic mode decomposition with control: a linear map between snapshots.

    ``y[k+1] = A y[k] + B u[k]`` on the leading principal directions of the outputs (Proctor, Brunton & Kutz 2016, SIAM
    J. Appl. Dyn. Syst. 15:142, sec. 3.3). Several records are used without a pair that crosses a seam; many snapshots
    are reduced to a triangle block by block, so that memory stays bounded. The directions are those of outputs scaled
    to their noise, so that neither a unit decides nor an output that holds noise alone.

    Parameters
    ----------
    rank : int or "auto", optional
        Number of principal directions; all outputs without it. ``"auto"`` takes the smallest whose one-step error on
        the last third of the records, over outputs that anything foretells, is within 2 % of the least.
    delays : int
        Number of snapshots stacked (1: none); positions alone need 2 or more.
    total : bool or "auto"
        Total DMD: snapshot pairs are first projected on their common leading subspace, which removes the bias of noise
        on the outputs (Hemati et al. 2017, Theor. Comput. Fluid Dyn. 31:349); what the inputs explain, which are exact,
        is kept. Needs ``rank`` and ``delays = 1``. ``"auto"`` takes whichever predicts ten steps ahead better on the
        last third of the records.
    offset : bool
        Fit a constant too, for motion around an operating point.
    scale : bool
        With False the directions are those of the outputs as they are: for fields of one quantity.
    stable : bool
        Nearest stable model where the fit is unstable.
    ridge : float
        Tikhonov weight.
    least_excitation : float
        As of ``least-squares``; not asked with a ridge.

    Notes
    -----
    Without ``rank`` and ``ridge`` the model keeps the record of its estimate
    (:func:`harness.models.estimate.estimate_of`), with intervals where the residuals are white. With ``rank``, whose
    directions are estimated too, or a ridge it is that of poles and static gains, by leaving out stretches.

    Examples
    --------
    >>> from harness.signals import Channel
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> u = np.array([[1.0], [-1.0], [2.0], [0.5], [0.0]])
    >>> y = np.zeros((5, 1))
    >>> for k in range(4):
    ...     y[k + 1] = 0.5 * y[k] + 2.0 * u[k]
    >>> Dmdc().fit([Trajectory(np.arange(5.0), u, y, spec)], rng=np.random.default_rng(0)).eigenvalues.real.round(9)
    array([0.5])
    """

    rank: int | Literal["auto"] | None = None
    delays: int = 1
    total: bool | Literal["auto"] = False
    offset: bool = False
    scale: bool = True
    stable: bool = False
    ridge: float = 0.0
    least_excitation: float = 2.0

    @told
    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> LinearModel:
        """Return a linear model in the coordinates of the principal directions."""
        what = "dmdc"
        self._check(what)
        records, spec = learnable(trajectories, samples=self.delays + 2, what=what)
        refuse_law(records, what, self.least_excitation)
        if self.rank is None:
            full = self._full(records, spec, what)
            return replace(full, notes={**full.notes, **missing_notes(trajectories, records)})
        scaling = Scaling(np.ones(spec.nu), np.ones(spec.ny))
        if self.scale:
            scaling = Scaling(sizes([record.u for record in records]), noise_levels(records))
            records = [replace(record, u=record.u / scaling.inputs, y=record.y / scaling.outputs) for record in records]
        rank, notes = self.rank, missing_notes(trajectories, records)
        if rank == "auto":
            rank, notes["rank_error"] = _best_rank(records, self.offset, what)
        if not 1 <= rank <= spec.ny:
            raise FitError(f"{what}: rank", expected=f"1 to {spec.ny}", got=str(rank), remedy="correct it")
        total = self.total
        if total == "auto":
            total, notes["total_error"] = self._total_is_better(records, spec, rank, what)
        model = self._reduced(_Snapshots.of(records, self.offset), spec, rank, bool(total), what)
        if "stabilized" not in model.notes:
            near = self._without_stretches(records, spec, rank, bool(total), what)
            model = replace(model, spread=spread_of(near))
        bands = determined_bands(model.matrices, records)
        said = {**notes, **model.notes, "rank": rank, "total": bool(total), KEY: bands}
        model = replace(model.in_units(scaling), notes=said)
        estimate = state_space_estimate(model, [], "given" if rank == self.rank else "held-out prediction errors")
        return model if estimate is None else replace(model, notes={**said, "estimate": estimate.to_dict()})

    def _check(self, what: str) -> None:
        """Refuse options that make no sense."""
        wrong = self.delays < 1 or (self.total is not False and (self.rank is None or self.delays != 1))
        wrong = wrong or (isinstance(self.rank, str) and self.rank != "auto")
        if wrong or (isinstance(self.total, str) and self.total != "auto"):
            raise wrong_options(
                self,
                what,
                'delays >= 1, rank a number or "auto"; with total a rank and delays = 1',
                "delays rank total",
            )
        if self.rank is not None and self.delays > 1:
            raise FitError(
                f"{what}: rank and delays together",
                expected="one of them",
                got=f"rank={self.rank}, delays={self.delays}",
                remedy="use rank with many outputs, delays with few",
            )

    def _full(self, records: Sequence[Trajectory], spec: PlantSpec, what: str) -> LinearModel:
        """Fit all outputs."""
        solution = one_step(records, self.delays, self.offset, self.ridge, what)
        if self.ridge == 0.0:
            refuse_feedback(solution, Columns(spec, self.delays), self.least_excitation, what)
        coefficients, notes = solution.coefficients, solution_notes(solution)
        if not self.offset and self.ridge == 0.0:
            notes |= operating_point(records, solution, self.delays, what)
        estimate = None
        if self.ridge == 0.0:
            estimate = least_squares_estimate(records, solution, self.delays, self.offset)
        kept = {} if estimate is None else {"estimate": estimate.to_dict()}
        model = lag_model(spec, coefficients, self.delays, self.offset, {**notes, **kept})
        if self.stable and spectral_radius(model.a_matrix) >= 1.0:
            weights = 1.0 / sizes([record.y for record in records])
            factor = solution.factor * solution.scale
            project = clip_eigenvalues if self.delays == 1 else stable_lags
            coefficients = nearest_stable(coefficients, factor, self.delays * spec.ny, project, weights)
            notes = told_of_stable(notes, solution, coefficients, weights)
            return lag_model(spec, coefficients, self.delays, self.offset, notes)
        model = replace(model, notes={**model.notes, KEY: determined_bands(model.matrices, records)})
        model = with_lag_neighbours(model, records, solution, self.delays, self.offset, estimate=estimate)
        if self.ridge > 0.0 and self.delays == 1 and (estimate := state_space_estimate(model, [], "given")):
            model = replace(model, notes={**model.notes, "estimate": estimate.to_dict()})
        return model

    def _total_is_better(
        self, records: Sequence[Trajectory], spec: PlantSpec, rank: int, what: str
    ) -> tuple[bool, dict[str, float]]:
        """Return True if total DMD of the first two thirds predicts the rest better, ten steps ahead."""
        fit, held = _split(records)
        found = {}
        for name, total in (("plain", False), ("total", True)):
            model = self._reduced(_Snapshots.of(fit, self.offset), spec, rank, total, what)
            found[name] = _ahead(model, held)
        return found["total"] < found["plain"], found

    def _without_stretches(
        self, records: Sequence[Trajectory], spec: PlantSpec, rank: int, total: bool, what: str
    ) -> list[Matrices]:
        """Return A, B, C, D of the fits without one stretch of the pairs each; none of many outputs."""
        if 2 * spec.ny + spec.nu > _WIDE:
            return []
        asks_nothing = replace(self, least_excitation=0.0, stable=False)
        return [
            asks_nothing._reduced(part, spec, rank, total, what).matrices
            for part in _Snapshots.without_stretches(records, self.offset)
        ]

    def _reduced(self, snapshots: _Snapshots, spec: PlantSpec, rank: int, total: bool, what: str) -> LinearModel:
        """Fit on the leading directions of the outputs."""
        ny, nu = spec.ny, spec.nu
        before, exact, after = snapshots.before, snapshots.exact, snapshots.after
        weight = np.ones(ny)
        if total:
            # Total DMD takes the noise of all outputs for equally large: scale them so.
            weight = 1.0 / _noise_sizes(before, rank)
            before, after = _cleaned(before * weight, exact, after * weight, rank)
        directions = np.linalg.svd(before, full_matrices=False)[2][:rank].T
        seen = before @ directions
        solution = solve(lambda: [(np.hstack([seen, exact]), after @ directions)], what, ridge=self.ridge)
        rms = solution.residual_rms * np.sqrt(len(before) / snapshots.rows)
        scale = solution.scale
        solution = Solution(
            solution.coefficients,
            solution.singular_values,
            rms,
            snapshots.rows,
            solution.method,
            solution.factor,
            scale,
        )
        if self.ridge == 0.0 and not total:
            refuse_feedback(solution, Columns.lifted(rank, spec), self.least_excitation, what)
        coefficients, notes = solution.coefficients, solution_notes(solution)
        if self.stable and spectral_radius(coefficients[:rank]) >= 1.0:
            coefficients = nearest_stable(coefficients, solution.factor * scale, rank, clip_eigenvalues, np.ones(rank))
            notes = told_of_stable(notes, solution, coefficients, np.ones(rank))
        theta = coefficients.T
        return LinearModel(
            spec,
            theta[:, :rank],
            theta[:, rank : rank + nu],
            directions / weight[:, None],
            np.zeros((ny, nu)),
            directions.T * weight,
            theta[:, -1] if self.offset else np.zeros(rank),
            np.zeros(ny),
            notes=notes,
        )


@dataclass(frozen=True, eq=False)
class _Snapshots:
    """Outputs before and after a step (n, ny), inputs and constant (n, nu + 1): the pairs, or their triangle.

    A triangle has the same inner products as the ``rows`` pairs it was made of, and serves every regression on them.
    """

    before: FloatArray
    exact: FloatArray
    after: FloatArray
    rows: int

    @classmethod
    def of(cls, records: Sequence[Trajectory], offset: bool) -> _Snapshots:
        """Return the pairs of records, none across a seam."""
        ny, nu = records[0].spec.ny, records[0].spec.nu
        rows = sum(len(record) - 1 for record in records)
        width = 2 * ny + nu + int(offset)
        if rows <= 2 * width:
            both = np.vstack(list(_pairs(records, offset, rows)))
        else:
            both = np.zeros((0, width))
            for block in _pairs(records, offset, max(_BLOCK, 4 * width)):
                both = stacked(both, block)
        return cls(both[:, :ny], both[:, ny : width - ny], both[:, width - ny :], rows)

    @classmethod
    def without_stretches(cls, records: Sequence[Trajectory], offset: bool) -> list[_Snapshots]:
        """Return the pairs but those of one stretch of the records each."""
        ny, nu = records[0].spec.ny, records[0].spec.nu
        rows, width = sum(len(record) - 1 for record in records), 2 * ny + nu + int(offset)
        found = triangles_without(_pairs(records, offset, max(_BLOCK, 4 * width)), rows, width)
        return [cls(both[:, :ny], both[:, ny : width - ny], both[:, width - ny :], kept) for both, kept in found]


def _pairs(records: Sequence[Trajectory], offset: bool, size: int) -> Iterator[FloatArray]:
    """Yield blocks of ``[y[k], u[k], 1, y[k+1]]``."""
    for record in records:
        for start in range(0, len(record) - 1, size):
            stop = min(start + size, len(record) - 1)
            constant = [np.ones((stop - start, 1))] if offset else []
            yield np.hstack([record.y[start:stop], record.u[start:stop], *constant, record.y[start + 1 : stop + 1]])


def _noise_sizes(before: FloatArray, rank: int) -> FloatArray:
    """Return the part of each output that the leading directions leave (ny,), never below a part of its size."""
    right = np.linalg.svd(before, full_matrices=False)[2][:rank]
    residual = np.sqrt(np.mean((before - before @ right.T @ right) ** 2, axis=0))
    size = np.sqrt(np.mean(before**2, axis=0))
    floor = np.maximum(size, 1e-6 * max(float(size.max()), 1e-300))
    found: FloatArray = np.maximum(residual, 1e-6 * floor)
    return found


def _cleaned(before: FloatArray, exact: FloatArray, after: FloatArray, rank: int) -> tuple[FloatArray, FloatArray]:
    """Return the pairs with what inputs and ``rank`` common directions do not explain taken away."""
    both = np.hstack([before, after])
    known = np.zeros_like(both)
    if exact.shape[1]:
        q = np.linalg.qr(exact / np.where((size := np.linalg.norm(exact, axis=0)) > 0, size, 1.0))[0]
        known = q @ (q.T @ both)
    left, values, right = np.linalg.svd(both - known, full_matrices=False)
    both = known + (left[:, :rank] * values[:rank]) @ right[:rank]
    return both[:, : before.shape[1]], both[:, before.shape[1] :]


def _split(records: Sequence[Trajectory]) -> tuple[list[Trajectory], list[Trajectory]]:
    """Return the first two thirds of every record, and the rest."""
    return [record[: 2 * len(record) // 3] for record in records], [
        record[2 * len(record) // 3 :] for record in records
    ]


def _best_rank(records: Sequence[Trajectory], offset: bool, what: str) -> tuple[int, dict[str, float]]:
    """Return the smallest rank that predicts the last third of the records about as well as the best."""
    fit, held = _split(records)
    fit, held = [record for record in fit if len(record) > 2], [record for record in held if len(record) > 2]
    if not fit or not held:
        raise FitError(
            f"{what}: records too short for an automatic rank",
            expected="at least 9 samples",
            got=str(max(map(len, records))),
            remedy="give the rank",
        )
    learn, judge = _Snapshots.of(fit, offset), _Snapshots.of(held, offset)
    right = np.linalg.svd(learn.before, full_matrices=False)[2]
    most = min(_MOST, right.shape[0], max(1, learn.rows // 2 - learn.exact.shape[1]))
    power = np.sum(judge.after**2, axis=0)
    found: dict[int, FloatArray] = {}
    for rank in range(1, most + 1):
        directions = right[:rank].T
        rows = np.hstack([learn.before @ directions, learn.exact])
        length = np.where((size := np.linalg.norm(rows, axis=0)) > 0, size, 1.0)
        theta = np.linalg.lstsq(rows / length, learn.after @ directions, rcond=1e-12)[0] / length[:, None]
        guess = np.hstack([judge.before @ directions, judge.exact]) @ theta @ directions.T
        found[rank] = np.sum((judge.after - guess) ** 2, axis=0)
    moves = lively(np.array(list(found.values())) / np.where(power > 0, power, 1.0))
    errors = {
        rank: max(float(np.sqrt(wrong[moves].sum() / max(float(power[moves].sum()), 1e-300))), _EXACT)
        for rank, wrong in found.items()
    }
    least = min(errors.values())
    chosen = min(rank for rank, error in errors.items() if error <= _NEAR * least)
    return chosen, {str(rank): error for rank, error in errors.items()}


def _ahead(model: LinearModel, records: Sequence[Trajectory], steps: int = 10) -> float:
    """Return the error of predictions some steps ahead, relative to the outputs' size."""
    total, count = 0.0, 0
    size = sizes([record.y for record in records])
    for record in records:
        few = min(steps, len(record) - 1)
        miss: Any = (record.y - predict(model, record, few))[few:] / size
        total += float(np.sum(miss**2))
        count += miss.size
    return float(np.sqrt(total / max(count, 1)))
