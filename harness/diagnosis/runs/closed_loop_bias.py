"""Data of a closed loop: by how much did the feedback of disturbances bias the parameters.

Under feedback the input answers to earlier disturbances, and so do the model's sensitivities: the fit then credits
parameters with what the disturbance did. A signal from outside the loop (a reference, an added excitation) knows
nothing of the disturbance. The same fit with that part of the motion as instrument is consistent, and the difference
of the two estimates, held against its own spread, is the test of Durbin, Wu and Hausman (Hausman, Econometrica
46:1251, 1978; instruments for closed loops: Gilson & Van den Hof, Automatica 41:241, 2005).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations_with_replacement
from typing import Any, Protocol

import numpy as np

from harness.diagnosis.policy import RUN_POLICY
from harness.diagnosis.runs.fitted import Fitted, stacked
from harness.diagnosis.runs.residual_tests import effective_samples
from harness.errors import HarnessError
from harness.signals import FloatArray, Trajectory

FUNCTIONS = 12


class Instrumented(Protocol):
    """A way to compare model and data whose sensitivities can be taken along another motion."""

    def driven_jacobian(self, fitted: Fitted, driven: Sequence[Trajectory]) -> tuple[FloatArray, ...]:
        """Return sensitivities (N_i, ny, p) along the part of the motion that comes from outside the loop."""
        ...

    def clean(self, base: Fitted, parts: Sequence[FloatArray]) -> tuple[FloatArray, ...]:
        """Take out of columns (N_i, ny, k) of the estimation runs what the initial states can do."""
        ...

    def lengths(self, fitted: Fitted, records: Sequence[Trajectory]) -> list[int]:
        """Return the samples of each window, or of each record where nothing is cut."""
        ...


@dataclass(frozen=True)
class Shift:
    """One parameter: the fit's estimate, the instrumented one, and the difference in standard errors of the fit."""

    value: float
    instrumented: float
    standard_error: float
    spread: float

    def to_dict(self, unit: str) -> dict[str, Any]:
        """Return the entry of ``report.json``."""
        moved = self.instrumented - self.value
        return {
            "value": _known(self.value),
            "instrumented": _known(self.instrumented),
            "shift_in_standard_errors": _known(moved / self.standard_error if self.standard_error > 0 else np.nan),
            "shift_over_its_own_error": _known(moved / self.spread if self.spread > 0 else np.nan),
            "unit": unit,
        }


@dataclass(frozen=True)
class BiasTest:
    """Outcome of the test."""

    instruments: tuple[str, ...]  # Signals from outside the loop
    reason: str = ""  # Why the test could not be made; empty if it was
    statistic: float = float("nan")
    """Wald statistic of the difference over its degrees of freedom, F distributed if there is no bias."""
    dof: tuple[int, int] = (0, 0)  # (int, int)
    p: float = float("nan")
    strength: float = float("nan")
    """Smallest cosine between the sensitivities and the instruments (1: open loop, 0: nothing in common)."""
    largest: float = float("nan")
    """Shift of the combination of parameters that moves most, in standard errors of the fit."""
    shifts: dict[str, Shift] = field(default_factory=dict)  # By parameter
    unreached: int = 0  # Combinations of parameters that the instruments hardly move: the test says nothing about them

    @property
    def biased(self) -> bool | None:
        """True if the test rejects and the shift matters, None if it could not be made."""
        return None if self.reason else bool(self.p < RUN_POLICY.bias_level and self.largest > RUN_POLICY.matters)

    def to_dict(self, units: Mapping[str, str]) -> dict[str, Any]:
        """Return the entry of ``report.json``; figures that do not exist are None."""
        shifts = {name: shift.to_dict(units.get(name, "")) for name, shift in self.shifts.items()}
        return {
            "test": "Durbin-Wu-Hausman",
            "instruments": list(self.instruments),
            "statistic": _known(self.statistic),
            "dof": list(self.dof),
            "p": _known(self.p),
            "strength": _known(self.strength),
            "largest_shift_in_standard_errors": _known(self.largest),
            "untested_combinations": self.unreached,
            "biased": self.biased,
            "parameters": shifts,
            "text": self.text(shifts),
        }

    def text(self, shifts: Mapping[str, Mapping[str, Any]]) -> str:
        """Return the outcome in one sentence."""
        if self.reason:
            return f"the test of the bias could not be made: {self.reason}"
        silent = f"; combinations of parameters that the instruments hardly move, untested: {self.unreached}"
        sizes = {name: shift["shift_in_standard_errors"] or 0.0 for name, shift in shifts.items()}
        worst = max(sizes, key=lambda name: abs(sizes[name]))
        moved = f"{worst} moves most, by {sizes[worst]:+.2g} standard errors"
        if self.biased:
            return (
                "the instrumented fit differs: the feedback of disturbances biases the parameters "
                f"({moved}; the worst combination by {self.largest:.2g})" + silent * bool(self.unreached)
            )
        return (
            f"no bias that matters was found: the instrumented fit agrees within {self.largest:.2g} standard errors "
            f"of the combination that moves most ({moved})" + silent * bool(self.unreached)
        )


