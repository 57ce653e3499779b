"""What an engineer tries in an hour: plain output error of the nominal model, alone and with one effect.

A latent force that is large enough to carry a whole missing law leaves nothing of it in the innovations: then neither
the score test nor the likelihood's own gains say which law it is. A free run has no such force. These fits propose
effects to the search, wherever the score test would not, and the answer must not lose to them where nothing was fitted.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from harness.diagnosis.effort import EFFORT
from harness.diagnosis.policy import Policy
from harness.diagnosis.records.horizon import Horizon
from harness.diagnosis.runs.compare import FreeRuns, seen_values
from harness.diagnosis.runs.fitted import Fitted
from harness.diagnosis.runs.form import FreeRunForm
from harness.diagnosis.search.fit import Fit, Suspect
from harness.diagnosis.systems import by_equations
from harness.effects.dictionary import Dictionary
from harness.effects.effect import Placed
from harness.errors import HarnessError
from harness.physics.compiled.system import System
from harness.physics.compiled.windows import Windows
from harness.physics.fitting.levenberg import log_scaled, minimise, minimise_states
from harness.physics.fitting.output_error import fit_output_error
from harness.rng import stream
from harness.signals import FloatArray

_FAILURES = (HarnessError, ArithmeticError, np.linalg.LinAlgError)
_HALVINGS = ((10, 6, 1.0), (40, EFFORT.points, 10.0), (200, EFFORT.points, 1e4))
"""Iterations of scattered starts, how many go on, and how much finer than roughly they are fitted, stage by stage."""


@dataclass(frozen=True, eq=False)
class SimpleFit:
    """A model whose free runs come nearest to the estimation records."""

    effects: tuple[Placed, ...]  # None or one, of what was tried
    values: dict[str, float]  # All parameters by full name
    fitted: Fitted  # As free runs show it on both uses, initial states and what else belongs to a record fitted

    @property
    def name(self) -> str:
        """Name of the effect, or of the model without one."""
        return " + ".join(map(str, self.effects)) or "the nominal model"

    def error(self, use: str) -> float:
        """Return the mean square of the weighted errors of the estimation or the validation records."""
        return _mean_square(self.fitted.estimation if use == "estimation" else self.fitted.validation)


@dataclass(eq=False)
class _Trial:
    """Where a fit of a model with an effect stands."""

    effects: tuple[Placed, ...]
    p: FloatArray
    x0: FloatArray
    cost: float


class SimpleFits:
    """Output-error fits of a model with and without single effects, made when they are asked for.

    - ``form``: simulates; its records and windows are those of all fits, its weights what outputs are compared by
    - ``start``: values of the nominal model, by maximum likelihood say: one of the starts
    - ``candidates``: what may be missing
    - ``say``: told what is done
    """

    def __init__(
        self,
        form: FreeRunForm,
        start: Mapping[str, float],
        candidates: Sequence[Placed] = (),
        say: Callable[[str], None] = lambda what: None,
        laws: Dictionary | None = None,
    ) -> None:
        self._form, self._start, self._candidates, self._say = form, dict(start), list(candidates), say
        self._laws = Dictionary.builtin() if laws is None else laws

    @functools.cached_property
    def nominal(self) -> SimpleFit | None:
        """The best free-run fit of the nominal model; None where it cannot be simulated.

        From where the likelihood ended, from the declared values and from equation errors, over growing horizons.
        """
        system = self._form.nominal
        assert by_equations(system)
        found = [seen_values(self._form, (), self._start)]
        for start in (None, self._start):
            try:
                fit = fit_output_error(
                    system,
                    self._form.records["estimation"],
                    start=start,
                    horizon=self._form.horizon,
                    noise=dict(zip((name for name, _ in self._form.columns), self._form.weights, strict=True)),
                    intersample=self._form.intersample,
                )
            except _FAILURES:
                continue
            found.append(seen_values(self._form, (), fit.parameters))
        able = [fitted for fitted in found if fitted is not None and fitted.finite]
        best = min(able, key=lambda fitted: _mean_square(fitted.estimation), default=None)
        return None if best is None else SimpleFit((), dict(best.values), best)

    @functools.cached_property
    def table(self) -> list[SimpleFit]:
        """Fits with one effect that come nearer than the nominal one, nearest to the estimation records first.

        All are begun; those whose first steps gain most go on, and with them the special cases of their laws: of a
        law that is not determined, or lies on a bound, a simpler one is what it says.
        """
        if self.nominal is None:
            return []
        self._say("free runs with one effect")
        begun = [trial for placed in self._candidates if (trial := self._begun(placed)) is not None]
        begun.sort(key=lambda trial: trial.cost)
        leaders = begun[: EFFORT.begun]
        simpler = {
            f"{name}@{t.effects[0].at}" for t in leaders for name in map(str, self._laws.nested(t.effects[0].effect))
        }
        leaders += [trial for trial in begun[EFFORT.begun :] if str(trial.effects[0]) in simpler]
        found = [fit for trial in leaders if (fit := self._finished(trial)) is not None]
        found = [fit for fit in found if fit.error("estimation") < self.nominal.error("estimation")]
        return sorted(found, key=lambda fit: fit.error("estimation"))

    def proposals(self, policy: Policy) -> list[Suspect]:
        """Return what the search is to begin whatever the score test says, the nearest fits and their special cases.

        Only what brings free runs of the estimation records nearer by a share of the mean square that is worth it.
        """
        if self.nominal is None:
            return []
        enough = (1.0 - policy.explained) * self.nominal.error("estimation")
        near = [fit for fit in self.table if fit.error("estimation") < enough]
        leaders = near[: EFFORT.proposed]
        simpler = {
            f"{name}@{fit.effects[0].at}"
            for fit in leaders
            for name in map(str, self._laws.nested(fit.effects[0].effect))
        }
        chosen = [*leaders, *(fit for fit in near[EFFORT.proposed :] if str(fit.effects[0]) in simpler)]
        return [Suspect(fit.effects[0], (fit.values,)) for fit in chosen]

    def refitted(self, fit: Fit) -> SimpleFit | None:
        """Return the model of a fit where its free runs come nearest, from where the likelihood has it."""
        windows = self._windows(fit.effects, self._vector(fit.effects, fit.values))
        try:
            states = self._states(windows, fit.effects, self._vector(fit.effects, fit.values))
            trial = self._stepped(_Trial(fit.effects, self._vector(fit.effects, fit.values), states, np.inf), 25)
        except _FAILURES:
            return None
        return None if trial is None else self._shown(trial)

    def seen(self, fit: Fit) -> Fitted | None:
        """Return a fit of the likelihood as the same free runs show it."""
        return seen_values(self._form, fit.effects, fit.values, {**fit.own, **fit.day})

    def errors(self, values: Mapping[str, float]) -> FloatArray | None:
        """Return the rms error of every output (ny,) of the estimation records with values of the nominal model."""
        names = self._form.nominal.parameter_names
        fitted = seen_values(self._form, (), {name: values[name] for name in names})
        if fitted is None or not fitted.finite:
            return None
        return np.asarray(np.sqrt(np.mean(np.concatenate(list(fitted.estimation)) ** 2, axis=0)) * self._form.weights)

    def further(self, mine: Fitted | None, other: Fitted | None, policy: Policy, share: float | None = None) -> bool:
        """Return True if free runs of a model are further from the validation records than those of another.

        By a share of what the nominal model leaves, one that is worth it unless another is given; of more effects, what
        one more must bring. Errors of a free run remember what came before: a standard error over blocks says nothing
        of them. What diverges is further than anything.
        """
        assert self.nominal is not None
        if other is None or not other.finite:
            return False
        if mine is None or not mine.finite:
            return True
        if share is None:
            share = policy.second_share if len(mine.effects) > len(other.effects) else policy.explained
        more = _mean_square(mine.validation) - _mean_square(other.validation)
        return more > share * self.nominal.error("validation")

    def left(self, fit: Fit) -> float:
        """Return the share of the motion of the validation records that free runs of a fit leave, the worst output."""
        return FreeRuns.of(Horizon(self._form.horizon, ""), self._form, None, self.seen(fit)).left

    def scattered(self) -> list[dict[str, float]]:
        """Return values of the nominal model from which free runs come near, of many starts around the declared ones.

        Where no output tells a state, no equation error tells where to start; a time constant ten times off leads to
        another maximum. All take a few steps, the best of them go on (successive halving).
        """
        system = self._form.nominal
        assert by_equations(system)
        free = np.array([not parameter.fixed for parameter in system.parameters], dtype=bool)
        if not free.any():
            return []
        draw, plain = stream("starts", system.name), system.vector()
        low, high = (np.array([getattr(p, side) for p in system.parameters]) for side in ("minimum", "maximum"))
        trials = []
        for number in range(EFFORT.scattered):
            factor = np.exp(EFFORT.spread * draw.normal(size=plain.shape)) if number else 1.0
            trials.append(_Trial((), np.where(free, np.clip(plain * factor, low, high), plain), np.zeros(0), np.inf))
        for most, kept, finer in _HALVINGS:
            after = []
            for trial in trials:
                try:
                    if trial.x0.size == 0:
                        trial.x0 = self._states(self._windows((), trial.p), (), trial.p)
                    after.append(self._stepped(trial, most, EFFORT.roughly / finer))
                except _FAILURES:
                    continue
            trials = sorted((trial for trial in after if trial is not None), key=lambda trial: trial.cost)
            trials = trials[:kept]
        return [self._start_of(system, trial) for trial in trials]

    # ---- the work ------------------------------------------------------------------------------------------------

    def _start_of(self, system: System, trial: _Trial) -> dict[str, float]:
        """Return where a likelihood fit starts: parameters, and the initial states of records that stay whole."""
        start = dict(zip(system.parameter_names, map(float, trial.p), strict=True))
        if self._form.horizon is None:
            names = [channel.name for channel in system.states]
            for row, state in enumerate(trial.x0):
                start |= {f"x0[{row}].{name}": float(value) for name, value in zip(names, state, strict=True)}
        return start

    def _vector(self, effects: Sequence[Placed], values: Mapping[str, float]) -> FloatArray:
        system = self._form.system(effects)
        return system.vector({name: value for name, value in values.items() if name in system.parameter_names})

    def _windows(self, effects: Sequence[Placed], p: FloatArray) -> Windows:
        return self._form.windows(self._form.system(effects), p, "estimation")

    def _states(self, windows: Windows, effects: Sequence[Placed], p: FloatArray) -> FloatArray:
        """Return initial states (W, nx) fitted to every window, from what the data tell."""
        states = [self._form.from_data(windows.simulator, run, p)[0] for run in self._form.records["estimation"]]
        return minimise_states(windows, p, windows.starts_from(states), 8, decrease=0.1)

    def _begun(self, placed: Placed) -> _Trial | None:
        """Return where the first steps of a fit with an effect lead, from the best one without."""
        assert self.nominal is not None
        if placed.effect.grows or placed.effect.cuts or placed.effect.sampled == "quantise":
            return None  # tried where a law that it refines was fitted, or no derivative tells of it
        try:
            p = self._vector([placed], self.nominal.values)
            windows = self._windows([placed], p)
            x0 = np.zeros((len(windows), windows.simulator.nx))
            known = np.array(self.nominal.fitted.record["x0"], dtype=float).reshape(len(windows), -1)
            x0[:, : known.shape[1]] = known
            for row, (number, first, _) in enumerate(windows.places):
                if x0.shape[1] > known.shape[1]:
                    u = self._form.records["estimation"][number].u[first]
                    x0[row, known.shape[1] :] = windows.simulator.hidden_start(x0[row], u, p)
            return self._stepped(_Trial((placed,), p, x0, np.inf), EFFORT.first_steps)
        except _FAILURES:
            return None

    def _stepped(self, trial: _Trial, most: int, decrease: float = EFFORT.roughly) -> _Trial | None:
        """Return where so many steps lead; None where the simulation diverges."""
        system = self._form.system(trial.effects)
        assert isinstance(system, System)
        free = np.array([not parameter.fixed for parameter in system.parameters], dtype=bool)
        p = np.where(log_scaled(system) & free, np.maximum(trial.p, _least(system)), trial.p)
        windows = self._windows(trial.effects, p)
        with np.errstate(all="ignore"):
            solution = minimise(windows, p, trial.x0, free, most, decrease=decrease)
        if not np.isfinite(solution.evaluation.cost):
            return None
        return _Trial(trial.effects, solution.p, solution.x0, solution.evaluation.cost)

    def _finished(self, trial: _Trial) -> SimpleFit | None:
        """Return a trial at its end."""
        try:
            ended = self._stepped(trial, 25)
        except _FAILURES:
            return None
        return None if ended is None else self._shown(ended)

    def _shown(self, trial: _Trial) -> SimpleFit | None:
        """Return a trial as free runs of both uses show it."""
        system = self._form.system(trial.effects)
        values = dict(zip(system.parameter_names, map(float, trial.p), strict=True))
        fitted = seen_values(self._form, trial.effects, values)
        return None if fitted is None or not fitted.finite else SimpleFit(trial.effects, values, fitted)


def _least(system: System) -> FloatArray:
    """Return where a parameter that is fitted through its logarithm wakes up, (np,): nothing moves it from 0."""
    return np.array([EFFORT.awake * abs(parameter.value) for parameter in system.parameters])


def _mean_square(parts: Sequence[FloatArray]) -> float:
    return float(np.mean(np.concatenate(list(parts)) ** 2)) if parts else float("inf")
