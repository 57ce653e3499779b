"""One row: make the records, diagnose them, refit the oracle, compare with the truth."""

from __future__ import annotations

import os
import time
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.errors import HarnessError
from sysid_lab.cost import timed_command
from sysid_lab.outcome import Answer, judge_answer, plain_law
from sysid_lab.plan import Task
from sysid_lab.records import SAMPLES, Records, make_records
from sysid_lab.truths.disturbances import UNNAMED, named
from sysid_lab.truths.hardware import LAWS

if TYPE_CHECKING:
    from harness.diagnosis.search.fit import Fit
    from harness.effects.effect import Placed
    from sysid_lab.power import Power

COLUMNS = (
    "key",
    "study",
    "plant",
    "engine",
    "model",
    "truth",
    "level",
    "noise",
    "disturbance",
    "shape",
    "structure",
    "input_noise",
    "index",
    "base",
    "seed",
    "status",
    "reason",
    "outcome",
    "how",
    "verdict",
    "adequacy",
    "stand_in",
    "accepted",
    "parts",
    "ties",
    "tie_size",
    "shown",
    "told",
    "nearest",
    "validation_before",
    "validation_after",
    "validation_oracle",
    "ratio",
    "improvement",
    "oracle_improvement",
    "residual_over_floor",
    "covered",
    "intervals",
    "outside_interval",
    "holds_truth",
    "noise_sd",
    "peak_deg",
    "cpu_s",
    "cpu_cold_s",
    "wall_s",
)


def do_row(task: Task, *, samples: int = SAMPLES) -> dict[str, Any]:
    """Return the row of a task; what goes wrong is a row with its reason.

    Parameters
    ----------
    task : Task
    samples : int
        Of one record.

    Returns
    -------
    dict
        The columns :data:`COLUMNS`; empty text for what is not known.
    """
    row = dict.fromkeys(COLUMNS, "") | task.columns()
    try:
        records = make_records(task, samples=samples)
        row.update(noise_sd=_short(records.noise), peak_deg=_short(records.peak))
        row.update(_diagnose(task, records))
        row["status"] = "ok"
    except HarnessError as error:
        row.update(status=error.status, reason=" ".join(str(error).split())[:300])
    except Exception as error:  # a fault of the diagnosis is a result of the study, and must not stop it
        row.update(status="crashed", reason=f"{type(error).__name__}: {' '.join(str(error).split())}"[:300])
    return row


def _diagnose(task: Task, records: Records) -> dict[str, Any]:
    """Return the columns that a diagnosis fills."""
    if task.model == "fmu":
        return _diagnose_fmu(task, records)
    if task.study == "cost":
        return _command(task, records)
    from harness.diagnosis.algorithm import diagnose

    cpu, wall = _cpu_of_tree(), time.monotonic()
    found = diagnose(records.dataset, _model(task, records))
    cpu, wall = _cpu_of_tree() - cpu, time.monotonic() - wall
    answer = _answer(task, found)
    accepted, beside = answer.accepted, named(task.structure, task.plant)
    rivals = (answer.by_plain_law() if task.engine == "hardware" else answer).ties
    outcome = judge_answer(task.effects, answer, task.plant, task.engine, task.structure)
    before, after = _error(found.runs.before), _error(found.runs.after)
    row: dict[str, Any] = {
        "outcome": outcome.word,
        "how": outcome.how,
        "verdict": found.verdict,
        "adequacy": found.grade,
        "stand_in": "; ".join([*found.stand_in, *found.misfit]),
        "accepted": " + ".join(accepted),
        "parts": " + ".join(str(effect.placed) for effect in found.outcome.accepted if effect.part_of),
        "ties": "; ".join(
            " / ".join(sorted(" & ".join(sorted(member)) for member in tie)) for tie in answer.ties if len(tie) > 1
        ),
        "tie_size": max((len(tie) for name, tie in zip(accepted, rivals, strict=True) if name != beside), default=0),
        "validation_before": _short(before),
        "validation_after": _short(after),
        "improvement": _short(before / after),
        "residual_over_floor": _short(after),
        "cpu_s": f"{cpu:.2f}",
        "wall_s": f"{wall:.2f}",
    }
    known = _oracle(found, records) if records.known and task.study != "outside" else None
    row.update(_beside_oracle(found, known, before, after, hidden=bool(records.known)))
    if task.study == "confusion" and known is not None:
        power = _power(task, found, found.final if outcome.word == "right" else known)
        row.update(shown=f"{power.shown:.3f}", told=f"{min(power.shown, power.told):.3f}", nearest=power.nearest)
    strangers = set(accepted) - {*task.effects, beside} if outcome.word == "wrong" else set()
    row.update(_coverage(found.final, records, strangers))
    row["holds_truth"] = "yes" if _holds(task, [effect.placed for effect in found.outcome.accepted], records) else "no"
    return row


