"""Effects that act on several joints of an arm at once: payload, tilted base, wrong link, joint zero, elasticity.

All of them are linear in their parameters once the motion is measured. They are tested after the friction that a joint
could have by itself (dry, viscous, in proportion to its torque, a constant) has been taken out joint by joint, so that
friction is never mistaken for a payload and hides none. A wrong torque gain of one joint competes with them on equal
terms: what it explains better is left to the search on that joint.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from harness.diagnosis.accept import (
    Comparison,
    Interval,
    Judgement,
    bic,
    block_interval,
    compare_blocks,
    information_samples,
    judge,
)
from harness.diagnosis.arm_effects import GAIN, Wide, wide_effects
from harness.diagnosis.arm_motion import ArmRun, moving_rows
from harness.diagnosis.surrogates import orthonormal, surrogate_test
from harness.physics.arm import ArmModel
from harness.rng import stream
from harness.signals import FloatArray

__all__ = ["DETAIL", "ArmFit", "WideCandidate", "WideResult", "fit_arm", "own_columns", "wide_search"]

LARGEST = {"sensor_offset": 0.1, "payload": 1.0}
"""Sizes of parameters at which an effect must show in the noise at all; 1 for the others."""
MOST = 3
SEEN = 0.02
DETAIL = 0.02
"""An effect below this share of the friction at the same joint is a detail of the friction's law."""
OWN = 5
"""Columns of each joint in :func:`own_columns`, the clock last."""


@dataclass(frozen=True, eq=False)
class ArmFit:
    """A linear fit of all joints together.

    Attributes
    ----------
    values : array (p,)
        Of the columns, in the order given.
    jacobian, estimation, validation : tuple of array (rows_i, n, p) and (rows_i, n)
        Over the weights.
    weights : array (n,)
    """

    values: FloatArray
    jacobian: tuple[FloatArray, ...]
    estimation: tuple[FloatArray, ...]
    validation: tuple[FloatArray, ...]
    weights: FloatArray

    def intervals(self, keep: slice = slice(None)) -> tuple[Interval, ...]:
        """Return the 95 % intervals of the values."""
        return block_interval(self.values, self.jacobian, self.estimation)[keep]


@dataclass(frozen=True, eq=False)
class WideCandidate:
    """An effect that was tried, and what was found."""

    effect: Wide
    round: int
    left: float
    delta_bic: float
    comparison: Comparison
    values: FloatArray
    intervals: tuple[Interval, ...]
    judgement: Judgement


@dataclass(frozen=True, eq=False)
class WideResult:
    """What acts on the whole arm.

    Attributes
    ----------
    accepted : tuple of WideCandidate
    ties : tuple of tuple of Wide
        For each accepted one what these data cannot tell from it.
    candidates : tuple of WideCandidate
    gains : dict
        Inputs whose gain explained more than any effect on the whole arm, with what ties with it.
    p : float or None
        Of the surrogate test of the first round.
    clock : tuple of Interval
        By how long the torque of each joint is recorded too late [s].
    """

    accepted: tuple[WideCandidate, ...]
    ties: tuple[tuple[Wide, ...], ...]
    candidates: tuple[WideCandidate, ...]
    gains: dict[str, tuple[Wide, ...]]
    p: float | None
    clock: tuple[Interval, ...]


def own_columns(run: ArmRun, level: Sequence[float]) -> FloatArray:
    """Return what every joint could do by itself (N, n, 5 n).

    Sign of the speed, speed, 1, size of the torque times the sign, slope of the torque.

    The slope stands for a torque that is recorded a fraction of a sample too late (tau - s tau'), and for the half
    step by which an integrator is late.

    Parameters
    ----------
    run : ArmRun
    level : sequence of float
        Width of the sign of each joint.
    """
    rows, n = run.motion.u.shape
    result = np.zeros((rows, n, OWN * n))
    for k in range(n):
        v = run.motion.v[:, k]
        sign = np.tanh(v / level[k])
        parts = (sign, v, np.ones(rows), np.abs(run.calm.u[:, k]) * sign, -run.first[:, k])
        for place, column in enumerate(parts):
            result[:, k, OWN * k + place] = column
    return result