def closed_loop_bias(
    form: Instrumented, fitted: Fitted, records: Sequence[Trajectory], references: Sequence[Mapping[str, FloatArray]]
) -> BiasTest:
    """Test whether feedback has biased a fit.

    - ``form``: how the model was compared with the data
    - ``fitted``: the model
    - ``records``: the estimation runs
    - ``references``: for each of them the recorded signals from outside the loop by name, arrays (N_i,)
    """
    names, signals = _usable(references)
    if not names:
        return BiasTest((), 'no reference or excitation from outside the loop is recorded (role = "reference")')
    if not fitted.free:
        return BiasTest(names, "no parameter was fitted")
    if [len(run) for run in records] != [len(signal) for signal in signals]:
        return BiasTest(names, "the references do not have the length of the runs")
    if all(any(_same(signal, run.u[:, k]) for k in range(run.u.shape[1])) for run, signal in _pairs(records, signals)):
        return BiasTest(names, "the reference is the input itself: the data were taken in open loop")
    driven = driven_part(records, signals)
    try:
        columns = form.driven_jacobian(fitted, driven)
    except (np.linalg.LinAlgError, ValueError, ArithmeticError, HarnessError) as error:
        return BiasTest(names, f"the part of the motion that the reference drives cannot be simulated ({error})")
    parts = form.clean(fitted, columns)
    residual = form.clean(fitted, [part[:, :, None] for part in fitted.estimation])
    return _compare(names, fitted, list(parts), [part[:, :, 0] for part in residual], form.lengths(fitted, records))


def driven_part(records: Sequence[Trajectory], signals: Sequence[FloatArray]) -> list[Trajectory]:
    """Return the records as far as they follow linearly from signals outside the loop.

    Inputs and outputs are regressed on the signals and on Laguerre filters of them (two time constants, those that
    explain most); what the regression explains keeps nothing of the disturbance.

    - ``signals`` sequence of array (N_i, m)
    """
    dt = records[0].spec.sample_time
    longest = max(len(run) for run in records)
    both = [np.hstack([run.u, _continuous(run)]) for run in records]
    middle = np.concatenate(both).mean(axis=0)
    spread = np.concatenate(both).std(axis=0)
    goal = np.concatenate([(columns - middle) / np.where(spread > 0, spread, 1.0) for columns in both])
    centre = np.concatenate(list(signals)).mean(axis=0)
    times = np.geomspace(2.0, max(longest / 10, 4.0), 7) * dt
    filtered = {
        float(tau): np.concatenate([_filtered(signal - centre, dt, float(tau)) for signal in signals]) for tau in times
    }
    plain = np.concatenate([np.column_stack([np.ones(len(signal)), signal - centre]) for signal in signals])
    best: tuple[float, FloatArray] | None = None
    for a, b in combinations_with_replacement(filtered, 2):
        x = np.hstack([plain, filtered[a]] + ([filtered[b]] if b != a else []))
        left, sizes, _ = np.linalg.svd(x / np.linalg.norm(x, axis=0).clip(1e-300), full_matrices=False)
        left = left[:, sizes > 1e-8 * sizes[0]]
        explained = left @ (left.T @ goal)
        lost = float(np.sum((goal - explained) ** 2)) / max(1.0 - left.shape[1] / len(goal), 1e-3) ** 2
        if best is None or lost < best[0]:
            best = (lost, explained)
    assert best is not None
    made = best[1] * spread + middle
    cuts = np.cumsum([len(run) for run in records])[:-1]
    nu = records[0].u.shape[1]
    return [
        replace(run, u=part[:, :nu], y=part[:, nu:], x=None)
        for run, part in zip(records, np.split(made, cuts), strict=True)
    ]


