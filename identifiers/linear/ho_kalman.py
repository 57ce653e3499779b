"""Ho-Kalman and eigensystem realization: a state-space model from Markov parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from harness.errors import FitError
from harness.judgement import feedback_of, refuse_law
from harness.models.determined import KEY, determined_bands
from harness.models.lqr import spectral_radius
from harness.models.spread import Matrices
from harness.scoring import simulation_error
from harness.signals import FloatArray, Trajectory
from identifiers.common.excitation import excited_lags, refuse_feedback_of_records
from identifiers.common.judge.excited import Excited
from identifiers.common.judge.told import told
from identifiers.common.linear_model import LinearModel
from identifiers.common.named import wrong_options
from identifiers.common.neighbours import STRETCHES, coefficients_without, spread_of
from identifiers.common.normal import scaled_equations, solved
from identifiers.common.observers import stationary_gain
from identifiers.common.records import (
    filled,
    lagged_blocks,
    missing_notes,
    moving,
    real_signals,
    usable,
    without_holes,
)
from identifiers.common.regression import Solution, solve
from identifiers.common.scaling import Scaling, lively, sizes, together
from identifiers.common.stability import clip_eigenvalues
from identifiers.linear.decaying import LARGEST, Decaying, decaying_response
from identifiers.linear.hankel import Hankel, leading_triplets
from identifiers.linear.markov import markov_parameters, sums_without
from identifiers.linear.state_space_estimate import state_space_estimate

__all__ = ["HoKalman", "markov_parameters", "realize"]


# Singular values that fall by so much from one to the next end there.
_CLEAR = 1e3
# A response beyond this grows without bound.
_BEYOND = 1e12
# Outputs are not told apart by noise below this fraction of their size.
_QUIET = 1e-6
# Memories of the observer that are tried.
OBSERVERS = (2, 4, 6, 8, 12, 20, 30)
# Unknowns of one output beyond which no fit without a stretch is made: a system of equations for each.
_MOST_UNKNOWNS = 300
# An observer must have so many equations for each parameter, and beat the direct estimate by more than chance does.
_ROWS, _NEAR = 10, 1.01


def realize(
    markov: FloatArray,
    *,
    order: int | None = None,
    rows: int | None = None,
    tolerance: float = 1e-8,
    noise: float | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Realize Markov parameters as a balanced state-space model.

    Ho & Kalman 1966 (Regelungstechnik 14:545); Juang & Pappa 1985 (J. Guidance 8:620, eq. 18-21).

    - ``markov`` (M, ny, nu): G[1], G[2], ... (without the direct term).
    - ``order``: state dimension; by default the number of Hankel singular values above ``noise``, or where that is not
      known the largest gap of those above ``tolerance``
    - ``rows``: block rows of the Hankel matrix; by default half of the Markov parameters, which uses all of them
    - ``tolerance``: singular values below this fraction of the largest count as zero
    - ``noise``: what the error of the Markov parameters leaves as singular value by itself
    - returns A (n, n), B (n, nu), C (ny, n), Hankel singular values (of a large matrix with a given order: the leading
      ones)

    Examples
    --------
    >>> G = 0.5 ** np.arange(8)[:, None, None]
    >>> realize(G)[0].round(12)
    array([[0.5]])
    """
    count, ny, nu = markov.shape
    p = count // 2 if rows is None else rows
    q = count - p
    if p < 1 or q < 1:
        raise FitError(
            "ho-kalman: window of the Hankel matrix",
            expected=f"1 to {count - 1} block rows",
            got=str(p),
            remedy="ask for more Markov parameters",
        )
    columns = max(1, q - 1)  # the last block column is only shifted in
    matrix = Hankel(markov[: p + columns - 1], p, columns)
    found = leading_triplets(matrix, order) if order is not None and order >= 1 else None
    left, values, right = found or np.linalg.svd(matrix.dense(), full_matrices=False)
    if values[0] == 0:
        raise FitError("ho-kalman: no response", expected="Markov parameters", got="zeros", remedy="excite the plant")
    if order is not None:
        n = order
    elif noise is not None:
        n = max(1, int(np.sum(values > noise)))
        clear = np.flatnonzero(values[: n - 1] > _CLEAR * values[1:n])
        n = int(clear[0]) + 1 if clear.size else n
    else:
        n = _gap(values, tolerance)
    if not 1 <= n <= values.size:
        raise FitError("ho-kalman: order", expected=f"1 to {values.size}", got=str(n), remedy="correct it")
    root = np.sqrt(values[:n])
    observe = left[:, :n] * root
    control = root[:, None] * right[:n]
    later = np.zeros((p + columns - 1, ny, nu))
    later[: count - 1] = markov[1 : p + columns]
    a = (left[:, :n].T / root[:, None]) @ Hankel(later, p, columns).times(right[:n].T / root)
    return a, control[:, :nu], observe[:ny], values