def fit_arm(
    target: Sequence[FloatArray],
    columns: Sequence[FloatArray],
    other: Sequence[FloatArray],
    check: Sequence[FloatArray],
) -> ArmFit:
    """Fit ``target = columns * values`` on the estimation runs by weighted least squares, weighing by what is left.

    Parameters
    ----------
    target, columns : sequence of array (rows_i, n) and (rows_i, n, p)
        Of the estimation runs, decimated.
    other, check : sequence of array (rows_i, n) and (rows_i, n, p)
        Target and columns of the validation runs.
    """
    y, x = np.concatenate(list(target)), np.concatenate(list(columns))
    weights = np.maximum(np.std(y, axis=0), 1e-12)
    values = np.zeros(x.shape[2])
    for _ in range(3):
        flat = (x / weights[:, None]).reshape(-1, x.shape[2])
        size = np.where((norm := np.linalg.norm(flat, axis=0)) > 0, norm, 1.0)
        values = np.linalg.lstsq(flat / size, (y / weights).reshape(-1), rcond=1e-10)[0] / size
        left = y - x @ values
        weights = np.maximum(np.sqrt(np.mean(left**2, axis=0)), 1e-9 * np.maximum(np.std(y, axis=0), 1e-12))
    return ArmFit(
        values,
        tuple(one / weights[:, None] for one in columns),
        tuple((a - b @ values) / weights for a, b in zip(target, columns, strict=True)),
        tuple((a - b @ values) / weights for a, b in zip(other, check, strict=True)),
        weights,
    )


@dataclass
class _Stack:
    """Decimated targets and columns of both uses."""

    runs: dict[str, tuple[ArmRun, ...]]
    target: dict[str, list[FloatArray]]
    base: dict[str, list[FloatArray]]
    joints: list[int]
    memory: dict[str, dict[str, list[FloatArray]]] = field(default_factory=dict)

    def of(self, effect: Wide) -> dict[str, list[FloatArray]]:
        """Return the columns of an effect, made once."""
        key = str(effect)
        if key not in self.memory:
            self.memory[key] = {
                use: [_slim(one, effect.columns(one), self.joints) for one in self.runs[use]] for use in self.target
            }
        return self.memory[key]

    def fit(self, effects: Sequence[Wide]) -> ArmFit:
        """Fit what joints do by themselves and these effects; the values of the effects come last."""
        parts: dict[str, list[FloatArray]] = {}
        for use, base in self.base.items():
            extra = [self.of(one)[use] for one in effects]
            parts[use] = [np.concatenate([b, *(e[i] for e in extra)], axis=2) for i, b in enumerate(base)]
        return fit_arm(self.target["estimation"], parts["estimation"], self.target["validation"], parts["validation"])