def laguerre(signal: FloatArray, sample_time: float, time_constant: float, count: int) -> FloatArray:
    """Return ``signal`` (N,) through the first ``count`` discrete Laguerre filters, (N, count).

    Examples
    --------
    >>> pulse = np.r_[1.0, np.zeros(400)]
    >>> out = laguerre(pulse, 0.1, 1.0, 3)
    >>> np.allclose(out.T @ out, np.eye(3))  # orthonormal impulse responses
    True
    """
    from scipy.signal import lfilter

    pole = float(np.exp(-sample_time / time_constant))
    now = lfilter([np.sqrt(1 - pole**2)], [1.0, -pole], signal)
    columns = [now]
    for _ in range(count - 1):
        now = lfilter([-pole, 1.0], [1.0, -pole], now)
        columns.append(now)
    return np.column_stack(columns)


def _compare(
    names: tuple[str, ...],
    fitted: Fitted,
    z_parts: list[FloatArray],
    r_parts: list[FloatArray],
    lengths: Sequence[int],
) -> BiasTest:
    """Return the test from instruments, Jacobian and residual, all weighted and free of the initial states.

    ``lengths`` are the samples of the windows, or of the records where these are simulated whole.
    """
    from scipy import stats

    ny = r_parts[0].shape[1]
    z, j = stacked(z_parts), stacked(fitted.jacobian)
    r = np.concatenate([part.reshape(-1) for part in r_parts])
    if z.shape != j.shape or not (np.isfinite(z).all() and np.isfinite(j).all() and np.isfinite(r).all()):
        return BiasTest(names, "the sensitivities along the driven motion are not finite")
    size = np.linalg.norm(j, axis=0)
    alive = size > 0
    free = [name for name, on in zip(fitted.free, alive, strict=True) if on]
    j, z, size = j[:, alive] / size[alive], z[:, alive], size[alive]
    # directions of the parameters that the data move and the instruments reach; the others are left out of the test
    left, sizes, right = np.linalg.svd(j, full_matrices=False)
    keep = sizes > 1e-6 * sizes[0]
    left, turn = left[:, keep], (right[keep].T / sizes[keep])
    basis, zs, _ = np.linalg.svd(z / np.linalg.norm(z, axis=0).clip(1e-300), full_matrices=False)
    basis = basis[:, zs > 1e-8 * zs[0]]
    into, cosines, _ = np.linalg.svd(left.T @ basis, full_matrices=False)
    strength = float(cosines.min(initial=1.0)) if cosines.size == left.shape[1] else 0.0
    reached = cosines > RUN_POLICY.weak
    if not reached.any():
        return BiasTest(names, "the reference hardly moves what the fit relies on", strength=strength)
    axes = into[:, : cosines.size][:, reached]
    directions = left @ axes  # orthonormal: the regressors of the fit
    seen = basis @ (basis.T @ directions)  # and what the instruments hold of them
    q = axes.shape[1]
    inverse = np.linalg.inv(seen.T @ directions)
    shift = inverse @ (seen.T @ r) - directions.T @ r
    after = r - directions @ (directions.T @ r + shift)
    influence = seen @ inverse.T - directions
    (spread, second), (plain, _) = (
        _spread(regressors, after, lengths, ny, q) for regressors in (influence, directions)
    )
    if second < 4:
        return BiasTest(names, f"too few independent stretches ({second + q}) for {q} parameters", strength=strength)
    statistic = float(shift @ np.linalg.pinv(spread, hermitian=True) @ shift) / q
    largest = float(np.sqrt(max(shift @ np.linalg.pinv(plain, hermitian=True) @ shift, 0.0)))
    moved = (turn @ axes @ shift) / size
    own = np.sqrt(np.maximum(np.diag(turn @ axes @ spread @ axes.T @ turn.T), 0.0)) / size
    intervals = fitted.intervals()
    half = {
        name: 0.5 * (interval.high - interval.low) / float(stats.t.ppf(0.975, 19))
        for name, interval in intervals.items()
    }
    shifts = {
        name: Shift(fitted.values[name], fitted.values[name] + float(d), half[name], float(s))
        for name, d, s in zip(free, moved, own, strict=True)
    }
    p = float(stats.f.sf(statistic, q, second))
    return BiasTest(names, "", float(statistic), (q, second), p, strength, largest, shifts, left.shape[1] - q)


