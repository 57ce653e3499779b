"""Transfer functions in continuous time fitted to sampled records: the least output error under a declared hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from harness.algebra import least_squares
from harness.errors import FitError
from harness.models.spread import gains, response_covariance
from harness.signals import FloatArray
from identifiers.common.linear_model import LinearModel
from identifiers.linear.continuous.rational import Hold, Rational, held
from identifiers.linear.continuous.response_fit import fit_to_response
from identifiers.linear.polynomials.model import OutputRecord

POINTS = 60  # Frequencies of the discrete model's response that a start is fitted to.
LOW, HIGH = 0.5, 0.8  # They reach from half a period in the longest record to this share of the highest frequency.
FAINT = 1e-3  # No response counts for surer than this share of its size: the discrete model is not exact.
STEP = 1e-5  # Relative difference of parameters in gradients.
SLOWEST, FASTEST = 1e-4, 1e3  # Poles of a start relative to the middle of the frequencies.
GROWS = 1e9  # A model that grows by so much in a sample is none: the search is turned back.
EVALUATIONS = 30  # Of the search's gradients at most.


@dataclass(frozen=True, eq=False)
class RecordFit:
    """A transfer function of one output in scaled signals."""

    model: Rational
    cost: float  # Sum of squares of the output error
    errors: FloatArray  # (N,): Record by record
    gradients: FloatArray  # (N, k): Of the errors, initial states and level solved for; zeros of what is not fitted
    level: float
    arrived: bool
    states: int  # Initial states that were solved for

    @property
    def criterion(self) -> float:
        """``N ln(cost / N) + k ln N`` (Schwarz 1978)."""
        n = self.errors.size
        free = int(np.sum(np.any(self.gradients != 0, axis=0))) + self.states
        found = float(n * np.log(max(self.cost, 1e-300) / n) + free * np.log(n))
        return found if np.isfinite(found) else float("inf")


@dataclass(frozen=True, eq=False)
class Shown:
    """Response of a discrete model without its hold: ``response`` (F, nu) and ``variance`` at ``frequency`` [Hz]."""

    frequency: FloatArray
    response: npt.NDArray[np.complex128]
    variance: FloatArray

    @classmethod
    def of(cls, model: LinearModel, output: int, hold: Hold, longest: int) -> Shown:
        """Return that of one output; ``longest`` is the length of the longest record in samples.

        Frequencies count by what the model's spread says is known there.
        """
        step = model.spec.sample_time
        frequency = np.geomspace(LOW / (longest * step), HIGH * 0.5 / step, POINTS)
        response = gains(model.matrices, frequency, step)[:, output]
        variance = (FAINT * np.abs(response)) ** 2 + 1e-30
        if model.spread is not None:
            spread = response_covariance(model, frequency)[:, output]
            variance = variance + np.trace(spread, axis1=-2, axis2=-1)
        s = 2j * np.pi * frequency * step
        keeps = (1 - np.exp(-s)) / s
        keeps = keeps if hold == "zoh" else keeps**2 * np.exp(s)
        return cls(frequency, response / keeps[:, None], variance / np.abs(keeps[:, None]) ** 2)

    def start(self, order: int, zeros: int | None, delay: float | None) -> Rational:
        """Return the transfer function of an order whose response comes nearest."""
        found = fit_to_response(
            self.frequency, self.response, self.variance, order, zeros=zeros, delay=delay, rough=True
        ).model
        return _settled(found)


def _settled(model: Rational) -> Rational:
    """Return the model with growing poles mirrored: a free run that overflows has no gradient."""
    poles = model.poles / model.rate
    size = np.clip(np.abs(poles), SLOWEST, FASTEST)
    poles = poles / np.where(np.abs(poles) > 0, np.abs(poles), 1.0) * size
    poles = -np.abs(poles.real) - (poles.real == 0) * SLOWEST + 1j * poles.imag
    return Rational(np.real(np.poly(poles))[1:], model.b, model.delay, model.rate)


def fit_to_records(
    parts: Sequence[OutputRecord], sample_time: float, start: Rational, hold: Hold, *, free_delay: bool, offset: bool
) -> RecordFit:
    """Return the transfer function with the least output error, initial states and level free.

    Raises FitError if the records are too short.

    - ``parts``: of one output, scaled
    - ``sample_time``: [s]
    - ``start``: strictly proper
    - ``hold`` {"zoh", "foh"}
    - ``free_delay``: estimate the dead times too
    """
    from scipy.optimize import least_squares

    nu = len(start.b)
    first = int(np.floor(start.delay.max() / sample_time)) + 3 if free_delay or start.delay.max() > 0 else 1
    rows = sum(max(part.y.size - first, 0) for part in parts)
    if rows <= start.vector.size + len(parts) * start.a.size + 1:
        raise FitError(
            "transfer-function: fewer equations than unknowns",
            expected=f"more than {start.vector.size + len(parts) * start.a.size + 1} samples after the dead time",
            got=str(rows),
            remedy="record longer, or lower the order",
        )
    count = start.vector.size if free_delay else start.vector.size - nu
    low, high = np.full(count, -np.inf), np.full(count, np.inf)
    if free_delay:  # inputs before the record are not known: no row counts that they reach
        low[-nu:], high[-nu:] = 0.0, (first - 1) * sample_time * start.rate
    worst = np.full(rows, 1e3 * float(np.sqrt(np.mean(np.concatenate([part.y for part in parts]) ** 2)) + 1e-300))

    def model_of(free: FloatArray) -> Rational:
        return start.moved(np.concatenate([free, start.vector[count:]]))

    def miss(free: FloatArray) -> FloatArray:
        found = output_errors(model_of(free), parts, sample_time, hold, first, offset)[0]
        if not np.isfinite(found).all():
            return worst
        return np.clip(found, -worst, worst)

    begin = np.clip(start.vector[:count], low, high)
    if free_delay:
        begin[-nu:] = np.clip(begin[-nu:], 1e-6, high[-nu:] - 1e-6)
    end = least_squares(
        miss,
        begin,
        bounds=(low, high),
        x_scale="jac",
        diff_step=np.full(count, STEP),
        xtol=1e-8,
        ftol=1e-8,
        max_nfev=EVALUATIONS,
    )
    errors, level = output_errors(model_of(end.x), parts, sample_time, hold, first, offset)
    gradients = np.zeros((rows, start.vector.size))
    gradients[:, :count] = np.asarray(end.jac, dtype=np.float64)
    states = len(parts) * start.a.size
    return RecordFit(model_of(end.x), float(errors @ errors), errors, gradients, level, bool(end.status > 0), states)


def output_errors(
    model: Rational, parts: Sequence[OutputRecord], sample_time: float, hold: Hold, first: int, offset: bool
) -> tuple[FloatArray, float]:
    """Return output errors (N,) of free runs from the row ``first`` of each record, and the level.

    Initial states and the level are solved for. Modes are filtered one by one: a polynomial of poles near 1, as fast
    sampling brings them, would lose its digits.
    """
    total = sum(part.y.size - first for part in parts)
    with np.errstate(over="ignore", invalid="ignore"):
        phi, pieces = held(model, sample_time, hold)
    if not np.isfinite(phi).all() or np.abs(phi).max() > GROWS:
        return np.full(total, np.nan), 0.0
    poles, vectors = np.linalg.eig(phi)
    back = np.linalg.inv(vectors)
    reads = vectors[0]
    targets, columns = [], []
    place, n = 0, len(phi)
    with np.errstate(over="ignore", invalid="ignore"):
        for part in parts:
            forced = _forced(part.u, pieces, poles, back, reads)
            rest = (part.y - forced)[first:]
            powers = reads * poles ** np.arange(rest.size)[:, None]
            # conjugate pairs span the same real space as their real and imaginary parts
            real = np.where(poles.imag >= 0, powers.real, powers.imag)
            own = np.zeros((total, n))
            own[place : place + rest.size] = real
            place += rest.size
            targets.append(rest)
            columns.append(own)
    target = np.concatenate(targets)
    regressors = np.hstack([*columns, np.ones((total, 1))]) if offset else np.hstack(columns)
    if not (np.isfinite(target).all() and np.isfinite(regressors).all()):
        return np.full(total, np.nan), 0.0
    theta = least_squares(regressors, target, 1e-10)
    return target - regressors @ theta, float(theta[-1]) if offset else 0.0


def _forced(
    u: FloatArray,
    pieces: Sequence[tuple[int, FloatArray, FloatArray, float]],
    poles: npt.NDArray[np.complex128],
    back: npt.NDArray[np.complex128],
    reads: npt.NDArray[np.complex128],
) -> FloatArray:
    """Return the outputs (N,) of a free run from rest under inputs (N, nu)."""
    from scipy.signal import lfilter

    driven = np.zeros((len(u), len(poles)), dtype=np.complex128)
    direct = np.zeros(len(u))
    for j, (delay, now, before, straight) in enumerate(pieces):
        late = np.concatenate([np.full(delay, u[0, j]), u[:, j]])[: len(u)]
        earlier = np.concatenate([late[:1], late[:-1]])
        driven += late[:, None] * (back @ now) + earlier[:, None] * (back @ before)
        direct += straight * late
    states = np.empty_like(driven)
    for mode, pole in enumerate(poles):
        moved = lfilter([1.0], [1.0, -pole], driven[:, mode])
        states[0, mode], states[1:, mode] = 0.0, moved[:-1]
    return np.asarray((states @ reads).real + direct, dtype=np.float64)
