"""What a diagnosis found out: the answer, how far it goes, and what it rests on."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field

import numpy as np

from harness.diagnosis.forms.apart import Apart
from harness.diagnosis.forms.fit_records import latent_shares, reading_noise
from harness.diagnosis.forms.form import WholeForm
from harness.diagnosis.policy import PLAN_POLICY, Policy
from harness.diagnosis.records.thinning import Thinned
from harness.diagnosis.runs.compare import FreeRuns
from harness.diagnosis.search.compare import Judged
from harness.diagnosis.search.fit import Fit, Jump, of_nothing
from harness.diagnosis.search.leftover import Axis, Leftover
from harness.diagnosis.search.outcome import Outcome
from harness.diagnosis.search.scores import Lead, ScoreTest
from harness.diagnosis.stand_in import stand_in_reasons, traded
from harness.diagnosis.systems import AnySystem
from harness.diagnosis.wanted import Wanted
from harness.signals import Dataset, FloatArray


@dataclass(eq=False)
class Diagnosis:
    """Everything that one diagnosis found out, for the reports."""

    dataset: Dataset
    system: AnySystem
    form: WholeForm
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
    alarms: tuple[str, ...] = ()
    """What a reader must know before anything else: a unit or a column that may be wrong, or why free runs judged the
    model where a likelihood would. They are warnings too."""
    rival: str = ""
    """An effect that alone comes nearer to the validation records in free runs, and that the likelihood refuses."""
    thinned: Thinned | None = None
    """The data at the rate at which the likelihood looks at them."""
    wanted: Wanted = field(default_factory=Wanted)
    """What the run gave of the dictionary, tried and left out."""

    @property
    def nominal(self) -> Fit:
        """The nominal model at its maximum."""
        return self.outcome.nominal

    @property
    def final(self) -> Fit:
        """The model with the accepted effects (the nominal one if none was accepted)."""
        return self.outcome.model

    def sensor_noise(self, fit: Fit) -> FloatArray:
        """Return the standard deviation of the noise of the readings, as they are in the data (ny,)."""
        share = 1.0 if self.thinned is None else np.array(self.thinned.noise)
        return np.asarray(reading_noise(fit) / share)

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
        if self.found or (self.outcome.accepted and not self.incomplete):
            return "effects_found"
        return "unexplained" if self.incomplete else "nothing_missing"

    @property
    def found(self) -> bool:
        """True where an effect was accepted that does something; that a sensor rounds stands in for nothing."""
        return any(accepted.placed.effect.sampled != "quantise" for accepted in self.outcome.accepted)

    @property
    def untried(self) -> list[str]:
        """Effects that were not tried to the end, alone or beside what was found, as that would have cost too much."""
        return self.form.left_out()

    @property
    def incomplete(self) -> bool:
        """True where something is left, or effects were not tried and nothing was found."""
        return self.lacking or bool(self.untried and not self.found)

    @property
    def lacking(self) -> bool:
        """True where something is left: that could be predicted, that no effect takes away, or between the uses."""
        left = self.left is not None or self.latent_share > self.policy.large
        # a process has no force that takes up what is left, and that a judge by free runs tells of
        lasts = not self.system.coordinates and self.runs.left > self.policy.explained
        # better than nothing at all, and no better than a line, is no misfit and lacks something
        lasts = lasts or self.runs.left > self.policy.misfit_nrmse**2 >= self.runs.beyond_start
        refused = not self.found and (lasts or self.promised is not None)
        denied = bool(self.outcome.withdrawn) or self.disagree or bool(self.rival) or self.astray
        return left or refused or denied or self.shaken

    @property
    def left(self) -> Axis | None:
        """The axis over which a free force predicts what is left, if that matters.

        Corners of a law that are rounder than those of the plant are seen by exact sensors, and missed by nobody where
        free runs with what was found leave no more than the noise.
        """
        if not self.found:
            return self.leftover.missing
        return None if self.runs.to_the_noise(self.policy) else self.leftover.best

    @functools.cached_property
    def promised(self) -> Judged | None:
        """See :meth:`harness.diagnosis.search.outcome.Outcome.promised`; asked once, as free runs are weighed anew."""
        return self.outcome.promised(self.policy)

    @property
    def astray(self) -> bool:
        """True where the nominal model runs far further from the validation records than from the others."""
        return not self.found and self.runs.further > self.policy.further

    @functools.cached_property
    def jumps(self) -> tuple[Jump, ...]:
        """Where the force that nobody measured changes faster than a disturbance does, beside the final model."""
        return tuple(self.form.jumps(self.final))

    @property
    def shaken(self) -> bool:
        """True where such a force jumps in both uses, by more than a disturbance that does not matter."""
        return {jump.use for jump in self.jumps if jump.share > self.policy.disturbed} >= {"estimation", "validation"}

    @property
    def disagree(self) -> bool:
        """True where records want other parameters than those that the estimation records tell together."""
        return self.apart is not None and self.apart.matters(self.policy)

    @property
    def grade(self) -> str:
        """How much of the motion the final model explains over the horizon, and whether more could be predicted."""
        if self.misfit:
            return "does_not_fit"
        if self.incomplete or self.runs.left > self.policy.proxy:
            return "proxy_or_incomplete"
        quiet = max(self.latent_share, self.lasting) <= self.policy.disturbed and not self.runs.worse(self.policy)
        doubts = self.stand_in or self.doubtful or self.untried
        good = quiet and self.runs.left <= self.policy.explained and not doubts
        return "explained" if good else "mostly_explained"

    @property
    def structure_fits(self) -> bool:
        """False where the final model lacks something that could be predicted: its intervals do not count that."""
        return self.grade in ("explained", "mostly_explained")

    @property
    def latent_share(self) -> float:
        """Size of the latent force of the final model over the typical force, the largest of all ports."""
        return float(latent_shares(self.final, self.form.noise_model.force_scale).max(initial=0.0))

    @property
    def lasting(self) -> float:
        """Size of what free runs leave of the motion, noise taken off, where no latent force takes it up; else 0."""
        return 0.0 if self.form.latent else float(np.sqrt(self.runs.left))

    @functools.cached_property
    def stand_in(self) -> tuple[str, ...]:
        """Why accepted effects imitate something that is not in the dictionary; empty if nothing says so."""
        reasons = stand_in_reasons(
            [accepted.placed for accepted in self.outcome.accepted], None if self.left is None else self.left.name
        )
        trade = traded([one for one, _ in of_nothing(self.final)])
        reasons = reasons if trade is None else (*reasons, trade)
        for name, share in self.outcome.denied(self.policy):
            reasons = (*reasons, f"the validation records want {100 * share:.0f} % of the size of {name}")
        unlawful = self.outcome.unlawful(self.policy) if self.outcome.accepted else None
        if unlawful is None:
            return reasons
        return (*reasons, f"{unlawful.name} explains the records better, with values that its own physics forbids")
