"""Comparing fits: penalised gain, gain on validation with its error, what physics forbids, and ties."""

from __future__ import annotations

import functools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from harness.diagnosis.effort import EFFORT
from harness.diagnosis.policy import POLICY, Policy
from harness.diagnosis.search.coloured import coloured_likelihood
from harness.diagnosis.search.fit import Fit, Form
from harness.diagnosis.search.refusal import LINE_RIVALS, Kind, Refusal
from harness.effects.effect import Placed
from harness.signals import FloatArray

_NEAR_BOUND = 1e-4
"""Share of a bound's size within which a value lies on it."""


@dataclass(frozen=True)
class FitComparison:
    """One fit against another.

    Attributes
    ----------
    evidence : float
        Difference of the penalised log-likelihoods of the estimation records.
    validation : float
        Difference of the log-likelihoods of the validation records.
    error : float
        Standard error of the latter, over blocks.
    total_error : float
        Standard error of both together.
    """

    evidence: float
    validation: float
    error: float
    total_error: float

    @property
    def total(self) -> float:
        """What decides: both uses together."""
        return self.evidence + self.validation


@dataclass(frozen=True, eq=False)
class Judged:
    """A candidate against the model before it.

    Attributes
    ----------
    added : tuple of Placed
    fit : Fit or None
    comparison : Comparison or None
    refusals : tuple of Refusal
        Why it is refused; empty if it passes.
    """

    added: tuple[Placed, ...]
    fit: Fit | None
    comparison: FitComparison | None
    refusals: tuple[Refusal, ...]

    @property
    def passed(self) -> bool:
        """True if nothing speaks against it."""
        return not self.refusals

    @property
    def name(self) -> str:
        """The added effects."""
        return " + ".join(sorted(str(placed) for placed in self.added))


def compared(fit: Fit, base: Fit, policy: Policy = POLICY) -> FitComparison:
    """Return how much better a fit is than a base."""
    gain, error = difference(fit, base, ("validation",), policy)
    _, total_error = difference(fit, base, ("estimation", "validation"), policy)
    return FitComparison(fit.penalised - base.penalised, gain, error, total_error)


def difference(fit: Fit, base: Fit, uses: Sequence[str], policy: Policy = POLICY) -> tuple[float, float]:
    """Return the difference of log-likelihoods over some uses, and its standard error over blocks.

    The error is that of what surprises the first model: the difference less what it expects of every sample, which is
    a martingale where it is true. What an effect does in a few places only, an end stop that is touched twice, say, is
    no error of it; errors that are coloured, or grow and fall, are (the variance of Vuong 1989, Econometrica 57:307,
    sec. 3, about a mean that changes from sample to sample).
    """
    gain, surprises = 0.0, []
    for use in uses:
        expected = _expected(fit, base, use)
        for mine, theirs, mean in zip(fit.terms[use], base.terms[use], expected, strict=True):
            change = mine - theirs
            gain += float(change.sum())
            edges = np.linspace(0, len(change), policy.blocks + 1).astype(int)
            surprises += list(np.diff(np.concatenate([[0.0], np.cumsum(change - mean)])[edges]))
    return gain, float(np.sqrt(len(surprises)) * np.std(surprises, ddof=1))


def expected_difference(fit: Fit, base: Fit, uses: Sequence[str]) -> float:
    """Return the mean of the difference of log-likelihoods over some uses, were the first of two fits true.

    It is the information that records of this kind have for telling the second from the first, whatever their noise
    did: Kullback & Leibler's divergence, the noncentrality that Atkinson & Fedorov 1975 (Biometrika 62:57) design for.
    """
    return sum(float(part.sum()) for use in uses for part in _expected(fit, base, use))


