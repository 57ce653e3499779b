"""The closed loop, step by step: fit, ask whether the model fits at all, search, grade what is left."""

from __future__ import annotations

import functools
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from harness.diagnosis.contested import at_optimum, proposals_of, simple_fits_of, uncontested
from harness.diagnosis.diagnosis import Diagnosis
from harness.diagnosis.dictionary import laws_of
from harness.diagnosis.forms.fit_records import reading_noise
from harness.diagnosis.forms.remembered import Remembered
from harness.diagnosis.kinds import EquationsKind, ModelKind
from harness.diagnosis.misfit import likely_mistakes, misfit_reasons, mostly_noise
from harness.diagnosis.policy import DATA_POLICY, POLICY, Policy
from harness.diagnosis.records.columns_check import Doubt
from harness.diagnosis.records.controller_check import check_controller
from harness.diagnosis.records.prepare import checked
from harness.diagnosis.records.starts import with_known_starts
from harness.diagnosis.search.outcome import Outcome
from harness.diagnosis.search.rounding import with_rounding
from harness.diagnosis.search.search import search
from harness.diagnosis.second import Hope, halved, searched_unless_carried, second_opinion
from harness.diagnosis.steps import (
    Progress,
    again_by_free_runs,
    all_readings,
    asked_by_all_readings,
    at_full_rate,
    beaten,
    candidates_of,
    day_warnings,
    form_of,
    lawful,
    nominal_fit,
    over_nothing,
    run_freely,
    sizes_off,
    teller,
    what_free_runs_say,
    widened,
    with_day,
)
from harness.diagnosis.systems import AnySystem
from harness.diagnosis.wanted import Wanted
from harness.effects.effect import Effect
from harness.signals import Dataset
from harness.supervision.workers import one_thread


def diagnose(
    dataset: Dataset,
    system: AnySystem,
    *,
    kind: ModelKind | None = None,
    progress: Progress | None = None,
    folder: Path | None = None,
    dictionary: Sequence[Effect] | None = None,
    wanted: Wanted | None = None,
    policy: Policy = POLICY,
) -> Diagnosis:
    """Run the closed loop and return all that it found, without writing a report.

    Parameters
    ----------
    dataset : Dataset
        With estimation and validation runs; test runs are scored at the end and influence nothing.
    system : System
        The nominal model, measured as the data are.
    kind : Kind, optional
        How such a model is prepared, fitted and simulated; by default one given by its equations.
    progress : callable, optional
        Called as ``progress(fraction_done, what)``.
    folder : Path, optional
        Where finished refits are kept, for ``resume``.
    dictionary : sequence of Effect, optional
        By default the built-in effects and those of installed plug-ins.
    wanted : Wanted, optional
        Which of them are given, tried and left out.
    policy : Policy
        The deciding numbers.

    Raises
    ------
    InputError
        If the data do not fit the model.
    FitError
        If the nominal model cannot be simulated along the data.
    """
    found = _diagnosed(
        dataset, system, kind or EquationsKind(), progress, folder, dictionary, wanted or Wanted(), policy
    )
    assert found is not None, "nothing was asked of its search"
    _add_doubts(found)
    return found


