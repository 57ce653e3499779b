"""The grey-box column: the loop finds what a nominal model lacks, which is then fitted to all of the data."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from harness import registry
from harness.benchmark.public.blackbox import parted
from harness.benchmark.public.choices import GreyChoice
from harness.benchmark.public.rules import Rule
from harness.benchmark.public.scores import figure, simulated
from harness.benchmark.public.structures import PublicModel, grown, refitted
from harness.data import LoadedDataset, Nominal, load_dataset, read_description
from harness.errors import InputError
from harness.protocols import Model
from harness.signals import Dataset, PlantSpec, Run, Trajectory

REPORT, MODEL = "report.json", "model.json"


@dataclass(frozen=True)
class PublicSignals:
    """How the channels of a public set become those of a recipe: a factor and a zero on each input.

    Parameters
    ----------
    spec : PlantSpec
        Of the model.
    scale, offset : tuple of float
        For each input.
    """

    spec: PlantSpec
    scale: tuple[float, ...]
    offset: tuple[float, ...]

    def of(self, record: Trajectory) -> Trajectory:
        """Return a record of the set in the model's channels."""
        return Trajectory(record.t, record.u * np.array(self.scale) + np.array(self.offset), record.y, self.spec)


@dataclass(frozen=True, eq=False)
class Repaired:
    """What the loop made of the nominal model."""

    model: Model
    signals: PublicSignals
    words: str  # The nominal model and the effects that it lacked
    refitted: bool  # True if the parameters are those of a fit to all of the data, False if those of the loop


def signals_of(rule: Rule, choice: GreyChoice) -> PublicSignals:
    """Return how the set's channels become those of its recipe; of a set without a recipe they stay as they are.

    Raises InputError if the recipe converts outputs: the figure would be in another unit.
    """
    if not choice.recording:
        return PublicSignals(rule.spec, (1.0,) * rule.spec.nu, (0.0,) * rule.spec.nu)
    path = registry.dataset_path(choice.recording)
    described = read_description(path).signals.values()
    inputs = [one for one in described if one.role == "input"]
    outputs = [one for one in described if one.role == "output"]
    if any(one.scale != 1.0 or one.offset != 0.0 or one.derivative for one in outputs):
        raise InputError(
            "outputs of a recipe", expected="as they are in the files", got="a factor, a zero or a rate",
            remedy="score the set without this recipe", file=path,
        )  # fmt: skip
    spec = load_dataset(path).dataset.spec
    return PublicSignals(spec, tuple(one.scale for one in inputs), tuple(one.offset for one in inputs))


def nominal_data(rule: Rule, train: Sequence[Trajectory], choice: GreyChoice) -> tuple[LoadedDataset, PublicSignals]:
    """Return the records to learn from, their end validating, with the nominal model; no test record among them.

    Of a recipe the nominal model, the conversion of the signals and how the input moves between samples are taken, not
    its runs: those of EMPS validate on what is the test here.
    """
    signals = signals_of(rule, choice)
    learn, validate = parted(train, choice.validation)
    runs = [Run(signals.of(one), "estimation", str(k)) for k, one in enumerate(learn)]
    runs += [Run(signals.of(one), "validation", str(k)) for k, one in enumerate(validate)]
    if choice.recording:
        recipe = load_dataset(registry.dataset_path(choice.recording))
        data = Dataset(rule.id, tuple(runs), recipe.dataset.intersample, recipe.dataset.noise)
        read = load_dataset(data)
        return replace(read, nominal=recipe.nominal, measured=recipe.measured), signals
    read = load_dataset(Dataset(rule.id, tuple(runs)))
    return replace(read, nominal=Nominal(choice.model, dict(choice.options))), signals


def repaired(
    rule: Rule,
    train: Sequence[Trajectory],
    choice: GreyChoice,
    folder: Path,
    progress: Callable[[float, str], None] | None = None,
) -> Repaired:
    """Return the repaired model of a set; the loop leaves its report in a folder, and a finished one is read back.

    Parameters
    ----------
    rule : Rule
    train : sequence of Trajectory
        The records to learn from.
    choice : GreyChoice
    folder : Path
        Of the loop's report.
    progress : callable, optional
        Called as ``progress(fraction_done, what)``.
    """
    from harness.diagnosis import close_loop_file
    from harness.parts.stored import read_model

    data, signals = nominal_data(rule, train, choice)
    if not ((folder / REPORT).is_file() and (folder / MODEL).is_file()):
        close_loop_file(cast("Any", data), out=folder, resume=folder.is_dir(), progress=progress)
    report = json.loads((folder / REPORT).read_text(encoding="utf-8"))
    content = json.loads((folder / MODEL).read_text(encoding="utf-8"))
    loop: Model = read_model(folder)
    whole = [signals.of(one) for one in train]
    ended = _ended(content, data.nominal)
    if choice.grow:
        found = _further(rule, ended, data, signals, whole, choice.grow, progress)
        if found is not None:
            return found
    again = None if ended is None else refitted(rule, ended, whole)
    better = again is not None and _figure(rule, again, whole) <= _figure(rule, loop, whole)
    chosen = again if better and again is not None else loop
    return Repaired(chosen, signals, _words(report, content), better)


def _ended(content: dict[str, Any], nominal: Any) -> PublicModel | None:
    """Return the structure that the loop ended with, or None where its model is no grey box."""
    if content.get("kind") != "grey-box":
        return None
    effects = tuple("@".join(one) for one in content.get("effects", []))
    intersample = content.get("intersample", "zoh")
    return PublicModel(nominal.model, content.get("options", {}), effects, content["parameters"], intersample)


def _further(
    rule: Rule,
    ended: PublicModel | None,
    data: LoadedDataset,
    signals: PublicSignals,
    whole: Sequence[Trajectory],
    most: int,
    progress: Callable[[float, str], None] | None,
) -> Repaired | None:
    """Return the model that added effects lead to, or None where the best over halves is what the loop ended with."""
    nominal = data.nominal
    if nominal is None:
        return None
    starts = [PublicModel(nominal.model, dict(nominal.options), intersample=data.dataset.intersample)]
    if ended is not None:
        starts.append(ended)

    def say(text: str) -> None:
        if progress is not None:
            progress(1.0, text)

    best, error = grown(rule, starts, whole, most, say)
    if not math.isfinite(error) or (ended is not None and best.effects == ended.effects):
        return None
    model = refitted(rule, best, whole)
    if model is None:
        return None
    effects = [one.split("@") for one in best.effects]
    words = _words({}, {"model": best.model, "effects": effects})
    return Repaired(model, signals, f"{words}, added by free runs ({error:.3g} {rule.unit} over halves)", True)


def _figure(rule: Rule, model: Model, records: Sequence[Trajectory]) -> float:
    """Return the rule's figure over the records to learn from."""
    return figure(rule, [one.y for one in records], [simulated(model, one, rule.window) for one in records])


def _words(report: dict[str, Any], content: dict[str, Any]) -> str:
    """Return the model and its effects on one line."""
    effects = ", ".join(f"{name.replace('_', ' ')} at {place}" for name, place in content.get("effects", []))
    verdict = str(report.get("verdict", "")).replace("_", " ")
    return (
        f"{content.get('model', 'model')} with {effects}" if effects else f"{content.get('model', 'model')}: {verdict}"
    )