def _expected(fit: Fit, base: Fit, use: str) -> list[FloatArray]:
    """Return for every record the mean of the difference of log-densities (N,) where the first of two fits is true.

    It is what the other prediction misses of the first, squared, over twice the wider variance. What variances alone
    would add to Kullback & Leibler's divergence is the same for every sample but the first ones, to which both fits
    have chosen their initial states. 0 where a form predicts no distributions.
    """
    if use not in fit.innovations or use not in base.innovations:
        return [np.zeros(len(terms)) for terms in fit.terms[use]]
    found = []
    for (e, s), (other, wide) in zip(fit.innovations[use], base.innovations[use], strict=True):
        with np.errstate(over="ignore", invalid="ignore"):  # of a model far off the data
            each = 0.5 * (e - other) ** 2 / np.maximum(s, wide)
        found.append(np.where(np.isfinite(each), each, 0.0).sum(axis=1))
    return found


def judged(
    form: Form,
    added: Sequence[Placed],
    fit: Fit | None,
    base: Fit,
    nominal: Fit,
    policy: Policy = POLICY,
    given: Collection[str] = (),
) -> Judged:
    """Apply the acceptance rule to effects that were added to a base; nothing is asked of those that are ``given``."""
    if fit is None:
        dear = set(map(str, added)) & set(form.left_out())
        return Judged(tuple(added), None, None, (Refusal(Kind.COST if dear else Kind.NOT_SIMULATED),))
    comparison = compared(fit, base, policy)
    names = {*given, *map(str, added)}
    reasons = [*_ended(fit), *unseen(fit), *_wanting(fit, base, nominal, comparison, policy)]
    for placed in added:
        reasons += impossible(form, placed, fit) + _traded(placed, fit, base)
        for kind, evidence in zip(LINE_RIVALS, fit.line_rivals.get(str(placed), ()), strict=False):
            if evidence > 0.0:  # likelier than a line that is drawn once in every record
                reasons.append(Refusal(kind, str(placed), (evidence,)))
    reasons += [  # what was found before must stay what it is
        Refusal(Kind.OTHER_LAW, str(placed), cause=refusal)
        for placed in fit.effects
        if str(placed) not in names
        for refusal in wrong_signs(placed, fit.values)
    ]
    if not reasons:  # what costs more than a comparison is asked last
        reasons = unremembered(fit, base, policy) or _small(form, added, fit, policy)
        reasons = reasons or _again(form, added, fit, base, policy)
    return Judged(tuple(added), fit, comparison, tuple(reasons))


def _ended(fit: Fit) -> list[Refusal]:
    """Return whether a fit came to its end."""
    if fit.beyond:
        return [Refusal(Kind.STOPPED)]
    return [] if fit.converged else [Refusal(Kind.UNCONVERGED)]


def unseen(fit: Fit) -> list[Refusal]:
    """Return whether something of a model is over sooner than the readings show."""
    return [Refusal(Kind.UNSEEN, numbers=(fit.unseen,))] if fit.unseen > 1.0 else []


def _wanting(fit: Fit, base: Fit, nominal: Fit, found: FitComparison, policy: Policy) -> list[Refusal]:
    """Return which of the evidence that is asked for a fit does not have."""
    reasons = []
    asked = max(2 * policy.evidence, policy.gain_z * found.total_error)
    if found.total < asked:
        reasons.append(Refusal(Kind.EVIDENCE, numbers=(found.evidence, found.validation, asked)))
    if found.evidence < policy.alone:
        reasons.append(Refusal(Kind.ESTIMATION, numbers=(found.evidence, policy.alone)))
    if found.validation < policy.alone_z * found.error:
        reasons.append(Refusal(Kind.VALIDATION, numbers=(found.validation, policy.alone_z * found.error)))
    if base is not nominal:
        whole = fit.penalised - nominal.penalised  # of records that no effect was fitted to, one may explain most
        if policy.alone <= found.evidence < policy.second_share * whole:  # what brings less than nothing was said
            reasons.append(Refusal(Kind.SHARE, numbers=(found.evidence / whole, policy.second_share)))
    return reasons