def _diagnosed(
    dataset: Dataset,
    system: AnySystem,
    kind: ModelKind,
    progress: Progress | None,
    folder: Path | None,
    dictionary: Sequence[Effect] | None,
    wanted: Wanted,
    policy: Policy,
    hope: Hope | None = None,
) -> Diagnosis | None:
    """Return what the closed loop found; None where there is no ``hope`` for what its search did."""
    began, say = time.monotonic(), teller(progress)
    with one_thread():
        # fit
        dataset, doubts = kind.prepared(with_known_starts(checked(dataset, system)), system)
        doubts = [*check_controller(dataset, system), *doubts]
        laws = laws_of(dictionary)
        thinned = kind.thinned(dataset)
        form, cut = form_of(kind, system, thinned.dataset, policy, laws.dictionary)
        candidates, faults = candidates_of(form, laws)
        given, candidates = wanted.chosen(candidates)  # a wrong name is refused before anything is kept
        remembered = Remembered(form, folder)
        say("first fit of the nominal model", 0.02)
        nominal = nominal_fit(remembered, form, doubts)
        simple = simple_fits_of(kind, form, nominal, candidates, say)
        nominal = at_optimum(remembered, form, nominal, simple, policy)
        # search, unless the records are wrong
        wrong = [*(doubt.words for doubt in doubts if doubt.certain), *mostly_noise(form, nominal, policy)]
        given, candidates = ([], []) if wrong else (given, candidates)
        remembered.proposed = proposals_of(form, nominal, simple, candidates, policy)
        looking, rival, other = not (wrong or given), "", kind.by_free_runs()

        @functools.cache
        def again(*, halves: bool = False, hope: Hope | None = None) -> Diagnosis | None:
            assert other is not None
            data, told = halved(dataset) if halves else dataset, again_by_free_runs(progress)
            return _diagnosed(data, system, other, told, folder, dictionary, wanted, policy, hope)

        asked = again if looking and form.latent and other is not None else None
        searched = functools.partial(
            search, remembered, nominal, candidates, policy=policy, say=say, sizes=form.sizes, given=given
        )
        outcome, instead = searched_unless_carried(form, nominal, policy, searched, asked)
        if instead is not None:
            return replace(instead, seconds=time.monotonic() - began)
        if hope is not None and not hope(outcome):
            return None
        outcome = lawful(remembered, outcome, policy)
        # what drifts in the free runs of a process is followed by any slow law: there no other fit denies an answer
        if looking and (form.latent or other is None):
            outcome, rival = uncontested(remembered, outcome, simple, candidates, policy, say, form.sizes)
        share = np.array(thinned.noise)
        whole = None if wrong else all_readings(kind, form, thinned, dataset, policy, folder)
        outcome = asked_by_all_readings(remembered, whole, outcome, policy)
        outcome = at_full_rate(whole, with_day(form, outcome))
        # grade what is left
        outcome, runs, leftover = what_free_runs_say(
            kind, form, outcome, dataset, policy, say, simple, share=share, whole=whole
        )
        rounded = with_rounding(
            remembered, outcome, dataset, candidates, policy, noise_of=lambda fit: reading_noise(fit) / share
        )
        if rounded is not outcome:  # named last: a rounded prediction errs by its own rounding, which denies nothing
            rounded = at_full_rate(whole, with_day(form, rounded))
            outcome, finer = rounded, run_freely(kind, form, rounded, dataset, simple, share)
            runs = runs if finer.worse(policy) else finer
        outcome = widened(form, outcome)
        misfit = misfit_reasons(form, outcome.nominal, outcome.model, runs, policy, wrong, factor=thinned.factor)
        apart = form.apart(outcome.model)
        alarms = _alarms(doubts, system, outcome)
        far = sizes_off(system, outcome.model, DATA_POLICY.far * DATA_POLICY.near)
    diagnosis = Diagnosis(
        dataset,
        system,
        form,
        outcome,
        leftover,
        runs,
        misfit,
        policy,
        [*alarms, *cut, *beaten(rival), *over_nothing(outcome.model), *day_warnings(outcome.model, runs), *faults],
        time.monotonic() - began,
        apart,
        doubtful=bool(doubts or far),
        alarms=tuple(alarms),
        rival=rival,
        thinned=thinned,
        wanted=wanted,
    )
    instead = None if asked is None else second_opinion(diagnosis, simple, asked)
    return diagnosis if instead is None else replace(instead, seconds=time.monotonic() - began)


def _alarms(doubts: Sequence[Doubt], system: AnySystem, outcome: Outcome) -> list[str]:
    """Return what may be wrong with columns, or where nothing is said of them with the sizes that were declared."""
    return [doubt.words for doubt in doubts if not doubt.certain] if doubts else sizes_off(system, outcome.model)


def _add_doubts(diagnosis: Diagnosis) -> None:
    """Add warnings of what the two uses want apart, and of columns that may be wrong though the model follows them."""
    model, factor = diagnosis.final, 1 if diagnosis.thinned is None else diagnosis.thinned.factor
    if diagnosis.apart is not None and diagnosis.disagree:
        diagnosis.warnings.append(diagnosis.apart.words(model.values))
    if diagnosis.verdict == "unexplained" or (diagnosis.stand_in and not diagnosis.misfit):
        with one_thread():
            diagnosis.warnings += likely_mistakes(
                diagnosis.form, diagnosis.outcome.nominal, model, diagnosis.policy, factor
            )
