"""Confirmation: refit the model with each candidate, all nominal parameters free, and judge it against the old one.

Refits run in worker processes where that pays; every one depends on its own name and seed only, so the number of
workers and the order change nothing. Finished ones are kept in a store.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from harness.diagnosis.accept import (
    GAIN,
    OWN_GAIN,
    Comparison,
    Interval,
    Judgement,
    bic,
    compare_blocks,
    information_samples,
    judge,
)
from harness.diagnosis.descent import Bar
from harness.diagnosis.forms import Fitted, Form, placed_name, rms
from harness.diagnosis.momentum_form import MomentumForm
from harness.diagnosis.per_record import PER_RECORD
from harness.diagnosis.store import Store
from harness.effects.effect import Placed
from harness.rng import stream

__all__ = ["Candidate", "Refitter", "Task", "assess", "far_above", "noise_ratio"]

NOTHING = Comparison(-np.inf, 1.0)
FAR = 2.0
"""Noise floors beyond which a residual is no detail: the level at which a model counts as incomplete."""
INSTANT = 0.05
"""Delays and lags below this share of a sample are no effect: half an integrator's step looks like one."""
PERIODS = 2.0
"""Of a periodic effect that a record must hold."""


@dataclass(frozen=True)
class Task:
    """One refit: the effects, full parameter values to start from, and what it must promise to be carried on."""

    effects: tuple[Placed, ...]
    starts: tuple[Mapping[str, float], ...]
    bar: Bar | None = None

    @property
    def key(self) -> str:
        """Name in the store."""
        places = ";".join(",".join(f"{k}={v:.12g}" for k, v in sorted(one.items())) for one in self.starts)
        bar = "" if self.bar is None else f"|{placed_name(self.bar.effects)}+{self.bar.gain:g}"
        return f"{placed_name(self.effects)}|{places}{bar}"


@dataclass(frozen=True, eq=False)
class Candidate:
    """A refitted model judged against the model before.

    Attributes
    ----------
    added : tuple of Placed
        What it has beyond the model before.
    fitted : Fitted or None
        None if the refit raised.
    delta_bic : float
        BIC before minus BIC after.
    comparison : Comparison
        On the validation records.
    main : dict
        Interval of the main parameter of each added effect.
    judgement : Judgement
    """

    added: tuple[Placed, ...]
    fitted: Fitted | None
    delta_bic: float
    comparison: Comparison
    main: dict[str, Interval] = field(default_factory=dict)
    judgement: Judgement = field(default_factory=lambda: Judgement(False, ("the refit failed",)))
    parameters: int = 0

    @property
    def name(self) -> str:
        """The added effects as text."""
        return placed_name(self.added)

    @property
    def accepted(self) -> bool:
        """True if the rule accepts it."""
        return self.judgement.accepted


_form: Form | None = None


def _install(form: Form) -> None:
    """Keep the form in a worker process (it is inherited or sent once, not with every task).

    Ctrl-C reaches every process of a terminal: the main one decides, and ends its workers.
    """
    import signal

    global _form
    _form = form
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _work(task: Task, seed: int) -> dict[str, Any]:
    """Solve one task in a worker."""
    assert _form is not None
    return _solve(_form, task, seed)


def _solve(form: Form, task: Task, seed: int) -> dict[str, Any]:
    """Solve one task; a refit that cannot be made is a record with its reason, not an exception."""
    from harness.errors import HarnessError

    try:
        with np.errstate(all="ignore"):
            return form.solve(task.effects, task.starts, seed=seed, bar=task.bar)
    except (HarnessError, ArithmeticError, np.linalg.LinAlgError, MemoryError) as error:
        return {"failed": " ".join(str(error).split())[:300]}


