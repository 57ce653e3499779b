"""The closed loop: fit, find the residual, trace it to an effect, add it, report the error before and after."""

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
from harness.diagnosis.forms import Fitted, Form, fit_here, rms
from harness.diagnosis.noise import NoiseFloor, noise_floors
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
from harness.errors import FitError, HarnessError, InputError
from harness.rng import stream
from harness.signals import Dataset

__all__ = ["Diagnosis", "Report", "close_loop", "close_loop_file", "diagnose"]

Progress = Callable[[float, str], None]
JSON, HTML, MODEL = "report.json", "report.html", "model.json"


@dataclass(frozen=True, eq=False)
class Report:
    """What :func:`close_loop` returns.

    Attributes
    ----------
    data : dict
        The content of ``report.json``; see :mod:`harness.diagnosis.report_json`.
    folder : Path or None
        Where ``report.json`` and ``report.html`` lie.
    model : System
        The model with the accepted effects, its parameters at their fitted values.
    """

    data: dict[str, Any]
    folder: Path | None
    model: Any = None

    @property
    def verdict(self) -> str:
        """``effects_found``, ``nothing_missing`` or ``unexplained``."""
        return str(self.data["verdict"])

    @property
    def html(self) -> Path | None:
        """The page to read."""
        return None if self.folder is None else self.folder / HTML

    def __str__(self) -> str:
        return str(self.data["summary"])


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
    nominal, same = _nominal(form, values, seed)
    if not same:
        warnings.append("the nominal fit did not end in the same minimum from two starts")
    form, nominal, floors = _reweighed(form, output, nominal, floors, warnings)
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


def close_loop(
    dataset: Dataset,
    model: Any,
    *,
    parameters: Mapping[str, Any] | None = None,
    out: str | Path | None = None,
    rng: np.random.Generator | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    resume: bool = False,
    force: bool = False,
    dictionary: Sequence[Effect] | None = None,
    inverse_dynamics: bool | None = None,
    workers: int | None = None,
    name: str | None = None,
) -> Report:
    """Find the effect that a model lacks, add it, report the error before and after.

    Parameters
    ----------
    dataset : Dataset
        Estimation and validation runs, test runs if there are any.
    model : System or str
        The nominal model, or the name of a built-in one.
    parameters : mapping, optional
        What is known of its parameters: a start value, or a :class:`harness.physics.Parameter` (bounds, fixed).
    out : path, optional
        Folder for ``report.json`` and ``report.html``; made if it is not there.
    rng : Generator, optional
        Draws the seed; otherwise ``seed`` counts.
    seed : int
        Keys surrogates and bootstrap draws: equal seeds give equal reports.
    progress : callable, optional
        Called as ``progress(fraction_done, what)``.
    resume : bool
        Continue what an interrupted call left in ``out``.
    force : bool
        Overwrite a finished report in ``out``.
    dictionary, inverse_dynamics, workers
        See :func:`diagnose`.
    name : str, optional
        What the nominal model is loaded by (``NAME`` or ``FILE.py:NAME``), for ``model.json``; by default the name of
        the model.

    Returns
    -------
    Report

    Raises
    ------
    InputError
        If the data do not fit the model, or ``out`` holds a report and neither ``resume`` nor ``force`` is given.
    """
    from harness.diagnosis.report_html import write_html
    from harness.diagnosis.report_json import report_data
    from harness.diagnosis.store import write_atomic

    folder = _folder(out, resume=resume, force=force)
    system = _system(model, parameters)
    chosen = seed if rng is None else int(rng.integers(2**31))
    found = diagnose(
        dataset,
        system,
        seed=chosen,
        progress=progress,
        folder=folder,
        dictionary=dictionary,
        inverse_dynamics=inverse_dynamics,
        workers=workers,
    )
    if progress is not None:
        progress(0.9, "report")
    data = report_data(found)
    if folder is not None:
        import json

        write_html(found, data, folder / HTML)
        repaired = _repaired(found, name or system.name)
        write_atomic(folder / MODEL, json.dumps(repaired, indent=1, allow_nan=False) + "\n")
        write_atomic(folder / JSON, json.dumps(data, indent=1, allow_nan=False) + "\n")
    if progress is not None:
        progress(1.0, data["summary"])
    return Report(data, folder, found.final.system.with_parameters(found.final.values))


def close_loop_file(
    dataset: str | Path,
    *,
    out: str | Path,
    model: str | None = None,
    validation: str | Path | None = None,
    resume: bool = False,
    force: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
) -> Report:
    """Do the same for a data set file, a bare CSV or Parquet file, or the name of a recording.

    Parameters are those of :func:`close_loop`; see :func:`harness.api.close_loop`.
    """
    from harness import registry
    from harness.data import load_dataset

    _folder(out, resume=resume, force=force, make=False)
    loaded = load_dataset(registry.dataset_path(dataset), model=model, validation=validation)
    system = loaded.system()
    return close_loop(
        loaded.for_system(system),
        system,
        out=out,
        resume=resume,
        force=force,
        seed=seed,
        progress=progress,
        name="" if loaded.nominal is None else loaded.nominal.model,
    )