def wide_search(
    arm: ArmModel,
    runs: dict[str, tuple[ArmRun, ...]],
    joints: Sequence[int],
    *,
    seed: int,
    calibrated: Sequence[FloatArray] | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> WideResult:
    """Find what acts on the whole arm, and by how much torques and positions are out of step.

    Parameters
    ----------
    arm : ArmModel
    runs : dict
        From :func:`harness.diagnosis.arm_motion.arm_runs`.
    joints : sequence of int
        Those that move: while a joint sticks, its torque says nothing.
    seed : int
        Keys surrogates and bootstrap draws.
    calibrated : sequence of array (10 * bodies,), optional
        Directions in which inertial parameters are free.
    say : callable
        Called with words about what is being done.
    """
    level = [max(0.02 * float(np.sqrt(np.mean(runs["estimation"][0].motion.v[:, k] ** 2))), 1e-6) for k in range(arm.n)]
    uses = ("estimation", "validation")
    target = {use: [_slim(one, one.motion.u - one.rigid, joints) for one in runs[use]] for use in uses}
    base: dict[str, list[FloatArray]] = {}
    for use in uses:
        base[use] = []
        for run in runs[use]:
            m = run.calm
            free = [arm.torques(m.q, m.v, m.a, parameters=p)[:, :, None] for p in calibrated or ()]
            base[use].append(_slim(run, np.concatenate([own_columns(run, level), *free], axis=2), joints))
    stack = _Stack(runs, target, base, list(joints))
    picked: list[Wide] = []
    accepted: list[WideCandidate] = []
    tried: list[WideCandidate] = []
    ties: list[tuple[Wide, ...]] = []
    first_p: float | None = None
    before = stack.fit([])
    everything = wide_effects(arm)
    while sum(one.name != GAIN for one in picked) < MOST:
        say("effects on the whole arm")
        rest = [one for one in everything if str(one) not in {str(other) for other in picked}]
        flat = np.concatenate([one.reshape(-1, one.shape[2]) for one in before.jacobian])
        nominal = orthonormal(flat, tolerance=1e-9)
        bases, left = {}, {}
        for one in rest:
            columns = np.concatenate(
                [(c / before.weights[:, None]).reshape(-1, c.shape[2]) for c in stack.of(one)["estimation"]]
            )
            size = float(np.linalg.norm(columns[:, 0]))
            if size * LARGEST.get(one.name, 1.0) < 1e-3 * np.sqrt(columns.shape[0]):
                left[str(one)] = 0.0  # moves nothing: the first joint's zero, say
                continue
            clean = columns[:, 0] - nominal @ (nominal.T @ columns[:, 0])
            left[str(one)] = float(np.linalg.norm(clean)) / size if size > 0 else 0.0
            if left[str(one)] >= SEEN:
                bases[str(one)] = orthonormal(columns, without=nominal, tolerance=1e-3)
        draws = stream("arm-surrogates", len(picked), seed)
        test = surrogate_test(list(before.estimation), bases, nominal, rng=draws, count=200)
        first_p = test.p if first_p is None else first_p
        fits = {str(one): stack.fit([*picked, one]) for one in rest if str(one) in bases}
        judged = _judged(rest, fits, before, left, test.p_of, len(picked) + 1, seed, OWN * arm.n)
        tried += judged
        good = [one for one in judged if one.judgement.accepted]
        if not good:
            break
        best = max(good, key=lambda one: one.delta_bic)
        tied = [one for one in judged if str(one.effect) in fits and best.delta_bic - one.delta_bic < 10.0]
        answer = min((one for one in tied if one in good), key=lambda one: (len(one.effect.parameters), -one.delta_bic))
        accepted.append(answer)
        picked.append(answer.effect)
        ties.append((answer.effect, *(one.effect for one in tied if one is not answer)))
        nested = {f"{name}@{answer.effect.at}" for name in answer.effect.nests}
        everything = [one for one in everything if str(one) not in nested]
        before = fits[str(answer.effect)]
    kept = _needed(stack, picked)
    if len(kept) < len(picked):
        pairs = [(one, tie) for one, tie in zip(accepted, ties, strict=True) if one.effect in kept]
        accepted, ties, picked = [one for one, _ in pairs], [tie for _, tie in pairs], kept
        before = stack.fit(picked)
    clock = before.intervals(slice(OWN - 1, OWN * arm.n, OWN))
    count = sum(len(one.parameters) for one in picked)
    found = before.intervals(slice(before.values.size - count, None)) if count else ()
    final: list[WideCandidate] = []
    for each in accepted:
        k = len(each.effect.parameters)
        own, found = found[:k], found[k:]
        values = np.array([interval.value for interval in own])
        if each.effect.name == GAIN:
            continue
        final.append(
            WideCandidate(
                each.effect, each.round, each.left, each.delta_bic, each.comparison, values, own, each.judgement
            )
        )
    shown = [tie for one, tie in zip(accepted, ties, strict=True) if one.effect.name != GAIN]
    gains = {one.effect.at: tie[1:] for one, tie in zip(accepted, ties, strict=True) if one.effect.name == GAIN}
    return WideResult(tuple(final), tuple(shown), tuple(tried), gains, first_p, clock)


def _slim(run: ArmRun, columns: FloatArray, joints: Sequence[int]) -> FloatArray:
    """Return columns (N, n) or (N, n, k) of some joints, decimated, 0 where a joint stands still."""
    chosen = list(joints)
    moving = moving_rows(run.motion)[:, chosen]
    slim = run.slim(columns[:, chosen])
    return slim * (moving if slim.ndim == 2 else moving[:, :, None])


def _needed(stack: _Stack, picked: Sequence[Wide]) -> list[Wide]:
    """Return the effects that are still needed beside the others: without them BIC rises by more than 10."""
    kept = list(picked)
    while len(kept) > 1:
        full = stack.fit(kept)
        samples = information_samples(full.estimation, None)
        reference = bic(full.estimation, full.values.size, samples)
        worth = []
        for one in kept:
            less = stack.fit([other for other in kept if other is not one])
            power = [r * less.weights / full.weights for r in less.estimation]
            worth.append(bic(power, less.values.size, samples) - reference)
        weakest = int(np.argmin(worth))
        if worth[weakest] > 10.0:
            break
        del kept[weakest]
    return kept


def _judged(
    rest: Sequence[Wide],
    fits: dict[str, ArmFit],
    before: ArmFit,
    left: dict[str, float],
    p_of: Any,
    number: int,
    seed: int,
    frictions: int,
) -> list[WideCandidate]:
    """Judge every candidate of one round by the acceptance rule."""
    nothing = Comparison(0.0, 1.0)
    best = min(fits.values(), key=lambda one: _size(one, before.weights), default=before)
    residual = [one * best.weights / before.weights for one in best.estimation]
    samples = information_samples(residual, None)
    reference = bic(before.estimation, before.values.size, samples)
    result = []
    for one in rest:
        fit = fits.get(str(one))
        if fit is None:
            reasons = Judgement(False, ("cannot be told from what joints do by themselves in this motion",))
            result.append(WideCandidate(one, number, left[str(one)], -np.inf, nothing, np.zeros(0), (), reasons))
            continue
        rescale = fit.weights / before.weights
        delta = reference - bic([r * rescale for r in fit.estimation], fit.values.size, samples)
        draws = stream("arm-bootstrap", str(one), number, seed)
        comparison = compare_blocks(before.validation, [r * rescale for r in fit.validation], rng=draws)
        k = len(one.parameters)
        intervals = fit.intervals(slice(fit.values.size - k, None))
        verdict = judge(
            converged=True,
            delta_bic=delta,
            comparison=comparison,
            main=intervals[0],
            sign=one.sign,
            minimum=-0.95 if one.name == "link_mass" else -np.inf,  # no link without mass
            maximum=np.inf,
            surrogate_p=p_of.get(str(one)),
        )
        if _beside_friction(fit, k, frictions) < DETAIL:
            text = (
                f"its torque is less than {100 * DETAIL:g} % of the friction beside it, whose law is not known so well"
            )
            verdict = Judgement(False, (*verdict.reasons, text))
        if k > 1 and not one.sign and any(i.excludes_zero for i in intervals[1:]):
            kept = tuple(text for text in verdict.reasons if "includes 0" not in text)
            verdict = Judgement(not kept, kept)
        result.append(
            WideCandidate(one, number, left[str(one)], float(delta), comparison, fit.values[-k:], intervals, verdict)
        )
    return result


def _beside_friction(fit: ArmFit, k: int, frictions: int) -> float:
    """Return the torque of the last k columns over that of the friction, at the joint where they weigh most."""
    x = np.concatenate(fit.jacobian)
    own = np.sqrt(np.mean((x[:, :, -k:] @ fit.values[-k:]) ** 2, axis=0))
    joint = int(np.argmax(own))
    # of the columns of a joint, only its own are not zero in its row
    dry = [place for place in range(frictions) if place % OWN in (0, 3) and np.any(x[:, joint, place])]
    friction = float(np.sqrt(np.mean((x[:, joint, dry] @ fit.values[dry]) ** 2))) if dry else 0.0
    return float(own[joint]) / max(friction, 1e-300)


def _size(fit: ArmFit, weights: FloatArray) -> float:
    """Return the mean logarithm of the power that a fit leaves in each joint."""
    power = np.mean(np.concatenate([one * fit.weights / weights for one in fit.estimation]) ** 2, axis=0)
    return float(np.mean(np.log(np.maximum(power, 1e-300))))
