"""The search over effects: one after the other, then the best subset with swaps, at most three.

Greedy selection alone is right in two of eight cases with two effects: the first one found is often a proxy for both.
So once a second effect stands, each is exchanged against its rivals while the other stays, simpler members that nest in
an accepted effect are tried, and an effect that is no longer needed is dropped. Where no single effect is accepted,
pairs are tried.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from harness.diagnosis.accept import LEVEL
from harness.diagnosis.confirm import Candidate, assess
from harness.diagnosis.descent import Bar
from harness.diagnosis.exchange import Accepted, swapped, with_ties
from harness.diagnosis.forms import Fitted, Form
from harness.diagnosis.pairs import best_pair, compatible
from harness.diagnosis.refit import Task
from harness.diagnosis.refitter import Refitter
from harness.diagnosis.residual_tests import detect, max_autocorrelation
from harness.diagnosis.screens import SEEN, Screen, sensitivity_screen, shortlist
from harness.diagnosis.starts import line_of, polished, starts_of
from harness.diagnosis.surrogates import SurrogateTest, surrogate_test
from harness.diagnosis.ties import leader, simplest, tie_set
from harness.diagnosis.unfold import hidden_signs
from harness.effects.effect import Placed
from harness.rng import stream

__all__ = ["Accepted", "Round", "Search", "SearchResult"]

MOST_EFFECTS = 3


@dataclass(frozen=True, eq=False)
class Round:
    """One pass: screen, global null, the refits judged against the model before."""

    before: Fitted
    screen: Screen
    surrogates: SurrogateTest
    p: float
    line: float | None
    candidates: tuple[Candidate, ...]


@dataclass(frozen=True, eq=False)
class SearchResult:
    """The final model, its effects, and every round on the way."""

    model: Fitted
    accepted: tuple[Accepted, ...]
    rounds: tuple[Round, ...]
    extra: tuple[Candidate, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass
class Search:
    """The search; :meth:`run` does it.

    Parameters
    ----------
    form : Form
        How model and data are compared.
    candidates : sequence of Placed
        The dictionary at every port it fits.
    sizes : mapping
        Sizes of the data by port.
    refitter : Refitter
    seed : int
    say : callable
        Called with words about what is being done.
    """

    form: Form
    candidates: Sequence[Placed]
    sizes: Mapping[str, Mapping[str, float]]
    refitter: Refitter
    seed: int = 0
    say: Callable[[str], None] = lambda text: None
    notes: list[str] = field(default_factory=list)

    def run(self, nominal: Fitted, *, first: Round | None = None) -> SearchResult:
        """Return the final model, starting from the fitted nominal one (and its first round, if that is done)."""
        model = nominal
        rounds: list[Round] = []
        picked: list[Placed] = []
        while len(picked) < MOST_EFFECTS and self.detected(model, later=bool(picked)):
            here = first if first is not None and not rounds else self.round(model)
            rounds.append(here)
            winner = self.winner(here.candidates)
            if winner is None and here.candidates and here.p <= LEVEL and len(picked) + 2 <= MOST_EFFECTS:
                winner = best_pair(self, model, here)
            if winner is None:
                break
            assert winner.fitted is not None
            picked += list(winner.added)
            model = winner.fitted
            if len(picked) > len(winner.added):
                model, picked = swapped(self, nominal, model, picked, rounds)
        accepted, extra = with_ties(self, nominal, model, picked, rounds)
        return SearchResult(model, tuple(accepted), tuple(rounds), tuple(extra), tuple(self.notes))

    def detected(self, model: Fitted, *, later: bool = False) -> bool:
        """Decide by effect size whether something is left to explain.

        On estimation or on validation; once an effect stands, on estimation only: a model that reaches the noise
        there has nothing left to fit, though a sensitive motion may still magnify its errors on validation.
        """
        for parts in (model.estimation,) if later else (model.estimation, model.validation):
            joined = np.concatenate(parts)
            for j in range(joined.shape[1]):
                floor = self.form.floors[j]
                ratio = None if not floor else float(np.sqrt(np.mean(joined[:, j] ** 2))) / floor
                acf = max(max_autocorrelation(one[:, j]) for one in parts)
                if detect(ratio, acf, min(one.shape[0] for one in parts)):
                    return True
        return False

    def round(self, model: Fitted) -> Round:
        """Screen, test against surrogates, refit the short list."""
        taken = {str(one) for one in model.effects}
        rest = [one for one in self.candidates if str(one) not in taken and compatible((*model.effects, one))]
        self.say("screening the dictionary")
        self.refitter.prepare()
        screen = sensitivity_screen(self.form, model, rest, self._size)
        bases = {str(one.placed): one.basis for one in screen.probes if one.left >= SEEN and one.rank}
        rng = stream("diagnosis-surrogates", len(model.effects), self.seed)
        cleaned = self.form.clean(model, [one[:, :, None] for one in model.estimation])
        seams: list[tuple[int, int, int]] = getattr(self.form, "seams", lambda _: [])(model)
        test = surrogate_test([one[:, :, 0] for one in cleaned], bases, screen.nominal, rng=rng, windows=seams)
        p = test.p
        line = line_of(self, model)
        signs = {key: own for key, own in hidden_signs(self.form, rest).items() if own <= LEVEL}
        if p > LEVEL and line is None and not signs:
            self.notes.append(f"the dictionary explains the residual no better than surrogates of it (p = {p:.3f})")
            return Round(model, screen, test, p, line, ())
        # A line and a lost sign have tests of their own; they vouch for nothing else.
        chosen = shortlist(screen, None, rest) if p <= LEVEL else []
        if line is None:  # its phase is fitted on validation too, so there any narrow band would seem to gain
            chosen = [one for one in chosen if one.effect.name != "periodic_disturbance"]
        chosen += [one for one in rest if str(one) in signs and str(one) not in map(str, chosen)]
        if line is not None:
            chosen += [
                one for one in rest if one.effect.name == "periodic_disturbance" and str(one) not in map(str, chosen)
            ]
        probes = {str(one.placed): one for one in screen.probes}
        bar = Bar(model.effects, model.values)
        tasks = [Task((*model.effects, one), starts_of(self, model, [one], probes, line), bar) for one in chosen]
        self.say(f"refitting {len(tasks)} candidates")
        null = {
            str(one): 0.0
            if line is not None and one.effect.name == "periodic_disturbance"
            else min(p, signs.get(str(one), 1.0))
            for one in chosen
        }
        candidates = self.judge(model, tasks, [(one,) for one in chosen], null)
        again = polished(tasks, candidates)
        if again:
            self.say(f"refitting {len(again)} rivals from where the best one ended")
            records = {**dict(zip((one.key for one in tasks), self.refitter.solve(tasks), strict=True))}
            for old, new, record in zip(again, again.values(), self.refitter.solve(list(again.values())), strict=True):
                if "failed" not in record and ("failed" in records[old] or record["cost"] < records[old]["cost"]):
                    tasks = [new if one.key == old else one for one in tasks]
            candidates = self.judge(model, tasks, [(one,) for one in chosen], null)
        return Round(model, screen, test, p, line, tuple(candidates))

    def judge(
        self,
        before: Fitted,
        tasks: Sequence[Task],
        added: Sequence[tuple[Placed, ...]],
        p: Mapping[str, float] | float | None,
    ) -> list[Candidate]:
        """Refit tasks and judge them against a model."""
        records = self.refitter.solve(tasks)
        models = [
            (new, self.refitter.evaluate(task, record)) for new, task, record in zip(added, tasks, records, strict=True)
        ]
        failures = [str(record.get("failed", "")) for record in records]
        return assess(self.form, before, models, surrogate_p=p, seed=self.seed, failures=failures)

    def winner(self, candidates: Sequence[Candidate]) -> Candidate | None:
        """Return the simplest member of the tie set of the best accepted candidate."""
        accepted = [one for one in candidates if one.accepted]
        if not accepted:
            return None
        best = leader(accepted, seed=self.seed)
        return simplest(tie_set(self.form, best, candidates, seed=self.seed))

    def _size(self, placed: Placed) -> Mapping[str, float]:
        """Return the sizes of the data at an effect's port."""
        return self.sizes.get(placed.at, self.sizes.get("base", {}))
