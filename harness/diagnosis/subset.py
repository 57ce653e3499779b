"""The search over effects: one after the other, then the best subset with swaps, at most three.

Greedy selection alone is right in two of eight cases with two effects: the first one found is often a proxy for both.
So once a second effect stands, each is exchanged against its rivals while the other stays, simpler members that nest in
an accepted effect are tried, and an effect that is no longer needed is dropped. Where no single effect is accepted,
pairs of the short list are tried.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from harness.diagnosis.accept import LEVEL
from harness.diagnosis.confirm import Candidate, Refitter, Task, assess
from harness.diagnosis.equation_form import EquationForm
from harness.diagnosis.forms import Fitted, Form
from harness.diagnosis.residual_tests import detect, fisher_g, max_autocorrelation
from harness.diagnosis.screens import SEEN, Probe, Screen, sensitivity_screen, shortlist
from harness.diagnosis.surrogates import SurrogateTest, surrogate_test
from harness.diagnosis.ties import leader, simplest, tie_set
from harness.diagnosis.weak_screen import WeakScreen, weak_screen
from harness.effects.effect import Placed
from harness.rng import stream

__all__ = ["Accepted", "Round", "Search", "SearchResult"]

MOST_EFFECTS = 3
SHORT = 6


@dataclass(frozen=True, eq=False)
class Round:
    """One pass: screens, global null, the refits judged against the model before."""

    before: Fitted
    screen: Screen
    weak: WeakScreen | None
    surrogates: SurrogateTest
    p: float
    line: float | None
    candidates: tuple[Candidate, ...]


@dataclass(frozen=True, eq=False)
class Accepted:
    """An accepted effect with what it cannot be told from, itself first."""

    placed: Placed
    delta_bic: float
    tie: tuple[tuple[Placed, ...], ...]


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
    weak : EquationForm or None
        The weak form of the equations, for its screen; None where the motion is not measured.
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
    weak: EquationForm | None
    candidates: Sequence[Placed]
    sizes: Mapping[str, Mapping[str, float]]
    refitter: Refitter
    seed: int = 0
    say: Callable[[str], None] = lambda text: None
    notes: list[str] = field(default_factory=list)

    def run(self, nominal: Fitted) -> SearchResult:
        """Return the final model, starting from the fitted nominal one."""
        model = nominal
        rounds: list[Round] = []
        picked: list[Placed] = []
        while len(picked) < MOST_EFFECTS and self.detected(model, later=bool(picked)):
            here = self.round(model)
            rounds.append(here)
            winner = self._winner(here.candidates)
            if winner is None and not picked and here.candidates:
                pair = self._pairs(model, here)
                if pair is not None:
                    assert pair.fitted is not None
                    picked, model = list(pair.added), pair.fitted
                    continue
            if winner is None:
                break
            assert winner.fitted is not None
            picked += list(winner.added)
            model = winner.fitted
            if len(picked) > 1:
                model, picked = self._swap(nominal, model, picked, rounds)
        accepted, extra = self._ties(nominal, model, picked, rounds)
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
        rest = [one for one in self.candidates if str(one) not in taken]
        self.say("screening the dictionary")
        screen = sensitivity_screen(self.form, model, rest, self._size)
        weak = self._weak_screen(model, rest)
        bases = {str(one.placed): one.basis for one in screen.probes if one.left >= SEEN and one.rank}
        rng = stream("diagnosis-surrogates", len(model.effects), self.seed)
        cleaned = self.form.clean(model, [one[:, :, None] for one in model.estimation])
        test = surrogate_test([one[:, :, 0] for one in cleaned], bases, screen.nominal, rng=rng)
        p = test.p
        if weak is not None:
            # two tests of one null: the smaller p counts twice
            momentum = {str(one.placed): one.basis for one in weak.screen.probes if one.left >= SEEN and one.rank}
            other = surrogate_test(list(weak.residual), momentum, weak.screen.nominal, rng=rng)
            p = min(1.0, 2 * min(test.p, other.p))
            test = other if other.p < test.p else test
        line = self._line(model)
        if p > LEVEL and line is None:
            self.notes.append(f"the dictionary explains the residual no better than surrogates of it (p = {p:.3f})")
            return Round(model, screen, weak, test, p, line, ())
        chosen = shortlist(screen, None if weak is None else weak.screen, rest)
        if line is not None:
            chosen += [
                one for one in rest if one.effect.name == "periodic_disturbance" and str(one) not in map(str, chosen)
            ]
        probes = {str(one.placed): one for one in screen.probes}
        tasks = [Task((*model.effects, one), self._starts(model, [one], probes, line, weak)) for one in chosen]
        self.say(f"refitting {len(tasks)} candidates")
        null = p if line is None else None
        candidates = self._judge(model, tasks, [(one,) for one in chosen], null)
        again = self._polished(tasks, candidates)
        if again:
            self.say(f"refitting {len(again)} rivals from where the best one ended")
            records = {**dict(zip((one.key for one in tasks), self.refitter.solve(tasks), strict=True))}
            for old, new, record in zip(again, again.values(), self.refitter.solve(list(again.values())), strict=True):
                if "failed" not in record and ("failed" in records[old] or record["cost"] < records[old]["cost"]):
                    tasks = [new if one.key == old else one for one in tasks]
            candidates = self._judge(model, tasks, [(one,) for one in chosen], null)
        return Round(model, screen, weak, test, p, line, tuple(candidates))

    def _polished(self, tasks: Sequence[Task], candidates: Sequence[Candidate]) -> dict[str, Task]:
        """Return second refits for the close rivals of the best candidate, by the key of the first.

        They start from the parameters at which the best one ended: rivals must not lose by a local minimum.
        """
        ranked = [one for one in candidates if one.fitted is not None and np.isfinite(one.delta_bic)]
        if not ranked:
            return {}
        best = max(ranked, key=lambda one: one.delta_bic)
        assert best.fitted is not None
        first = best.added[0]
        shared = {one.name: best.fitted.values[first.name(one.name)] for one in first.effect.parameters}
        result: dict[str, Task] = {}
        for task, one in zip(tasks, candidates, strict=True):
            placed = one.added[0]
            if one is best or one.fitted is None or one.delta_bic < 0.5 * best.delta_bic or best.delta_bic <= 10:
                continue
            start = {k: v for k, v in best.fitted.values.items() if not k.startswith(f"{first}.")}
            for other in placed.effect.parameters:
                own = one.fitted.values[placed.name(other.name)]
                start[placed.name(other.name)] = shared.get(other.name, own) if other.nuisance else own
            result[task.key] = Task(task.effects, (start,))
        return result

    def _judge(
        self, before: Fitted, tasks: Sequence[Task], added: Sequence[tuple[Placed, ...]], p: float | None
    ) -> list[Candidate]:
        """Refit tasks and judge them against a model."""
        records = self.refitter.solve(tasks)
        models = [
            (new, self.refitter.evaluate(task, record)) for new, task, record in zip(added, tasks, records, strict=True)
        ]
        return assess(self.form, before, models, surrogate_p=p, seed=self.seed)

    def _winner(self, candidates: Sequence[Candidate]) -> Candidate | None:
        """Return the simplest member of the tie set of the best accepted candidate."""
        accepted = [one for one in candidates if one.accepted]
        if not accepted:
            return None
        best = leader(accepted, seed=self.seed)
        return simplest(tie_set(self.form, best, candidates, seed=self.seed))

    def _weak_screen(self, model: Fitted, rest: Sequence[Placed]) -> WeakScreen | None:
        """Return the screen on the momentum equation, where there is one for this model."""
        if self.weak is None or not all(self.weak.judges(one) for one in model.effects):
            return None
        return weak_screen(self.weak, model.effects, model.values, rest, self.sizes)

    def _size(self, placed: Placed) -> Mapping[str, float]:
        """Return the sizes of the data at an effect's port."""
        return self.sizes.get(placed.at, self.sizes.get("base", {}))

    def _line(self, model: Fitted) -> float | None:
        """Return the angular frequency of a pure line that stands in estimation and in validation, or None."""
        dt = getattr(self.form, "sample_time", 1.0)
        longest = [max(parts, key=len) for parts in (model.estimation, model.validation)]
        for j in range(longest[0].shape[1]):
            inside, outside = (fisher_g(one[:, j], dt) for one in longest)
            width = 2 * np.pi / (dt * min(len(one) for one in longest))
            if max(inside.p, outside.p) <= LEVEL and abs(inside.omega - outside.omega) < 1.5 * width:
                return inside.omega
        return None

    def _starts(
        self,
        model: Fitted,
        added: Sequence[Placed],
        probes: Mapping[str, Probe],
        line: float | None = None,
        weak: WeakScreen | None = None,
    ) -> tuple[dict[str, float], ...]:
        """Return starting parameters: of the weak form, then the model's own with the screened values."""
        base = dict(model.values)
        lists: list[list[dict[str, float]]] = []
        first: list[dict[str, float]] = []
        if weak is not None:
            found = {str(one.placed): one.starts[0] for one in weak.screen.probes}
            if all(str(one) in found for one in added):
                start = dict(base)
                for placed in added:
                    start.update(weak.parameters[str(placed)])
                    usual = placed.effect.complete({}, self._size(placed))
                    start.update({placed.name(k): v for k, v in {**usual, **found[str(placed)]}.items()})
                first = [start]
        for placed in added:
            probe = probes.get(str(placed))
            own = list(probe.starts) if probe is not None else [placed.effect.complete({}, self._size(placed))]
            if placed.effect.name == "periodic_disturbance" and line is not None:
                own = [{**own[0], "omega": line}]
            several = any(len(one.grid) > 1 and not one.nuisance for one in placed.effect.parameters)
            lists.append([{placed.name(k): v for k, v in one.items()} for one in own[: 3 if several else 1]])
        starts = list(first)
        for k in range(max(len(one) for one in lists)):
            start = dict(base)
            for own in lists:
                start.update(own[min(k, len(own) - 1)])
            starts.append(start)
        return tuple(starts)

    def _short(self, here: Round) -> list[Placed]:
        """Return at most six effects worth combining: best refits first, then leaders of the screens."""
        ranked = sorted((one for one in here.candidates if one.fitted is not None), key=lambda one: -one.delta_bic)
        ordered = [one.added[0] for one in ranked] + [one.placed for one in here.screen.leaders(3)]
        return list({str(one): one for one in ordered}.values())[:SHORT]

    def _pairs(self, model: Fitted, here: Round) -> Candidate | None:
        """Return the best accepted pair of the short list, where no single effect was accepted."""
        probes = {str(one.placed): one for one in here.screen.probes}
        wanted = [] if here.weak is None else here.weak.pairs(8)
        wanted += list(combinations(self._short(here)[:4], 2))
        pairs = list({frozenset(map(str, pair)): pair for pair in wanted}.values())
        self.say(f"refitting {len(pairs)} pairs")
        tasks = [Task((*model.effects, *pair), self._starts(model, pair, probes, None, here.weak)) for pair in pairs]
        p = here.p if here.line is None else None
        judged = self._judge(model, tasks, pairs, p)
        accepted = [one for one in judged if one.accepted and self._each_needed(model, one)]
        if not accepted:
            return None
        best = max(accepted, key=lambda one: one.delta_bic)
        return simplest([one for one in tie_set(self.form, best, judged, seed=self.seed) if one in accepted])

    def _each_needed(self, model: Fitted, pair: Candidate) -> bool:
        """Return True if both members of a pair lower the BIC by more than 10 beside the other."""
        assert pair.fitted is not None
        for kept in pair.added:
            task = Task((*model.effects, kept), self._starts(model, [kept], {}))
            alone = self.refitter.fit(task)
            if alone is None:
                continue
            gone = tuple(one for one in pair.added if one is not kept)
            judged = assess(self.form, alone, [(gone, pair.fitted)], surrogate_p=None, seed=self.seed)[0]
            if judged.delta_bic <= 10 or judged.comparison.gain < 0.01 or judged.comparison.p > LEVEL:
                return False
        return True

    def _swap(
        self, nominal: Fitted, model: Fitted, picked: list[Placed], rounds: Sequence[Round]
    ) -> tuple[Fitted, list[Placed]]:
        """Exchange each effect against its rivals while the others stay, drop what is not needed."""
        rivals: dict[str, Placed] = {}
        for here in rounds:
            for one in self._short(here):
                rivals.setdefault(str(one), one)
        by_name = {(one.effect.name, one.at): one for one in self.candidates}
        for one in picked:
            for name in one.effect.nests:
                if (name, one.at) in by_name:
                    rivals.setdefault(f"{name}@{one.at}", by_name[name, one.at])
        probes: dict[str, Probe] = {}
        for here in rounds:
            for probe in here.screen.probes:
                probes.setdefault(str(probe.placed), probe)
        self.say("best subset: swaps")
        for _ in range(2):
            changed = False
            for place in range(len(picked)):
                others = [one for k, one in enumerate(picked) if k != place]
                taken = {str(one) for one in picked}
                tries = [one for key, one in rivals.items() if key not in taken][: SHORT + 2]
                known = {k: v for k, v in model.values.items() if not k.startswith(f"{picked[place]}.")}
                stand_in = replace(model, values=known)
                tasks = [Task((*nominal.effects, *others, one), self._starts(stand_in, [one], probes)) for one in tries]
                before_task = Task((*nominal.effects, *others), (known,))
                before = self.refitter.fit(before_task)
                if before is None:
                    continue
                added = [*tries, picked[place]]
                records = self.refitter.solve(tasks)
                models: list[tuple[tuple[Placed, ...], Fitted | None]] = [
                    ((one,), self.refitter.evaluate(task, record))
                    for one, task, record in zip(tries, tasks, records, strict=True)
                ]
                models.append(((picked[place],), model))
                judged = assess(self.form, before, models, surrogate_p=None, seed=self.seed)
                best = self._winner(judged)
                if best is None:  # not needed beside the others any more
                    return before, others
                if best.added[0] is not added[-1] and best.fitted is not None:
                    picked = [*others[:place], best.added[0], *others[place:]]
                    model, changed = best.fitted, True
            if not changed:
                break
        return model, picked

    def _ties(
        self, nominal: Fitted, model: Fitted, picked: Sequence[Placed], rounds: Sequence[Round]
    ) -> tuple[list[Accepted], list[Candidate]]:
        """Return each effect of the final model with its tie set, the others being in the model."""
        if not picked:
            return [], []
        if len(picked) == 1:
            judged = list(rounds[0].candidates)
            own = next((one for one in judged if one.added == (picked[0],)), None)
            if own is not None and own.fitted is not None and _same(own.fitted, model):
                best = leader([one for one in judged if one.accepted], seed=self.seed)
                tied = [one for one in tie_set(self.form, best, judged, seed=self.seed) if one is not own]
                return [Accepted(picked[0], own.delta_bic, ((picked[0],), *(one.added for one in tied)))], []
        probes = {str(one.placed): one for here in rounds for one in here.screen.probes}
        result, extra = [], []
        for placed in picked:
            others = [one for one in picked if one is not placed]
            known = {k: v for k, v in model.values.items() if not k.startswith(f"{placed}.")}
            before = self.refitter.fit(Task((*nominal.effects, *others), (known,)))
            if before is None:
                result.append(Accepted(placed, float("nan"), ((placed,),)))
                continue
            names = {*placed.effect.family, *placed.effect.nests}
            tries = [
                one
                for one in self.candidates
                if str(one) not in {str(other) for other in picked}
                and one.effect.name in names
                and (str(one) not in probes or probes[str(one)].left >= SEEN)
            ]
            here = [one for one in tries if one.at == placed.at]
            tries = (here + [one for one in tries if one.at != placed.at])[:SHORT]
            stand_in = replace(model, values=known)
            tasks = [Task((*nominal.effects, *others, one), self._starts(stand_in, [one], probes)) for one in tries]
            records = self.refitter.solve(tasks)
            models: list[tuple[tuple[Placed, ...], Fitted | None]] = [((placed,), model)]
            models += [
                ((one,), self.refitter.evaluate(task, record))
                for one, task, record in zip(tries, tasks, records, strict=True)
            ]
            judged = assess(self.form, before, models, surrogate_p=None, seed=self.seed)
            extra += judged[1:]
            tied = tie_set(self.form, judged[0], judged, seed=self.seed)
            result.append(Accepted(placed, judged[0].delta_bic, tuple(one.added for one in tied)))
        return result, extra


def _same(a: Fitted, b: Fitted) -> bool:
    """Return True if two fits of one model ended in the same minimum."""
    return bool(abs(a.record["cost"] - b.record["cost"]) <= 1e-3 * max(b.record["cost"], 1e-300))