def _gap(values: FloatArray, tolerance: float) -> int:
    """Return the numerical rank where it is clear; else the order at the largest gap among the larger half."""
    rank = int(np.sum(values > tolerance * values[0]))
    if rank < values.size and values[rank - 1] > _CLEAR * values[rank]:
        return rank
    kept = values[:rank]
    ratios = kept[:-1] / kept[1:]
    half = max(1, ratios.size // 2)
    return int(np.argmax(ratios[:half])) + 1 if ratios.size else 1


@dataclass(frozen=True)
class _Response:
    """Markov parameters with the direct term, to the input (M, ny, nu) and to the innovation (M, ny, ny or 0).

    ``level`` and ``rms`` (ny,) are the constant output and the residual; ``decaying`` is there where the response was
    expected to die away.
    """

    input: FloatArray
    innovation: FloatArray
    level: FloatArray
    rms: FloatArray
    decaying: Decaying | None = None

    def scaled(self, scaling: Scaling) -> _Response:
        """Return the response over the sizes of inputs and outputs."""
        outputs, decaying = scaling.outputs[:, None], self.decaying
        if decaying is not None:
            decaying = replace(decaying, draws=decaying.draws * scaling.inputs / outputs)
        return replace(
            self,
            input=self.input * scaling.inputs / outputs,
            innovation=self.innovation * scaling.outputs / outputs if self.innovation.shape[2] else self.innovation,
            level=self.level / scaling.outputs,
            decaying=decaying,
        )


@dataclass(frozen=True)
class HoKalman(Excited):
    """Ho-Kalman identification: Markov parameters by least squares, then a balanced realization.

    Parameters
    ----------
    markov : int
        Number of Markov parameters estimated (impulse response over ``markov`` samples). The response must have died
        away by then.
    order : int, optional
        State dimension; by default as many as stand out of the noise, or those above the largest gap of the Hankel
        singular values where the noise is not known (without ``regularised``, or without any noise).
    rows : int, optional
        Block rows of the Hankel matrix.
    observer : int or "auto", optional
        Memory of an observer through which the Markov parameters are estimated (OKID), instead of directly: the
        response need not have died away, and the model gets the filter gain of the noise in the data. ``"auto"`` takes
        the memory, or the direct estimate, whose model simulates held-out records best (the last third of them, or of
        each where there are less than three); the direct one where it is within 1 %.
    offset : bool
        Fit a constant output too.
    direct : bool
        Keep the direct term D; without it y[k] does not depend on u[k].
    regularised : bool
        Expect the response to die away, as fast as the data say (:mod:`identifiers.linear.decaying`), and take as many
        states
        as stand out of what the data leave open. Without it, or with ``observer``, or beyond 600 unknowns, plain least
        squares, whose noise at frequencies that the input hardly excites can end up as a state that grows.
    stable : bool
        Move eigenvalues on or outside the unit circle to radius 0.999, and fit B anew.

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> u = np.random.default_rng(0).choice([-1.0, 1.0], size=(400, 1))
    >>> y = np.zeros((400, 1))
    >>> for k in range(399):
    ...     y[k + 1] = 0.5 * y[k] + 2.0 * u[k]
    >>> data = Trajectory(np.arange(400.0), u, y, spec)
    >>> model = HoKalman(markov=40, order=1).fit([data], rng=np.random.default_rng(0))
    >>> model.eigenvalues.real.round(6)
    array([0.5])
    """

    markov: int = 100
    order: int | None = None
    rows: int | None = None
    observer: int | Literal["auto"] | None = None
    offset: bool = True
    direct: bool = False
    regularised: bool = True
    stable: bool = False

    @told
    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> LinearModel:
        """Return a balanced model; in innovation form with ``observer``, else in output-error form."""
        what = "ho-kalman"
        records, spec = usable(trajectories, samples=3, what=what, holes="kept")
        records = filled(records)
        real_signals(spec, what)
        if spec.nu == 0:
            raise FitError(f"{what}: no input", expected="an input", got="none", remedy="use dmdc for free motion")
        if self.observer == "auto":
            return self._chosen(records, what, rng)
        if self.markov < 3 or (self.observer is not None and self.observer < 1):
            raise wrong_options(self, what, "markov >= 3, observer >= 1", "markov observer")
        if self.observer is not None:
            records = without_holes(records, samples=self.observer + 2, what=what)
        moving(records, what)
        refuse_law(records, what, self.least_excitation)
        response = self._response(records, what)
        if isinstance(self.observer, int):
            refuse_feedback_of_records(records, self.observer, self.least_excitation, what)
        feedback = feedback_of(records)
        said = missing_notes(trajectories, None if self.observer is None else records)
        notes: dict[str, Any] = {"residual_rms": response.rms.tolist(), "feedback_share": feedback.share, **said}
        if feedback.found and self.observer is None:
            notes["warning"] = "past outputs predict the input (feedback): the direct fit is biased; use observer"
        # Outputs count by their noise, inputs by their size: no unit decides on order and directions.
        size = sizes([record.y for record in records])
        scaling = Scaling(sizes([record.u for record in records]), np.maximum(response.rms, _QUIET * size))
        response = response.scaled(scaling)
        a, b, c = self._realized(response, notes)
        if spectral_radius(a) >= 1.0:
            a, b = self._settled(a, b, c, response, notes)
        if self.observer is not None and "stabilized" not in notes:
            gain = _observer_gain(a, c, response.innovation)
        else:
            gain = stationary_gain(a, c)
        d = response.input[0] if self.direct else np.zeros((spec.ny, spec.nu))
        model = LinearModel(spec, a, b, c, d, gain, np.zeros(a.shape[0]), response.level, notes=notes)
        if "stabilized" not in notes:
            near = self._without_stretches(records, response, scaling, len(a))
            left = [] if self.observer is None or not near else self._of_longer_memory(records, scaling, len(a))
            method = f"{STRETCHES}, and the fit with an observer of twice the memory" if left else ""
            factor = (len(near) - 1) / max(len(near), 1)
            spread = spread_of([*near, *left], factor=factor, method=method, warning=notes.get("warning", ""))
            model = replace(model, spread=spread)
        model = model.in_units(scaling)
        notes[KEY] = determined_bands(model.matrices, records)
        rule = "given" if self.order is not None else "Hankel singular values above the noise"
        estimate = state_space_estimate(model, notes["hankel_singular_values"], rule)
        return replace(model, notes=notes if estimate is None else {**notes, "estimate": estimate.to_dict()})

    def _settled(
        self, a: FloatArray, b: FloatArray, c: FloatArray, response: _Response, notes: dict[str, Any]
    ) -> tuple[FloatArray, FloatArray]:
        """Return A and B of a model that grows, stable if that was asked for; ``notes`` say so."""
        if self.stable:
            notes["stabilized"] = True
            a = clip_eigenvalues(a)
            return a, _input_matrix(a, c, response.input[1:])
        if self.observer is None:
            notes.setdefault(
                "warning",
                f"the model grows (spectral radius {spectral_radius(a):.4g}) although its response was taken to have "
                "died away: lower the order, or use stable or observer",
            )
        return a, b

    def _without_stretches(
        self, records: Sequence[Trajectory], response: _Response, scaling: Scaling, order: int
    ) -> list[Matrices]:
        """Return A, B, C, D of the fits without one stretch of the records each, order and prior held; scaled."""
        return [self._matrices(markov, scaling, order) for markov in self._responses_without(records, response)]

    def _of_longer_memory(self, records: Sequence[Trajectory], scaling: Scaling, order: int) -> list[Matrices]:
        """Return A, B, C, D of the fit with an observer of twice the memory, none where records do not tell it.

        What an observer's memory cuts off is no noise of any stretch: how far the answer moves when it is kept says how
        much that may be.
        """
        assert isinstance(self.observer, int)
        memory, how = 2 * self.observer, {"offset": self.offset, "direct": self.direct}
        if sum(map(len, records)) < _ROWS * memory * (records[0].spec.ny + records[0].spec.nu):
            return []
        try:
            return [self._matrices(observer_markov(records, memory, self.markov, **how)[0], scaling, order)]
        except FitError:
            return []

    def _matrices(self, markov: FloatArray, scaling: Scaling, order: int) -> Matrices:
        """Return A, B, C, D of Markov parameters (M, ny, nu) of unscaled records."""
        ny, nu = markov.shape[1:]
        markov = markov * scaling.inputs / scaling.outputs[:, None]
        a, b, c, _ = realize(markov[1:], order=order, rows=self.rows)
        return a, b, c, markov[0] if self.direct else np.zeros((ny, nu))

    def _responses_without(self, records: Sequence[Trajectory], response: _Response) -> list[FloatArray]:
        """Return the Markov parameters (M, ny, nu) without one stretch of the records each."""
        ny, nu = records[0].spec.ny, records[0].spec.nu
        if isinstance(self.observer, int):
            memory, offset, direct = self.observer, self.offset, self.direct
            found = coefficients_without(
                lambda: lagged_blocks(records, memory, offset=offset, direct=direct),
                _observer(records, memory, offset=offset, direct=direct),
            )
            near = [] if found is None else [one.T for one in found[0]]
            grown = [_expanded(one, memory, self.markov, ny, nu, direct)[0] for one in near]
            return grown if all((np.abs(one) < _BEYOND).all() for one in grown) else []
        if self.markov * nu > _MOST_UNKNOWNS:
            return []
        responses = []
        for sums in sums_without(records, self.markov, offset=self.offset):
            if response.decaying is not None:
                theta = response.decaying.prior.coefficients(sums, offset=self.offset)
            else:
                gram, right, size = scaled_equations(sums)
                theta = solved(gram, right) / size[:, None]
            responses.append(theta[: self.markov * nu].reshape(self.markov, nu, ny).transpose(0, 2, 1))
        return responses

    def _response(self, records: Sequence[Trajectory], what: str) -> _Response:
        """Return the Markov parameters, directly or through an observer."""
        assert not isinstance(self.observer, str)
        if self.observer is not None:
            return _Response(
                *observer_markov(records, self.observer, self.markov, offset=self.offset, direct=self.direct)
            )
        ny, nu = records[0].spec.ny, records[0].spec.nu
        response, level, rms = markov_parameters(records, self.markov, offset=self.offset)
        decaying: Decaying | None = None
        loud = bool(np.all(rms > _QUIET * sizes([record.y for record in records])))
        if self.regularised and loud and self.markov * nu <= LARGEST:
            windows, _ = usable(records, samples=self.markov + 1, what=what, holes="kept")
            decaying = decaying_response(windows, self.markov, response, rms, offset=self.offset)
            response, level = decaying.response, decaying.level
        return _Response(response, np.zeros((self.markov, ny, 0)), level, rms, decaying)

    def _realized(self, response: _Response, notes: dict[str, Any]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return A, B, C of a response in the units of its noise; ``notes`` tell how the order came about.

        The response to the innovation is far less certain than that to the input: with both in one Hankel matrix the
        noise of the former ends up in A.
        """
        markov, noise = response.input[1:], None
        if response.decaying is not None:
            noise = max(float(realize(draw[1:], order=1, rows=self.rows)[3][0]) for draw in response.decaying.draws)
            notes |= {"decay": response.decaying.decay, "hankel_noise": noise}
        a, b, c, values = realize(markov, order=self.order, rows=self.rows, noise=noise)
        asked = self.order is not None or self.observer is not None
        left_out = []
        while not asked and len(a) > 1 and spectral_radius(a) >= 1.0:
            # The response has died away within the window, or the direct estimate is none: a state that grows is noise.
            left_out.append(len(a))
            a, b, c, _ = realize(markov, order=len(a) - 1, rows=self.rows)
        notes |= {"hankel_singular_values": values[:20].tolist(), "order": int(a.shape[0])}
        if left_out:
            notes["unstable_orders"] = left_out
        return a, b, c

    def _chosen(self, records: Sequence[Trajectory], what: str, rng: np.random.Generator) -> LinearModel:
        """Return the model whose memory of the observer simulates held-out data best."""
        if len(records) >= 3:
            few = 2 * len(records) // 3
            learn, judge = list(records[:few]), list(records[few:])
        else:
            learn = [record[: 2 * len(record) // 3] for record in records]
            judge = [record[2 * len(record) // 3 :] for record in records]
        judge = without_holes(judge, samples=1, what=what)
        squares: dict[str, FloatArray] = {}
        refused: FitError | None = None
        spec = records[0].spec
        for observer in (None, *OBSERVERS):
            if observer is not None and _ROWS * observer * (spec.ny + spec.nu) > sum(map(len, learn)):
                break
            try:
                model = replace(self, observer=observer).fit(learn, rng=rng)
            except FitError as error:
                refused = error
                continue
            wrong = np.mean([simulation_error(model, record).nrmse ** 2 for record in judge], axis=0)
            squares["direct" if observer is None else str(observer)] = np.where(np.isfinite(wrong), wrong, 1e300)
        if not squares:
            assert refused is not None
            raise refused
        moves = lively(np.array(list(squares.values())))  # of outputs that hold noise alone all memories err alike
        errors = {name: float(np.sqrt(together(one, moves))) for name, one in squares.items()}
        best = min(errors, key=lambda name: errors[name])
        if errors.get("direct", np.inf) <= _NEAR * errors[best]:
            best = "direct"
        model = replace(self, observer=None if best == "direct" else int(best)).fit(records, rng=rng)
        return replace(model, notes={**model.notes, "observer": best, "observer_error": errors})


def observer_markov(
    trajectories: Sequence[Trajectory], lags: int, length: int, *, offset: bool = True, direct: bool = False
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return Markov parameters by way of an observer: OKID (Juang, Phan, Horta & Longman 1993, J. Guidance 16:320).

    ``y[k] = D u[k] + sum_{i=1}^{p} (P_i u[k-i] + Q_i y[k-i]) + c`` is fitted; the response of the system follows from
    ``G[k] = P_k + sum_{i=1}^{k} Q_i G[k-i]``, that to the innovation from ``H[k] = Q_k + sum_{i=1}^{k-1} Q_i H[k-i]``.

    - ``lags``: p, the length of the observer's memory
    - ``length``: number of Markov parameters wanted, the direct term included
    - ``offset, direct``: fit a constant; fit D
    - returns G (length, ny, nu), H (length, ny, ny), output offset (ny,), residual rms (ny,)
    """
    what = "ho-kalman"
    records, spec = usable(trajectories, samples=lags + 2, what=what)
    ny, nu = spec.ny, spec.nu
    if (excited := excited_lags(records, lags)) < lags:
        raise FitError(
            f"{what}: the inputs do not excite the observer's memory",
            expected=f"persistent excitation of order {lags}",
            got=f"order {excited}: each further lag of the inputs follows from those before",
            remedy="use a richer input (PRBS, more lines), or an observer of shorter memory",
        )

    solution = _observer(records, lags, offset=offset, direct=direct)
    theta = solution.coefficients.T
    response, innovation = _expanded(theta, lags, length, ny, nu, direct)
    if not (np.abs(response) < _BEYOND).all() or not np.isfinite(innovation).all():
        raise FitError(
            f"{what}: the observer's model grows without bound",
            expected="Markov parameters that stay finite",
            got=f"above {_BEYOND:g} within {length} samples",
            remedy="use direct=True if an output depends on the input of the same sample, or another observer",
        )
    level = np.zeros(ny)
    if offset:
        remaining = np.eye(ny) - theta[:, : lags * ny].reshape(ny, lags, ny).sum(axis=1)
        level = np.linalg.lstsq(remaining, theta[:, -1], rcond=1e-10)[0]
    return response, innovation, level, solution.residual_rms


def _observer(records: Sequence[Trajectory], lags: int, *, offset: bool, direct: bool) -> Solution:
    """Return the regression of the outputs on the memory of an observer."""
    blocks = partial(lagged_blocks, records, lags, offset=offset, direct=direct)
    return solve(blocks, "ho-kalman", least_norm=True)


def _expanded(
    theta: FloatArray, lags: int, length: int, ny: int, nu: int, direct: bool
) -> tuple[FloatArray, FloatArray]:
    """Return the responses to input and innovation (length, ny, nu or ny) of an observer's coefficients (ny, p)."""
    seen = theta[:, : lags * ny].reshape(ny, lags, ny).transpose(1, 0, 2)
    pushed = theta[:, lags * ny : lags * (ny + nu)].reshape(ny, lags, nu).transpose(1, 0, 2)
    response, innovation = np.zeros((length, ny, nu)), np.zeros((length, ny, ny))
    if direct:
        response[0] = theta[:, lags * (ny + nu) : lags * (ny + nu) + nu]
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(1, length):
            few = min(k, lags)
            if k <= lags:
                response[k], innovation[k] = pushed[k - 1], seen[k - 1]
            response[k] += np.einsum("iab,ibc->ac", seen[:few], response[k - 1 :: -1][:few])
            innovation[k] += np.einsum("iab,ibc->ac", seen[:few], innovation[k - 1 :: -1][:few])
    return response, innovation


def _input_matrix(a: FloatArray, c: FloatArray, markov: FloatArray) -> FloatArray:
    """Return B with which A and C come closest to the Markov parameters G[1], G[2], ..."""
    rows: list[FloatArray] = []
    power = c
    for _ in range(len(markov)):
        rows.append(power)
        power = power @ a
    found = np.linalg.lstsq(np.vstack(rows), markov.reshape(-1, markov.shape[2]), rcond=1e-12)[0]
    return np.asarray(found, dtype=np.float64)


def _observer_gain(a: FloatArray, c: FloatArray, innovation: FloatArray) -> FloatArray:
    """Return the K whose A K explains the response to the innovation; a stationary one if that observer grows."""
    gain = np.asarray(np.linalg.lstsq(a, _input_matrix(a, c, innovation[1:]), rcond=1e-10)[0], dtype=float)  # K = A L
    return stationary_gain(a, c) if np.abs(np.linalg.eigvals(a - a @ gain @ c)).max() >= 1.0 else gain