def unremembered(fit: Fit, base: Fit, policy: Policy) -> list[Refusal]:
    """Return what free runs refuse of a fit beside an error that remembers; empty with latent forces."""
    if not fit.free_run:
        return []
    gains = coloured_gains(fit, base, policy.order)
    return [Refusal(Kind.COLOURED, numbers=(*gains, _asked(gains, policy)))] if drifts(gains, policy) else []


def drifts(gains: tuple[float, float], policy: Policy) -> bool:
    """Return True if an error that remembers explains free runs as well as what brings these gains beside one.

    Of the estimation records, its parameters paid, and of the validation records: nothing is told by less, neither
    what a plant lacks nor that it lacks something.
    """
    return gains[0] < 0.0 or sum(gains) < _asked(gains, policy)


def _asked(gains: tuple[float, float], policy: Policy) -> float:
    """Return the gain of both uses that is asked beside an error that remembers."""
    return 2 * policy.evidence if gains[1] >= 0.0 else policy.misfit_gain


def _small(form: Form, added: Sequence[Placed], fit: Fit, policy: Policy) -> list[Refusal]:
    """Return which effects change less than anybody would miss."""
    shares = [(placed, form.change(fit, placed)) for placed in added]
    return [Refusal(Kind.SIZE, str(placed), (share, policy.least)) for placed, share in shares if share < policy.least]


def _again(form: Form, added: Sequence[Placed], fit: Fit, base: Fit, policy: Policy) -> list[Refusal]:
    """Return which effects are said to happen once, where beside them the like of it goes on.

    A force that nobody measured goes on jumping; or the errors of free runs, which have no such force, last.
    """
    once = [placed for placed in added if placed.effect.parameter_of("instant") is not None]
    if once and fit.free_run:
        left = max(_lasting(fit, base, use) for use in base.innovations)
        return [Refusal(Kind.LASTING, str(one), (left,)) for one in once if left > policy.once]
    more = [jump.port for jump in form.jumps(fit)] if once else []
    return [Refusal(Kind.AGAIN, str(one), (more.count(one.at),)) for one in once if one.at in more]


def _lasting(fit: Fit, base: Fit, use: str) -> float:
    """Return how much of the errors of a base that last from sample to sample a fit leaves, noise left out.

    Covariances of neighbours, each output over its own variance in the base: noise that is new with every sample has
    none.
    """

    def lasts(one: Fit) -> float:
        products = [
            np.nanmean(np.concatenate([e[1:, j] * e[:-1, j] for e, _ in one.innovations[use]])) / scale
            for j, scale in enumerate(scales)
        ]
        return max(float(np.sum(products)), 0.0)

    errors = np.concatenate([e for e, _ in base.innovations[use]])
    scales = np.maximum(np.nanvar(errors, axis=0), 1e-300)
    before = lasts(base)
    return lasts(fit) / before if before > 0.0 else 1.0


def coloured_gains(fit: Fit, base: Fit, order: int) -> tuple[float, float]:
    """Return what a fit gains of the estimation records, penalised, and of the validation records, beside a memory.

    The error of a free run is what nobody modelled, and lasts: taken as noise that is new with every sample it makes
    any slow law likely that follows it by chance. Beside an error that remembers, its own for either model, only what
    cannot be told from its last values counts.
    """
    mine, theirs = (_beside_memory(one, order) for one in (fit, base))
    price = 0.5 * (fit.count - base.count) * float(np.log(fit.samples))
    return mine["estimation"] - theirs["estimation"] - price, mine["validation"] - theirs["validation"]


@functools.lru_cache(maxsize=4)
def _beside_memory(fit: Fit, order: int) -> dict[str, float]:
    """Return the log-likelihood of a fit by use beside an error that remembers; a base is asked it again and again."""
    return coloured_likelihood(fit.innovations, order)


