"""Prediction-error method with free initial states: state space, ARX, ARMAX, output error, Box-Jenkins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from harness.errors import FitError
from harness.judgement import Feedback, feedback_of, refuse_undetermined
from harness.models.arx_orders import Delay, input_delays
from harness.models.determined import KEY, determined_bands
from harness.models.lqr import spectral_radius
from harness.models.whiteness import whiteness
from harness.scoring import equation_error, simulation_error
from harness.signals import FloatArray, Trajectory
from identifiers.common.excitation import excited_lags, refuse_feedback_of_records, unexcited
from identifiers.common.judge.excited import Excited
from identifiers.common.judge.loops import ANSWERED, COLOURED
from identifiers.common.judge.told import told
from identifiers.common.linear_model import LinearModel
from identifiers.common.named import wrong_options
from identifiers.common.neighbours import spread_of, steps_without
from identifiers.common.observers import innovation_form
from identifiers.common.records import filled, missing_notes, moving, real_signals, usable, without_holes
from identifiers.common.scaling import scaled
from identifiers.common.stability import RADIUS
from identifiers.linear.directions import lively_directions
from identifiers.linear.polynomials.estimate import FittedOutput, in_units, prediction_error_estimate
from identifiers.linear.polynomials.holes import in_pieces
from identifiers.linear.polynomials.model import Orders, OutputRecord, Polynomials, block_form
from identifiers.linear.polynomials.orders import LETTERS, Counts, orders_by_output
from identifiers.linear.polynomials.search import best, needed, search
from identifiers.linear.polynomials.starts import settled, starting_models
from identifiers.linear.state_space_estimate import state_space_estimate
from identifiers.linear.statespace.fit import state_space_of
from identifiers.linear.statespace.ladder import ORDERS

Structure = Literal["auto", "state-space", "oe", "arx", "armax", "bj"]

LADDER = (1, 2, 3, 4, 6)
# Another order must lower the validated error by this much.
_GAIN = 0.98
# Errors below this fraction of the outputs are rounding: no reason for another order.
_ROUNDING = 1e-7
# Gradients that depend on others up to this share of the largest singular value: what numpy.linalg.pinv leaves out.
_LOST = 1e-15
# Samples of the past in which a controller's law is looked for beside a fit.
_LAW = 4


@dataclass(frozen=True)
class PredictionError(Excited):
    """Model by minimising its one-step prediction errors, the initial state of every record free.

    Without options a state-space model of all outputs together: ``x+ = A x + B u``, ``y = C x + v``, and the noise v of
    each output an autoregression. Plants of order 1 to 10, noises of up to 6 coefficients and dead times of the inputs
    are tried, each brought to the largest likelihood from several starts (long one-step models, reduced by balanced
    truncation; larger orders without one of their modes; regressions on filtered signals), and Schwarz's rule decides
    (Ljung 1999, *System Identification*, sec. 7.4, 10.2 and 16.4; :mod:`identifiers.linear.statespace`).

    The other structures are polynomials, of each output by itself: ``A y = sum B_i/F_i u_i + C/D e`` with ``"oe"``: F
    and B (white noise on the output; the model is fitted to free runs), ``"arx"``: A, B, ``"armax"``: A, B, C,
    ``"bj"``: B, F, C, D (sec. 4.2), by Levenberg and Marquardt's method with exact gradients. Output error and
    Box-Jenkins start from Steiglitz & McBride's iteration, ARMAX from Hannan & Rissanen's two stages; of several starts
    the best end is taken.

    Readings that are missing are not filled in: the likelihood is that of the readings that there are, as a Kalman
    filter that passes over the others has it (:mod:`identifiers.linear.polynomials.holes`); a state-space model of
    noise that remembers leaves out the prediction errors that would stand on a missing reading.

    Parameters
    ----------
    structure : {"auto", "state-space", "oe", "arx", "armax", "bj"}
        ``"auto"`` is ``"state-space"`` where no order, delay or degree is given, else ``"oe"``.
    order : int, optional
        States, or of all polynomials that no option below gives. By default of a state-space model 1 to 10, by
        Schwarz's rule; of polynomials one of 1, 2, 3, 4, 6, by the error on the last third of the records: of free runs
        for output error, one step ahead for the others.
    delay : int, optional
        Samples that an input takes to reach an output: 0 with feedthrough, else 1 or more. By default found from the
        data for a state-space model, 1 for polynomials.
    na, nc, nd : int or list of int, optional
        Degrees of A, C and D: a number, or one for each output.
    nb, nf : int, list of int or list of lists, optional
        Coefficients of B and degree of F: a number, one for each input, or rows of outputs by columns of inputs. A
        number for ``nf`` is one F that the inputs share, else each has its own.
    nk : int, list of int, list of lists or "auto", optional
        Delay of each input instead of ``delay``, as for ``nb``; ``"auto"`` finds each from the data, and the notes say
        how sure it is (:func:`harness.models.arx_orders.input_delays`).
    offset : bool
        Fit a constant level of each output too.
    stable : bool
        Where an output's model is unstable, search it again among those with all poles within radius 0.999.

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> rng = np.random.default_rng(0)
    >>> u, x = rng.normal(size=(600, 1)), np.zeros((600, 1))
    >>> for k in range(599):
    ...     x[k + 1] = 0.8 * x[k] + u[k]
    >>> data = Trajectory(np.arange(600.0), u, x + 0.2 * rng.normal(size=(600, 1)), spec)
    >>> PredictionError(order=1).fit([data], rng=rng).eigenvalues.real.round(2)
    array([0.8])
    """

    structure: Structure = "auto"
    order: int | None = None
    delay: int | None = None
    offset: bool = True
    stable: bool = False
    na: int | list[int] | None = None
    nb: Counts | None = None
    nc: int | list[int] | None = None
    nd: int | list[int] | None = None
    nf: Counts | None = None
    nk: Counts | Literal["auto"] | None = None

    @told
    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> LinearModel:
        """Return the model in innovation form; one with white noise on the outputs has no filter gain."""
        what = "prediction-error"
        self._check(what)
        records, spec = usable(trajectories, samples=4 * (self.order or 1) + 4, what=what, holes="kept")
        real_signals(spec, what)
        if spec.nu == 0:
            raise FitError(f"{what}: no input", expected="an input", got="none", remedy="use dmdc for free motion")
        said = missing_notes(records, how="likelihood of the readings that there are")
        records = filled(records)
        moving(records, what)
        refuse_undetermined(records, what, self.least_excitation)
        if self._structure == "state-space":
            return self._of_states(records, said, what)
        delay = 1 if self.delay is None else self.delay
        return replace(self, structure=self._structure, delay=delay)._of_polynomials(records, said, what)

    @property
    def _structure(self) -> Structure:
        """The structure, decided."""
        if self.structure != "auto":
            return self.structure
        given = (self.order, self.delay, *self._given().values())
        return "state-space" if all(one is None for one in given) else "oe"

    def _of_states(self, records: list[Trajectory], said: dict[str, Any], what: str) -> LinearModel:
        """Return the state-space model."""
        measured, directions = records, None
        if not any(record.missing is not None for record in records):
            directions = lively_directions(records)
        if directions:
            records = directions.compressed(records)
        records, scaling = scaled(records)
        feedback = feedback_of(records)
        lags = excited_lags(records, 2 * ORDERS) if self.least_excitation > 0 else 2 * ORDERS
        asked = partial(
            state_space_of,
            records,
            what,
            order=self.order,
            delay=self.delay,
            offset=self.offset,
            loop=feedback.found,
            most=max(min(lags // 2, ORDERS), 1),
        )
        found, stabilized = asked(radius=np.inf), False
        if self.stable and spectral_radius(found.plant.a_matrix) >= 1.0:
            found, stabilized = asked(radius=RADIUS, innovations=False), True
        notes: dict[str, Any] = {"structure": "state-space", **said, **found.notes, "feedback_share": feedback.share}
        notes["residual_rms"] = (np.array(found.notes["residual_rms"]) * scaling.outputs).tolist()
        if found.ladder:
            notes["order_criterion"] = found.ladder
        if stabilized:
            notes["stabilized"] = True
        if self.order is not None and (poor := self._unexcited(records, self.order)):
            notes["warning"] = poor
        white = [
            whiteness([one[:, output] for one in found.residuals]) for output in range(found.residuals[0].shape[1])
        ]
        if feedback.found and "warning" not in notes and (doubt := self._looped(records, feedback, white, what)):
            notes["warning"] = doubt

        def told(model: LinearModel) -> LinearModel:
            if model.spread is not None:
                warning = str(notes.get("warning", ""))
                spread = None if stabilized else replace(model.spread, warning=warning)
                model = replace(model, spread=spread)
            model = model.in_units(scaling)
            return directions.expanded(model, measured[0]) if directions else model

        rule = "given" if self.order is not None else "BIC"
        if "warning" not in notes and not stabilized:
            estimate = state_space_estimate(told(found.plant), [], rule)
            notes |= {} if estimate is None else {"estimate": estimate.to_dict()}
        model = told(found.model)
        notes[KEY] = determined_bands(model.matrices, measured)
        return replace(model, notes=notes)

    def _of_polynomials(self, records: list[Trajectory], said: dict[str, Any], what: str) -> LinearModel:
        """Return the model whose outputs have polynomials each."""
        spec, measured = records[0].spec, records
        records, scaling = scaled(records)
        notes: dict[str, Any] = {"structure": self.structure, **said}
        made, delays = self._with_delays(records)
        notes |= {"delays": delays} if delays else {}
        order = self.order
        if order is None:
            order, notes["order_error"] = made._chosen(records, what)
        model, fits = made._fitted(records, order, what)
        feedback = feedback_of(records)
        notes["feedback_share"] = feedback.share
        if poor := self._unexcited(records, order):
            notes["warning"] = poor
        if feedback.found and self.structure == "oe":
            notes["warning"] = "outputs predict the input (feedback): output error is biased unless noise is white"
        rms = (np.array(model.notes["residual_rms"]) * scaling.outputs).tolist()
        told = [in_units(fit, scaling, output) for output, fit in enumerate(fits)]
        notes = {**notes, **model.notes, "order": order, "residual_rms": rms}
        notes["polynomials"] = [polynomials.to_dict() for polynomials, _ in told]
        notes["standard_errors"] = [errors.tolist() for _, errors in told]
        white = [fit.whiteness for fit in fits]
        if feedback.found and "warning" not in notes and (doubt := self._looped(records, feedback, white, what)):
            notes["warning"] = doubt
        estimate = prediction_error_estimate(spec, fits, scaling)
        # about a biased answer, or one on the edge of what is allowed, the spread of the fit says nothing
        if estimate is not None and "warning" not in notes and "stabilized" not in notes:
            notes["estimate"] = estimate.to_dict()
        notes[KEY] = determined_bands(model.in_units(scaling).matrices, measured)
        model = replace(model, notes=notes)
        return (model if "stabilized" in notes else self._with_spread(model, fits)).in_units(scaling)

    def _check(self, what: str) -> None:
        """Refuse options that mean nothing."""
        fine = self.structure in (*LETTERS, "auto", "state-space") and (self.delay is None or self.delay >= 0)
        if self.structure == "state-space" and (
            given := [name for name, one in self._given().items() if one is not None]
        ):
            raise FitError(
                f"{what}: options",
                expected="order and delay with structure state-space",
                got=", ".join(given),
                remedy="leave them out, or take structure oe, arx, armax or bj",
            )
        if not fine or (self.order is not None and self.order < 1) or (isinstance(self.nk, str) and self.nk != "auto"):
            raise wrong_options(
                self,
                what,
                "structure auto, state-space, oe, arx, armax or bj, order >= 1, delay >= 0, nk as nb or auto",
                "structure order delay nk",
            )

    def _looped(self, records: Sequence[Trajectory], feedback: Feedback, white: Sequence[float], what: str) -> str:
        """Return a warning where the model may be that of the controller, or the loop biases it; empty if neither."""
        try:
            refuse_feedback_of_records(records, _LAW, self.least_excitation, what)
        except FitError as error:  # noise models can tell a loop that n4sid refuses, or take its controller for it
            return f"the model may be that of the controller: {error}"
        if feedback.share > ANSWERED and min(white) < COLOURED / records[0].spec.ny:
            return (
                "residuals are correlated in time, which under feedback (past outputs predict the input) biases "
                "what the inputs do: raise the order, or move the set-point more"
            )
        return ""

    def _unexcited(self, records: Sequence[Trajectory], order: int) -> str:
        """Return a warning where the inputs excite fewer lags than their polynomials have numbers, else nothing."""
        needed = (
            2 * order
            if self._structure in ("oe", "bj", "state-space") and self.nb is None and self.nf is None
            else order
        )
        return unexcited(records, needed) if self.least_excitation > 0 else ""

    def _with_delays(self, records: Sequence[Trajectory]) -> tuple[PredictionError, dict[str, Any]]:
        """Return the identifier with its delays as numbers, and what the data say of them."""
        if self.nk is None:
            return replace(self, nk=1 if self.delay is None else self.delay), {}
        if self.nk != "auto":
            return self, {}
        spec = records[0].spec
        found: list[list[Delay]] = [input_delays(records, output) for output in range(spec.ny)]
        said = {
            f"{output.name} from {given.name}": one.to_dict()
            for output, row in zip(spec.outputs, found, strict=True)
            for given, one in zip(spec.inputs, row, strict=True)
        }
        return replace(self, nk=[[one.samples for one in row] for row in found]), said

    def _given(self) -> dict[str, Any]:
        """Return the orders that options give."""
        return {"na": self.na, "nb": self.nb, "nc": self.nc, "nd": self.nd, "nf": self.nf, "nk": self.nk}

    def _chosen(self, records: Sequence[Trajectory], what: str) -> tuple[int, dict[str, float]]:
        """Return the order that does best on the last third of the records."""
        given, letters = self._given(), LETTERS[self.structure]
        if all(given[f"n{letter}"] is not None for letter in letters):
            return max(int(np.max(given[f"n{letter}"])) for letter in letters), {}
        fit = [record[: 2 * len(record) // 3] for record in records]
        held = [record[2 * len(record) // 3 :] for record in records]
        errors: dict[str, float] = {}
        best_of = (np.inf, 1)
        for order in LADDER:
            learn = [one for one in fit if len(one) > 8 * order]
            try:
                judge = without_holes(held, samples=4 * order + 1, what=what)
            except FitError:
                break
            if not learn:
                break
            model, _ = self._fitted(learn, order, what)
            score = simulation_error if self.structure == "oe" else equation_error
            wrong = [score(model, record, burn_in=2 * order).rms for record in judge]
            error = float(np.sqrt(np.mean(np.square(wrong))))
            errors[str(order)] = error if np.isfinite(error) else 1e300
            if error < _GAIN * best_of[0] and best_of[0] > _ROUNDING:
                best_of = (error, order)
        return best_of[1], errors

    def _fitted(self, records: Sequence[Trajectory], order: int, what: str) -> tuple[LinearModel, list[FittedOutput]]:
        """Return the model of one order, of scaled records, and the fit of every output."""
        spec = records[0].spec
        every = orders_by_output(self.structure, spec, self._given(), order, what)
        fits = [self._one_output(_parts(records, column, own), own, what) for column, own in enumerate(every)]
        found = [fit.model for fit in fits]
        moved = {"stabilized": True} if any(fit.stabilized for fit in fits) else {}
        a, b, c, d, k, level_of = block_form(found)
        notes = {
            "residual_rms": [fit.rms for fit in fits],
            "converged": all(fit.arrived for fit in fits),
            **moved,
        }
        model = innovation_form(spec, a, b, c, d, k, np.zeros(len(a)), level_of, notes=notes)
        return model, fits

    def _with_spread(self, model: LinearModel, fits: Sequence[FittedOutput]) -> LinearModel:
        """Return the model with the fits without one stretch of the records each, one step of the search away."""
        moves = [fit.moves for fit in fits]
        count = min(0 if own is None else len(own) for own in moves)
        near = []
        for group in range(count):
            others = [
                Polynomials.of(fit.model.vector + own[group], fit.model.orders)
                for fit, own in zip(fits, moves, strict=True)
                if own is not None
            ]
            a, b, c, d, _, _ = block_form(others)
            more = len(model.a_matrix) - len(a)  # states that hold the last innovation, which no input reaches
            near.append((np.pad(a, (0, more)), np.pad(b, ((0, more), (0, 0))), np.pad(c, ((0, 0), (0, more))), d))
        return replace(model, spread=spread_of(near, warning=str(model.notes.get("warning", ""))))

    def _one_output(self, parts: Sequence[OutputRecord], orders: Orders, what: str) -> FittedOutput:
        """Return polynomials, their covariance, and how the search ended."""
        count = orders.count
        rows = sum(part.y.size - len(part.holes) for part in parts)
        free = count + len(parts) * (orders.start_x + orders.start_z)
        if rows <= free:
            raise FitError(
                f"{what}: fewer equations than unknowns",
                expected=f"more than {free} samples",
                got=str(rows),
                remedy="record longer, or lower the order",
            )
        starts = starting_models(parts, orders, self.offset)
        end = best([search(first, parts, self.offset) for first in starts])
        if orders.nf and (orders.nc or orders.nd):
            end = needed(end, parts, self.offset)
        stabilized = self.stable and end.model.slowest >= 1.0
        if stabilized:
            again = [settled(first) for first in (end.model, *starts)]
            end = best([search(first, parts, self.offset, RADIUS) for first in again])
        spare, cost, gradients = max(rows - free, 1), end.cost, end.misses.gradients
        length = np.linalg.norm(gradients, axis=0)
        kept = length > 0  # a level that is not fitted has no gradient
        length = np.where(kept, length, 1.0)
        _, values, right = np.linalg.svd(gradients[:, kept] / length[kept], full_matrices=False)
        inverse = np.zeros((length.size,) * 2)
        good = values > _LOST * values[0]
        inverse[np.ix_(kept, kept)] = (right[good].T / values[good] ** 2) @ right[good]
        covariance = cost / spare * (inverse / np.outer(length, length))[:count, :count]
        rms = float(np.sqrt(cost / rows)) / end.misses.scale
        moves = steps_without(gradients, end.misses.errors)
        own = None if moves is None else moves[:, :count]
        white = whiteness(_residuals(end.misses.errors, parts))
        return FittedOutput(end.model, covariance, rms, white, values, end.arrived, spare, stabilized, own)


def _parts(records: Sequence[Trajectory], column: int, orders: Orders) -> list[OutputRecord]:
    """Return the records of one output, cut where too much of it is missing."""
    found: list[OutputRecord] = []
    for record in records:
        gone = () if record.missing is None else tuple(np.flatnonzero(record.missing[:, column]).tolist())
        whole = OutputRecord(record.u, record.y[:, column], gone)
        found += in_pieces(whole, at_once=not (orders.na or orders.nc or orders.nd))
    return found


def _residuals(errors: FloatArray, parts: Sequence[OutputRecord]) -> list[FloatArray]:
    """Return the errors record by record, zeros where a reading is missing."""
    found = [piece.copy() for piece in np.split(errors, np.cumsum([part.y.size for part in parts])[:-1])]
    for piece, part in zip(found, parts, strict=True):
        piece[list(part.holes)] = 0.0
    return found