def _answer(task: Task, found: Any) -> Answer:
    """Return what a report says is there; a part of something unknown is none."""
    names = [effect for effect in found.outcome.accepted if not effect.part_of]
    accepted = tuple(str(effect.placed) for effect in names)
    ties = tuple(tuple(frozenset(map(str, member)) for member in effect.tie) for effect in names)
    # what the report says this experiment cannot show matters only where nothing of what is hidden was found
    silent = task.effects and not set(accepted) - {named(task.structure, task.plant)}
    hidden = frozenset(str(lead.placed) for lead in found.not_visible) if silent else frozenset()
    return Answer(found.verdict, accepted, ties, hidden, bool(found.stand_in or found.misfit))


def _beside_oracle(found: Any, known: Fit | None, before: float, after: float, *, hidden: bool) -> dict[str, str]:
    """Return the errors of a fit that knows what is hidden; where nothing is, the nominal fit knows all."""
    oracle = before if not hidden else None if known is None else _free_run(found, known)
    if oracle is None:
        return {}
    return {
        "validation_oracle": _short(oracle),
        "ratio": _short(after / oracle),
        "oracle_improvement": _short(before / oracle),
    }


def _holds(task: Task, accepted: Sequence[Placed], records: Records) -> bool:
    """Return True if the answer's model has the truth in it, so that every parameter has a true value.

    Laws of another formulation than the dictionary's are in no model, though their names may be right.
    """
    from harness.effects import Dictionary

    if task.structure in UNNAMED or not all(effect.exact for effect in records.known):
        return False
    if task.engine == "hardware" and any(effect.name in LAWS for effect in records.known):
        return False
    names = Dictionary.builtin().contained(accepted)
    return all(f"{effect.name}@{effect.at}" in names for effect in records.known)


def _command(task: Task, records: Records) -> dict[str, Any]:
    """Return the cost and the answer of the command as a user gives it."""
    timed = timed_command(task, records)
    report = timed.pop("report")
    accepted = tuple(f"{effect['name']}@{effect['at']}" for effect in report["effects"] if not effect["may_be_part_of"])
    outcome = judge_answer(task.effects, Answer(report["verdict"], accepted), task.plant, task.engine)
    return timed | {"outcome": outcome.word, "how": outcome.how, "accepted": " + ".join(accepted)}


def _diagnose_fmu(task: Task, records: Records) -> dict[str, Any]:
    """Return the columns that a diagnosis around an FMU fills; its cost counts."""
    from harness.diagnosis import diagnose
    from harness.diagnosis.fmu.kind import BlackBox

    cpu, wall = _cpu_of_tree(), time.monotonic()
    found = diagnose(records.dataset, _model(task, records), kind=BlackBox())
    accepted = tuple(str(effect.placed) for effect in found.outcome.accepted if not effect.part_of)
    outcome = judge_answer(task.effects, Answer(found.verdict, accepted), task.plant, task.engine)
    return {
        "outcome": outcome.word,
        "how": outcome.how,
        "verdict": found.verdict,
        "adequacy": found.grade,
        "accepted": " + ".join(accepted),
        "cpu_s": f"{_cpu_of_tree() - cpu:.2f}",
        "wall_s": f"{time.monotonic() - wall:.2f}",
    }


def _cpu_of_tree() -> float:
    """Return the CPU seconds of this process and of those it has waited for, compilers among them."""
    return sum(os.times()[:4])