def pays(fit: Fit, base: Fit, policy: Policy = POLICY) -> bool:
    """Return True if a fit pays for its parameters, or comes as near to it as an effect has to go beyond it."""
    return fit.penalised > base.penalised - policy.evidence


def impossible(form: Form, placed: Placed, fit: Fit) -> list[Refusal]:
    """Return what physics forbids in the values of an effect, as its parameters declare."""
    reasons = wrong_signs(placed, fit.values)
    for parameter in placed.effect.parameters:
        name = placed.name(parameter.name)
        if name not in fit.free or parameter.nuisance:
            continue
        value = fit.values[name]
        bounds = [bound for bound in (parameter.minimum, parameter.maximum) if np.isfinite(bound) and bound != 0.0]
        near = [bound for bound in bounds if abs(value - bound) <= _NEAR_BOUND * abs(bound)]
        # the data's sizes set a ceiling; and what refines a law no more than they could show does not refine it
        sized = parameter.ceiling or (placed.effect.grows and parameter.floor)
        if sized and name in fit.on_bound and not near and value != parameter.neutral:
            near = [value]
        if near and near[0] != parameter.neutral:
            reasons.append(Refusal(Kind.BOUND, parameter.name, (near[0],)))
        elif parameter.main and _undetermined(name, parameter.neutral or 0.0, fit):
            reasons.append(Refusal(Kind.UNDETERMINED, parameter.name, (value,)))
    return reasons + violations(form, placed, fit)


def _undetermined(name: str, neutral: float, fit: Fit) -> bool:
    """Return True for a parameter that its own standard deviation cannot tell from nothing, or from e times as much.

    Three values that only tell a straight line together are none of them told: a wave far longer than the travel.
    Nominal parameters of which the records tell nothing are held.
    """
    deviation = fit.beside.get(name, fit.deviations.get(name, 0.0))
    return deviation >= (EFFORT.untold if name in fit.logarithmic else abs(fit.values[name] - neutral))


def _traded(placed: Placed, fit: Fit, base: Fit) -> list[Refusal]:
    """Return whether an effect only trades with parameters that are told without it: together they do what those did.

    Not where it shares the fate of parameters that nothing told before, as a friction that of a scale.
    """
    if placed.effect.main is None:  # it is there or not, and trades with nothing
        return []
    main = placed.name(placed.effect.main.name)
    lost = [name for name in base.free if name in fit.free and _told(name, base) and not _told(name, fit)]
    if not lost or main not in fit.free or _told(main, fit):
        return []
    return [Refusal(Kind.TRADED, ", ".join(lost))]


def _told(name: str, fit: Fit) -> bool:
    """Return True for a parameter that the records tell by itself, and not in combinations with others alone."""
    limit = EFFORT.untold if name in fit.logarithmic else abs(fit.values[name])
    return fit.deviations.get(name, np.inf) < limit


def wrong_signs(placed: Placed, values: Mapping[str, float]) -> list[Refusal]:
    """Return which values of an effect have a sign that its law does not have."""
    reasons = []
    for parameter in placed.effect.parameters:
        value = values.get(placed.name(parameter.name), 0.0)
        if not (parameter.fixed or parameter.nuisance) and (
            (parameter.sign == "+" and value < 0) or (parameter.sign == "-" and value > 0)
        ):
            reasons.append(Refusal(Kind.SIGN, parameter.name, (value,)))
    return reasons


def violations(form: Form, placed: Placed, fit: Fit) -> list[Refusal]:
    """Return which relations between the values of an effect, as its law asks for them, do not hold."""
    effect = placed.effect
    values = {parameter.name: fit.values[placed.name(parameter.name)] for parameter in effect.parameters}
    along = form.damping(fit, placed.at) if effect.requires_along else None
    broken = effect.violations(values) + ([] if along is None else effect.violations_along(values, *along))
    return [Refusal(Kind.LAW, sentence) for sentence in broken]
