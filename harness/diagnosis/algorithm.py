"""The diagnosis, step by step: fit, find the residual, trace it to effects, grade what is left."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from harness.diagnosis.adequacy import Adequacy, grade, predictable_part
from harness.diagnosis.confirm import Refitter
from harness.diagnosis.equation_form import EquationForm
from harness.diagnosis.forms import Fitted, Form
from harness.diagnosis.noise import NoiseFloor, noise_floors
from harness.diagnosis.nominal import fit_nominal, reweighed
from harness.diagnosis.output_form import OutputForm
from harness.diagnosis.prepare import (
    Horizon,
    checked,
    choose_horizon,
    forms,
    prefers_equations,
    rough_values,
    short_window,
    sizes_of,
)
from harness.diagnosis.response import Family, responses_of
from harness.diagnosis.screens import Screen, sensitivity_screen
from harness.diagnosis.store import Store, fingerprint
from harness.diagnosis.subset import Search, SearchResult
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
    first_screen: Screen
    adequacy: Adequacy
    families: dict[str, Family]
    warnings: list[str] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def final(self) -> Fitted:
        """The model with the accepted effects (the nominal one if none was accepted)."""
        return self.result.model

    @property
    def verdict(self) -> str:
        """See diagnosis: effects_found, nothing_missing, unexplained."""
        if self.result.accepted:
            return "effects_found"
        return "unexplained" if self.adequacy.predictable else "nothing_missing"


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

    dataset = checked(dataset, system)
    warnings = list(dataset.warnings)
    say(0.02, "first fit of the nominal model")
    values = rough_values(system, dataset)
    horizon = choose_horizon(system, values, dataset)
    say(0.06, "noise floor")
    floors = noise_floors(dataset, horizon=horizon.seconds)
    sizes = sizes_of(system, values, dataset)
    inverse = prefers_equations(system, horizon, floors) if inverse_dynamics is None else inverse_dynamics
    spread = np.std(np.concatenate([run.y for run in dataset.estimation]), axis=0)
    weights = np.array([one.value if one.value else max(0.1 * s, 1e-12) for one, s in zip(floors, spread, strict=True)])
    output, strong, weak = forms(system, dataset, horizon=horizon, floors=floors, weights=weights, sizes=sizes)
    if inverse and strong is None:
        raise FitError(
            "inverse dynamics asked for",
            expected="a measured position for every coordinate",
            got=", ".join(channel.name for channel in system.outputs),
            remedy="leave inverse_dynamics to the data",
        )
    form: Form = strong if inverse and strong is not None else output
    say(0.1, "nominal fit")
    nominal, same = fit_nominal(form, values, seed)
    if not same:
        warnings.append("the nominal fit did not end in the same minimum from two starts")
    form, nominal, floors = reweighed(form, output, nominal, floors, warnings)
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
    first = result.rounds[0].screen if result.rounds else sensitivity_screen(form, nominal, candidates, size_of)
    say(0.82, "what is left, and whether it can be predicted")
    adequacy, families = _adequacy(form, result.model, seed)
    if isinstance(form, OutputForm) and search.detected(result.model):
        seconds = short_window(dataset)
        if horizon.seconds is None or horizon.seconds > 1.5 * seconds:
            other, more = _adequacy(*form.shortened(result.model, seconds), seed)
            if other.rest > adequacy.rest:
                adequacy, families = other, more
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
        first_screen=first,
        adequacy=adequacy,
        families=families,
        warnings=warnings,
        seconds=time.monotonic() - began,
    )


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
