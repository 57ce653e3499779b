"""Kernel-regularised impulse responses (FIR) of several inputs and outputs, with intervals of a looser prior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from harness.errors import FitError
from harness.judgement import feedback_of, refuse_undetermined
from harness.models.determined import KEY, determined_bands
from harness.models.estimate import Estimate
from harness.models.whiteness import white
from harness.signals import FloatArray, Trajectory
from harness.units import quotient
from identifiers.common.judge.excited import Excited
from identifiers.common.judge.told import told
from identifiers.common.linear_model import LinearModel
from identifiers.common.named import wrong_options
from identifiers.common.one_step_estimate import LARGEST
from identifiers.common.records import filled, missing_notes, moving, real_signals, usable
from identifiers.common.scaling import sizes
from identifiers.linear.impulse.kernels import (
    KERNELS,
    Evidence,
    Kernel,
    Loose,
    evidence,
    joined,
    kernel_root,
    loose,
    misfit,
)
from identifiers.linear.markov import normal_equations

_UNKNOWNS = 600  # Lags times inputs at most: each trial of a kernel's numbers factors a matrix of that size.
_CONSTANTS = 6  # Time constants that the search starts from, evenly in their logarithm.
_WEIGHTS = np.geomspace(1e-2, 1e6, 9)  # Variances of the first lag over that of the noise that the search starts from.
_SHORTEST = 0.3  # Least time constant [samples]: a kernel that falls to 4 % within a sample expects one lag.
_ROUNDS = 60  # Iterations of the search at most, for each number.
_LOOSER, _LONGER = 16.0, 2.4
"""Intervals are those of a prior of so many times the variance and so many times the time constants: with those that
fit best, the response of a random system lies outside its band at half of all lags, as the prior is taken for known and
smoother than the system. Chosen on 240 systems of benchmarks/kernel_responses.py with seeds that are not counted: with
2.5 they hold 96.6 % of all lags under white inputs and 94.5 % under slow ones, with 2.2 95.6 % and 92.9 %."""
_LEVEL = 0.95


@dataclass(frozen=True)
class ImpulseResponse(Excited):
    """Impulse responses under a prior that they decay and are smooth, its numbers by marginal likelihood.

    Every output has its own noise, and every input of it its own size, time constant and, under DC, smoothness; all by
    empirical Bayes (Pillonetto & De Nicolao 2010, Automatica 46:81; Chen, Ohlsson & Ljung 2012, Automatica 48:1525).
    So no order is chosen, and short or noisy records give a smooth response where least squares gives noise.

    The posterior at these numbers is too sure of itself. Intervals are those of an undersmoothed posterior (Hall 1992,
    Ann. Statist. 20:675: bias that is not known is made small beside the spread, not corrected): the same kernel with
    16 times the variance and 2.4 times the time constants, the noise counted by what is left over, each drawn out to
    hold the estimate. They hold each lag of a response with 95 % in the mean over lags and systems, not each by itself
    (Nychka 1988, J. Am. Stat. Assoc. 83:1134). They stand in the estimate where the residuals are white and no feedback
    is found.

    Parameters
    ----------
    length : int, optional
        Lags of the response, which must have died away by then. Without it 100, or what leaves 600 unknowns and a
        third of the samples.
    kernel : {"auto", "tc", "dc", "ss"}
        :func:`identifiers.linear.impulse.kernels.kernel_matrix`; ``"auto"`` takes, for each output, the one of the
        largest marginal likelihood, each of its numbers paid for (Schwarz).
    direct : bool
        The input acts on the output of the same sample.
    offset : bool
        Fit a constant output too.

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec
    >>> spec, rng = PlantSpec((Channel("u"),), (Channel("y"),), 1.0), np.random.default_rng(0)
    >>> u, x = rng.normal(size=(300, 1)), np.zeros((300, 1))
    >>> for k in range(299):
    ...     x[k + 1] = 0.8 * x[k] + u[k]
    >>> data = Trajectory(np.arange(300.0), u, x + 0.5 * rng.normal(size=x.shape), spec)
    >>> model = ImpulseResponse(length=40).fit([data], rng=rng)
    >>> response, deviation = (np.array(model.notes[name])[2, 0, 0] for name in ("response", "deviation"))
    >>> bool(abs(response - 0.8**2) < 3 * deviation)
    True
    """

    length: int | None = None
    kernel: Kernel | Literal["auto"] = "auto"
    direct: bool = False
    offset: bool = True

    @told
    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> LinearModel:
        """Return a model whose state is the past inputs.

        Its notes hold the ``response`` (length, ny, nu), the ``deviation`` of its posterior, and ``low`` and ``high``
        of the 95 % intervals where these are claimed.
        """
        what = "impulse-response"
        if (self.length is not None and self.length < 2) or self.kernel not in ("auto", *KERNELS):
            raise wrong_options(self, what, "length at least 2, kernel auto, tc, dc or ss", "length kernel")
        records, spec = usable(trajectories, samples=4, what=what, holes="kept")
        real_signals(spec, what)
        if spec.nu == 0:
            raise FitError(f"{what}: no input", expected="an input", got="none", remedy="use dmdc for free motion")
        records = filled(records)
        moving(records, what)
        refuse_undetermined(records, what, self.least_excitation)
        length = self.length or max(2, min(100, _UNKNOWNS // spec.nu, max(map(len, records)) // 3))
        if length * spec.nu > _UNKNOWNS:
            raise FitError(
                f"{what}: too many unknowns",
                expected=f"lags times inputs at most {_UNKNOWNS}",
                got=f"{length * spec.nu}",
                remedy="lower length, sample more slowly, or use n4sid",
            )
        first = 0 if self.direct else 1
        records, _ = usable(records, samples=length + first + 2, what=what, holes="kept")
        known = _Sums.of(records, length, first, self.offset)
        response, deviation = np.zeros((length, spec.ny, spec.nu)), np.zeros((length, spec.ny, spec.nu))
        said: list[dict[str, Any]] = []
        noise = np.zeros(spec.ny)
        bands = _Bands.none(length, spec.ny, spec.nu)
        for output in range(spec.ny):
            found, chosen, wide = self._best(known, output, spec.nu, length)
            size = known.sizes / known.scale[output]
            response[:, output] = found.mean.reshape(spec.nu, length).T / size
            deviation[:, output] = np.linalg.norm(found.root, axis=1).reshape(spec.nu, length).T / size
            noise[output] = np.sqrt(found.noise) * known.scale[output]
            bands.add(output, wide, response[:, output], size)
            said.append(chosen)
        level = known.level(response)
        notes: dict[str, Any] = {
            "kernels": said,
            "lags": length,
            "response": response.tolist(),
            "deviation": deviation.tolist(),
            "residual_rms": noise.tolist(),
            "samples": known.rows,
            **missing_notes(trajectories),
        }
        feedback = feedback_of(records).found
        if feedback:
            notes["warning"] = "past outputs predict the input (feedback): the response is biased; use prediction-error"
        coloured = _coloured(records, response, level, first)
        if not feedback and coloured is None:
            notes |= {"low": bands.low.tolist(), "high": bands.high.tolist()}
        why = "feedback biases the response" if feedback else coloured
        estimate = _estimate(response, bands, spec.outputs, spec.inputs, first, why)
        if estimate is not None:
            notes["estimate"] = estimate.to_dict()
        model = _model(records[0], response, level, first, notes)
        return replace(model, notes={**notes, KEY: determined_bands(model.matrices, records)})

    def _best(self, known: _Sums, output: int, nu: int, length: int) -> tuple[Evidence, dict[str, Any], Loose]:
        """Return what the best kernel makes of one output, its numbers, and what a looser prior makes of it."""
        from scipy.optimize import minimize

        gram, right, square, rows = known.gram, known.right[:, output], float(known.square[output]), known.rows
        best: tuple[float, Evidence, dict[str, Any], FloatArray] | None = None
        for kernel in KERNELS if self.kernel == "auto" else (self.kernel,):
            each = 3 if kernel == "dc" else 2

            def prior(numbers: FloatArray, kernel: Kernel = kernel, each: int = each) -> FloatArray:
                roots = []
                for one in np.asarray(numbers).reshape(nu, each):
                    decay = float(np.exp(-1.0 / np.exp(one[1])))
                    own = float(np.tanh(one[2])) if each == 3 else 0.0
                    roots.append(np.exp(0.5 * one[0]) * kernel_root(kernel, length, decay, own))
                return joined(roots)

            def cost(numbers: FloatArray, prior: Any = prior) -> float:
                return misfit(gram, right, square, rows, prior(numbers))

            longest = max(2.0 * _SHORTEST, float(length))
            starts = [
                np.tile([np.log(weight), np.log(constant), np.arctanh(np.exp(-0.5 / constant))][:each], nu)
                for constant in np.geomspace(1.0, longest, _CONSTANTS)
                for weight in _WEIGHTS
            ]
            start = min(starts, key=cost)
            limits = [(-25.0, 40.0), (np.log(_SHORTEST), np.log(5.0 * longest)), (-3.0, 4.0)][:each] * nu
            ended = minimize(cost, start, method="L-BFGS-B", bounds=limits, options={"maxiter": _ROUNDS})
            numbers = np.asarray(ended.x if ended.fun < cost(start) else start)
            found = evidence(gram, right, square, rows, prior(numbers))
            value = found.value + numbers.size * np.log(rows)
            if best is None or value < best[0]:
                named = {
                    "kernel": kernel,
                    "time_constants": np.exp(numbers.reshape(nu, each)[:, 1]).tolist(),
                    "evidence": -0.5 * found.value,
                }
                wider = numbers.reshape(nu, each) + np.array([np.log(_LOOSER), np.log(_LONGER), 0.0])[:each]
                best = (value, found, named, prior(wider.ravel()))
        assert best is not None
        return best[1], best[2], loose(gram, right, square, rows, best[3])


@dataclass(frozen=True, eq=False)
class _Sums:
    """Normal equations of scaled signals, lags of the first input, then of the second; the constant solved for."""

    gram: FloatArray
    right: FloatArray
    square: FloatArray
    rows: int
    sizes: FloatArray
    scale: FloatArray
    shift: FloatArray
    middle: FloatArray

    @classmethod
    def of(cls, records: Sequence[Trajectory], length: int, first: int, offset: bool) -> _Sums:
        """Return the sums over the windows of records, none across a seam."""
        nu = records[0].spec.nu
        sums = normal_equations(records, length + first, offset=True)
        count = (length + first) * nu
        order = np.arange(first * nu, count).reshape(length, nu).T.ravel()
        gram, right, square = sums.gram[np.ix_(order, order)], sums.right[order], sums.square
        shift, middle = np.zeros(order.size), np.zeros(len(square))
        if offset:
            shift, middle = sums.gram[order, -1] / sums.rows, sums.right[-1] / sums.rows
            gram = gram - sums.rows * np.outer(shift, shift)
            right = right - sums.rows * np.outer(shift, middle)
            square = square - sums.rows * middle**2
        own = sizes([record.u for record in records])
        scale = np.sqrt(np.maximum(square, 1e-300) / sums.rows)
        unit = np.repeat(own, length)
        return cls(
            gram / np.outer(unit, unit),
            right / unit[:, None] / scale,
            square / scale**2,
            sums.rows - int(offset),
            own,
            scale,
            shift,
            middle,
        )

    def level(self, response: FloatArray) -> FloatArray:
        """Return the constant of each output (ny,) beside a response (length, ny, nu)."""
        return np.asarray(self.middle - response.transpose(2, 0, 1).reshape(-1, response.shape[1]).T @ self.shift)


def _model(
    record: Trajectory, response: FloatArray, level: FloatArray, first: int, notes: dict[str, Any]
) -> LinearModel:
    """Return the state-space form: the state holds the inputs of the samples before, newest first."""
    spec = record.spec
    length, ny, nu = response.shape
    held = length + first - 1
    a, b = np.zeros((held * nu, held * nu)), np.zeros((held * nu, nu))
    a[nu:, : (held - 1) * nu] = np.eye((held - 1) * nu)
    b[:nu] = np.eye(nu)
    late = response[1 - first :]  # what inputs one sample old and older do
    c = late.transpose(1, 0, 2).reshape(ny, held * nu)
    d = np.zeros((ny, nu)) if first else response[0]
    zero = np.zeros((held * nu, ny))
    return LinearModel(spec, a, b, c, d, zero, np.zeros(held * nu), level, burn_in=held, notes=notes)


@dataclass(frozen=True, eq=False)
class _Bands:
    """Low and high of every lag (length, ny, nu), and the covariance of the lags of each output, inputs one by one."""

    low: FloatArray
    high: FloatArray
    covariances: list[FloatArray]

    @classmethod
    def none(cls, length: int, ny: int, nu: int) -> _Bands:
        """Return bands that are to be filled."""
        return cls(np.zeros((length, ny, nu)), np.zeros((length, ny, nu)), [])

    def add(self, output: int, wide: Loose, response: FloatArray, size: FloatArray) -> None:
        """Fill in one output from its scaled coefficients; intervals hold the response (length, nu) that is shown."""
        from scipy.stats import t

        length, nu = response.shape
        unit = np.repeat(size, length)
        middle = (wide.mean / unit).reshape(nu, length).T
        covariance = wide.covariance / np.outer(unit, unit)
        half = float(t.ppf(0.5 + _LEVEL / 2, wide.freedom)) * np.sqrt(np.diag(covariance)).reshape(nu, length).T
        self.low[:, output] = np.minimum(middle - half, response)
        self.high[:, output] = np.maximum(middle + half, response)
        self.covariances.append(covariance)


def _coloured(records: Sequence[Trajectory], response: FloatArray, level: FloatArray, first: int) -> str | None:
    """Return the reason why intervals say too little: an output whose residuals are correlated in time; else None."""
    from scipy.signal import fftconvolve

    late = len(response) + first - 1
    padded = np.concatenate([np.zeros((first, *response.shape[1:])), response])
    rests = []
    for record in records:
        rest = record.y - level
        for given in range(record.u.shape[1]):
            rest = rest - fftconvolve(record.u[:, given : given + 1], padded[:, :, given], axes=0)[: len(record)]
        if record.missing is not None:
            rest = np.where(record.missing, 0.0, rest)
        rests.append(rest[late:])
    spec = records[0].spec
    for output, channel in enumerate(spec.outputs):
        if not white([rest[:, output] for rest in rests], spec.ny):
            return f"the residuals of {channel.name} are correlated in time"
    return None


def _estimate(
    response: FloatArray,
    bands: _Bands,
    outputs: Sequence[Any],
    inputs: Sequence[Any],
    first: int,
    why: str | None,
) -> Estimate | None:
    """Return the record of the response with its intervals, or why there are none; None beyond 200 numbers."""
    from scipy.linalg import block_diag

    if response.size > LARGEST:
        return None
    length = len(response)
    places = [(i, j, k) for i in range(len(outputs)) for j in range(len(inputs)) for k in range(length)]
    values, low, high = (np.array([part[k, i, j] for i, j, k in places]) for part in (response, bands.low, bands.high))
    return Estimate(
        tuple(f"{outputs[i].name} per {inputs[j].name}, lag {k + first}" for i, j, k in places),
        tuple(quotient(outputs[i].unit, inputs[j].unit) for i, j, k in places),
        values,
        np.asarray(block_diag(*bands.covariances), dtype=np.float64),
        None if why is not None else np.column_stack([low, high]),
        _LEVEL,
        f"no interval: {why}"
        if why is not None
        else "posterior of a prior made looser, so that bias is small beside it",
    )
