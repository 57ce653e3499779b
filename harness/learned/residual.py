"""A learned residual force at the end of a closed loop: reads its folder, learns on the same data, writes a folder."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import numpy as np

from harness.errors import UNREADABLE, InputError, unread
from harness.jobs.alone import alone_in
from harness.physics.fitting.output_error import simulate_error
from harness.physics.fitting.residual_force import LABEL
from harness.physics.fitting.residual_learning import LearnedForce, learn_residual_force
from harness.signals import Dataset

if TYPE_CHECKING:
    from harness.data import LoadedDataset

FORMAT = "sysid-harness/learned-residual/1"
JSON, HTML, MODEL, REPORT = "learned.json", "learned.html", "model.json", "report.json"
NOTHING_LEFT = {
    "nothing_missing": "the loop found that nothing is missing",
    "model_does_not_fit": "the loop found that the model does not fit these data: a mistake in the columns is likelier",
    "explained": "the effects that the loop found explain the data",
}
"""Verdicts, and the grade of an answer, after which a force without a name would only learn noise or a mistake."""


@dataclass(frozen=True, eq=False)
class LearnedResidual:
    """What :func:`learn_residual` returns.

    Parameters
    ----------
    data : dict
        The content of ``learned.json``.
    learned : LearnedForce
    folder : Path
    """

    data: dict[str, Any]
    learned: LearnedForce
    folder: Path

    def __str__(self) -> str:
        return str(self.data["summary"])


def learn_residual(
    loop: str | Path,
    model: Any,
    loaded: LoadedDataset,
    *,
    out: str | Path,
    coordinate: str | None = None,
    arguments: Sequence[str] | None = None,
    refit: bool = False,
    rng: np.random.Generator,
    progress: Callable[[float, str], None] | None = None,
) -> LearnedResidual:
    """Learn the force that the model of a finished loop still lacks, and store the model with it.

    Parameters
    ----------
    loop : path
        Folder that ``sysid close-loop`` wrote.
    model : GreyBoxModel
        The model in it.
    loaded : LoadedDataset
        The data of the loop.
    out : path
        Folder for ``learned.html``, ``learned.json`` and, if the force helps, ``model.json``; made if needed.
    coordinate, arguments, refit, progress
        See :func:`harness.physics.fitting.residual_learning.learn_residual_force`.
    rng : numpy.random.Generator

    Raises
    ------
    InputError
        If the loop left nothing to learn, or its model has no equations of motion that a force could be added to.
    FitError
        If no fit succeeds.
    """
    from harness.learned.page import page

    folder, target = Path(loop), Path(out)
    report = _report(folder)
    verdict = _something_left(report, folder)
    if not hasattr(model, "recipe"):
        raise InputError(
            "a residual force",
            expected="a loop closed around equations of motion",
            got=f"a model of class {type(model).__name__}",
            remedy="an FMU or an arm takes no learned force: write the plant as equations (docs/plugins.md)",
            file=folder,
        )
    if model.recipe.unnamed:
        raise InputError(
            "a second learned force",
            expected="a folder of sysid close-loop",
            got="a model that has a learned force already",
            remedy="start from the folder of the closed loop",
            file=folder,
        )
    with alone_in(target):
        system = model.system()
        known = () if loaded.nominal is None else [name for name, one in loaded.nominal.parameters.items() if one.fixed]
        system = system.with_parameters(
            {name: replace(system.parameter(name), fixed=True) for name in known if name in system.parameter_names}
        )
        dataset = loaded.for_system(system)
        how = {"horizon": report["horizon"]["seconds"], "intersample": model.intersample}
        learned = learn_residual_force(
            system,
            model.parameters,
            list(dataset.estimation),
            list(dataset.validation),
            coordinate=coordinate,
            arguments=arguments,
            refit=refit,
            rng=rng,
            progress=progress,
            **how,
        )
        before = system.values(model.parameters)
        data: dict[str, Any] = {
            "format": FORMAT,
            "label": LABEL,
            "dataset": dataset.name,
            "model": report["model"],
            "loop": {"verdict": verdict, "adequacy": report.get("adequacy"), "summary": report.get("summary")},
            "helps": learned.helps,
            "gain": _number(learned.gain),
            "gain_standard_error": _number(learned.gain_error),
            "outside_the_hull": learned.outside,
            "refit": refit,
            "horizon_s": how["horizon"],
            "intersample": how["intersample"],
            "errors": _errors(system, before, learned, dataset, how),
            "force": learned.force.to_dict(),
            "parameters": {"before": before, "after": learned.system.values()},
            "warnings": _warnings(report, dataset, learned),
            "summary": "",
        }
        data["summary"] = _summary(data, learned)
        _write(target / HTML, page(data, learned, system, before, dataset))
        if learned.helps:
            repaired = replace(
                model,
                recipe=model.recipe.with_unnamed([learned.force]),
                parameters=learned.system.values(),
                filter_gain=None,
                notes={**model.notes, "learned": str(learned.force)},
            )
            _write(target / MODEL, json.dumps(repaired.to_dict(), indent=1, allow_nan=False) + "\n")
        else:
            (target / MODEL).unlink(missing_ok=True)  # of an earlier call
        _write(target / JSON, json.dumps(data, indent=1, allow_nan=False) + "\n")
        return LearnedResidual(data, learned, target)


class _Horizon(msgspec.Struct):
    seconds: Annotated[float, msgspec.Meta(gt=0.0)] | None


class _Read(msgspec.Struct):
    """What is taken from ``report.json``."""

    verdict: str
    model: str
    horizon: _Horizon
    adequacy: str | None = None
    dataset: str | None = None
    summary: str | None = None


def _report(folder: Path) -> dict[str, Any]:
    """Return the content of report.json."""
    path = folder / REPORT
    try:
        content: Any = json.loads(path.read_text(encoding="utf-8"))
        if not str(content["format"]).startswith("sysid-harness/close-loop/"):
            raise KeyError("format")
        msgspec.convert(content, _Read)
    except (*UNREADABLE, KeyError, TypeError, msgspec.ValidationError) as error:
        raise InputError(
            "not a finished closed loop",
            expected=f"a folder of sysid close-loop with {REPORT}",
            got=unread(path, error),
            remedy="run sysid close-loop first",
            file=path,
        ) from error
    return dict(content)


def _something_left(report: dict[str, Any], folder: Path) -> str:
    """Return the verdict of a loop that left something, or refuse."""
    verdict = str(report["verdict"])
    for said in (verdict, str(report.get("adequacy"))):
        if said in NOTHING_LEFT:
            raise InputError(
                "nothing to learn",
                expected="a loop that ended unexplained, or with a rest",
                got=NOTHING_LEFT[said],
                remedy="use the model of the loop as it is, or correct the data and close the loop again",
                file=folder / REPORT,
            )
    return verdict


def _errors(
    system: Any, before: dict[str, float], learned: LearnedForce, dataset: Dataset, how: dict[str, Any]
) -> dict[str, dict[str, dict[str, Any]]]:
    """Return the rms of free runs without and with the force, by use and output."""
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for use in ("estimation", "validation", "test"):
        records = list(dataset.using(use))
        if not records:
            continue
        pair = [simulate_error(system, before, records, **how), simulate_error(learned.system, {}, records, **how)]
        rms = [np.sqrt(np.mean(np.concatenate(errors) ** 2, axis=0)) for errors in pair]
        found[use] = {
            channel.name: {"unit": channel.unit, "before": _number(rms[0][j]), "after": _number(rms[1][j])}
            for j, channel in enumerate(dataset.spec.outputs)
        }
    return found


def _number(value: float) -> float | None:
    """Return a number that JSON has, None in place of any other."""
    return float(value) if np.isfinite(value) else None


def _warnings(report: dict[str, Any], dataset: Dataset, learned: LearnedForce) -> list[str]:
    """Return what a user of the force must know."""
    found = ["the force has no physical meaning: outside the hull of its data it fades to 0 and nothing is claimed"]
    if not dataset.test:
        found.append(
            "validation chose the force and there is no test run: its figures are not independent of the choice"
        )
    if dataset.name != report.get("dataset"):
        found.append(f"the loop was closed on {report.get('dataset')}, the force is learned on {dataset.name}")
    if learned.outside > 0.05:
        found.append(f"{100 * learned.outside:.0f} % of the validation samples lie outside the hull")
    return found


def _summary(data: dict[str, Any], learned: LearnedForce) -> str:
    """Return one paragraph in words."""
    sure = f"{100 * learned.gain:.0f} +- {100 * learned.gain_error:.0f} %" if np.isfinite(learned.gain) else "nothing"
    if not learned.helps:
        return (
            f"no learned force lowers the validation error for certain (best: {sure} of its mean square): "
            "the model of the loop stays as it is"
        )
    use = "test" if "test" in data["errors"] else "validation"
    pairs = ", ".join(
        f"{name} {one['before']:.4g} -> {one['after']:.4g} {one['unit']}"
        for name, one in data["errors"][use].items()
        if None not in (one["before"], one["after"])
    )
    return f"{learned.force}; it takes away {sure} of the mean square of the validation error; {use} rms {pairs}"


def _write(path: Path, text: str) -> None:
    """Write a file whole or not at all."""
    from harness.data.whole_files import whole_file

    with whole_file(path) as scratch:
        scratch.write_text(text, encoding="utf-8")
