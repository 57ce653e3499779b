"""The diagnosis, step by step: fit, find the residual, trace it to effects, grade what is left."""

from __future__ import annotations

import functools
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from harness.diagnosis.adequacy import Adequacy, grade, no_small_disturbance, nothing_left, predictable_part
from harness.diagnosis.columns_check import check_columns, check_scale
from harness.diagnosis.confirm import Refitter
from harness.diagnosis.equation_form import EquationForm
from harness.diagnosis.forms import Fitted, Form
from harness.diagnosis.noise import NoiseFloor, noise_floors
from harness.diagnosis.nominal import fit_nominal, reweighed
from harness.diagnosis.output_form import OutputForm
from harness.diagnosis.prepare import Horizon, short_window
from harness.diagnosis.response import Family, responses_of
from harness.diagnosis.screens import Screen, sensitivity_screen
from harness.diagnosis.store import Store, fingerprint
from harness.diagnosis.stretches import polished, stretched
from harness.diagnosis.subset import Search, SearchResult
from harness.diagnosis.thinning import thinned_dataset
from harness.effects.effect import Effect, Placed
from harness.errors import FitError, HarnessError
from harness.rng import stream
from harness.signals import Dataset

__all__ = ["Diagnosis", "diagnose"]

Progress = Callable[[float, str], None]


@dataclass(eq=False)
class Diagnosis:
    """Everything that one diagnosis found out, for the reports."""

    dataset: Dataset
    system: Any
    horizon: Horizon
    floors: tuple[NoiseFloor, ...]
    form: Form
    output: OutputForm
    strong: EquationForm | None
    inverse: bool
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


