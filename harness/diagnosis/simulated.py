"""Diagnosis by free runs and screens: of FMUs, which show no equations, and of processes without equations of motion.

A latent force on every rate of a process takes up what a missing law does to it, so free runs judge there.
"""

from __future__ import annotations

import functools
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from harness.diagnosis.adequacy import Adequacy
from harness.diagnosis.confirm import far_above
from harness.diagnosis.dictionary import placed
from harness.diagnosis.forms import Fitted, Form
from harness.diagnosis.horizons import searched
from harness.diagnosis.leftover import leftover
from harness.diagnosis.noise import NoiseFloor, noise_floors
from harness.diagnosis.nominal import fit_nominal, reweighed
from harness.diagnosis.output_form import OutputForm
from harness.diagnosis.prepare import Horizon
from harness.diagnosis.refit_workers import RefitWorkers
from harness.diagnosis.refitter import Refitter
from harness.diagnosis.response import Family
from harness.diagnosis.screens import Screen, sensitivity_screen
from harness.diagnosis.store import Store, fingerprint
from harness.diagnosis.stretches import polished, stretched
from harness.diagnosis.subset import Search, SearchResult
from harness.effects.effect import Effect, Placed
from harness.signals import Dataset
from harness.workers import one_thread

__all__ = ["SimulatedDiagnosis", "diagnose_by_simulation"]

Progress = Callable[[float, str], None]
DISTURBED = "something that is not measured disturbs the plant: over short windows the effects stand out most from it"


@dataclass(eq=False)
class SimulatedDiagnosis:
    """Everything that one diagnosis found out, for the reports."""

    dataset: Dataset
    system: Any
    horizon: Horizon
    floors: tuple[NoiseFloor, ...]
    form: Form
    output: OutputForm
    nominal: Fitted
    same_minimum: bool
    result: SearchResult
    screened: Callable[[], Screen] = field(repr=False)
    adequacy: Adequacy
    families: dict[str, Family]
    warnings: list[str] = field(default_factory=list)
    seconds: float = 0.0

    @functools.cached_property
    def first_screen(self) -> Screen:
        """The dictionary against the nominal model: what this experiment can show, and tell apart."""
        return self.result.rounds[0].screen if self.result.rounds else self.screened()

    @property
    def final(self) -> Fitted:
        """The model with the accepted effects (the nominal one if none was accepted)."""
        return self.result.model

    @property
    def verdict(self) -> str:
        """See diagnosis: effects_found, nothing_missing, unexplained."""
        if self.result.accepted:
            return "effects_found"
        return "unexplained" if self.adequacy.unexplained else "nothing_missing"


def diagnose_by_simulation(
    dataset: Dataset,
    system: Any,
    *,
    seed: int = 0,
    progress: Progress | None = None,
    folder: Path | None = None,
    dictionary: Sequence[Effect] | None = None,
    workers: int | None = None,
) -> SimulatedDiagnosis:
    """Run the algorithm and return all that it found, without writing a report.

    Parameters
    ----------
    dataset : Dataset
        With estimation and validation runs; test runs are scored at the end and influence nothing.
    system : System
        The nominal model, measured as the data are.
    seed : int
        Keys surrogates and bootstrap draws.
    progress : callable, optional
        Called as ``progress(fraction_done, what)``.
    folder : Path, optional
        Where finished refits are kept.
    dictionary : sequence of Effect, optional
        By default the built-in effects and those of installed plug-ins.
    workers : int, optional
        Processes for refits; by default the number of cores, at most 4.

    Raises
    ------
    InputError
        If the data do not fit the model.
    """
    count = min(os.cpu_count() or 1, 4) if workers is None else workers
    with one_thread(), RefitWorkers(count) as helpers:
        return _diagnosed(dataset, system, seed, progress, folder, dictionary, helpers)


