"""The acceptance rule: what a candidate must show before the loop says that an effect is there.

Lower BIC alone accepts anything as soon as a few percent of unmodelled coloured torque are present, lower held-out
error alone accepts noise. All of the conditions here together gave no false alarm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harness.diagnosis.intervals import Interval, block_interval
from harness.diagnosis.residual_tests import RATIO, effective_samples
from harness.signals import FloatArray

__all__ = [
    "OWN_GAIN",
    "WRONG_SIGN",
    "Comparison",
    "Interval",
    "Judgement",
    "bic",
    "block_interval",
    "compare_blocks",
    "information_samples",
    "judge",
    "on_bound",
]

BLOCKS = 20
DRAWS = 4000
DELTA_BIC = 10.0
GAIN = 0.01
OWN_GAIN = 0.1
"""Share of the validation error that an effect must take away if a phase or instant of it is fitted to validation:
that alone gains some percent wherever a residual is coloured."""
LEVEL = 0.01
WRONG_SIGN = "its main parameter has an unphysical sign"


@dataclass(frozen=True)
class Comparison:
    """Paired comparison of two models on the same records.

    Attributes
    ----------
    gain : float
        Share by which the squared error falls (negative if it grows).
    p : float
        Bootstrap probability that it does not fall.
    """

    gain: float
    p: float

    @property
    def distinguishable(self) -> bool:
        """True if one of the two is better beyond the bootstrap's 1 % (either side)."""
        return self.p <= LEVEL or self.p >= 1 - LEVEL


@dataclass(frozen=True)
class Judgement:
    """Accepted or not, and every reason against."""

    accepted: bool
    reasons: tuple[str, ...]


def compare_blocks(
    before: Sequence[FloatArray],
    after: Sequence[FloatArray],
    *,
    rng: np.random.Generator,
    blocks: int = BLOCKS,
    draws: int = DRAWS,
    white: bool = False,
) -> Comparison:
    """Compare two models by the paired block bootstrap of their squared errors.

    Parameters
    ----------
    before, after : sequence of array (N_i, ny)
        Weighted residuals of the same records (each output over its weight).
    rng : Generator
        Source of the draws.
    blocks : int
        Consecutive blocks of nearly equal length over all records.
    draws : int
        Bootstrap draws.
    white : bool
        The residuals are white, and the question is whether what the second model adds is there at all: p then is that
        of the product of change and residual. It has twice the t value of the squared errors, which also pay for what
        the estimation of a true effect's size costs.

    Examples
    --------
    >>> r = np.random.default_rng(0).standard_normal((1000, 1))
    >>> found = compare_blocks([r], [0.5 * r], rng=np.random.default_rng(1))
    >>> round(found.gain, 2), found.p < 0.01
    (0.75, True)
    """
    a = np.concatenate([np.sum(np.asarray(one) ** 2, axis=1) for one in before])
    b = np.concatenate([np.sum(np.asarray(one) ** 2, axis=1) for one in after])
    if not np.isfinite(b).all():
        return Comparison(-np.inf, 1.0)
    if not np.isfinite(a).all():
        return Comparison(1.0, 1.0 / (draws + 1))
    edges = np.linspace(0, a.size, min(blocks, a.size) + 1).astype(int)
    difference = np.add.reduceat(a - b, edges[:-1])
    asked = difference
    if white:
        pairs = [(np.asarray(x), np.asarray(y)) for x, y in zip(before, after, strict=True)]
        asked = np.add.reduceat(np.concatenate([np.sum((x - y) * x, axis=1) for x, y in pairs]), edges[:-1])
    chosen = rng.integers(0, asked.size, size=(draws, asked.size))
    sums = asked[chosen].sum(axis=1)
    worse = np.sum(sums < 0) + 0.5 * np.sum(sums == 0)  # two equal models: p = 1/2, not 1
    total = float(a.sum())
    return Comparison(float(difference.sum()) / total if total > 0 else 0.0, float((worse + 0.5) / (draws + 1)))


