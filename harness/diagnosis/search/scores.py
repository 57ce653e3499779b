"""The score test of a dictionary: what each effect promises, in one pass, without a refit (Rao 1948)."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from harness.diagnosis.effort import EFFORT
from harness.diagnosis.policy import POLICY, Policy
from harness.diagnosis.search.fit import Column, Fit, Form
from harness.effects.effect import Placed
from harness.signals import FloatArray

SINGULAR = 1e-5
"""Singular values of unit columns below which nothing is divided by them."""


@dataclass(frozen=True, eq=False)
class Lead:
    """What an effect promises.

    Attributes
    ----------
    placed : Placed
    gain : float
        Log-likelihood that it would gain on the estimation records with everything else fixed, at first order.
    penalised : float
        Less half the BIC penalty of its parameters.
    share : float
        Part of its column that nothing free can take up; below ``policy.seen`` it cannot be told from that.
    starts : tuple of dict
        Values by full name: those that the gain is for first, then of the next best choices of what is not linear.
        With the effect's own, the values of what is free already, initial states too, moved along at first order: for
        the whole of an effect that cannot be a tenth of itself.
    direction : array (n,)
        The whitened innovations that it would explain, nuisance projected out, of length 1.
    span : array (n, k)
        Orthonormal basis of all that it could explain.
    """

    placed: Placed
    gain: float
    penalised: float
    share: float
    starts: tuple[dict[str, float], ...]
    direction: FloatArray = field(repr=False)
    span: FloatArray = field(repr=False)
    taken: FloatArray = field(repr=False)
    """What the effect at its start does to the whitened innovations (n,)."""


@dataclass(frozen=True, eq=False)
class ScoreTest:
    """Leads, best first; and those that cannot be told from what is free already."""

    leads: list[Lead]
    hidden: list[Lead]

    def with_shown(self, shown: Collection[str]) -> ScoreTest:
        """Return the same with what was shown among the leads, however little of its column nothing takes up."""
        seen = [lead for lead in self.hidden if str(lead.placed) in shown]
        return ScoreTest([*self.leads, *seen], [lead for lead in self.hidden if lead not in seen])

    def cosines(self, first: Sequence[str] = (), most: int = 26) -> tuple[tuple[str, ...], FloatArray]:
        """Return how well each visible effect is mimicked by every other.

        Parameters
        ----------
        first : sequence of str
            Effects to show in any case.
        most : int

        Returns
        -------
        names : tuple of str
        cosines : array (n, n)
            Entry (i, j): cosine between what effect i would explain and all that effect j could; 1: they cannot be
            told apart in these data.
        """
        shown = sorted(self.leads, key=lambda lead: (str(lead.placed) not in first, str(lead.placed)))[:most]
        cosines = np.eye(len(shown))
        for i, a in enumerate(shown):
            for j, b in enumerate(shown):
                if i != j:
                    cosines[i, j] = min(float(np.linalg.norm(b.span.T @ a.direction)), 1.0)
        return tuple(str(lead.placed) for lead in shown), cosines


def score_test(form: Form, fit: Fit, candidates: Sequence[Placed], policy: Policy = POLICY) -> ScoreTest:
    """Return what each candidate promises beside a fit.

    Parameters
    ----------
    form : Form
    fit : Fit
    candidates : sequence of Placed
    policy : Policy
    """
    basis, residual = projected(form, fit)
    by_effect: dict[str, list[Lead]] = {}
    penalty = 0.5 * float(np.log(fit.samples))
    moved = _mover(form, fit)
    for column in form.columns(fit, candidates):
        lead = moved(_lead(column, basis, residual, penalty))
        by_effect.setdefault(str(lead.placed), []).append(lead)
    best = [_joined(several, policy) for several in by_effect.values()]
    ranked = sorted(best, key=lambda lead: -lead.penalised)
    return ScoreTest(
        [lead for lead in ranked if lead.share >= policy.seen], [lead for lead in ranked if lead.share < policy.seen]
    )


def _joined(several: list[Lead], policy: Policy) -> Lead:
    """Return the best choice of an effect's parameters, with the starts of the next best ones."""
    ordered = sorted(several, key=lambda lead: (-lead.gain, -lead.share))
    starts = tuple(lead.starts[0] for lead in ordered[: EFFORT.starts])
    return replace(ordered[0], starts=starts)