def _diagnosed(
    dataset: Dataset,
    system: Any,
    seed: int,
    progress: Progress | None,
    folder: Path | None,
    dictionary: Sequence[Effect] | None,
    helpers: RefitWorkers,
) -> SimulatedDiagnosis:
    """Do what :func:`diagnose_by_simulation` says."""
    began = time.monotonic()

    def say(part: float, what: str) -> None:
        if progress is not None:
            progress(part, what)

    ways = _ways(system)
    whole = ways.checked(dataset, system)
    dataset = stretched(whole)
    warnings = list(dataset.warnings)
    say(0.02, "first fit of the nominal model")
    values = ways.rough_values(system, dataset)
    horizon = ways.choose_horizon(system, values, dataset)
    say(0.06, "noise floor")
    floors = noise_floors(dataset, horizon=horizon.seconds)
    sizes: dict[str, dict[str, float]] = ways.sizes_of(system, values, dataset)
    spread = np.std(np.concatenate([run.y for run in dataset.estimation]), axis=0)
    weights = np.array([one.value if one.value else max(0.1 * s, 1e-12) for one, s in zip(floors, spread, strict=True)])
    output: OutputForm = ways.form(system, dataset, horizon=horizon, floors=floors, weights=weights, sizes=sizes)
    form: Form = output
    say(0.1, "nominal fit")
    nominal, same = fit_nominal(form, values, seed, floors)
    if not same:
        warnings.append("the nominal fit did not end in the same minimum from two starts")
    form, nominal, floors = reweighed(form, output, nominal, floors, warnings)
    sizes = {port: dict(one) for port, one in output.sizes.items()}
    steps = iter(np.linspace(0.25, 0.8, 60))

    def _fraction() -> float:
        return float(next(steps, 0.8))

    everything, faults = placed(system, dictionary)
    warnings += faults
    candidates = [one for one in everything if form.judges(one)]

    def size_of(placed: Placed) -> Mapping[str, float]:
        return sizes.get(placed.at, sizes.get("base", {}))

    stores: dict[tuple[str, float | None], Store] = {}  # what a second search needs again is there

    def search_of(one: Form) -> Search:
        seconds = getattr(one, "horizon", horizon.seconds)
        identity = fingerprint(dataset, model=str(system), parameters=str(system.parameters), horizon=seconds,
                               weights=one.weights.tolist())  # fmt: skip
        store = stores.setdefault((type(one).__name__, seconds), Store(folder, identity))
        refitter = Refitter(one, store, seed, helpers, lambda name: say(_fraction(), f"refitted {name}"))
        judged = [placed for placed in candidates if one.judges(placed)]
        return Search(one, judged, sizes, refitter, seed, lambda text: say(_fraction(), text))

    def graded(one: Form, found: SearchResult, others: Sequence[tuple[Form, Fitted]]) -> Any:
        say(0.82, "what is left, and whether it can be predicted")
        return leftover(one, found, others, dataset, seed, detected=search_of(one).detected(found.model))

    usual, usual_nominal = form, nominal
    form, nominal, result = searched(form, nominal, search_of, size_of)
    others = [] if form is usual or result.accepted else [(usual, usual_nominal)]
    adequacy, families = graded(form, result, others)
    if form is not usual and adequacy.predictable:
        # no disturbance can be predicted: a law is missing that the search over short windows did not find
        again = search_of(usual).run(usual_nominal)
        if again.accepted and not far_above(usual, again.model):
            form, nominal, result = usual, usual_nominal, again
            adequacy, families = graded(form, result, [])
    if form is not usual:
        assert isinstance(form, OutputForm)
        output, horizon = form, Horizon(form.horizon, DISTURBED)
    if dataset is not whole:
        say(0.85, "refitting on the whole records")
        first = polished(form, nominal, whole)
        result = replace(result, model=first if result.model is nominal else polished(form, result.model, whole))
        nominal = first
        adequacy, families = graded(form, result, [])
    warnings += undetermined(result.model)
    return SimulatedDiagnosis(
        dataset=dataset,
        system=system,
        horizon=horizon,
        floors=floors,
        form=form,
        output=output,
        nominal=nominal,
        same_minimum=same,
        result=result,
        screened=lambda: sensitivity_screen(form, nominal, candidates, size_of),
        adequacy=adequacy,
        families=families,
        warnings=warnings,
        seconds=time.monotonic() - began,
    )


def undetermined(model: Fitted) -> list[str]:
    """Return a warning for every effect whose size the data hardly tell, though it takes away error."""
    found = []
    for one in model.effects:
        name, parameter = one.main(), one.effect.main
        if name is None or parameter is None or parameter.neutral is None or name not in model.free:
            continue
        interval = model.intervals()[name]
        if interval.low <= parameter.neutral <= interval.high:
            found.append(
                f"the 95 % interval of {name} includes {parameter.neutral:g}: what is left stays correlated for so "
                "long that its size is hardly known; that the error falls is no chance"
            )
    return found


def _ways(system: Any) -> Any:
    """Return what prepares the loop: for an FMU, or for equations."""
    from harness.diagnosis import fmu_prepare, prepare
    from harness.diagnosis.fmu_system import FmuSystem

    return fmu_prepare if isinstance(system, FmuSystem) else prepare
