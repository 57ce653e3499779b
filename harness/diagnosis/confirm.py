"""Confirmation: a model refitted with each candidate, all nominal parameters free, is judged against the old one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from harness.diagnosis.accept import (
    GAIN,
    OWN_GAIN,
    Comparison,
    Interval,
    Judgement,
    bic,
    compare_blocks,
    information_samples,
    judge,
    on_bound,
)
from harness.diagnosis.forms import Fitted, Form, placed_name, rms
from harness.diagnosis.per_record import PER_RECORD
from harness.effects.effect import Placed
from harness.rng import stream

__all__ = ["Candidate", "assess", "far_above", "noise_ratio"]

NOTHING = Comparison(-np.inf, 1.0)
FAR = 2.0
"""Noise floors beyond which a residual is no detail: the level at which a model counts as incomplete."""
INSTANT = 0.05
"""Delays and lags below this share of a sample are no effect: half an integrator's step looks like one."""
PERIODS = 2.0
"""Of a periodic effect that a record must hold."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A refitted model judged against the model before.

    Attributes
    ----------
    added : tuple of Placed
        What it has beyond the model before.
    fitted : Fitted or None
        None if the refit raised.
    delta_bic : float
        BIC before minus BIC after.
    comparison : Comparison
        On the validation records.
    main : dict
        Interval of the main parameter of each added effect.
    judgement : Judgement
    """

    added: tuple[Placed, ...]
    fitted: Fitted | None
    delta_bic: float
    comparison: Comparison
    main: dict[str, Interval] = field(default_factory=dict)
    judgement: Judgement = field(default_factory=lambda: Judgement(False, ("the refit failed",)))
    parameters: int = 0

    @property
    def name(self) -> str:
        """The added effects as text."""
        return placed_name(self.added)

    @property
    def accepted(self) -> bool:
        """True if the rule accepts it."""
        return self.judgement.accepted


def noise_ratio(fitted: Fitted, floors: Sequence[float | None]) -> float | None:
    """Return the largest ratio of residual to noise floor over the outputs, on estimation; None if unknown."""
    known = [(value, floor) for value, floor in zip(rms(fitted.estimation), floors, strict=True) if floor]
    return max((float(value / floor) for value, floor in known), default=None)


def far_above(form: Any, fitted: Fitted) -> bool:
    """Return True if every noise floor is known and a residual is far above its own."""
    ratio = noise_ratio(fitted, form.floors)
    return all(form.floors) and ratio is not None and ratio > FAR


def assess(
    form: Form,
    before: Fitted,
    models: Sequence[tuple[tuple[Placed, ...], Fitted | None]],
    *,
    surrogate_p: Mapping[str, float] | float | None,
    seed: int,
    failures: Sequence[str] = (),
    doubts: Callable[[Fitted, Sequence[Placed]], Sequence[str]] = lambda fitted, added: (),
) -> list[Candidate]:
    """Judge refitted models against the model before; all with the same count of independent samples.

    Parameters
    ----------
    form : Form
    before : Fitted
        The model before.
    models : sequence of (added effects, Fitted or None)
        What was added, and the refit.
    surrogate_p : float or mapping, optional
        p-value of the global null, or one for each candidate's name.
    seed : int
        Keys the bootstrap draws.
    failures : sequence of str
        Of each model why its refit failed; empty where it did not.
    doubts : callable, optional
        Returns what else speaks against a model and the effects added to it; asked where nothing else does.

    Returns
    -------
    list of Candidate
        In the order given.
    """
    usable = [one for _, one in models if one is not None and one.finite]
    best = min(usable, key=lambda one: bic(one.estimation, 0, 1.0), default=before)
    samples = information_samples(best.estimation, noise_ratio(best, form.floors))
    reference = bic(before.estimation, len(before.free), samples)
    found = []
    for number, (added, fitted) in enumerate(models):
        if fitted is None or not fitted.finite:
            known = failures[number] if number < len(failures) else ""
            reason = known or ("the refit failed" if fitted is None else "the refitted model diverges")
            found.append(Candidate(added, fitted, -np.inf, NOTHING, judgement=Judgement(False, (reason,))))
            continue
        delta = reference - bic(fitted.estimation, len(fitted.free), samples)
        draws = stream("diagnosis-bootstrap", placed_name(fitted.effects), seed)
        comparison = compare_blocks(before.validation, fitted.validation, rng=draws)
        # twentieths: the other conditions know how few independent samples there are, and this one asks for a sign only
        intervals = fitted.intervals(adapt=False)
        reasons: list[str] = []
        if fitted.unaided and comparison.gain >= GAIN:
            alone = compare_blocks(before.unaided or before.validation, fitted.unaided, rng=draws)
            if alone.gain < GAIN:
                reasons.append("it gains only through fitted initial values of its hidden state")
        mains: dict[str, Interval] = {}
        for placed in added:
            p = surrogate_p.get(str(placed)) if isinstance(surrogate_p, Mapping) else surrogate_p
            verdict, main = _judge_one(placed, fitted, delta, comparison, intervals, p, form.sample_time)
            if main is not None:
                mains[str(placed)] = main
            reasons += [
                f"{placed}: {reason}" if len(added) > 1 else reason
                for reason in verdict.reasons
                if len(added) == 1 or f"{added[0]}: {reason}" not in reasons
            ]
            reasons += _too_slow(form, placed, fitted)
        if not reasons:
            reasons += doubts(fitted, added)
        judgement = Judgement(not reasons, tuple(dict.fromkeys(reasons)))
        found.append(Candidate(added, fitted, float(delta), comparison, mains, judgement, len(fitted.free)))
    return found