def _error(fitted: Any) -> float:
    """Return the weighted rms of the validation residual; infinite where the free run diverges."""
    if fitted is None or not fitted.finite:
        return float("inf")
    return float(np.sqrt(np.mean(np.concatenate(fitted.validation) ** 2)))


def _oracle(found: Any, records: Records) -> Fit | None:
    """Return a refit that knows which effects are there; None where it cannot be made.

    It starts from the true values, so it does not lose by a local minimum.
    """
    from harness.effects import builtin
    from harness.effects.effect import Placed

    known = builtin()
    start: dict[str, float] = {**found.nominal.values, **_nominal_truth(found.nominal.values, records.parameters)}
    placed = []
    for effect in records.known:
        here = Placed(known[effect.name], effect.at)
        placed.append(here)
        values = here.effect.complete(effect.named, found.form.sizes.get(effect.at, found.form.sizes.get("base", {})))
        start.update({here.name(name): value for name, value in values.items()})
    fit: Fit | None = found.form.fit(placed, [start], found.nominal)
    return fit


def _free_run(found: Any, fit: Fit) -> float | None:
    """Return the validation error of a fit; None where its free run diverges."""
    from harness.diagnosis.runs.compare import seen

    fitted = seen(found.runs.output, fit)
    return None if fitted is None or not fitted.finite else _error(fitted)


def _power(task: Task, found: Any, oracle: Fit) -> Power:
    """Return what these records can tell of what is hidden."""
    from sysid_lab.power import power

    def counted(name: str) -> str:
        return plain_law(name) if task.engine == "hardware" else name

    hidden = [placed for placed in oracle.effects if counted(str(placed)) in map(counted, task.effects)]
    return power(found, oracle, hidden, counted)


def _nominal_truth(values: Mapping[str, float], truth: Mapping[str, float]) -> dict[str, float]:
    """Return the true values of the nominal parameters that the model has."""
    return {name: value for name, value in truth.items() if name in values}


def _coverage(model: Any, records: Records, strangers: Collection[str] = ()) -> dict[str, Any]:
    """Return how many intervals of the final model hold the true value, whatever was accepted.

    Compared are the nominal parameters and those of the effects that mean the same in truth and dictionary; smoothing
    widths, phases and instants that belong to one record have no truth to compare with. An accepted effect that is not
    there (a stranger) counts as one interval that does not hold the truth.
    """
    from harness.effects import builtin
    from harness.effects.effect import Placed

    truth = dict(records.parameters)
    known = builtin()
    for effect in records.known:
        if effect.name not in known or not effect.exact:  # no parameter of the dictionary's law is exactly this one
            continue
        here = Placed(known[effect.name], effect.at)
        for parameter in here.effect.parameters:
            if parameter.name in effect.named and not parameter.nuisance and not parameter.per_record:
                truth[here.name(parameter.name)] = effect.named[parameter.name]
    outside, count = [], 0
    for name in model.free:
        low, high = model.interval(name)
        if name not in truth or name in model.on_bound or not np.isfinite([low, high]).all():
            continue
        count += 1
        if not low <= truth[name] <= high:
            half = 0.5 * (high - low)
            outside.append(f"{name} ({(model.values[name] - truth[name]) / half:+.2g})" if half > 0 else name)
    outside += [f"{name} (not there)" for name in sorted(strangers)]
    count += len(strangers)
    return {"covered": count - len(outside), "intervals": count, "outside_interval": "; ".join(outside)}


def _model(task: Task, records: Records) -> Any:
    """Return the nominal model: the built-in one, or an FMU whose parameters start 20 % off."""
    if task.model == "fmu":
        from harness import registry
        from harness.blackbox.reader import fmu_system

        path = registry.load("plants", "fmu").mockup(task.plant.replace("-", "_"))
        return fmu_system(path, records.dataset.spec, {k: 1.2 * v for k, v in records.parameters.items()})
    from harness.physics import load_model

    return load_model(task.plant)


def _short(value: float) -> str:
    """Return a number in five digits; empty text for one that is not finite."""
    return f"{value:.5g}" if np.isfinite(value) else ""
