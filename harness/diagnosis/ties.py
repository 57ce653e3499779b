"""Tie sets: everything that these data cannot tell from an accepted effect."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from harness.diagnosis.accept import compare_blocks, information_samples
from harness.diagnosis.confirm import Candidate, noise_ratio
from harness.diagnosis.forms import Fitted, Form, placed_name
from harness.rng import stream
from harness.signals import FloatArray

__all__ = ["leader", "simplest", "tie_set"]

WITHIN = 10.0
VAGUE = 0.5
"""A parameter whose interval is wider than this share of its value (to each side) is not determined."""


def tie_set(form: Form, best: Candidate, candidates: Sequence[Candidate], *, seed: int) -> list[Candidate]:
    """Return the candidates that the data cannot tell from the best one, the best first.

    A candidate ties if it is within 10 of the best in BIC and the paired bootstrap on validation cannot tell the two.
    A more complex one whose additional parameters are not determined by the data (Stribeck friction seen only at high
    speed) also ties: only the penalty separates it, not the data.
    """
    assert best.fitted is not None
    samples = information_samples(best.fitted.estimation, noise_ratio(best.fitted, form.floors))
    tied = [best]
    for one in candidates:
        if one is best or one.fitted is None or not one.fitted.finite:
            continue
        close = best.delta_bic - one.delta_bic <= WITHIN
        if not close:
            gap = _deviance(one.fitted, samples) - _deviance(best.fitted, samples)
            close = gap <= WITHIN and one.parameters > best.parameters and _vague(one)
        if not close:
            continue
        key = f"{placed_name(best.added)} against {placed_name(one.added)}"
        versus = compare_blocks(best.fitted.validation, one.fitted.validation, rng=stream("diagnosis-tie", key, seed))
        if not versus.distinguishable or abs(versus.gain) < 1e-3:
            tied.append(one)
    return tied


def leader(accepted: Sequence[Candidate], *, seed: int) -> Candidate:
    """Return the best accepted candidate by BIC; of those within 10 of it, one that validation tells to be better."""
    best = max(accepted, key=lambda one: one.delta_bic)
    for one in accepted:
        if one is best or best.delta_bic - one.delta_bic > WITHIN or one.fitted is None or best.fitted is None:
            continue
        key = f"{placed_name(best.added)} against {placed_name(one.added)}"
        versus = compare_blocks(best.fitted.validation, one.fitted.validation, rng=stream("diagnosis-tie", key, seed))
        if versus.gain >= 1e-3 and versus.p <= 0.01:
            best = one
    return best


def simplest(tied: Sequence[Candidate]) -> Candidate:
    """Return the accepted member with the fewest parameters, of those the one with the best BIC."""
    accepted = [one for one in tied if one.accepted]
    return min(accepted or list(tied), key=lambda one: (one.parameters, -one.delta_bic))


def _deviance(fitted: Fitted, samples: float) -> float:
    """Return n mean_j log(mean r_j^2): the fit part of the information criterion."""
    power: FloatArray = np.mean(np.concatenate(fitted.estimation) ** 2, axis=0)
    return float(samples * np.mean(np.log(np.maximum(power, 1e-300))))


def _vague(candidate: Candidate) -> bool:
    """Return True if a parameter of the added effects (no smoothing width, no phase) is not determined."""
    assert candidate.fitted is not None
    intervals = candidate.fitted.intervals()
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
