"""Subspace identification from inputs and outputs: N4SID, MOESP, CVA for open loop, PARSIM-E and PBSID for any."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from harness.errors import FitError
from harness.judgement import Feedback, feedback_of, refuse_law
from harness.models.determined import KEY, determined_bands
from harness.models.lqr import spectral_radius
from harness.models.spread import Matrices
from harness.scoring import predict
from harness.signals import FloatArray, Trajectory
from identifiers.common.excitation import excited_lags, refuse_feedback_of_records
from identifiers.common.judge.told import told
from identifiers.common.linear_model import LinearModel
from identifiers.common.neighbours import GROUPS, spread_of
from identifiers.common.records import learnable, missing_notes
from identifiers.common.scaling import Scaling, scaled
from identifiers.common.stability import clip_eigenvalues
from identifiers.linear.directions import Directions, lively_directions
from identifiers.linear.projections import (
    ANY_LOOP,
    RANK,
    ROUNDING,
    Method,
    Stacked,
    completed,
    oblique,
    parsim,
    pbsid,
    weighted,
)
from identifiers.linear.state_space_estimate import state_space_estimate

# Without an order the candidates are those up to here; a later method is taken only for this gain in validated error.
_MOST = 12
_GAIN = 0.99
# The last order that few lines can tell is not needed if a smaller one comes so near.
_NEAR = 1.1
_FAR = 1e70  # An error that counts as any larger one: the variance of its square is a number still.
PASTS = (12, 20, 30, 50)  # Lengths of the past that are tried where none is given.
SHORTER = (8, 5, 3)  # Lengths that are tried where missing readings leave no stretch of that length.
# A longer past is taken only if it lowers the error by this much: it costs variance and time.
_LONGER = 0.95
# Stretches left out of a record, at most, and windows in one of them, at least, where there are several.
_TURNS = 4
_STRETCH = 4
# Samples of the past in which a law of feedback is looked for, as in the test for feedback itself.
_LAW = 4


def _candidates(method: Method | Literal["auto"], feedback: bool) -> tuple[Method, ...]:
    """Return the methods that are compared."""
    if method != "auto":
        return (method,)
    return ANY_LOOP if feedback else ("cva", *ANY_LOOP)


@dataclass(frozen=True)
class Subspace:
    """State-space model in innovation form by a subspace method; no starting values, no local minima.

    The future outputs are regressed on past and future data, the part that the past explains is cut to few directions,
    and these are the states; A, B, C, D, K follow by least squares (Van Overschee & De Moor 1996, *Subspace
    Identification for Linear Systems*, ch. 4). All regressions run on one triangle that is made of the data block by
    block: memory stays bounded, and no window crosses a seam. Directions of the outputs that hold nothing but white
    noise are left out before (:mod:`identifiers.linear.directions`), so that many outputs of few states do no harm.

    Parameters
    ----------
    order : int, optional
        State dimension; by default the one up to 12 that errs least, on all samples and on every third stretch,
        left out: in free runs, or one step ahead where past outputs predict the input.
    past : int, optional
        Samples of the past, and of the future, in the regressions; raised above the order where it is smaller. By
        default 12, and more (20, 30, 50) as long as each step lowers the error by 5 %: fast sampling asks for more.
    method : {"auto", "n4sid", "moesp", "cva", "parsim", "pbsid"}
        Weighting of the directions; ``"parsim"`` is PARSIM-E (Qin & Ljung 2003, IFAC SYSID, sec. 3): row by row, with
        innovations estimated on the way, so that no future input foretells a past error: also for data from a closed
        loop. ``"pbsid"`` predicts from the past alone (Chiuso 2007, Automatica 43, 1034-1048, sec. 3), with a ridge
        chosen by generalised cross-validation: also for closed loops, and for smooth inputs, whose future the past
        foretells, so that the other regressions tell the two apart by rounding and noise. ``"auto"`` takes of cva
        (not where past outputs predict the input), parsim and pbsid what errs least over all samples, each of its
        own order.
    direct : bool
        Keep the direct term D; under feedback leave it out. Outputs that answer the input of the same sample need it,
        and ``feedthrough`` declared in the record's spec: else they pass for feedback and the model is wrong.
    stable : bool
        Move eigenvalues on or outside the unit circle to radius 0.999.
    least_excitation : float
        As of ``least-squares``: where past outputs predict the input, it must depart from the law by so many times
        the noise that the law passes on; 0 asks for nothing.

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> u = np.random.default_rng(0).normal(size=(400, 1))
    >>> y = np.zeros((400, 1))
    >>> for k in range(399):
    ...     y[k + 1] = 0.5 * y[k] + 2.0 * u[k]
    >>> data = Trajectory(np.arange(400.0), u, y, spec)
    >>> Subspace(order=1).fit([data], rng=np.random.default_rng(0)).eigenvalues.real.round(6)
    array([0.5])
    """

    order: int | None = None
    past: int | None = None
    method: Method | Literal["auto"] = "auto"
    direct: bool = False
    stable: bool = False
    least_excitation: float = 2.0

    @told
    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> LinearModel:
        """Return the model in innovation form."""
        if self.past is not None:
            return self._finished(self._of_past(trajectories, self.past))
        best = self._first(trajectories)
        for past in PASTS[1:]:
            try:
                longer = self._of_past(trajectories, past)
            except FitError:  # records too short, or inputs too poor, for so much: what there is stands
                break
            if longer.error > _LONGER * best.error or best.error < ROUNDING:
                break
            best = longer
        return self._finished(best)

    def _first(self, trajectories: Sequence[Trajectory]) -> _Found:
        """Return what the first length of the past finds; a shorter one where missing readings leave no such window."""
        holes = any(record.missing is not None for record in trajectories)
        for past in (PASTS[0], *SHORTER) if holes else PASTS[:1]:
            try:
                return self._of_past(trajectories, past)
            except FitError as error:
                refused = error
        raise refused

    def _of_past(self, trajectories: Sequence[Trajectory], past: int) -> _Found:
        """Return what is found with one length of the past, of scaled records."""
        what = "n4sid"
        window = self._window(past, what)
        data = self._prepared(trajectories, window, what)
        methods, wanted = _candidates(self.method, data.feedback.found), window
        lags = excited_lags(data.records, 2 * window)
        if lags < 2 * wanted:
            methods, window = self._narrowed(methods, lags, window, what)
        orders = [self.order] if self.order else list(range(1, min(_MOST, window - 1, lags // 2) + 1))
        found = self._models(data.records, window, methods, orders, what)
        ladders = {
            name: {
                len(model.a_matrix): _squares(model, data.records, window, data.feedback.found) for model, _ in models
            }
            for name, models in found.items()
        }
        judged = ladders
        if self.order is None:
            judged = self._left_out(ladders, data.records, window, data.feedback.found, what)
            ladders = {
                name: {size: np.concatenate([ladders[name][size], held]) for size, held in own.items()}
                for name, own in judged.items()
            }
        chosen = {name: _order(ladder) for name, ladder in judged.items()}
        method = _best({name: _rms(ladder[chosen[name]]) for name, ladder in ladders.items()})
        order = chosen[method]
        if self.order is None and lags < 2 * wanted and order == orders[-1]:
            order = _enough(judged[method], order, lags, what)
        model, values = next(candidate for candidate in found[method] if len(candidate[0].a_matrix) == order)
        ladder = {size: _rms(squares) for size, squares in ladders[method].items()}
        return _Found(data, model, values, method, window, ladder)

    def _window(self, past: int, what: str) -> int:
        """Return the length of past and future for these options; refuse those that make no sense."""
        if self.method not in ("auto", *get_args(Method)) or past < 2 or (self.order or 1) < 1:
            raise FitError(
                f"{what}: options",
                expected="method auto, n4sid, moesp, cva, parsim or pbsid, past >= 2, order >= 1",
                got=f"method={self.method}, past={past}, order={self.order}",
                remedy="correct the options",
            )
        return past if self.order is None else max(past, self.order + 1)

    def _prepared(self, trajectories: Sequence[Trajectory], window: int, what: str) -> _Prepared:
        """Return the records in scaled directions; refuse those from which nothing can be learned."""
        records, _ = learnable(trajectories, samples=2 * window + 2, what=what)
        refuse_law(records, what, self.least_excitation)
        measured = records
        if directions := lively_directions(records):
            records = directions.compressed(records)
        records, scaling = scaled(records)
        feedback = feedback_of(records)
        if feedback.found:
            refuse_feedback_of_records(records, _LAW, self.least_excitation, what)
        return _Prepared(records, measured, directions, scaling, feedback, missing_notes(trajectories, measured))

    def _finished(self, found: _Found) -> LinearModel:
        """Return the model in the units of the channels, with its spread and its record."""
        data, order = found.data, len(found.model.a_matrix)
        notes: dict[str, Any] = {
            "method": found.method,
            "feedback_share": data.feedback.share,
            "order": order,
            "past": found.window,
            "fit_error": found.error,
            **data.missing,
        }
        if self.order is None:
            notes["order_error"] = {str(size): error for size, error in found.ladder.items()}
        if data.feedback.found and found.method not in ANY_LOOP:
            notes["warning"] = "past outputs predict the input (feedback): use method parsim or pbsid"
        values = found.values[:20].tolist()
        notes |= {"singular_values": values, "output_directions": data.records[0].spec.ny}
        model = found.model
        if self.stable and spectral_radius(model.a_matrix) >= 1.0:
            model = replace(model, a_matrix=clip_eigenvalues(model.a_matrix))
            notes["stabilized"] = True
        else:
            near = self._without_stretches(found)
            model = replace(model, spread=spread_of(near, warning=notes.get("warning", "")))
        model = data.in_units(replace(model, notes=notes))
        notes[KEY] = determined_bands(model.matrices, data.measured)
        rule = "given" if self.order is not None else "held-out prediction errors"
        estimate = state_space_estimate(model, values, rule)
        return replace(model, notes=notes if estimate is None else {**notes, "estimate": estimate.to_dict()})

    def _without_stretches(self, found: _Found) -> list[Matrices]:
        """Return A, B, C, D of the fits without one stretch of the windows each, method and order held."""
        records, order = found.data.records, len(found.model.a_matrix)
        near = []
        try:
            for part in Stacked.without_stretches(records, found.window):
                model, _ = self._of_method(records, part, found.method, [order], "n4sid")[0]
                near.append(model.matrices)
        except FitError:  # without a stretch the rest does not determine the order: no spread is known
            return []
        return near if all(len(one[0]) == len(near[0][0]) for one in near) else []

    def _narrowed(
        self, methods: tuple[Method, ...], lags: int, window: int, what: str
    ) -> tuple[tuple[Method, ...], int]:
        """Return methods and window for inputs that excite so many lags and no more.

        PBSID regresses on the past alone, the others on the inputs of past and future.
        """
        least = self.order or 2  # of an order not given one more is tried, and lost
        if methods == ("pbsid",) or ("pbsid" in methods and lags // 2 <= least + 1):
            methods, window = ("pbsid",), min(window, lags)
        else:
            window = lags // 2
        needed = 2 * least
        if lags < needed or window < least + 1:
            raise _unexcited(what, f"{max(needed, window + 1)}", lags)
        return methods, window

    def _left_out(
        self,
        ladders: Mapping[Method, Mapping[int, FloatArray]],
        records: Sequence[Trajectory],
        window: int,
        feedback: bool,
        what: str,
    ) -> dict[Method, dict[int, FloatArray]]:
        """Return the errors of methods and orders on stretches that a fit on the others left out."""
        fit, held = _parted(records, window)
        fit, held = (
            [record for record in fit if len(record) > 2 * window + 1],
            [record for record in held if len(record) > window + 1],
        )
        if not fit or not held:
            raise FitError(
                f"{what}: records too short to choose an order",
                expected=f"more than {3 * window + 3} samples",
                got=str(max(map(len, records))),
                remedy="give the order, or a smaller past",
            )
        orders = list(range(1, max(max(ladder) for ladder in ladders.values()) + 1))
        found: dict[Method, dict[int, FloatArray]] = {}
        for method, models in self._models(fit, window, tuple(ladders), orders, what).items():
            errors = {model.a_matrix.shape[0]: _squares(model, held, window, feedback) for model, _ in models}
            found[method] = {n: errors[n] for n in ladders[method] if n in errors}
        return found

    def _models(
        self, records: Sequence[Trajectory], window: int, methods: Sequence[Method], orders: Sequence[int], what: str
    ) -> dict[Method, list[tuple[LinearModel, FloatArray]]]:
        """Return the models of some orders by method, all from one triangle; methods that refuse it are left out."""
        data = Stacked.of(records, window, what)
        models: dict[Method, list[tuple[LinearModel, FloatArray]]] = {}
        refused: FitError | None = None
        for method in methods:
            try:
                models[method] = self._of_method(records, data, method, orders, what)
            except FitError as error:
                refused = refused or error
        if refused and not models:
            raise refused
        return models

    def _of_method(
        self, records: Sequence[Trajectory], data: Stacked, method: Method, orders: Sequence[int], what: str
    ) -> list[tuple[LinearModel, FloatArray]]:
        """Return the models of some orders by one method."""
        if method == "parsim":
            predicted = parsim(data, self.direct)
        elif method == "pbsid":
            predicted = pbsid(data, self.direct)
        else:
            predicted = oblique(data)
        left, values, right = weighted(data, predicted, method)
        found = []
        for order in orders:
            if order > int(np.sum(values > RANK * values[0])):
                break
            found.append((completed(records, data, left, values, right, order, self.direct), values))
        if not found:
            raise FitError(
                f"{what}: order",
                expected=f"1 to {int(np.sum(values > RANK * values[0]))}, the rank of the data",
                got=str(orders[0]),
                remedy="lower the order",
            )
        return found


@dataclass(frozen=True, eq=False)
class _Prepared:
    """Records in scaled directions of the outputs, and the way back to the units of ``measured``."""

    records: Sequence[Trajectory]
    measured: Sequence[Trajectory]
    directions: Directions | None
    scaling: Scaling
    feedback: Feedback
    missing: Mapping[str, Any]

    def in_units(self, model: LinearModel) -> LinearModel:
        """Return the model, and its neighbours, for the records as they were measured."""
        model = model.in_units(self.scaling)
        return self.directions.expanded(model, self.measured[0]) if self.directions else model


@dataclass(frozen=True, eq=False)
class _Found:
    """A model of prepared records: singular values, method, window, and the errors of all orders of the method."""

    data: _Prepared
    model: LinearModel
    values: FloatArray
    method: Method
    window: int
    ladder: Mapping[int, float]

    @property
    def error(self) -> float:
        """That of the order chosen."""
        return self.ladder[len(self.model.a_matrix)]


def _unexcited(what: str, needed: str, lags: int) -> FitError:
    """Return the refusal of inputs whose lags follow from one another."""
    return FitError(
        f"{what}: the inputs do not excite what the model needs",
        expected=f"persistent excitation of order {needed}",
        got=f"order {lags}: each further lag of the inputs follows from those before",
        remedy="use a richer input (PRBS, more lines), or give a lower order",
    )


def _parted(records: Sequence[Trajectory], window: int) -> tuple[list[Trajectory], list[Trajectory]]:
    """Return what orders are fitted on and every third stretch, left out: spread, for a sweep changes as it goes."""
    fit, held = [], []
    for record in records:
        turns = min(max(len(record) // (3 * _STRETCH * window), 1), _TURNS)
        edges = np.linspace(0, len(record), 3 * turns + 1).astype(int)
        fit += [record[edges[i] : edges[i + 2]] for i in range(0, 3 * turns, 3)]
        held += [record[edges[i + 2] : edges[i + 3]] for i in range(0, 3 * turns, 3)]
    return fit, held


def _squares(model: LinearModel, records: Sequence[Trajectory], skip: int, feedback: bool) -> FloatArray:
    """Return the mean squares in 20 stretches of the errors one step ahead, or in open loop of free runs.

    A free run shows modes that grow, which one step ahead hides; under feedback it would leave the records by itself.
    Its start is fitted to every record: as many degrees of freedom as there are states.
    """
    fitted = 0 if feedback else len(model.a_matrix) * len(records)
    misses = []
    for record in records:
        with np.errstate(over="ignore", invalid="ignore"):
            ahead = predict(model, record, 1 if feedback else None)
        first = skip if feedback else int(model.burn_in)
        misses.append((record.y - np.where(np.isfinite(ahead), ahead, _FAR))[first:])
    squares = np.clip(np.concatenate(misses), -_FAR, _FAR) ** 2
    squares = squares[np.isfinite(squares).all(axis=1)].mean(axis=1)  # where readings are missing nothing is known
    squares = squares * len(squares) / max(len(squares) - fitted / model.spec.ny, 1.0)
    return np.array([np.mean(part) for part in np.array_split(squares, min(GROUPS, len(squares)))])


def _rms(squares: FloatArray) -> float:
    """Return the root of the mean of mean squares."""
    return float(np.sqrt(np.mean(squares)))


def _order(squares: Mapping[int, FloatArray]) -> int:
    """Return the smallest order that errs no more than that of least error does, by more than one standard error.

    Of the difference over the stretches (Breiman, Friedman, Olshen & Stone 1984, *Classification and Regression Trees*,
    sec. 3.4.3): the least of many errors is so by chance.
    """
    best = squares[min(squares, key=lambda order: _rms(squares[order]))]
    for order, own in squares.items():
        more = own - best
        if _rms(own) <= ROUNDING or more.mean() * np.sqrt(len(more)) <= more.std():
            return order
    return max(squares)


def _enough(squares: Mapping[int, FloatArray], last: int, lags: int, what: str) -> int:
    """Return the order below the last that inputs of so many lags can tell; refuse if the last is clearly better."""
    smaller = {order: own for order, own in squares.items() if order < last}
    if not smaller or _rms(smaller[_order(smaller)]) > _NEAR * _rms(squares[last]):
        raise _unexcited(what, f"{lags + 1} or more, which tells whether {last} states are enough", lags)
    return _order(smaller)


def _best(errors: Mapping[Method, float]) -> Method:
    """Return the method of least error; a later one only for a gain that is more than chance or rounding."""
    names = list(errors)
    best = names[0]
    for name in names[1:]:
        if errors[name] < _GAIN * errors[best] and errors[best] > ROUNDING:
            best = name
    return best
