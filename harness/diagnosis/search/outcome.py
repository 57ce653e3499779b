"""What a search found: its rounds, the answer, and what speaks against it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from harness.diagnosis.policy import POLICY, Policy
from harness.diagnosis.search.compare import (
    Judged,
    compared,
    difference,
    violations,
    wrong_signs,
)
from harness.diagnosis.search.fit import Fit
from harness.diagnosis.search.refusal import WANT_OF_EVIDENCE, Kind, Refusal, only
from harness.diagnosis.search.score_test import ScoreTest
from harness.diagnosis.search.ties import Accepted, total
from harness.effects.dictionary import Dictionary
from harness.effects.effect import Placed

__all__ = ["Outcome", "Round"]


@dataclass(frozen=True, eq=False)
class Round:
    """One round: the score test beside a model, the refits that followed, and what was begun and left."""

    base: Fit
    test: ScoreTest
    candidates: tuple[Judged, ...]
    left: frozenset[str] = frozenset()


@dataclass(eq=False)
class Outcome:
    """What a search found: the nominal fit at its maximum, the model with the accepted effects, and the way there."""

    nominal: Fit
    model: Fit
    accepted: list[Accepted] = field(default_factory=list)
    rounds: list[Round] = field(default_factory=list)
    withdrawn: list[Accepted] = field(default_factory=list)
    """Effects that the likelihood prefers and that were taken back."""
    laws: Dictionary = field(default_factory=Dictionary.builtin)
    """The effects of the run."""

    def unlawful(self, policy: Policy = POLICY) -> Judged | None:
        """Return the rival that explains the records best, if its law forbids its values and the answer is worse.

        Where one is, the answer is the best of the laws that were allowed, and not the law of the plant. What has the
        answer in it, as a special case of a law or beside others, is no rival of it, unless it is a further effect that
        nothing but its law speaks against.
        """
        best: tuple[float, Judged] | None = None
        answer = {str(placed) for placed in self.model.effects}
        for base, rival in ((past.base, row) for past in self.rounds for row in past.candidates):
            if rival.fit is None:
                continue
            forbidden = [
                refusal
                for placed in rival.added
                for refusal in (*wrong_signs(placed, rival.fit.values), *violations(placed, rival.fit))
            ]
            if not forbidden:
                continue
            has_it = answer <= self.laws.contained(rival.fit.effects)
            if has_it and not _asked_for(rival, base, answer, forbidden, policy):
                continue
            gap = compared(rival.fit, self.model, policy).total
            _, error = difference(rival.fit, self.model, ("estimation", "validation"), policy)
            if gap > max(policy.tie, policy.tie_z * error) and (best is None or gap > best[0]):
                best = gap, rival
        return None if best is None else best[1]

    def promised(self, policy: Policy = POLICY) -> Judged | None:
        """Return the likeliest rival of the answer that nothing but its own fit or law speaks against, if any.

        The data prefer it by all that is asked of an effect: it is no answer, and without it something is missing.
        """
        asked = {*WANT_OF_EVIDENCE, Kind.INCOHERENT, Kind.OTHER_LAW}
        rows = [row for row in self.rounds[-1].candidates if row.fit is not None and row.refusals]
        held = [
            row
            for row in rows
            if not any(refusal.kind in asked for refusal in row.refusals) or _sure_where_fitted(row, policy)
        ]
        best = max(held, key=total, default=None)
        if best is None or best.fit is None or best.fit.change(best.added[0]) < policy.least:
            return None
        return best

    def fits_with(self, effects: Sequence[Placed]) -> list[Fit]:
        """Return the finished fits of past rounds that have these effects and no others."""
        names = {str(placed) for placed in effects}
        fits = [fit for past in self.rounds for fit in (past.base, *(row.fit for row in past.candidates))]
        return [fit for fit in fits if fit is not None and fit.converged and {*map(str, fit.effects)} == names]

    def withdraw(self) -> None:
        """Take all effects back; that stands beside them in the rounds that accepted them."""
        names = {str(accepted.placed) for accepted in self.accepted}
        self.rounds = [
            replace(past, candidates=tuple(
                replace(row, refusals=(*row.refusals, Refusal(Kind.WITHDRAWN)))
                if row.passed and row.name in names else row
                for row in past.candidates
            )) for past in self.rounds
        ]  # fmt: skip
        self.withdrawn, self.accepted, self.model = self.accepted, [], self.nominal


def _sure_where_fitted(row: Judged, policy: Policy) -> bool:
    """Return True for a candidate beyond doubt where it was fitted, of which the validation records show nothing."""
    if row.comparison is None or row.comparison.evidence < policy.misfit_gain:
        return False
    return only(row.refusals, {Kind.VALIDATION}) and row.comparison.validation > 0.0


def _asked_for(row: Judged, base: Fit, answer: set[str], forbidden: Sequence[Refusal], policy: Policy) -> bool:
    """Return True for a candidate beside a whole answer that would be accepted if its law allowed its values.

    One whose fit has not come to its end is as likely as it is at least. With exact sensors the data are sure of the
    rounded corners of the answer too, and of the step of the engine that wrote them: what other parameters cannot do as
    well must be a part of what the answer changes.
    """
    assert row.fit is not None
    beside = answer == {str(placed) for placed in row.fit.effects} - {str(placed) for placed in row.added}
    rest = set(row.refusals) - {*forbidden, Refusal(Kind.UNCONVERGED)}
    if not beside or rest or row.fit.change(row.added[0]) < policy.least:
        return False
    whole = max((base.change(placed) for placed in base.effects), default=0.0)
    return row.fit.distance(base) >= policy.second_share * whole