def _spread(weights: FloatArray, r: FloatArray, lengths: Sequence[int], ny: int, q: int) -> tuple[FloatArray, int]:
    """Return the covariance of ``weights.T @ r`` and its degrees of freedom.

    Many windows are independent of each other, whatever happens inside: their sums tell the spread. In a few long
    records a vector autoregression of the residual does, the weights being independent of it if there is no bias.
    """
    ends = np.cumsum(lengths)
    if len(lengths) >= 2 * q + 8:
        groups = min(len(lengths), 60)
        starts = np.concatenate([[0], ends[:-1]])[(np.arange(groups) * len(lengths)) // groups] * ny
        scores = np.add.reduceat(weights * r[:, None], starts, axis=0)
        scores = scores - scores.mean(axis=0)
        return scores.T @ scores * groups / max(groups - q, 1), groups - q
    parts = np.split(r.reshape(-1, ny), ends[:-1])
    lags, noise = _autoregression(parts)
    total = np.zeros((q, q))
    for weight in np.split(weights.reshape(-1, ny, q), ends[:-1]):
        back = weight.copy()
        for k in range(len(weight) - 2, -1, -1):
            ahead = back[k + 1 : k + 1 + len(lags)]
            back[k] += np.einsum("iab,iaq->bq", lags[: len(ahead)], ahead)
        total += np.einsum("taq,ab,tbp->qp", back, noise, back)
    independent = sum(effective_samples(part[:, j]) for part in parts for j in range(ny)) / ny
    return total, int(independent) - q


def _autoregression(parts: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return coefficients (n, ny, ny) and noise covariance (ny, ny) of an autoregression, its order by BIC."""
    ny, most = parts[0].shape[1], int(np.clip(min(map(len, parts)) // 20, 1, 20))
    goal = np.concatenate([part[most:] for part in parts])
    lagged = np.concatenate(
        [np.hstack([part[most - lag : len(part) - lag] for lag in range(1, most + 1)]) for part in parts]
    )
    best: tuple[float, FloatArray, FloatArray] | None = None
    for order in range(1, most + 1):
        x = lagged[:, : order * ny]
        coefficients = np.linalg.lstsq(x, goal, rcond=1e-12)[0]
        noise = np.cov(goal - x @ coefficients, rowvar=False, bias=True).reshape(ny, ny)
        score = len(goal) * np.linalg.slogdet(noise)[1] + order * ny**2 * np.log(len(goal))
        if best is None or score < best[0]:
            best = (float(score), coefficients, noise)
    assert best is not None
    return np.transpose(best[1].reshape(-1, ny, ny), (0, 2, 1)), best[2]


def _usable(references: Sequence[Mapping[str, FloatArray]]) -> tuple[tuple[str, ...], list[FloatArray]]:
    """Return the names of the signals that every run has and that move, and their columns by run."""
    if not references:
        return (), []
    names = tuple(
        name
        for name in references[0]
        if all(name in reference for reference in references)
        and any(np.ptp(reference[name]) > 0 for reference in references)
        and all(np.isfinite(reference[name]).all() for reference in references)
    )
    return names, [np.column_stack([reference[name] for name in names]) for reference in references] if names else []


def _pairs(records: Sequence[Trajectory], signals: Sequence[FloatArray]) -> list[tuple[Trajectory, FloatArray]]:
    """Return each record with each of its signals."""
    return [(run, signal[:, k]) for run, signal in zip(records, signals, strict=True) for k in range(signal.shape[1])]


def _same(a: FloatArray, b: FloatArray) -> bool:
    """Return True if two signals are one, whatever the digits."""
    return bool(np.allclose(a, b, rtol=1e-6, atol=1e-9 * max(float(np.abs(b).max(initial=0.0)), 1e-300)))


def _continuous(run: Trajectory) -> FloatArray:
    """Return the outputs with the jumps of angles taken out."""
    channels = enumerate(run.spec.outputs)
    return np.column_stack([np.unwrap(run.y[:, k], period=c.period) if c.period else run.y[:, k] for k, c in channels])


def _filtered(signals: FloatArray, dt: float, tau: float) -> FloatArray:
    """Return all Laguerre filters of all signals."""
    return np.hstack([laguerre(signals[:, k], dt, tau, FUNCTIONS) for k in range(signals.shape[1])])


def _known(value: float) -> float | None:
    """Return a finite value, or None."""
    return float(value) if np.isfinite(value) else None
