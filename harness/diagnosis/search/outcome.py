"""What a search found: its rounds, the answer, and what speaks against it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from harness.diagnosis.policy import POLICY, Policy
from harness.diagnosis.search.compare import (
    Judged,
    coloured_gains,
    compared,
    difference,
    expected_difference,
    unremembered,
    violations,
    wrong_signs,
)
from harness.diagnosis.search.fit import Fit, Form
from harness.diagnosis.search.refusal import LINE_RIVALS, WANT_OF_EVIDENCE, Kind, Refusal, only
from harness.diagnosis.search.table import Accepted, Round, named
from harness.diagnosis.search.ties import total


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a search found: the nominal fit at its maximum, the model with the accepted effects, and the way there."""

    form: Form
    nominal: Fit
    model: Fit
    accepted: tuple[Accepted, ...] = ()
    rounds: tuple[Round, ...] = ()
    withdrawn: tuple[Accepted, ...] = ()
    """Effects that the likelihood prefers and that were taken back."""

    def unlawful(self, policy: Policy = POLICY) -> Judged | None:
        """Return the rival that explains the records best, if its law forbids its values and the answer is worse.

        Where one is, the answer is the best of the laws that were allowed, and not the law of the plant. What has the
        answer in it, as a special case of a law or beside others, is no rival of it, unless it is a further effect that
        nothing but its law speaks against.
        """
        best: tuple[float, Judged] | None = None
        answer = named(self.model.effects)
        for base, rival in ((past.base, row) for past in self.rounds for row in past.candidates):
            if rival.fit is None:
                continue
            forbidden = [
                refusal
                for placed in rival.added
                for refusal in (*wrong_signs(placed, rival.fit.values), *violations(self.form, placed, rival.fit))
            ]
            if not forbidden:
                continue
            has_it = answer <= self.form.laws.contained(rival.fit.effects)
            if has_it and not self._asked_for(rival, base, forbidden, policy):
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
        asked = {*WANT_OF_EVIDENCE, *LINE_RIVALS, Kind.OTHER_LAW, Kind.AGAIN, Kind.LASTING}
        rows = [row for row in self.rounds[-1].candidates if row.fit is not None and row.refusals]
        held = [
            row
            for row in rows
            if not any(refusal.kind in asked for refusal in row.refusals) or _sure_where_fitted(row, policy)
        ]
        for row in sorted(held, key=total, reverse=True):
            if row.fit is not None and not unremembered(row.fit, self.model, policy):
                return row if self.form.change(row.fit, row.added[0]) >= policy.least else None
        return None

    def denied(self, policy: Policy = POLICY) -> tuple[tuple[str, float], ...]:
        """Return the accepted effects whose size the validation records deny, and the share of it that they want.

        Of a true law they gain what its prediction differs by from that of the model without it, but for chance. Where
        they gain less than ``policy.sized`` of that, it is no constant of the plant that was fitted.
        """
        found = {str(accepted.placed) for accepted in self.accepted}
        denied = {}
        for base, row in ((past.base, row) for past in self.rounds for row in past.candidates):
            if row.name not in found or not row.passed or row.fit is None or row.comparison is None:
                continue
            expected = expected_difference(row.fit, base, ("validation",))
            most = row.comparison.validation + policy.gain_z * row.comparison.error
            if expected > 2 * policy.evidence and most < policy.sized * expected:
                denied[row.name] = 0.5 * (1.0 + row.comparison.validation / expected)
        return tuple(denied.items())

    def _asked_for(self, rival: Judged, base: Fit, forbidden: Sequence[Refusal], policy: Policy) -> bool:
        """Return True for a candidate beside the whole answer that would be accepted if its law allowed its values.

        One whose fit has not come to its end is as likely as it is at least. With exact sensors the data are sure of
        the rounded corners of the answer too, and of the step of the engine that wrote them: what other parameters
        cannot do as well must be a part of what the answer changes.
        """
        assert rival.fit is not None
        beside = named(self.model.effects) == named(rival.fit.effects) - named(rival.added)
        rest = set(rival.refusals) - {*forbidden, Refusal(Kind.UNCONVERGED)}
        if not beside or rest or self.form.change(rival.fit, rival.added[0]) < policy.least:
            return False
        whole = max((self.form.change(base, placed) for placed in base.effects), default=0.0)
        return self.form.distance(rival.fit, base) >= policy.second_share * whole

    def taken_back(self, sure: float = 0.0) -> Outcome:
        """Return the same without any effect; that they were withdrawn stands in the rounds that accepted them.

        ``withdrawn`` are those that together gained so much in log-likelihood that something is there: of free runs
        beside an error that remembers.
        """
        names = {str(accepted.placed) for accepted in self.accepted}
        rounds = self._refused(names, Refusal(Kind.WITHDRAWN))
        if self.model.free_run:
            gained = sum(coloured_gains(self.model, self.nominal, POLICY.order))
        else:
            gained = sum(self.model.log_likelihood(use) - self.nominal.log_likelihood(use) for use in self.model.terms)
        withdrawn = self.accepted if gained >= sure else ()
        return replace(self, model=self.nominal, accepted=(), withdrawn=withdrawn, rounds=rounds)

    def dropped(self, gone: Accepted, model: Fit, why: Refusal) -> Outcome:
        """Return the same without one of its effects."""
        accepted = tuple(one for one in self.accepted if one is not gone)
        return replace(self, model=model, accepted=accepted, rounds=self._refused({str(gone.placed)}, why))

    def _refused(self, names: set[str], why: Refusal) -> tuple[Round, ...]:
        """Return the rounds, in which what was accepted of these names is refused."""
        return tuple(
            replace(past, candidates=tuple(
                replace(row, refusals=(*row.refusals, why)) if row.passed and row.name in names else row
                for row in past.candidates
            )) for past in self.rounds
        )  # fmt: skip


def _sure_where_fitted(row: Judged, policy: Policy) -> bool:
    """Return True for a candidate beyond doubt where it was fitted, and that only the validation records refuse."""
    if row.comparison is None or row.comparison.evidence < policy.misfit_gain:
        return False
    return only(row.refusals, {Kind.VALIDATION})
