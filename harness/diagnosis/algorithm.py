"""The closed loop, step by step: fit, ask whether the model fits at all, search, grade what is left."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from harness.diagnosis.dictionary import placed
from harness.diagnosis.kinds import Equations, Kind
from harness.diagnosis.misfit import misfit_reasons, mostly_noise
from harness.diagnosis.policy import PLAN_POLICY, POLICY, Policy
from harness.diagnosis.records.prepare import checked
from harness.diagnosis.records.stretches import stretched, windowed
from harness.diagnosis.runs.compare import FreeRuns, free_runs
from harness.diagnosis.search.apart import Apart
from harness.diagnosis.search.fit import Fit
from harness.diagnosis.search.leftover import Leftover, left_over
from harness.diagnosis.search.likelihood_form import LikelihoodForm
from harness.diagnosis.search.remembered import Remembered
from harness.diagnosis.search.rounding import add_rounding
from harness.diagnosis.search.rounds import Outcome, search
from harness.diagnosis.search.score_test import Lead, ScoreTest
from harness.effects.effect import Effect, Placed
from harness.errors import FitError
from harness.signals import Dataset
from harness.workers import one_thread

__all__ = ["DRY", "Diagnosis", "Progress", "diagnose", "stand_in_reasons"]

Progress = Callable[[float, str], None]
WORSE = "with it the model runs further from the validation records than without, and something is left"
MOVED = (
    "Free runs of the validation records err more with the accepted effects than without them, though nothing is left "
    "that could be predicted: an unknown force moves these runs more than the effects do, and one error may cancel "
    "another by chance. What was accepted rests on the likelihood, one step ahead."
)
DRY = frozenset({"coulomb_friction", "stribeck_friction", "asymmetric_friction", "hysteresis",
                 "position_dependent_friction", "sublinear_friction",
                 "yield_friction"})  # fmt: skip
"""Laws of the whole dry friction of a joint: a sum of two is neither."""


@dataclass(eq=False)
class Diagnosis:
    """Everything that one diagnosis found out, for the reports."""

    dataset: Dataset
    system: Any
    form: LikelihoodForm
    outcome: Outcome
    leftover: Leftover
    runs: FreeRuns
    misfit: tuple[str, ...]
    policy: Policy
    warnings: list[str] = field(default_factory=list)
    seconds: float = 0.0
    apart: Apart | None = None
    doubtful: bool = False
    """True where a unit may be wrong, though the model fits as it is."""

    @property
    def nominal(self) -> Fit:
        """The nominal model at its maximum."""
        return self.outcome.nominal

    @property
    def final(self) -> Fit:
        """The model with the accepted effects (the nominal one if none was accepted)."""
        return self.outcome.model

    @property
    def test(self) -> ScoreTest:
        """The dictionary against the nominal model: what this experiment can show, and tell apart."""
        return self.outcome.rounds[0].test

    @property
    def not_visible(self) -> list[Lead]:
        """Effects that the nominal parameters and initial states can do as well: these data do not show them."""
        first = self.outcome.rounds[0].candidates
        shown = {
            candidate.name
            for candidate in first
            if candidate.comparison and candidate.comparison.evidence >= self.policy.evidence
        }
        shown |= {str(accepted.placed) for accepted in self.outcome.accepted}
        faint = [lead for lead in self.test.leads if lead.share < PLAN_POLICY.visible and str(lead.placed) not in shown]
        return sorted([*self.test.hidden, *faint], key=lambda lead: str(lead.placed))

    @property
    def verdict(self) -> str:
        """See diagnosis: model_does_not_fit, effects_found, unexplained, nothing_missing."""
        if self.misfit:
            return "model_does_not_fit"
        if self.outcome.accepted:
            return "effects_found"
        return "unexplained" if self.incomplete else "nothing_missing"

    @property
    def incomplete(self) -> bool:
        """True where something is left: that could be predicted, that no effect takes away, or between the uses."""
        left = self.leftover.best is not None or self.latent_share > self.policy.large
        refused = not self.outcome.accepted and self.outcome.promised(self.policy) is not None
        return left or refused or bool(self.outcome.withdrawn) or self.disagree

    @property
    def disagree(self) -> bool:
        """True where the validation records want other parameters than the estimation records."""
        return self.apart is not None and self.apart.matters(self.policy)

    @property
    def grade(self) -> str:
        """How much of the motion the final model explains over the horizon, and whether more could be predicted."""
        if self.misfit:
            return "does_not_fit"
        if self.incomplete:
            return "proxy_or_incomplete"
        quiet = self.latent_share <= self.policy.disturbed and not self.runs.worse(self.policy)
        good = quiet and self.runs.left <= self.policy.explained and not (self.stand_in or self.doubtful)
        return "explained" if good else "mostly_explained"

    @property
    def structure_fits(self) -> bool:
        """False where the final model lacks something that could be predicted: its intervals do not count that."""
        return self.grade in ("explained", "mostly_explained")

    @property
    def latent_share(self) -> float:
        """Size of the latent force of the final model over the typical force, the largest of all ports."""
        noise = self.final.detail.points["estimation"].noise
        size = (noise.s**2 + noise.w**2) ** 0.5 / self.form.noise_model.force_scale
        return float(size.max(initial=0.0))

    @functools.cached_property
    def stand_in(self) -> tuple[str, ...]:
        """Why accepted effects imitate something that is not in the dictionary; empty if nothing says so."""
        best = self.leftover.best
        reasons = stand_in_reasons(
            [accepted.placed for accepted in self.outcome.accepted], None if best is None else best.name
        )
        unlawful = self.outcome.unlawful(self.policy) if self.outcome.accepted else None
        if unlawful is None:
            return reasons
        return (*reasons, f"{unlawful.name} explains the records better, with values that its own physics forbids")


def stand_in_reasons(accepted: Sequence[Placed], left: str | None) -> tuple[str, ...]:
    """Return why accepted effects imitate something else; ``left`` names the axis of a force that still predicts."""
    reasons = []
    for place in dict.fromkeys(law.at for law in accepted):
        dry = [law.effect.name.replace("_", " ") for law in accepted if law.at == place and law.effect.name in DRY]
        if len(dry) > 1:
            reasons.append(
                f"the friction at {place} is none of the dictionary's laws: {' and '.join(dry)} together imitate it"
            )
    if accepted and left is not None:
        reasons.append(f"what is left can still be predicted, as a force at {left}")
    return tuple(reasons)


def diagnose(
    dataset: Dataset,
    system: Any,
    *,
    kind: Kind | None = None,
    progress: Progress | None = None,
    folder: Path | None = None,
    dictionary: Sequence[Effect] | None = None,
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
    policy : Policy
        The deciding numbers.

    Raises
    ------
    InputError
        If the data do not fit the model.
    FitError
        If the nominal model cannot be simulated along the data.
    """
    began = time.monotonic()
    parts = iter(0.75 * (1.0 - 0.9**k) for k in range(1, 10_000))

    def say(what: str, part: float | None = None) -> None:
        if progress is not None:
            progress(next(parts) if part is None else part, what)

    with one_thread():
        kind = kind or Equations()
        dataset, doubts = kind.prepared(checked(dataset, system), system)
        wrong = [doubt.words for doubt in doubts if doubt.certain]
        judged = stretched(stretched(dataset), use="validation")
        warnings = [*(doubt.words for doubt in doubts if not doubt.certain), *judged.warnings]
        form = kind.form(system, judged)
        if not form.latent:  # a plant that loses its start cannot be judged by whole free runs
            horizon = kind.horizon(system, system.values(), judged)
            form = kind.form(system, windowed(judged, horizon.seconds and policy.window * horizon.seconds))
        remembered = Remembered(form, folder)
        say("first fit of the nominal model", 0.02)
        nominal = remembered.fit((), form.first_starts(), None)
        if nominal is None:
            raise FitError(
                f"the nominal model {system.name}",
                expected="start values from which it can be simulated along the data",
                got="a state that diverges",
                remedy="; ".join(doubt.words for doubt in doubts)
                or "check signs and units of the columns, or give start values nearer to the plant",
            )
        if form.resize(nominal):
            nominal = remembered.fit((), [nominal.values], nominal) or nominal
        wrong += mostly_noise(form, nominal, policy)
        candidates, faults = placed(
            system,
            dictionary,
            composed=lambda effects: form.composed(effects) if all(map(form.judges, effects)) else None,
        )
        candidates = [] if wrong else [candidate for candidate in candidates if form.judges(candidate)]
        outcome = search(remembered, nominal, candidates, policy=policy, say=say)
        add_rounding(remembered, outcome, dataset, candidates, policy)
        horizon = kind.horizon(system, outcome.nominal.values, dataset)

        def run_freely() -> FreeRuns:
            noise = outcome.model.detail.points["estimation"].noise.r
            return free_runs(kind.runs(form, dataset, noise, horizon), horizon, outcome.nominal, outcome.model)

        runs = run_freely()
        say("what is left", 0.8)
        leftover = left_over(form, outcome.model, policy)
        if leftover.best is not None and runs.worse(policy):
            outcome.withdraw(WORSE)
            runs, leftover = run_freely(), left_over(form, outcome.model, policy)
        elif runs.worse(policy):
            warnings = [*warnings, MOVED]
        same = outcome.model is outcome.nominal
        outcome.nominal = form.with_deviations(outcome.nominal)
        outcome.model = outcome.nominal if same else form.with_deviations(outcome.model)
        misfit = misfit_reasons(form, outcome.model, runs, policy, wrong)
        apart = form.apart(outcome.model)
    if outcome.withdrawn:
        names = ", ".join(str(accepted.placed) for accepted in outcome.withdrawn)
        warnings = [*warnings, f"{names}: likely by the likelihood and taken back: {WORSE}"]
    diagnosis = Diagnosis(
        dataset,
        system,
        form,
        outcome,
        leftover,
        runs,
        misfit,
        policy,
        warnings + faults,
        time.monotonic() - began,
        apart,
        doubtful=bool(doubts),
    )
    if apart is not None and diagnosis.disagree:
        diagnosis.warnings.append(apart.words(outcome.model.values))
    return diagnosis