def information_samples(residual: Sequence[FloatArray], ratio: float | None) -> float:
    """Return the number of samples that the information criterion counts.

    All of them if the residual is no larger than 1.15 noise floors; else only the independent ones, by output.

    Parameters
    ----------
    residual : sequence of array (N_i, ny)
        Residual of the model before the change; records are not joined.
    ratio : float or None
        Residual over noise floor; None if the floor is unknown.
    """
    samples = float(sum(one.size for one in residual))
    if ratio is not None and ratio < RATIO:
        return samples
    return sum(effective_samples(one[:, j]) for one in residual for j in range(one.shape[1]))


def bic(residual: Sequence[FloatArray], parameters: int, samples: float) -> float:
    """Return the Bayesian information criterion n sum_j w_j log(mean r_j^2) + k log n of a weighted residual.

    Each output has its own variance (concentrated likelihood); ``samples`` counts over all outputs.
    """
    joined = np.concatenate(list(residual))
    power = np.mean(joined**2, axis=0)
    if not np.isfinite(power).all():
        return float("inf")
    return float(samples * np.mean(np.log(np.maximum(power, 1e-300))) + parameters * np.log(max(samples, 2.0)))


def judge(
    *,
    converged: bool,
    delta_bic: float,
    comparison: Comparison,
    main: Interval,
    sign: int,
    minimum: float,
    maximum: float,
    surrogate_p: float | None = None,
    gain: float = GAIN,
) -> Judgement:
    """Apply the acceptance rule.

    Parameters
    ----------
    converged : bool
        Did the refit end in a minimum.
    delta_bic : float
        BIC of the model before minus BIC with the candidate.
    comparison : Comparison
        On the validation records.
    main : Interval
        The candidate's main parameter.
    sign : int
        +1 or -1 if only that sign is physical, else 0.
    minimum, maximum : float
        Bounds of the main parameter.
    surrogate_p : float, optional
        p-value of the global null.
    gain : float
        Share of the validation error that must be gone.
    """
    reasons: list[str] = []
    if not converged:
        reasons.append("the refit did not converge")
    if surrogate_p is not None and surrogate_p > LEVEL:
        reasons.append(f"no better than on surrogates of the residual (p = {surrogate_p:.3f})")
    if not delta_bic > DELTA_BIC:
        reasons.append(f"delta BIC {delta_bic:.1f} is not above {DELTA_BIC:g}")
    if not comparison.gain >= gain:
        reasons.append(
            f"validation error falls by {100 * comparison.gain:.2f} %, not by {100 * gain:g} %"
            if comparison.gain >= 0
            else "validation error grows"
        )
    elif not comparison.p <= LEVEL:
        reasons.append(f"the gain on validation may be chance (bootstrap p = {comparison.p:.3f})")
    if not main.excludes_zero:
        reasons.append("the interval of its main parameter includes 0")
    if sign and main.value * sign < 0:
        reasons.append(WRONG_SIGN)
    if on_bound(main.value, minimum, maximum):
        reasons.append("its main parameter lies on a bound")
    return Judgement(not reasons, tuple(reasons))


def on_bound(value: float, minimum: float, maximum: float) -> bool:
    """Return True if a value lies on a finite bound other than a minimum of 0.

    Within a thousandth of the range, or, where the range is far wider than a bound is from 0, of twice that distance.

    Examples
    --------
    >>> on_bound(2.502, 2.5, 1000.0), on_bound(3.0, 2.5, 1000.0), on_bound(999.5, 2.5, 1000.0)
    (True, False, True)
    >>> on_bound(1e-9, 0.0, 1.0), on_bound(1.6, -1.6, 1.6), on_bound(5.0, -np.inf, np.inf)
    (False, True, False)
    """
    span = maximum - minimum

    def edge(bound: float) -> float:
        return 1e-3 * min(span, 2 * abs(bound) or span) if np.isfinite(span) else 1e-6 * max(abs(value), 1e-12)

    above = np.isfinite(maximum) and value > maximum - edge(maximum)
    below = np.isfinite(minimum) and minimum != 0 and value < minimum + edge(minimum)
    return bool(above or below)
