"""The table of a search: every set of effects that was fitted, the rounds that filled it, and an answer out of it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from harness.diagnosis.policy import POLICY, Policy
from harness.diagnosis.search.compare import Judged, compared, impossible, judged, unseen
from harness.diagnosis.search.fit import Begun, Fit, Form, InOneGo
from harness.diagnosis.search.refusal import Kind
from harness.diagnosis.search.scores import ScoreTest, score_test
from harness.effects.dictionary import Dictionary
from harness.effects.effect import Placed
from harness.errors import FitError

Say = Callable[[str], None]


def silent(text: str) -> None:
    """Say nothing."""


def named(effects: Iterable[Placed]) -> frozenset[str]:
    """Return the names of effects, by which a set of them is known."""
    return frozenset(map(str, effects))


def value(fit: Fit) -> float:
    """Return what decides between two sets of effects: both uses together, the estimation records penalised."""
    return fit.penalised + fit.log_likelihood("validation")


@dataclass(frozen=True, eq=False)
class Accepted:
    """One accepted effect with all that these data cannot tell from it, itself first, and its evidence.

    ``beside`` names the effects beside which the tie set was asked for, None where it was not asked for yet;
    ``found`` counts the rounds before the one that found it, with its rivals; ``part_of`` names the unknown force that
    it may be a part of, where that is larger than what it explains; ``given`` says that it was not asked for evidence:
    no move takes it away.
    """

    placed: Placed
    tie: tuple[tuple[Placed, ...], ...]
    evidence: float
    validation: float
    beside: frozenset[str] | None = None
    found: int = 0
    part_of: str = ""
    given: bool = False


@dataclass(frozen=True, eq=False)
class Answer:
    """A set of effects that stands, in the order in which they were found, and its fit."""

    model: Fit
    accepted: tuple[Accepted, ...] = ()

    @property
    def earlier(self) -> list[tuple[int, Accepted]]:
        """The effects that moves may take away, by number: those that were found, all but the last one."""
        return [(number, one) for number, one in enumerate(self.accepted[:-1]) if not one.given]

    def without(self, gone: int) -> list[Placed]:
        """Return the effects but one."""
        return [accepted.placed for number, accepted in enumerate(self.accepted) if number != gone]

    def added(self, row: Judged, found: int) -> Answer:
        """Return the answer with a candidate, whose rivals are not asked for yet, beside it."""
        assert row.fit is not None
        assert row.comparison is not None
        gains = row.comparison.evidence, row.comparison.validation
        new = Accepted(row.added[-1], (row.added,), *gains, named(self.model.effects), found)
        return Answer(row.fit, (*self.accepted, new))

    def exchanged(
        self, number: int, new: Placed, fit: Fit, found: int, alike: Sequence[tuple[Placed, ...]] = ()
    ) -> Answer:
        """Return the answer with an effect in the place of another one, which may be tied with it."""
        old, gains = self.accepted[number], compared(fit, self.model)
        changed = replace(
            old,
            placed=new,
            tie=tuple(dict.fromkeys([(new,), *old.tie, *alike])),
            evidence=old.evidence + gains.evidence,
            validation=old.validation + gains.validation,
            beside=None,
            found=found,
        )
        return Answer(fit, (*self.accepted[:number], changed, *self.accepted[number + 1 :]))

    def dropped(self, number: int, fit: Fit) -> Answer:
        """Return the answer without an effect."""
        return Answer(fit, (*self.accepted[:number], *self.accepted[number + 1 :]))


@dataclass(frozen=True, eq=False)
class Round:
    """What was added to a set: the score test beside it, the refits that followed, and what was begun and left."""

    base: Fit
    test: ScoreTest
    candidates: tuple[Judged, ...]
    left: frozenset[str] = frozenset()


@dataclass(eq=False)
class FitTable(InOneGo):
    """Every set of effects that was fitted, with the best fit of it.

    Parameters
    ----------
    form : Form
    root : Fit
        Of the nominal model.
    candidates : sequence of Placed
        The effects that may be added.
    policy : Policy
    say : callable
        Told what is fitted.
    sizes : mapping
        Sizes of the data by port, for what laws that refine others start from.
    kept : frozenset of str
        Names of effects that are given.
    """

    form: Form
    root: Fit
    candidates: Sequence[Placed]
    policy: Policy = POLICY
    say: Say = silent
    sizes: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    kept: frozenset[str] = frozenset()
    fits: dict[frozenset[str], Fit] = field(default_factory=dict)
    rounds: list[Round] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Begin with what is known."""
        self.put(self.root)
        for past in self.rounds:
            for fit in (past.base, *(row.fit for row in past.candidates)):
                if fit is not None:
                    self.put(fit)

    @property
    def laws(self) -> Dictionary:
        """The effects of the run, and what they say of each other."""
        return self.form.laws

    @property
    def nominal(self) -> Fit:
        """The best fit of the nominal model."""
        return self.fits[frozenset()]

    def best(self, effects: Iterable[Placed]) -> Fit | None:
        """Return the best fit of a set, None where it was not fitted."""
        return self.fits.get(named(effects))

    def put(self, fit: Fit) -> Fit:
        """Keep a fit if it is the best one of its set; what was left on its way is none where another was not."""
        key = named(fit.effects)
        known = self.fits.get(key)
        if known is None or (not fit.beyond, value(fit)) > (not known.beyond, value(known)):
            self.fits[key] = fit
        return fit

    def begin(
        self, effects: Sequence[Placed], starts: Sequence[Mapping[str, float]], base: Fit | None, hope: float = -np.inf
    ) -> Begun | None:
        """Take the first steps of a fit, see :meth:`Form.begin`."""
        return self.form.begin(effects, starts, base, hope)

    def finish(self, begun: Begun, base: Fit | None, rival: Fit | None = None, least: float = -np.inf) -> Fit | None:
        """Finish a fit, see :meth:`Form.finish`, and keep it."""
        fit = self.form.finish(begun, base, rival, least)
        return None if fit is None else self.put(fit)

    def given(self, effects: Sequence[Placed]) -> Answer:
        """Return the answer with effects that are given, each begun where the one before ended.

        Raises
        ------
        FitError
            If the model with them cannot be simulated along the data.
        """
        answer, self.kept = Answer(self.nominal), named(effects)
        for placed in effects:
            base = answer.model
            test = score_test(self.form, base, [placed], self.policy)
            starts = [start for lead in (*test.leads, *test.hidden) for start in lead.starts]
            starts += [start for suspect in self.form.suspects(base, None, [placed]) for start in suspect.starts]
            self.say(f"{placed}, as given")
            fit = self.fit([*base.effects, placed], [{**base.values, **start} for start in starts or [{}]], base)
            if fit is None:
                raise FitError(
                    f"the model with {placed}, which the dictionary of this run gives",
                    expected="one that can be simulated along the data",
                    got="a state that diverges",
                    remedy=f"try it instead: {placed.effect.name}({placed.at})?",
                )
            gains = compared(fit, base, self.policy)
            new = Accepted(placed, ((placed,),), gains.evidence, gains.validation, given=True)
            answer = Answer(fit, (*answer.accepted, new))
        present = named(answer.model.effects)
        return Answer(answer.model, tuple(replace(one, beside=present - {str(one.placed)}) for one in answer.accepted))

    def judged(self, added: Sequence[Placed], fit: Fit | None, base: Fit | None = None) -> Judged:
        """Return what speaks for and against effects that were added to a base, the nominal model if none is given."""
        return judged(self.form, added, fit, base or self.nominal, self.nominal, self.policy, self.kept)

    def lawful(self, fit: Fit, before: Fit | None = None) -> bool:
        """Return True for a fit at its end in which physics forbids nothing but what was not told ``before``."""
        if not fit.converged or unseen(fit):
            return False
        untold = set() if before is None else {one for one in self._forbidden(before) if one[1] is Kind.UNDETERMINED}
        return self._forbidden(fit) <= untold

    def _forbidden(self, fit: Fit) -> set[tuple[str, Kind, str]]:
        """Return what physics forbids of the values of effects, but of those that are kept whatever they are."""
        asked = [placed for placed in fit.effects if str(placed) not in self.kept]
        return {
            (str(placed), refusal.kind, refusal.subject)
            for placed in asked
            for refusal in impossible(self.form, placed, fit)
        }
