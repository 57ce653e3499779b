"""The identifier of transfer functions in continuous time, from records or from a frequency response."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from harness.errors import FitError
from harness.frequency import FrequencyResponse
from harness.judgement import feedback_of, refuse_undetermined
from harness.models.determined import KEY, determined_bands
from harness.signals import FloatArray, Trajectory
from identifiers.common.judge.excited import Excited
from identifiers.common.judge.told import told
from identifiers.common.linear_model import LinearModel
from identifiers.common.named import wrong_options
from identifiers.common.neighbours import GROUPS, STRETCHES, steps_without
from identifiers.common.records import learnable
from identifiers.common.scaling import Scaling, scaled
from identifiers.linear.arx import Arx
from identifiers.linear.continuous.model import TransferFunction, estimate_of_rows, sampled_model
from identifiers.linear.continuous.rational import Hold, Rational
from identifiers.linear.continuous.record_fit import RecordFit, Shown, fit_to_records
from identifiers.linear.continuous.response_fit import ResponseFit, fit_response
from identifiers.linear.polynomials.model import OutputRecord

ORDERS = (1, 2, 3, 4, 5)  # Orders that are tried where none is given.
ENOUGH = 2  # Orders beyond the best one that are still tried on records, where each is a search of its own.


@dataclass(frozen=True)
class ContinuousTransferFunction(Excited):
    """Transfer functions in continuous time with dead times, from sampled records or from a frequency response.

    From records: the least output error, each output with a denominator of its own and the initial states free, exact
    between samples for the hold that is declared (Garnier & Wang 2008, *Identification of Continuous-time Models from
    Sampled Data*, ch. 1). The search begins from the response of an ARX model of long memory, without its hold. From a
    frequency response: maximum likelihood under its variance (:meth:`fit_response`).

    Parameters
    ----------
    order : int, optional
        Of the denominator; by default the one up to 5 with the least criterion of Schwarz.
    zeros : int, optional
        Degree of the numerators; by default one less than the order.
    delay : float, optional
        Dead time of all inputs [s]; by default one is estimated for every input. 0: none.
    hold : {"zoh", "foh"}
        What the inputs do between samples of records: stay, or go straight (a sensor read them).
    offset : bool
        Fit a constant level of each output too; of records.

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec
    >>> u = np.repeat(np.random.default_rng(0).choice([-1.0, 1.0], 100), 5)[:, None]
    >>> y = np.zeros((500, 1))
    >>> for k in range(499):  # 2 / (s + 2), sampled at 10 Hz
    ...     y[k + 1] = np.exp(-0.2) * y[k] + (1 - np.exp(-0.2)) * u[k]
    >>> data = Trajectory(np.arange(500) * 0.1, u, y, PlantSpec((Channel("u"),), (Channel("y"),), 0.1))
    >>> model = ContinuousTransferFunction(order=1, delay=0.0).fit([data], rng=np.random.default_rng(0))
    >>> print(TransferFunction.from_dict(model.notes["transfer_function"]))
    y per u: 2 / (s + 2)
    """

    order: int | None = None
    zeros: int | None = None
    delay: float | None = None
    hold: Hold = "zoh"
    offset: bool = True

    @told
    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> LinearModel:
        """Return the model between samples; ``notes["transfer_function"]`` holds that in continuous time."""
        what = "transfer-function"
        self._check(what, proper=True)
        records, spec = learnable(trajectories, samples=4 * (self.order or 1) + 8, what=what)
        if spec.nu == 0:
            raise FitError(f"{what}: no input", expected="an input", got="none", remedy="use dmdc for free motion")
        refuse_undetermined(records, what, self.least_excitation)
        measured = records
        records, scaling = scaled(records)
        discrete = Arx(least_excitation=0.0).fit(records, rng=rng)
        fits, criteria = [], {}
        for column, output in enumerate(spec.outputs):
            fit, own = self._one_output(records, discrete, column, what)
            fits.append(fit)
            criteria[output.name] = {str(order): value for order, value in own.items()}
        return self._model(measured, fits, scaling, {"order_criterion": criteria})

    def fit_response(self, data: FrequencyResponse) -> TransferFunction:
        """Return the transfer functions that are most likely for a measured frequency response.

        Residuals over their standard deviations are minimised from Sanathanan and Koerner's iteration; without a
        variance every response counts by its own size. ``hold`` and ``offset`` play no part.
        """
        self._check("transfer-function", proper=False)
        orders = ORDERS if self.order is None else (self.order,)
        rows: list[Rational] = []
        fits: list[ResponseFit] = []
        criteria = {}
        for row, output in enumerate(data.outputs):
            variance = None if data.variance is None else data.variance[:, row]
            fit, own = fit_response(
                data.frequency, data.response[:, row], variance, orders, zeros=self.zeros, delay=self.delay
            )
            rows.append(fit.model)
            fits.append(fit)
            criteria[output.name] = {str(order): value for order, value in own.items()}
        notes = {
            "misfit": [fit.misfit for fit in fits],
            "variance_known": data.variance is not None,
            "order_criterion": criteria,
            KEY: _band(data),
        }
        covariances = tuple(fit.covariance for fit in fits)
        return TransferFunction(data.inputs, data.outputs, tuple(rows), covariances, notes)

    def _check(self, what: str, *, proper: bool) -> None:
        """Refuse options that make no sense."""
        order = max(ORDERS) if self.order is None else self.order
        zeros = 0 if self.zeros is None else self.zeros
        wrong = order < 1 or not 0 <= zeros <= order - int(proper) or (self.delay is not None and self.delay < 0)
        if wrong or self.hold not in ("zoh", "foh"):
            raise wrong_options(
                self,
                what,
                "order >= 1, zeros from 0 to below it, delay >= 0, hold zoh or foh",
                "order zeros delay hold",
            )

    def _one_output(
        self, records: Sequence[Trajectory], discrete: LinearModel, column: int, what: str
    ) -> tuple[RecordFit, dict[int, float]]:
        """Return the fit of the order with the least criterion, and the criteria of all."""
        parts = [OutputRecord(record.u, record.y[:, column]) for record in records]
        step, longest = records[0].spec.sample_time, max(map(len, records))
        shown = Shown.of(discrete, column, self.hold, longest)
        fits: dict[int, RecordFit] = {}
        refused: FitError | None = None
        for order in ORDERS if self.order is None else (self.order,):
            degree = order - 1 if self.zeros is None else min(self.zeros, order - 1)
            try:
                start = shown.start(order, degree, self.delay)
                free = self.delay is None
                fits[order] = fit_to_records(parts, step, start, self.hold, free_delay=free, offset=self.offset)
            except FitError as error:
                refused = error
                continue
            if order - min(fits, key=lambda one: fits[one].criterion) >= ENOUGH:
                break
        if not fits:
            assert refused is not None
            raise refused
        best = min(fits, key=lambda order: fits[order].criterion)
        return fits[best], {order: fit.criterion for order, fit in fits.items()}

    def _model(
        self, measured: Sequence[Trajectory], fits: Sequence[RecordFit], scaling: Scaling, notes: dict[str, Any]
    ) -> LinearModel:
        """Return the sampled model in the units of the channels, with its intervals."""
        spec = measured[0].spec
        rows, covariances = [], []
        for fit, size in zip(fits, scaling.outputs, strict=True):
            row, scale = fit.model, float(size) / scaling.inputs
            by = np.concatenate([np.ones(row.a.size), np.repeat(scale, row.b.shape[1]), np.ones(row.delay.size)])
            moves = steps_without(fit.gradients, fit.errors)
            rows.append(replace(row, b=row.b * scale[:, None]))
            covariances.append(_covariance(moves, row.vector.size) * np.outer(by, by))
        told = TransferFunction(spec.inputs, spec.outputs, tuple(rows), tuple(covariances))
        rms = [float(size * np.sqrt(np.mean(fit.errors**2))) for fit, size in zip(fits, scaling.outputs, strict=True)]
        notes |= {
            "hold": self.hold,
            "order": max(row.a.size for row in rows),
            "residual_rms": rms,
            "converged": all(fit.arrived for fit in fits),
            "transfer_function": told.to_dict(),
        }
        feedback = feedback_of(measured)
        if feedback.found:
            notes["warning"] = "outputs predict the input (feedback): output error is biased unless noise is white"
        method = STRETCHES
        free = float(GROUPS - 1)
        model = sampled_model(spec, rows, covariances, self.hold, notes, freedom=free, method=method)
        estimate = estimate_of_rows(spec.inputs, spec.outputs, rows, covariances, freedom=free, method=method)
        level = np.array([fit.level for fit in fits]) * scaling.outputs
        bands = determined_bands(model.matrices, measured)
        said = {**notes, "estimate": estimate.to_dict(), KEY: bands}
        return replace(model, spec=spec, output_offset=level, notes=said)


def _covariance(moves: FloatArray | None, size: int) -> FloatArray:
    """Return the jackknife's covariance of parameters that move so without one stretch each."""
    if moves is None:
        return np.zeros((size, size))
    found: FloatArray = (len(moves) - 1) / len(moves) * moves.T @ moves
    return found


def _band(data: FrequencyResponse) -> dict[str, list[list[float]]]:
    """Return the measured range of every pair."""
    own = [[float(data.frequency[0]), float(data.frequency[-1])]]
    return {f"{output.name} per {given.name}": own for output in data.outputs for given in data.inputs}