@dataclass
class Refitter:
    """Solves tasks: from the store, in this process, or in workers.

    Parameters
    ----------
    form : Form
    store : Store
    seed : int
        Together with a task's effects it keys the random numbers of the refit.
    workers : int
        Processes at most; 1 stays in this process.
    progress : callable, optional
        Called with the name of each finished refit.
    """

    form: Form
    store: Store
    seed: int = 0
    workers: int = 1
    progress: Callable[[str], None] | None = None
    seconds: dict[str, float] = field(default_factory=dict)

    def solve(self, tasks: Sequence[Task]) -> list[dict[str, Any]]:
        """Return the record of every task, in order; each is stored as soon as it is there."""
        records: dict[str, dict[str, Any]] = {}
        missing: list[Task] = []
        for task in tasks:
            known = self.store.get(task.key)
            if known is not None:
                records[task.key] = known
            elif task.key not in {other.key for other in missing}:
                missing.append(task)
        workers = min(self.workers, len(missing), os.cpu_count() or 1)
        with closing(self._parallel(missing, workers) if workers > 1 else self._serial(missing)) as finished:
            for task, record in finished:
                records[task.key] = record
                self.store.put(task.key, record)
                if self.progress is not None:
                    self.progress(placed_name(task.effects))
        return [records[task.key] for task in tasks]

    def fit(self, task: Task) -> Fitted | None:
        """Solve and evaluate one task; None if the refit failed."""
        return self.evaluate(task, self.solve([task])[0])

    def evaluate(self, task: Task, record: Mapping[str, Any]) -> Fitted | None:
        """Return the residuals of a record; None if the refit failed or its simulation breaks down."""
        if "failed" in record:
            return None
        try:
            with np.errstate(all="ignore"):
                return self.form.evaluate(task.effects, record)
        except np.linalg.LinAlgError:
            return None

    def _key(self, task: Task) -> int:
        """Return the seed of a task: its own, whatever the order."""
        return int(stream("diagnosis", placed_name(task.effects), self.seed).integers(2**31))

    def _serial(self, tasks: Sequence[Task]) -> Any:
        """Yield (task, record) one after the other."""
        for task in tasks:
            yield task, _solve(self.form, task, self._key(task))

    def _parallel(self, tasks: Sequence[Task], workers: int) -> Any:
        """Yield (task, record) as workers finish them; falls back to this process if a worker dies."""
        import multiprocessing
        from concurrent.futures import ProcessPoolExecutor, as_completed
        from concurrent.futures.process import BrokenProcessPool

        method = "fork" if "fork" in multiprocessing.get_all_start_methods() else "spawn"
        context = multiprocessing.get_context(method)
        done: set[str] = set()
        others = set(multiprocessing.active_children())
        pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_install, initargs=(self.form,))
        futures: dict[Any, Task] = {}
        try:
            futures = {pool.submit(_work, task, self._key(task)): task for task in tasks}
            for future in as_completed(futures):
                task = futures[future]
                try:
                    record = future.result()
                except BrokenProcessPool:
                    break
                done.add(task.key)
                yield task, record
        except BaseException:
            # interrupted: keep what is finished, and wait for nothing else
            for future, task in futures.items():
                if task.key not in done and future.done() and not future.cancelled() and future.exception() is None:
                    self.store.put(task.key, future.result())
            for process in set(multiprocessing.active_children()) - others:
                process.terminate()
            raise
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
        yield from self._serial([task for task in tasks if task.key not in done])


def noise_ratio(fitted: Fitted, floors: Sequence[float | None]) -> float | None:
    """Return the largest ratio of residual to noise floor over the outputs, on estimation; None if unknown."""
    known = [(value, floor) for value, floor in zip(rms(fitted.estimation), floors, strict=True) if floor]
    return max((float(value / floor) for value, floor in known), default=None)


def far_above(form: Any, fitted: Fitted) -> bool:
    """Return True if every noise floor is known and a residual is far above its own."""
    ratio = noise_ratio(fitted, form.floors)
    return all(form.floors) and ratio is not None and ratio > FAR


def assess(
    form: Form,
    before: Fitted,
    models: Sequence[tuple[tuple[Placed, ...], Fitted | None]],
    *,
    surrogate_p: Mapping[str, float] | float | None,
    seed: int,
    failures: Sequence[str] = (),
    doubts: Callable[[Fitted, Sequence[Placed]], Sequence[str]] = lambda fitted, added: (),
) -> list[Candidate]:
    """Judge refitted models against the model before; all with the same count of independent samples.

    Parameters
    ----------
    form : Form
    before : Fitted
        The model before.
    models : sequence of (added effects, Fitted or None)
        What was added, and the refit.
    surrogate_p : float or mapping, optional
        p-value of the global null, or one for each candidate's name.
    seed : int
        Keys the bootstrap draws.
    failures : sequence of str
        Of each model why its refit failed; empty where it did not.
    doubts : callable, optional
        Returns what else speaks against a model and the effects added to it; asked where nothing else does.

    Returns
    -------
    list of Candidate
        In the order given.
    """
    usable = [one for _, one in models if one is not None and one.finite]
    best = min(usable, key=lambda one: bic(one.estimation, 0, 1.0), default=before)
    samples = information_samples(best.estimation, noise_ratio(best, form.floors))
    reference = bic(before.estimation, len(before.free), samples)
    found = []
    for number, (added, fitted) in enumerate(models):
        if fitted is None or not fitted.finite:
            known = failures[number] if number < len(failures) else ""
            reason = known or ("the refit failed" if fitted is None else "the refitted model diverges")
            found.append(Candidate(added, fitted, -np.inf, NOTHING, judgement=Judgement(False, (reason,))))
            continue
        delta = reference - bic(fitted.estimation, len(fitted.free), samples)
        draws = stream("diagnosis-bootstrap", placed_name(fitted.effects), seed)
        white = isinstance(form, MomentumForm)
        comparison = compare_blocks(before.validation, fitted.validation, rng=draws, white=white)
        # twentieths: the other conditions know how few independent samples there are, and this one asks for a sign only
        intervals = fitted.intervals(adapt=False)
        reasons: list[str] = []
        if fitted.unaided and comparison.gain >= GAIN:
            alone = compare_blocks(before.unaided or before.validation, fitted.unaided, rng=draws)
            if alone.gain < GAIN:
                reasons.append("it gains only through fitted initial values of its hidden state")
        mains: dict[str, Interval] = {}
        for placed in added:
            p = surrogate_p.get(str(placed)) if isinstance(surrogate_p, Mapping) else surrogate_p
            verdict, main = _judge_one(placed, fitted, delta, comparison, intervals, p, form.sample_time)
            if main is not None:
                mains[str(placed)] = main
            reasons += [
                f"{placed}: {reason}" if len(added) > 1 else reason
                for reason in verdict.reasons
                if len(added) == 1 or f"{added[0]}: {reason}" not in reasons
            ]
            reasons += _too_slow(form, placed, fitted)
        if not reasons:
            reasons += doubts(fitted, added)
        judgement = Judgement(not reasons, tuple(dict.fromkeys(reasons)))
        found.append(Candidate(added, fitted, float(delta), comparison, mains, judgement, len(fitted.free)))
    return found