def _repaired(found: Diagnosis, name: str) -> dict[str, Any]:
    """Return the repaired model as a grey box that ``sysid export`` reads."""
    from harness.specs import spec_to_dict

    return {
        "kind": "grey-box",
        "spec": spec_to_dict(found.dataset.spec),
        "model": name,
        "parameters": {key: float(value) for key, value in found.final.system.values(found.final.values).items()},
        "effects": [[placed.effect.name, placed.at] for placed in found.final.system.effects],
        "intersample": found.dataset.intersample,
        "notes": {"verdict": found.verdict},
    }


# ---- steps -----------------------------------------------------------------------------------------------------------


def _nominal(form: Form, values: Mapping[str, float], seed: int) -> tuple[Fitted, bool]:
    """Return the nominal fit, and whether a second start ends in the same minimum."""
    first = form.solve((), [dict(values)], seed=seed)
    rng = stream("diagnosis-second-start", seed)
    moved = {
        one.name: values[one.name]
        if one.fixed
        else float(np.clip(values[one.name] * np.exp(0.3 * rng.standard_normal()), one.minimum, one.maximum))
        for one in form.nominal.parameters
    }
    try:
        second = form.solve((), [moved], seed=seed)
    except HarnessError:
        return form.evaluate((), first), False
    best = min((first, second), key=lambda one: float(one["cost"]))
    same = abs(first["cost"] - second["cost"]) <= 1e-3 * max(best["cost"], 1e-300)
    return form.evaluate((), best), bool(same)


def _reweighed(
    form: Form, output: OutputForm, nominal: Fitted, floors: tuple[NoiseFloor, ...], warnings: list[str]
) -> tuple[Form, Fitted, tuple[NoiseFloor, ...]]:
    """Weigh columns of unknown noise by their nominal residual; give up a black box that the nominal model beats."""
    from dataclasses import replace

    size = rms(nominal.estimation) * form.weights
    if isinstance(form, EquationForm):
        form.weights = size
        return form, form.evaluate((), nominal.record), floors
    kept = []
    for value, floor in zip(size, floors, strict=True):
        if floor.source == "black_box" and floor.value is not None and value < 0.9 * floor.value:
            note = f"{floor.note}; not used: the nominal model does better ({value:.3g} against {floor.value:.3g})"
            warnings.append(f"noise floor of {floor.output} unknown: {note}")
            kept.append(replace(floor, value=None, source=None, note=note))
        else:
            kept.append(floor)
    floors = tuple(kept)
    weights = np.array([f.value if f.value else float(s) for f, s in zip(floors, size, strict=True)])
    if not np.allclose(weights, output.weights):
        output.weights = weights
        known = dict(nominal.values)
        nominal = fit_here(output, (), [known])
    output.floors = tuple(None if f.value is None else f.value / w for f, w in zip(floors, weights, strict=True))
    return output, nominal, floors


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


def _system(model: Any, parameters: Mapping[str, Any] | None) -> Any:
    """Return the nominal system from a name, a definition or a system."""
    if isinstance(model, str):
        from harness.physics import load_model

        made = load_model(model)
    else:
        made = model.system() if hasattr(model, "system") and not hasattr(model, "generalized_forces") else model
    return made.with_parameters(parameters) if parameters else made


def _folder(out: str | Path | None, *, resume: bool, force: bool, make: bool = True) -> Path | None:
    """Return the folder for the report, made if needed; refuse to overwrite a report."""
    if out is None:
        return None
    folder = Path(out)
    if folder.exists() and not folder.is_dir():
        raise InputError("output folder", expected="a folder", got="a file", remedy="choose another --out", file=folder)
    if (folder / JSON).exists() and not (force or resume):
        raise InputError(
            "the folder holds a report",
            expected="an empty or new folder",
            got=JSON,
            remedy="choose another --out, or --force to overwrite it",
            file=folder,
        )
    held = folder / "candidates"
    if held.is_dir() and any(held.iterdir()) and not (resume or force):
        raise InputError(
            "the folder holds an interrupted diagnosis",
            expected="an empty or new folder",
            got="finished refits without a report",
            remedy="--resume to continue it, or --force to start anew",
            file=folder,
        )
    if make:
        folder.mkdir(parents=True, exist_ok=True)
        if force and not resume and held.is_dir():
            for path in held.iterdir():
                path.unlink()
    return folder