def diagnose(
    dataset: Dataset,
    system: Any,
    *,
    seed: int = 0,
    progress: Progress | None = None,
    folder: Path | None = None,
    dictionary: Sequence[Effect] | None = None,
    inverse_dynamics: bool | None = None,
    workers: int | None = None,
) -> Diagnosis:
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
    inverse_dynamics : bool, optional
        Judge force residuals on measured motion instead of simulations; by default decided from the data.
    workers : int, optional
        Processes for refits; by default the number of cores, at most 4.

    Raises
    ------
    InputError
        If the data do not fit the model.
    """
    began = time.monotonic()

    def say(part: float, what: str) -> None:
        if progress is not None:
            progress(part, what)

    ways = _ways(system)
    whole = thinned_dataset(ways.checked(dataset, system), system)
    dataset = stretched(whole)
    warnings = list(dataset.warnings)
    say(0.02, "first fit of the nominal model")
    if hasattr(system, "coordinates") and hasattr(system, "f"):
        check_columns(system, dataset)
    values = ways.rough_values(system, dataset)
    if hasattr(system, "f"):
        warnings += check_scale(system, values)
    horizon = ways.choose_horizon(system, values, dataset)
    say(0.06, "noise floor")
    floors = noise_floors(dataset, horizon=horizon.seconds)
    sizes: dict[str, dict[str, float]] = ways.sizes_of(system, values, dataset)
    inverse = ways.prefers_equations(system, horizon, floors) if inverse_dynamics is None else inverse_dynamics
    spread = np.std(np.concatenate([run.y for run in dataset.estimation]), axis=0)
    weights = np.array([one.value if one.value else max(0.1 * s, 1e-12) for one, s in zip(floors, spread, strict=True)])
    output, strong, weak = ways.forms(system, dataset, horizon=horizon, floors=floors, weights=weights, sizes=sizes)
    if inverse and strong is None:
        raise FitError(
            "inverse dynamics asked for",
            expected="a measured position for every coordinate",
            got=", ".join(channel.name for channel in system.outputs),
            remedy="leave inverse_dynamics to the data",
        )
    form: Form = strong if inverse and strong is not None else output
    say(0.1, "nominal fit")
    nominal, same = fit_nominal(form, values, seed, floors)
    if not same:
        warnings.append("the nominal fit did not end in the same minimum from two starts")
    form, nominal, floors = reweighed(form, output, nominal, floors, warnings)
    sizes = output.sizes
    identity = fingerprint(dataset, model=str(system), parameters=str(system.parameters), horizon=horizon.seconds,
                           inverse=inverse, weights=form.weights.tolist())  # fmt: skip
    count = min(os.cpu_count() or 1, 4) if workers is None else workers
    refitter = Refitter(form, Store(folder, identity), seed, count, lambda name: say(_fraction(), f"refitted {name}"))
    steps = iter(np.linspace(0.25, 0.8, 60))

    def _fraction() -> float:
        return float(next(steps, 0.8))

    candidates = [one for one in _placed(system, dictionary) if form.judges(one)]

    def size_of(placed: Placed) -> Mapping[str, float]:
        return sizes.get(placed.at, sizes.get("base", {}))

    search = Search(form, weak, candidates, sizes, refitter, seed, lambda text: say(_fraction(), text))
    result = search.run(nominal)
    if dataset is not whole:
        say(0.8, "refitting on the whole records")
        again = polished(form, nominal, whole)
        result = replace(result, model=again if result.model is nominal else polished(form, result.model, whole))
        nominal = again
    say(0.82, "what is left, and whether it can be predicted")
    left = search.detected(result.model) or not all(form.floors)
    adequacy, families = _adequacy(form, result.model, seed) if left else (nothing_left(), {})
    if isinstance(form, OutputForm) and search.detected(result.model):
        seconds = short_window(dataset)
        if horizon.seconds is None or horizon.seconds > 1.5 * seconds:
            other, more = _adequacy(*form.shortened(result.model, seconds), seed)
            if other.rest > adequacy.rest:
                adequacy, families = other, more
        if not adequacy.predictable and weak is not None and all(weak.judges(one) for one in result.model.effects):
            # a strong law makes free runs lose track; in the momentum balance of the measured motion it shows directly
            other, more = _adequacy(weak, weak.evaluate(*_solved(weak, result.model)), seed)
            if other.predictable:
                adequacy, families = other, more
        if not result.accepted and not adequacy.predictable:
            for seen in (result.model, form.shortened(result.model, seconds)[1]):
                for use, parts in (("estimation", seen.estimation), ("validation", seen.validation)):
                    outputs = [run.y / form.weights for run in form.records[use]]
                    if no_small_disturbance(parts, outputs, form.floors):
                        adequacy = replace(adequacy, grade="proxy_or_incomplete", too_large=True)
    return Diagnosis(
        dataset=dataset,
        system=system,
        horizon=horizon,
        floors=floors,
        form=form,
        output=output,
        strong=strong,
        inverse=inverse,
        nominal=nominal,
        same_minimum=same,
        result=result,
        screened=lambda: sensitivity_screen(form, nominal, candidates, size_of),
        adequacy=adequacy,
        families=families,
        warnings=warnings,
        seconds=time.monotonic() - began,
    )


def _ways(system: Any) -> Any:
    """Return what prepares the loop: for equations, or for an FMU."""
    from harness.diagnosis import prepare
    from harness.diagnosis.fmu_system import FmuSystem

    if isinstance(system, FmuSystem):
        from harness.diagnosis import fmu_prepare

        return fmu_prepare
    return prepare


def _solved(weak: EquationForm, fitted: Fitted) -> tuple[tuple[Placed, ...], Mapping[str, Any]]:
    """Return the effects of a model and their fit in the momentum balance."""
    return fitted.effects, weak.solve(fitted.effects, [fitted.values], seed=0)


def _adequacy(form: Form, fitted: Fitted, seed: int) -> tuple[Adequacy, dict[str, Family]]:
    """Return how much of what is left can be predicted on validation data."""
    responses, families, outside = responses_of(form, fitted)
    usable = {
        name: pair for name, pair in responses.items() if all(np.isfinite(one).all() for part in pair for one in part)
    }
    inside = form.clean(fitted, [one[:, :, None] for one in fitted.estimation])
    found, null = predictable_part(
        [one[:, :, 0] for one in inside],
        outside,
        usable,
        rng=stream("diagnosis-adequacy", seed),
        roughness={name: family.roughness() for name, family in families.items()},
    )
    return grade(found, null, outside, form.floors, rng=stream("diagnosis-adequacy-blocks", seed)), families


def _placed(system: Any, dictionary: Sequence[Effect] | None) -> list[Placed]:
    """Return every effect at every port it fits: built in, of plug-ins, or the dictionary given."""
    from harness.effects import builtin, place_all

    if dictionary is not None:
        return place_all(system, dictionary)
    known = dict(builtin())
    try:
        from harness import registry

        for entry in registry.entries("effects"):
            made = registry.load("effects", entry.id)
            if isinstance(made, Effect):
                known.setdefault(made.name, made)
    except HarnessError:
        pass  # no plug-in brings effects
    return place_all(system, known.values())