def _too_slow(form: Any, placed: Placed, fitted: Fitted) -> list[str]:
    """Return a reason if a periodic effect has too few periods in every record: a drift or a constant is none."""
    if placed.effect.name != "periodic_disturbance":
        return []
    records = getattr(form, "records", None) or form.motions
    seconds = max((len(one.t) for one in records["estimation"]), default=0) * form.sample_time
    periods = fitted.values[placed.name("omega")] * seconds / (2 * np.pi)
    return [] if periods >= PERIODS else [f"{periods:.2g} periods in the longest record: nothing that repeats is seen"]


def _judge_one(
    placed: Placed,
    fitted: Fitted,
    delta: float,
    comparison: Comparison,
    intervals: Mapping[str, Interval],
    surrogate_p: float | None,
    sample_time: float,
) -> tuple[Judgement, Interval | None]:
    """Apply the acceptance rule to one added effect of a model."""
    parameter = placed.effect.main
    name = placed.main()
    if parameter is None or name is None or name not in intervals:
        # an effect without parameters stands or falls with the error alone
        sure = Interval(1.0, 1.0, 1.0)
        verdict = judge(
            converged=fitted.converged,
            delta_bic=delta,
            comparison=comparison,
            main=sure,
            sign=0,
            minimum=-np.inf,
            maximum=np.inf,
            surrogate_p=surrogate_p,
        )
        return verdict, None
    interval = intervals[name]
    neutral = parameter.neutral or 0.0
    shifted = Interval(interval.value - neutral, interval.low - neutral, interval.high - neutral)
    if parameter.neutral is None and parameter.minimum >= 0:
        # the place of a rim or of a limit: 0 is not its absence, and it was fitted through its logarithm
        half = min(0.5 * (interval.high - interval.low) / max(abs(interval.value), 1e-300), 100.0)
        shifted = Interval(interval.value, interval.value * np.exp(-half), interval.value * np.exp(half))
    sign = {"+": 1, "-": -1, "any": 0}[parameter.sign] if neutral == 0.0 else 0
    verdict = judge(
        converged=fitted.converged,
        delta_bic=delta,
        comparison=comparison,
        main=shifted,
        sign=sign,
        minimum=parameter.minimum - neutral if np.isfinite(parameter.minimum) and parameter.minimum else -np.inf,
        maximum=parameter.maximum - neutral,
        surrogate_p=surrogate_p,
        gain=OWN_GAIN if placed.effect.name in PER_RECORD else GAIN,
    )
    wrong = [
        f"{other.name} has an unphysical sign"
        for other in placed.effect.parameters
        if not other.nuisance
        and other.name != parameter.name
        and _against(other, fitted.values[placed.name(other.name)])
    ]
    wrong += [
        f"{other.name} lies on a bound"
        for other in placed.effect.parameters
        if not (other.nuisance or other.fixed or other is parameter)
        and _on_bound(other, fitted.values[placed.name(other.name)])
    ]
    shape = {other.name: abs(fitted.values[placed.name(other.name)]) for other in placed.effect.parameters}
    if "vs" in shape and "w" in shape and shape["vs"] < 2 * shape["w"]:
        wrong.append("its Stribeck speed lies within the smoothing of the sign: no Stribeck branch is seen")
    if parameter.unit == "s" and abs(interval.value) < INSTANT * sample_time:
        wrong.append(
            f"{interval.value:.2g} s is less than {100 * INSTANT:g} % of a sample: a detail of a clock or an integrator"
        )
    if wrong:
        verdict = Judgement(False, (*verdict.reasons, *wrong))
    return verdict, interval


def _against(parameter: Any, value: float) -> bool:
    """Return True if a value has the sign that physics forbids."""
    return (parameter.sign == "+" and value < 0) or (parameter.sign == "-" and value > 0)


def _on_bound(parameter: Any, value: float) -> bool:
    """Return True if a value lies on a bound other than 0."""
    low, high = parameter.minimum, parameter.maximum
    edge = 1e-3 * (high - low) if np.isfinite(high - low) else 1e-6 * max(abs(value), 1e-12)
    return bool((np.isfinite(high) and value > high - edge) or (np.isfinite(low) and low != 0 and value < low + edge))
