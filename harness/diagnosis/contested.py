"""An answer held against what simple fits by output error can do: more starts before the search, a rival after it."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from harness.diagnosis.effort import EFFORT
from harness.diagnosis.forms.fit_records import latent_shares, likelihood_detail
from harness.diagnosis.forms.form import WholeForm
from harness.diagnosis.forms.remembered import Remembered
from harness.diagnosis.kinds import ModelKind
from harness.diagnosis.policy import POLICY, Policy
from harness.diagnosis.records.horizon import Horizon
from harness.diagnosis.runs.compare import FreeRuns
from harness.diagnosis.runs.form import FreeRunForm
from harness.diagnosis.runs.simple_fits import SimpleFit, SimpleFits
from harness.diagnosis.search.compare import Judged, judged
from harness.diagnosis.search.fit import Fit, Suspect
from harness.diagnosis.search.outcome import Outcome
from harness.diagnosis.search.search import search
from harness.diagnosis.search.table import Accepted
from harness.diagnosis.search.ties import tie_set, total
from harness.effects.effect import Placed
from harness.physics.fitting.likelihood_fit import sensor_noise


def simple_fits_of(
    kind: ModelKind, form: WholeForm, nominal: Fit, candidates: Sequence[Placed], say: Callable[[str], None]
) -> SimpleFits | None:
    """Return output-error fits of the records that the likelihood judges; None where nothing compiled simulates them.

    Outputs are compared by what a straight line leaves of them, as the free runs of the report are.
    """
    whole = Horizon(None, "records are cut for the likelihood already")
    horizon = kind.horizon(form.nominal, nominal.values, form.dataset) if form.latent else whole
    runs = kind.runs(form, form.dataset, form.noise_model.output_scale, horizon)
    return SimpleFits(runs, nominal.values, candidates, say, form.laws) if type(runs) is FreeRunForm else None


def follows_whole(kind: ModelKind, form: WholeForm, policy: Policy = POLICY) -> bool:
    """Return True if whole free runs of the nominal model come as near to their records as the sensors read.

    Of a plant that loses its start, free runs are cut into windows; but over a window shorter than its time constants
    these are hardly told. Where nothing carries a run away, whole records tell all that they can.
    """
    runs = kind.runs(form, form.dataset, form.noise_model.output_scale, Horizon(None, "whole records"))
    if type(runs) is not FreeRunForm:
        return False
    simple, near = SimpleFits(runs, form.nominal.values()), policy.tie * sensor_noise(form.records["estimation"])
    errors = [simple.errors(values) for values in simple.scattered()]
    return any(error is not None and bool((error <= near).all()) for error in errors)


def carried(form: WholeForm, fit: Fit, policy: Policy, share: float | None = None) -> bool:
    """Return True if a latent force may carry a missing law, or a free run errs by more than its sensors do.

    ``share`` of the typical force is what it is then larger than: what counts as an effect unless another is given.
    """
    if form.latent:
        shares = latent_shares(fit, form.noise_model.force_scale)
        return bool((shares > (policy.disturbed if share is None else share)).any())
    noise = likelihood_detail(fit).points["estimation"].noise
    return bool((noise.r > policy.tie * sensor_noise(form.records["estimation"])).any())


def explains_nothing(form: WholeForm, outcome: Outcome, runs: FreeRuns, policy: Policy) -> bool:
    """Return True where what acts on the motion brings free runs no nearer and leaves the latent force as it was.

    A law of the plant does the one or the other. What only makes the innovations whiter is the law of something else,
    whose force is still there. A sensor moves nothing.
    """
    if all(set(accepted.placed.effect.kinds) == {"output"} for accepted in outcome.accepted):
        return False
    scale = form.noise_model.force_scale
    before, after = (float(np.linalg.norm(latent_shares(fit, scale))) for fit in (outcome.nominal, outcome.model))
    return not runs.nearer(policy) and after >= before


def at_optimum(
    remembered: Remembered, form: WholeForm, nominal: Fit, simple: SimpleFits | None, policy: Policy = POLICY
) -> Fit:
    """Return the nominal fit, begun again from where free runs come nearest if it may have ended beside its maximum.

    Where some state is told by no output, many starts around the declared values are tried as well.
    """
    if simple is None or not carried(form, nominal, policy):
        return nominal
    starts = [] if simple.nominal is None else [simple.nominal.values]
    if len(form.first_starts()) == 1:  # nothing but the declared values tells where to start
        starts += simple.scattered()
    best = nominal
    for start in starts:
        fit = remembered.fit((), [start], None)
        if fit is not None and fit.penalised > best.penalised + policy.tie:
            best = fit
    return best


def proposals_of(
    form: WholeForm, nominal: Fit, simple: SimpleFits | None, candidates: Sequence[Placed], policy: Policy
) -> Callable[[], list[Suspect]]:
    """Return what tells what free runs propose to a search: nothing where no latent force may carry a missing law."""
    if simple is None or not candidates or not form.latent or not carried(form, nominal, policy, policy.large):
        return list
    return functools.partial(simple.proposals, policy)


def uncontested(
    remembered: Remembered,
    outcome: Outcome,
    simple: SimpleFits | None,
    candidates: Sequence[Placed],
    policy: Policy,
    say: Callable[[str], None],
    sizes: Mapping[str, Mapping[str, float]],
) -> tuple[Outcome, str]:
    """Return an answer that does not lose, in free runs of the validation records, to the best fit with one effect.

    Where it does, that effect takes its place if the likelihood accepts it, and the search goes on from there as long
    as that is not lost again. Where free runs are all that judges, it only denies the answer.

    Returns
    -------
    outcome : Outcome
    rival : str
        The effect to which the answer loses by half of what the nominal model leaves, as the likelihood accepts nothing
        that does not lose; else empty.
    """
    form = remembered.form
    if simple is None or simple.nominal is None:
        return outcome, ""
    # of a motion that lasts, a small force makes all that a free run misses
    if not carried(form, outcome.model, policy) and simple.left(outcome.model) <= policy.explained:
        return outcome, ""
    say("against simple fits")
    best = _rival(simple, outcome.model, policy)
    if best is None:
        return outcome, ""
    replaced = _with_rival(remembered, outcome, simple, policy) if form.latent else None
    if replaced is None:  # of many simple fits to a disturbed record some run a little nearer by chance
        clear = simple.further(simple.seen(outcome.model), best.fitted, policy, policy.proxy)
        return outcome, best.name if clear else ""
    further = search(remembered, replaced.nominal, candidates, policy=policy, say=say, sizes=sizes, begun=replaced)
    lost = simple.further(simple.seen(further.model), simple.seen(replaced.model), policy)
    return (replaced if lost else further), ""


def nearer(simple: SimpleFits | None, new: Fit, old: Fit, policy: Policy) -> bool:
    """Return True if free runs of one model come nearer to the validation records than another's, by a clear share.

    By half of what the nominal model leaves, as a rival has to.
    """
    return simple is not None and simple.further(simple.seen(old), simple.seen(new), policy, policy.proxy)


def _rival(simple: SimpleFits, model: Fit, policy: Policy) -> SimpleFit | None:
    """Return the fit with one effect to which a model loses, as it was fitted and as free runs would have it."""
    best = min(simple.table, key=lambda fit: fit.error("validation"), default=None)
    if best is None or not simple.further(simple.seen(model), best.fitted, policy):
        return None
    again = simple.refitted(model)
    return best if simple.further(None if again is None else again.fitted, best.fitted, policy) else None


def _with_rival(remembered: Remembered, outcome: Outcome, simple: SimpleFits, policy: Policy) -> Outcome | None:
    """Return an outcome with the simple fit in the place of the answer that the likelihood accepts; None if none.

    The likeliest of those that run nearer to the validation records than the answer, also with the parameters that
    the likelihood gives them.
    """
    mine, passed = simple.seen(outcome.model), list[Judged]()
    for near in sorted(simple.table, key=lambda fit: fit.error("validation"))[: EFFORT.refits]:
        if not simple.further(mine, near.fitted, policy):
            break
        fit = remembered.fit(near.effects, [near.values], outcome.nominal)
        row = judged(remembered, near.effects, fit, outcome.nominal, outcome.nominal, policy)
        if row.passed and fit is not None and simple.further(mine, simple.seen(fit), policy):
            passed.append(row)
    if not passed:
        return None
    best = max(passed, key=total)
    assert best.fit is not None
    assert best.comparison is not None
    gains = best.comparison.evidence, best.comparison.validation
    accepted = Accepted(best.added[0], tie_set(remembered, best, passed, policy), *gains)
    return Outcome(remembered, outcome.nominal, best.fit, (accepted,), outcome.rounds[:1])