def _too_slow(form: Any, placed: Placed, fitted: Fitted) -> list[str]:
    """Return a reason if a periodic effect has too few periods in every record: a drift or a constant is none."""
    if placed.effect.name != "periodic_disturbance":
        return []
    records = getattr(form, "records", None) or form.motions
    seconds = max((len(one.t) for one in records["estimation"]), default=0) * form.sample_time
    periods = fitted.values[placed.name("omega")] * seconds / (2 * np.pi)
    return [] if periods >= PERIODS else [f"{periods:.2g} periods in the longest record: nothing that repeats is seen"]


def _judge_one(
    placed: Placed,
    fitted: Fitted,
    delta: float,
    comparison: Comparison,
    intervals: Mapping[str, Interval],
    surrogate_p: float | None,
    sample_time: float,
) -> tuple[Judgement, Interval | None]:
    """Apply the acceptance rule to one added effect of a model."""
    parameter = placed.effect.main
    name = placed.main()
    if parameter is None or name is None or name not in intervals:
        # an effect without parameters stands or falls with the error alone
        sure = Interval(1.0, 1.0, 1.0)
        verdict = judge(
            converged=fitted.converged,
            delta_bic=delta,
            comparison=comparison,
            main=sure,
            sign=0,
            minimum=-np.inf,
            maximum=np.inf,
            surrogate_p=surrogate_p,
        )
        return verdict, None
    interval = intervals[name]
    neutral = parameter.neutral or 0.0
    shifted = Interval(interval.value - neutral, interval.low - neutral, interval.high - neutral)
    if parameter.neutral is None and parameter.minimum >= 0:
        # the place of a rim or of a limit: 0 is not its absence, and it was fitted through its logarithm
        half = min(0.5 * (interval.high - interval.low) / max(abs(interval.value), 1e-300), 100.0)
        shifted = Interval(interval.value, interval.value * np.exp(-half), interval.value * np.exp(half))
    sign = {"+": 1, "-": -1, "any": 0}[parameter.sign] if neutral == 0.0 else 0
    verdict = judge(
        converged=fitted.converged,
        delta_bic=delta,
        comparison=comparison,
        main=shifted,
        sign=sign,
        minimum=parameter.minimum - neutral if np.isfinite(parameter.minimum) and parameter.minimum else -np.inf,
        maximum=parameter.maximum - neutral,
        surrogate_p=surrogate_p,
        gain=OWN_GAIN if placed.effect.name in PER_RECORD else GAIN,
    )
    wrong = [
        f"{other.name} has an unphysical sign"
        for other in placed.effect.parameters
        if not other.nuisance
        and other.name != parameter.name
        and _against(other, fitted.values[placed.name(other.name)])
    ]
    wrong += [
        f"{other.name} lies on a bound"
        for other in placed.effect.parameters
        if not (other.nuisance or other.fixed or other is parameter)
        and on_bound(fitted.values[placed.name(other.name)], other.minimum, other.maximum)
    ]
    shape = {other.name: abs(fitted.values[placed.name(other.name)]) for other in placed.effect.parameters}
    if "vs" in shape and "w" in shape and shape["vs"] < 2 * shape["w"]:
        wrong.append("its Stribeck speed lies within the smoothing of the sign: no Stribeck branch is seen")
    if parameter.unit == "s" and abs(interval.value) < INSTANT * sample_time:
        wrong.append(
            f"{interval.value:.2g} s is less than {100 * INSTANT:g} % of a sample: a detail of a clock or an integrator"
        )
    if wrong:
        verdict = Judgement(False, (*verdict.reasons, *wrong))
    return verdict, interval


def _against(parameter: Any, value: float) -> bool:
    """Return True if a value has the sign that physics forbids."""
    return (parameter.sign == "+" and value < 0) or (parameter.sign == "-" and value > 0)