def projected(form: Form, fit: Fit) -> tuple[FloatArray, FloatArray]:
    """Return an orthonormal basis of what is free already (n, p), and the innovations without it (n,)."""
    linear = form.linearised(fit)
    nuisance = linear.nuisance["estimation"]
    size = np.linalg.norm(nuisance, axis=0)
    basis, _ = np.linalg.qr(nuisance[:, size > 0] / size[size > 0])
    residual = linear.residual["estimation"]
    return basis, residual - basis @ (basis.T @ residual)


def _lead(column: Column, basis: FloatArray, residual: FloatArray, penalty: float) -> Lead:
    """Return what one choice of parameters promises."""
    assert column.placed is not None
    with np.errstate(over="ignore"):  # what diverges is as good as not seen: nothing is left of it over its size
        size = np.linalg.norm(column.estimation, axis=0)
    use = size > 0
    coefficients = np.zeros(len(size))
    direction, span = np.zeros(len(residual)), np.zeros((len(residual), 0))
    gain = share = 0.0
    if use.any():
        unit = column.estimation[:, use] / size[use]
        left = unit - basis @ (basis.T @ unit)
        share = float(np.sqrt((left**2).sum(axis=0)).max())
        u, s, vt = np.linalg.svd(left, full_matrices=False)
        keep = s > SINGULAR
        along = -(u[:, keep].T @ residual)  # the innovations must go down
        gain = 0.5 * float(along @ along)
        coefficients[use] = vt[keep].T @ (along / s[keep]) / size[use]
        span = u[:, keep]
        direction = span @ along if gain > 0 else span.sum(axis=1)
        direction = direction / (np.linalg.norm(direction) or 1.0)
    penalised = gain - penalty * _free(column.placed)
    start, realised = _start(column, coefficients)
    return Lead(column.placed, gain, penalised, share, (start,), direction, span, column.estimation @ realised)


def _mover(form: Form, fit: Fit) -> Callable[[Lead], Lead]:
    """Return what adds to the start of a lead how everything that is free already moves along with the effect.

    Left where they are, parameters and initial states that can take up an effect in part put it far below its base.
    """
    linear = form.linearised(fit)
    nuisance = linear.nuisance["estimation"]
    size = np.linalg.norm(nuisance, axis=0)
    size[size == 0] = 1.0
    free = {**{name: fit.values[name] for name in linear.names}, **linear.states}
    back = (np.linalg.pinv(nuisance / size, rcond=1e-12) / size[:, None])[: len(free)]

    def moved(lead: Lead) -> Lead:
        steps = -(back @ lead.taken)
        values = {name: value + float(step) for (name, value), step in zip(free.items(), steps, strict=True)}
        ratios = [values[name] / (fit.values[name] or 1.0) for name in linear.names]
        if not lead.placed.effect.vanishes and any(not 0.5 < ratio < 2.0 for ratio in ratios):
            return lead  # the first order does not reach so far, and there is no going back
        return replace(lead, starts=tuple({**values, **start} for start in lead.starts))

    return moved


def _free(placed: Placed) -> int:
    """Return how many parameters an effect adds."""
    return sum(not parameter.fixed for parameter in placed.effect.parameters)


def _start(column: Column, coefficients: FloatArray) -> tuple[dict[str, float], FloatArray]:
    """Return the parameters that a column and its coefficients stand for, by full name, within their bounds.

    With them, the coefficients as they are there: a law that does not vanish with its main parameter stays whole.
    """
    placed = column.placed
    assert placed is not None
    values = dict(column.given)
    realised = coefficients.copy()
    for name, coefficient in zip(column.names, coefficients, strict=True):
        if name == "effect":  # the whole effect counts this many times: its main parameter scales so, at first order
            main = placed.effect.main
            realised[0] = 1.0
            if main is not None and main.name in values:
                nothing = 0.0 if main.unit == "s" else main.neutral  # a lag of no time is none
                if nothing is not None:
                    realised[0] = part = float(np.clip(coefficient, 0.1, 3.0))
                    values[main.name] = nothing + part * (values[main.name] - nothing)
        elif name in placed.effect.parameter_names:
            values[name] = (placed.effect.parameter(name).neutral or 0.0) + float(coefficient)
    main, phase = placed.effect.main, placed.effect.parameter_of("phase")
    if column.kind == "wave" and main is not None and phase is not None:
        values[main.name] = float(np.hypot(*coefficients))
        values[phase.name] = float(np.arctan2(coefficients[1], coefficients[0]))
    bounded = {}
    for name, value in values.items():
        if name in placed.effect.parameter_names:
            parameter = placed.effect.parameter(name)
            bounded[placed.name(name)] = float(np.clip(value, parameter.minimum, parameter.maximum))
    return bounded, realised
