"""Steps of the closed loop, each by itself: the form to judge by, the nominal fit, candidates, free runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from harness.diagnosis.contested import explains_nothing, follows_whole
from harness.diagnosis.dictionary import Laws, placed
from harness.diagnosis.forms.fit_records import reading_noise
from harness.diagnosis.forms.form import WholeForm
from harness.diagnosis.forms.remembered import Remembered
from harness.diagnosis.kinds import ModelKind
from harness.diagnosis.policy import Policy
from harness.diagnosis.records.columns_check import Doubt
from harness.diagnosis.records.stretches import stretched, windowed
from harness.diagnosis.records.thinning import Thinned
from harness.diagnosis.runs.compare import FreeRuns, free_runs
from harness.diagnosis.runs.simple_fits import SimpleFits
from harness.diagnosis.search.compare import impossible, judged
from harness.diagnosis.search.fit import Fit, of_nothing
from harness.diagnosis.search.leftover import Leftover, left_over
from harness.diagnosis.search.outcome import Outcome
from harness.diagnosis.search.refusal import Kind as Reason
from harness.diagnosis.search.refusal import Refusal
from harness.diagnosis.search.table import Accepted
from harness.diagnosis.systems import AnySystem
from harness.effects.dictionary import Dictionary
from harness.effects.effect import Placed
from harness.errors import FitError
from harness.physics.definition.parameters import FAR, said_far
from harness.signals import Dataset, FloatArray

Progress = Callable[[float, str], None]


class Say(Protocol):
    """Tells of the next step."""

    def __call__(self, what: str, part: float | None = None) -> None:
        """Tell what comes, and which part of all is done; without a part it moves on by itself."""


def teller(progress: Progress | None) -> Say:
    """Return what tells ``progress`` of every step."""
    parts = iter(0.75 * (1.0 - 0.9**k) for k in range(1, 10_000))

    def say(what: str, part: float | None = None) -> None:
        if progress is not None:
            progress(next(parts) if part is None else part, what)

    return say


def again_by_free_runs(progress: Progress | None) -> Progress | None:
    """Return what tells of a second diagnosis in the last tenth of the work."""
    return None if progress is None else lambda part, what: progress(0.8 + 0.1 * part, f"by free runs: {what}")


def form_of(
    kind: ModelKind, system: AnySystem, dataset: Dataset, policy: Policy, laws: Dictionary
) -> tuple[WholeForm, list[str]]:
    """Return the likelihood of the data, in stretches that are judged one by one, and warnings about these."""
    judged = stretched(stretched(dataset), use="validation")
    form = kind.form(system, judged, laws)
    if not form.latent and not follows_whole(kind, form, policy):  # a plant that loses its start
        horizon = kind.horizon(system, system.values(), judged)
        whole = windowed(judged, horizon.seconds and policy.window * horizon.seconds)
        form = kind.form(system, whole, laws)
    return form, list(judged.warnings)


def nominal_fit(remembered: Remembered, form: WholeForm, doubts: Sequence[Doubt]) -> Fit:
    """Return the nominal model at its maximum, sizes of the form taken from there.

    Raises FitError if it cannot be simulated along the data.
    """
    nominal = remembered.fit((), form.first_starts(), None)
    if nominal is None:
        raise FitError(
            f"the nominal model {form.nominal.name}",
            expected="start values from which it can be simulated along the data",
            got="a state that diverges",
            remedy="; ".join(doubt.words for doubt in doubts)
            or "check signs and units of the columns, or give start values nearer to the plant",
        )
    if form.resize(nominal):
        nominal = remembered.fit((), [nominal.values], nominal) or nominal
    return nominal


def candidates_of(form: WholeForm, laws: Laws) -> tuple[list[Placed], list[str]]:
    """Return the effects that the form can judge at the ports of the nominal model, and what is wrong with plug-ins."""
    candidates, faults = placed(
        form.nominal,
        laws,
        composed=lambda effects: form.composed(effects) if all(map(form.judges, effects)) else None,
    )
    return [candidate for candidate in candidates if form.judges(candidate)], faults


def what_free_runs_say(
    kind: ModelKind,
    form: WholeForm,
    outcome: Outcome,
    dataset: Dataset,
    policy: Policy,
    say: Say,
    simple: SimpleFits | None = None,
    *,
    share: FloatArray,
    whole: Remembered | None = None,
) -> tuple[Outcome, FreeRuns, Leftover]:
    """Return the outcome that stands, free runs before and after, and what is left of the final model.

    They are compared along all readings; the noise of those that the form judges is this ``share`` (ny,) of theirs.
    Accepted effects with which the model runs further from the data than the nominal one at its nearest are taken back,
    those that explain nothing, and those of which nothing is told once the colour of errors counts. Where free runs are
    all that judges, they must come nearer.
    """
    runs = run_freely(kind, form, outcome, dataset, simple, share)
    say("what is left", 0.8)
    leftover = what_is_left(form, whole, outcome, policy)
    idle = explains_nothing(form, outcome, runs, policy) if form.latent else runs.idle(policy)
    denied = runs.worse(policy) or idle or untold(form, outcome)
    if not denied or any(one.given for one in outcome.accepted):  # what is given is not taken back
        return outcome, runs, leftover
    outcome = outcome.taken_back(0.0 if runs.worse(policy) else policy.misfit_gain)
    runs = run_freely(kind, form, outcome, dataset, simple, share)
    return outcome, runs, what_is_left(form, whole, outcome, policy)


def lawful(remembered: Remembered, outcome: Outcome, policy: Policy) -> Outcome:
    """Return an outcome without the effects that end where their laws do, and what does not stand without these.

    On a bound, or of a sign that it does not have, a law is another one: it stood in for what was found beside it, or
    for what no law of the dictionary is.
    """
    form, left = remembered.form, outcome
    for one in outcome.accepted:
        broken = [why for why in impossible(form, one.placed, left.model) if why.kind is not Reason.UNDETERMINED]
        if broken and not one.given:
            left = _without(remembered, left, one, broken[0])
    if left is outcome:
        return outcome
    for one in tuple(left.accepted):
        base = _without(remembered, left, one, Refusal(Reason.WITHDRAWN)).model
        row = judged(form, [one.placed], left.model, base, left.nominal, policy)
        if not row.passed and not one.given:
            left = _without(remembered, left, one, row.refusals[0])
    return left


def _without(remembered: Remembered, outcome: Outcome, gone: Accepted, why: Refusal) -> Outcome:
    """Return an outcome without one of its effects, the others fitted anew; as it was if they cannot be."""
    rest = [placed for placed in outcome.model.effects if str(placed) != str(gone.placed)]
    starts = [outcome.model.values, {**outcome.model.values, **outcome.nominal.values}]
    model = remembered.fit(rest, starts, outcome.model) if rest else outcome.nominal
    return outcome if model is None else outcome.dropped(gone, model, why)


def untold(form: WholeForm, outcome: Outcome) -> bool:
    """Return whether an accepted effect cannot be told from none where deviations count how errors are coloured."""
    model = form.with_deviations(outcome.model)
    return model is not outcome.model and any(
        refusal.kind is Reason.UNDETERMINED
        for accepted in outcome.accepted
        for refusal in impossible(form, accepted.placed, model)
    )


def run_freely(
    kind: ModelKind, form: WholeForm, outcome: Outcome, dataset: Dataset, simple: SimpleFits | None, share: FloatArray
) -> FreeRuns:
    """Return free runs of an outcome, before and after, along all readings; arguments as above."""
    horizon = kind.horizon(form.nominal, outcome.nominal.values, dataset)
    output = kind.runs(form, dataset, reading_noise(outcome.model) / share, horizon)
    nearest = simple.nominal.values if simple is not None and form.latent and simple.nominal is not None else None
    return free_runs(output, horizon, outcome.nominal, outcome.model, nearest)


def all_readings(
    kind: ModelKind, form: WholeForm, thinned: Thinned, dataset: Dataset, policy: Policy, folder: Path | None
) -> Remembered | None:
    """Return the likelihood of all readings where the search looks at fewer; None elsewhere."""
    if thinned.factor == 1:
        return None
    return Remembered(form_of(kind, form.nominal, dataset, policy, form.laws)[0], folder)


def what_is_left(form: WholeForm, whole: Remembered | None, outcome: Outcome, policy: Policy) -> Leftover:
    """Return what can still be predicted of the final model's innovations.

    Without unmeasured forces of all readings, where the search looked at fewer: an input that is thinned passes a bend,
    of a drive or of an outlet, otherwise than as it was, and what that leaves would be missing.
    """
    if whole is not None and not form.latent:
        found = whole.anew(outcome.model)
        if found is not None and found.converged:
            return left_over(whole, found, policy)
    return left_over(form, outcome.model, policy)


def with_day(form: WholeForm, outcome: Outcome) -> Outcome:
    """Return an outcome whose model has the friction and the zeros of the day of the validation records there."""
    model = form.with_day(outcome.model)
    return outcome if model is outcome.model else replace(outcome, model=model)


def asked_by_all_readings(thin: Remembered, whole: Remembered | None, outcome: Outcome, policy: Policy) -> Outcome:
    """Return an outcome without the effects that only the rate of the search asked for: all readings gain too little.

    A thinned input takes a mass where it was, but passes a bend, of a drive or of an outlet, otherwise than it did, and
    a second effect takes up what that leaves.
    """
    bends = not thin.form.latent or any("input" in one.placed.effect.kinds for one in outcome.accepted)
    if whole is None or not bends or len(outcome.accepted) < 2:
        return outcome
    found = whole.anew(outcome.model)
    for one in reversed(outcome.accepted):
        rest = [placed for placed in outcome.model.effects if str(placed) != str(one.placed)]
        model = None if one.given or not rest else thin.fit(rest, [outcome.model.values], outcome.model)
        if found is None or model is None:
            continue
        fewer = whole.fit(rest, [model.values, found.values], None)
        if fewer is None or not fewer.converged or any(impossible(whole, placed, fewer) for placed in rest):
            continue
        gain = found.penalised - fewer.penalised
        if gain < policy.evidence:
            why = Refusal(Reason.FULL_RATE, str(one.placed), (gain, policy.evidence))
            outcome, found = outcome.dropped(one, model, why), fewer
    return outcome


def at_full_rate(whole: Remembered | None, outcome: Outcome) -> Outcome:
    """Return an outcome whose model has the values that all readings tell, as sure as these make them.

    The search looks at fewer: they tell a law as well, and beside exact sensors its size half as sharply. Initial
    states and unmeasured forces begin anew: those of the fewer belong to other instants, and lead a model that leaves
    nothing unexplained astray. One that does not come to its end, or to what physics allows, stays as it was.

    - ``whole``: the likelihood of all readings; without it the outcome stays as it is
    """
    fit = outcome.model
    found = None if whole is None else whole.anew(fit)
    if whole is None or found is None or not found.converged:
        return outcome
    if any(impossible(whole, one, found) for one in fit.effects):
        return outcome
    # the system has their bounds
    told = "system", "values", "deviations", "beside", "logarithmic", "on_bound", "own"
    model = replace(fit, **{name: getattr(found, name) for name in told})
    return replace(outcome, nominal=model if fit is outcome.nominal else outcome.nominal, model=model)


def widened(form: WholeForm, outcome: Outcome) -> Outcome:
    """Return an outcome whose fits have deviations that count how their errors are coloured."""
    nominal = form.with_deviations(outcome.nominal)
    model = nominal if outcome.model is outcome.nominal else form.with_deviations(outcome.model)
    return replace(outcome, nominal=nominal, model=model)


def sizes_off(system: AnySystem, fit: Fit, factor: float = FAR) -> list[str]:
    """Return a warning about parameters that the data determine, and a factor from what was declared."""
    far = fit.far_off(system.parameters, factor)
    return [f"{said_far(far)}. If the plant is that size, give the model such values"] if far else []


def over_nothing(fit: Fit) -> list[str]:
    """Return warnings about effects whose size, with the values that are shown, may be nothing at all.

    What was accepted was told beside fewer readings, or before the rounding of the sensors was known.
    """
    return [
        f"the 95 % interval of {one.main()}, {low:.3g} to {high:.3g}, holds {main.neutral:g}: by all readings "
        f"{one.effect.name.replace('_', ' ')} may not be there"
        for one, (low, high) in of_nothing(fit)
        if (main := one.effect.main) is not None
    ]


def day_warnings(fit: Fit, runs: FreeRuns) -> list[str]:
    """Return warnings about friction and zeros of instruments that are others on the day of the validation records."""
    return [
        f"{name} differs between the records, as from one day to another: it is {fit.values[name]:.3g} on the "
        f"estimation records and about {level:.3g} on the validation records, whose figures use that"
        for name, level in ({} if runs.after is None else runs.after.refitted).items()
        if name in fit.day
    ]


def beaten(rival: str) -> list[str]:
    """Return a warning about an effect to which the answer loses in free runs."""
    if not rival:
        return []
    return [
        f"{rival} alone, fitted to free runs, comes nearer to the validation records than this answer does, and the "
        "likelihood does not accept it: what is missing is not in the dictionary, or these data do not tell it"
    ]
