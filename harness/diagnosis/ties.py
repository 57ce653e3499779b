"""Tie sets: everything that these data cannot tell from an accepted effect."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from harness.diagnosis.accept import compare_blocks, information_samples
from harness.diagnosis.confirm import Candidate, noise_ratio
from harness.diagnosis.forms import Fitted, Form, placed_name
from harness.diagnosis.residual_tests import RATIO
from harness.rng import stream
from harness.signals import FloatArray

__all__ = ["leader", "simplest", "tie_set"]

WITHIN = 10.0
SHARE = 0.002
"""Candidates also tie within this share of what the best gains: at N = 5000 a numerical detail is worth 10 in BIC."""
SPECIAL = 0.01
"""The same for a special case of the best: the rounding of a law is worth hundreds in BIC, a law is worth more."""
PREDICTS = 0.05
"""The same for a special case of the best that predicts validation at least as well."""
ALIKE = 0.02
"""Validation errors that differ by less than this count as equal, whatever the bootstrap says."""
VAGUE = 0.5
"""A parameter whose interval is wider than this share of its value (to each side) is not determined."""


def tie_set(form: Form, best: Candidate, candidates: Sequence[Candidate], *, seed: int) -> list[Candidate]:
    """Return the candidates that the data cannot tell from the best one, the best first.

    A candidate ties if it is within 10 of the best in BIC (or within 0.2 % of what the best gains), and the paired
    bootstrap on validation cannot tell the two (or they differ by less than 2 %).
    A special case of the best within 10 in BIC ties whatever the bootstrap says: the evidence for the more general
    effect is then no more than the evidence that an effect needs to be accepted at all. A special case that gains
    within 1 % as much ties if its validation error is within 2 %, and one that gains within 5 % as much if it predicts
    validation at least as well: under a disturbance the criterion counts details of one record as evidence.
    Where the best leaves more than the noise, an accepted candidate also ties if the paired bootstrap cannot tell the
    two on estimation either: blocks stay right where the residual is coloured, the criterion does not.
    A more complex one whose additional parameters are not determined by the data (Stribeck friction seen only at high
    speed) also ties: only the penalty separates it, not the data.
    """
    assert best.fitted is not None
    ratio = noise_ratio(best.fitted, form.floors)
    samples = information_samples(best.fitted.estimation, ratio)
    coloured = ratio is not None and ratio >= RATIO
    tied = [best]
    for one in candidates:
        if one is best or one.fitted is None or not one.fitted.finite:
            continue
        nested, lost = _special_case(one, best), best.delta_bic - one.delta_bic
        close = lost <= max(WITHIN, (SPECIAL if nested else SHARE) * best.delta_bic)
        if not close:
            gap = _deviance(one.fitted, samples) - _deviance(best.fitted, samples)
            close = gap <= WITHIN and one.parameters > best.parameters and _vague(one)
        key = f"{placed_name(best.added)} against {placed_name(one.added)}"
        if not close and coloured and one.accepted:
            rng = stream("diagnosis-tie-estimation", key, seed)
            close = not compare_blocks(best.fitted.estimation, one.fitted.estimation, rng=rng).distinguishable
        maybe = nested and one.accepted and lost <= PREDICTS * best.delta_bic
        if not (close or maybe):
            continue
        versus = compare_blocks(best.fitted.validation, one.fitted.validation, rng=stream("diagnosis-tie", key, seed))
        alike = not versus.distinguishable or abs(versus.gain) < ALIKE or (nested and lost <= WITHIN)
        if (close and alike) or (maybe and versus.gain >= 0):
            tied.append(one)
    return tied


def leader(accepted: Sequence[Candidate], *, seed: int) -> Candidate:
    """Return the best accepted candidate.

    By BIC; but one that validation tells to be better wins if it is no more complex and gains nearly as much (5 %), or
    lies within 10 in BIC: what is left between those two is a detail of the estimation record.
    """
    best = max(accepted, key=lambda one: one.delta_bic)
    for one in sorted(accepted, key=lambda one: -one.delta_bic):
        if one is best or one.fitted is None or best.fitted is None:
            continue
        lost = best.delta_bic - one.delta_bic
        simpler = one.parameters <= best.parameters and lost <= 0.05 * best.delta_bic
        if not (simpler or lost <= WITHIN):
            continue
        key = f"{placed_name(best.added)} against {placed_name(one.added)}"
        versus = compare_blocks(best.fitted.validation, one.fitted.validation, rng=stream("diagnosis-tie", key, seed))
        if versus.gain >= ALIKE and versus.p <= 0.05:
            best = one
    return best


def simplest(tied: Sequence[Candidate]) -> Candidate:
    """Return the accepted member with the fewest parameters; of those the one that is a special case of most others."""
    accepted = [one for one in tied if one.accepted] or list(tied)

    def cases(one: Candidate) -> int:
        names = {placed.effect.name for placed in one.added}
        return sum(
            bool(names & {*placed.effect.nests, *placed.effect.limits})
            for other in tied
            if other is not one
            for placed in other.added
        )

    return min(accepted, key=lambda one: (one.parameters, -cases(one), -one.delta_bic))


def _special_case(one: Candidate, best: Candidate) -> bool:
    """Return True if one differs from the best only by effects that the best one's effects contain."""
    if len(one.added) != len(best.added):
        return False
    pairs = zip(one.added, best.added, strict=True)
    return all(a.at == b.at and (a.effect.name == b.effect.name or a.effect.name in b.effect.nests) for a, b in pairs)


def _deviance(fitted: Fitted, samples: float) -> float:
    """Return n mean_j log(mean r_j^2): the fit part of the information criterion."""
    power: FloatArray = np.mean(np.concatenate(fitted.estimation) ** 2, axis=0)
    return float(samples * np.mean(np.log(np.maximum(power, 1e-300))))


def _vague(candidate: Candidate) -> bool:
    """Return True if a parameter of the added effects (no smoothing width, no phase) is not determined."""
    assert candidate.fitted is not None
    intervals = candidate.fitted.intervals(adapt=False)
    for placed in candidate.added:
        for one in placed.effect.parameters:
            name = placed.name(one.name)
            if one.nuisance or name not in intervals:
                continue
            found = intervals[name]
            half = 0.5 * (found.high - found.low)
            if not half <= VAGUE * abs(found.value - (one.neutral or 0.0)):
                return True
    return False
