"""``report.json`` of an arm: the keys of :mod:`harness.diagnosis.report.evidence_json`, and what is an arm's own.

What does not apply is empty: an arm is not simulated, so there are no simulation errors, noise or horizon.

``joints``
    By joint: ``joint`` (name of its position), ``link_joint`` (name in the URDF), ``judged``, ``standstill`` (share of
    the time), ``effects``, ``before`` and ``after`` (by use: rms of the torque residual while it moves), ``unit``,
    ``torque_rms``, ``clock_s`` (by how long its torque is recorded too late; null where
    that is more than a clock can be); under ``left``: ``share``
    (of the torque's standard deviation that stays unexplained, its noise taken off), ``noise`` (of the torque's
    samples, as it shows in the residual), ``predictable`` and ``axis`` (what could still be predicted, over what),
    ``error`` (partial autocorrelations and deviation of the error that the likelihood found).
``explained_share``
    Share of the variance of the torque that is explained, at the joint where it is least.
``closed_loop_bias``
    Says in ``text`` why the bias that feedback puts on the parameters is not tested.
``inertia``
    ``fixed`` (the URDF is believed) or ``calibrated``.
``inertial_parameters``
    Of calibrated bodies, else null: the record of the estimate (``names``, ``units``, ``values`` and what else
    :meth:`harness.models.estimate.Estimate.to_dict`), every body one that mass can make; ``impossible``: whether
    directions
    free of that limit fit the log better than chance, so that something else is missing; ``lost``: by how much
    log-likelihood.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from harness.diagnosis.arm.bodies import ArmBodies
from harness.diagnosis.arm.found import ArmDiagnosis
from harness.diagnosis.arm.regression import regression_detail
from harness.diagnosis.arm.rotor import LINK_SIDE, ROTOR, SPRINGS, in_the_bodies
from harness.diagnosis.arm.wide_regression import ROTOR as WIDE_ROTOR
from harness.diagnosis.policy import POLICY
from harness.diagnosis.report.estimates import effect_data, known
from harness.diagnosis.report.experiments import separating
from harness.diagnosis.report.keys import blank, numbers
from harness.diagnosis.report.refusals import refusals_text
from harness.diagnosis.report.words import change_text, named, recorded_units, standing_in
from harness.diagnosis.runs.closed_loop_bias import BiasTest
from harness.diagnosis.search.compare import Judged
from harness.diagnosis.search.outcome import Outcome
from harness.diagnosis.search.table import Accepted
from harness.diagnosis.stand_in import stand_in_reasons
from harness.effects.effect import Placed

NO_PATH = (
    "an arm is always under its controller, and the planned path, which comes from outside that loop, is not used; "
    "disturbances to which the controller responds may bias friction and gains"
)
"""Why the bias of feedback is not tested on an arm."""


def arm_report(found: ArmDiagnosis) -> dict[str, Any]:
    """Return the content of ``report.json``."""
    before = {use: found.before(use) for use in ("estimation", "validation", "test")}
    # what a search adds to a model that does not fit is no finding
    after = before if found.misfit else {use: found.after(use) for use in before}
    added, ties, apart = _effects(found)
    effects = [] if found.misfit else added
    stand_in = _stand_in(found)
    data: dict[str, Any] = {
        **blank(),
        "dataset": found.dataset.name,
        "model": found.arm.name,
        "inertia": found.arm.inertia,
        "inertial_parameters": None if found.bodies is None or found.misfit else _bodies(found.bodies),
        "verdict": found.verdict,
        "adequacy": found.grade,
        "explained_share": None if found.misfit else known(found.explained_share),
        "misfit": list(found.misfit),
        "stand_in": {"flagged": bool(stand_in), "reasons": stand_in},
        "effects": effects,
        "searched": added if found.misfit else [],
        "tie_sets": ties if effects else [],
        "separating_experiments": apart if effects else [],
        "separate_with": [[] for _ in effects],
        "recorded": recorded_units(found.dataset),
        "parameters": {
            "before": {},
            "after": {
                f"{effect['name']}@{effect['at']}.{name}": {
                    key: value for key, value in own.items() if key != "meaning"
                }
                for effect in effects
                for name, own in effect["parameters"].items()
            },
        },
        "left_over": _left_over(found),
        "converged": {
            "nominal": all(joint.nominal.converged for joint in found.joints),
            "final": all(joint.final.converged for joint in found.joints),
        },
        "intervals": _intervals(found),
        "horizon": {"seconds": None, "reason": "inverse dynamics: the arm is not simulated"},
        "joints": [_joint(found, k, before, after) for k in range(found.arm.n)],
        "candidates": _candidates(found),
        "not_visible": _not_visible(found),
        "form": "inverse dynamics, maximum likelihood",
        "policy": numbers(found.policy),
        "closed_loop_bias": BiasTest((), NO_PATH).to_dict({}),
        "warnings": list(dict.fromkeys(found.warnings)),
        "seconds": round(found.seconds, 2),
    }
    for when, values in (("before", before), ("after", after)):
        data["errors"][when]["equation_error"] = _errors(found, values)
    data["summary"] = _summary(data, [found.arm.positions[joint.joint].name for joint in found.incomplete])
    return data


def _bodies(bodies: ArmBodies) -> dict[str, Any]:
    """Return the record of the bodies that were estimated."""
    return {**bodies.estimate.to_dict(), "impossible": not bodies.possible, "lost": known(bodies.lost)}


def _stand_in(found: ArmDiagnosis) -> list[str]:
    """Return why effects of a joint imitate something that is not in the dictionary."""
    if found.misfit:
        return []
    reasons: list[str] = []
    for joint in found.joints:
        left = None if joint.predictable is None else joint.predictable.name
        reasons += stand_in_reasons([accepted.placed for accepted in joint.outcome.accepted], left)
    return reasons


def _left_over(found: ArmDiagnosis) -> list[dict[str, Any]]:
    """Return what free torques would still gain, joint by joint, most first."""
    rows = [
        {**axis.to_dict(), "at": found.arm.positions[joint.joint].name}
        for joint in found.joints
        for axis in joint.leftover.axes
    ]
    return sorted(rows, key=lambda row: -(row["evidence"] + row["validation"]))


def _intervals(found: ArmDiagnosis) -> dict[str, Any]:
    """Return whether intervals can be relied on, and what they count."""
    if found.grade in ("explained", "mostly_explained"):
        return {"hold": True, "meaning": "95 %, from the curvature of the likelihood, including a coloured error"}
    lacking = "they include a coloured error, but not that the model lacks something: true values may lie far outside"
    return {"hold": False, "meaning": lacking}


def _errors(found: ArmDiagnosis, values: dict[str, Any]) -> dict[str, Any]:
    """Return the torque residual by use and joint."""
    result: dict[str, Any] = {"meaning": "torque residual of each joint, low-passed, while the joint moves"}
    for use, row in values.items():
        if found.runs[use]:
            result[use] = {
                position.name: {"rms": known(value), "unit": drive.unit}
                for position, drive, value in zip(found.arm.positions, found.arm.inputs, row, strict=True)
            }
    return result


def _effects(found: ArmDiagnosis) -> tuple[list[dict[str, Any]], list[list[dict[str, str]]], list[list[str]]]:
    """Return what was found, what each cannot be told from, and what would separate them."""
    effects: list[dict[str, Any]] = []
    ties: list[list[dict[str, str]]] = []
    apart: list[list[str]] = []
    for accepted in found.wide.accepted:
        data = effect_data(found.wide.fit, accepted)
        if accepted.placed.effect.name in SPRINGS:
            data["parameters"] = {"stiffness": _stiffness(found, accepted.placed), **data["parameters"]}
        effects.append(data)
        members = _members(accepted)
        members += [{"name": name, "at": at} for name, at in accepted.placed.effect.same_as.items()]
        ties.append(members)
        apart.append(separating([placed for group in accepted.tie for placed in group]))
    for joint in found.joints:
        for accepted in joint.outcome.accepted:
            effects.append(effect_data(joint.final, accepted))
            members = _members(accepted)
            if accepted.placed.effect.name == "input_gain":
                others = found.wide.gains.get(accepted.placed.at, ())
                members += [{"name": other.effect.name, "at": other.at} for other in others]
                if joint.joint == found.arm.n - 1:
                    members.append({"name": "parameter", "at": "mass and inertia of the last link"})
            if accepted.placed.effect.name == ROTOR and in_the_bodies(found.arm, found.runs, joint.joint):
                members.append({"name": "parameter", "at": "inertia of its link about the axis of the joint"})
            ties.append(members)
            apart.append(separating([placed for group in accepted.tie for placed in group]))
    return effects, ties, apart


def _stiffness(found: ArmDiagnosis, spring: Placed) -> dict[str, Any]:
    """Return the stiffness of a joint with its interval: seen from the link, through the rotor that was fitted there.

    Parameters of a spring are fitted by their logarithms, a rotor is not; the two errors are taken for independent.
    """
    fit, main = found.wide.fit, spring.name(spring.effect.parameter_names[0])
    k = [channel.name for channel in found.arm.positions].index(spring.at)
    value, spread = 1 / fit.values[main], fit.deviations[main]
    if spring.effect.name == LINK_SIDE:
        name = f"{spring.at} {WIDE_ROTOR}"
        rotor = fit.values[name] + float(found.arm.motor_inertia[k])
        value, spread = value * rotor, float(np.hypot(spread, fit.deviations[name] / rotor))
    told = np.isfinite(spread)
    return {
        "value": known(value),
        "low": known(value * np.exp(-1.96 * spread)) if told else None,
        "high": known(value * np.exp(1.96 * spread)) if told else None,
        "unit": f"{found.arm.inputs[k].unit}/{found.arm.positions[k].unit}",
        "state": "determined" if told else "not_determined",
        "meaning": "stiffness between motor and link",
    }


def _members(accepted: Accepted) -> list[dict[str, str]]:
    """Return the tie set of an effect, itself first."""
    return [
        {"name": " + ".join(p.effect.name for p in group), "at": ", ".join(dict.fromkeys(p.at for p in group))}
        for group in accepted.tie
    ]


def _joint(found: ArmDiagnosis, k: int, before: dict[str, Any], after: dict[str, Any]) -> dict[str, Any]:
    """Return the entry of one joint."""
    judged = next((joint for joint in found.joints if joint.joint == k), None)
    torque = np.concatenate([run.motion.u[:, k] for run in found.runs["estimation"]])
    uses = [use for use in before if found.runs[use]]
    entry: dict[str, Any] = {
        "joint": found.arm.positions[k].name,
        "link_joint": found.arm.arm.moving[k].name,
        "judged": judged is not None,
        "standstill": known(found.still[k]),
        "torque_rms": known(float(np.sqrt(np.mean(torque**2)))),
        "unit": found.arm.inputs[k].unit,
        "before": {use: known(before[use][k]) for use in uses},
        "after": {use: known(after[use][k]) for use in uses},
        "effects": [],
        "clock_s": None,
        "left": None,
    }
    if judged is not None:
        error = regression_detail(judged.final).errors["estimation"][0][0]
        entry["effects"] = [] if found.misfit else [str(accepted.placed) for accepted in judged.outcome.accepted]
        entry["clock_s"] = None if judged.clock is None else known(judged.clock)
        entry["left"] = {
            "share": known(judged.share),
            "noise": known(judged.noise),
            "predictable": judged.predictable is not None,
            "axis": None if judged.predictable is None else judged.predictable.name,
            "error": {"partial": error.partial.tolist(), "deviation": known(error.deviation)},
        }
    return entry


def _candidates(found: ArmDiagnosis) -> list[dict[str, Any]]:
    """Return one row for each effect that was tried, with the reason against it."""
    rows = _rows(found.wide.outcome)
    for joint in found.joints:
        rows += _rows(joint.outcome)
    for row in rows if found.misfit else ():
        if row["accepted"]:
            row.update(accepted=False, reason="the model does not fit these data: nothing is accepted")
    return rows


def _rows(outcome: Outcome) -> list[dict[str, Any]]:
    """Return the rows of one search: every refit, and what the score test alone set aside."""
    accepted = {str(effect.placed) for effect in outcome.accepted}
    rows = []
    for number, step in enumerate(outcome.rounds, start=1):
        rows += [
            _row(judged, number, accepted) for judged in sorted(step.candidates, key=lambda judged: -_total(judged))
        ]
        refitted = {judged.name for judged in step.candidates}
        rows += [
            {
                "name": lead.placed.effect.name,
                "at": lead.placed.at,
                "round": number,
                "refitted": False,
                "accepted": False,
                "reason": f"the score test promises {lead.gain:.1f}",
                "evidence": None,
                "delta_bic": None,
                "validation_gain": None,
                "standard_error": None,
            }
            for lead in step.test.leads
            if str(lead.placed) not in refitted
        ]
    return rows


def _total(judged: Judged) -> float:
    return -np.inf if judged.comparison is None else judged.comparison.total


def _row(judged: Judged, number: int, accepted: set[str]) -> dict[str, Any]:
    """Return the row of one refit."""
    answer = judged.name in accepted and judged.passed
    compared = judged.comparison
    return {
        "name": " + ".join(p.effect.name for p in judged.added),
        "at": ", ".join(p.at for p in judged.added),
        "round": number,
        "refitted": True,
        "accepted": answer,
        "reason": refusals_text(judged.refusals) or ("" if answer else "another one explains more, or is simpler"),
        "evidence": None if compared is None else known(compared.evidence),
        "delta_bic": None if compared is None else known(2 * compared.evidence),
        "validation_gain": None if compared is None else known(compared.validation),
        "standard_error": None if compared is None else known(compared.error),
        "total_error": None if compared is None else known(compared.total_error),
    }


def _not_visible(found: ArmDiagnosis) -> list[dict[str, str]]:
    """Return what this experiment cannot show, with what would."""
    rows = [
        {"name": hidden.placed.effect.name, "at": hidden.placed.at, "reason": hidden.placed.effect.experiment}
        for hidden in sorted(found.wide.outcome.rounds[0].test.hidden, key=lambda hidden: str(hidden.placed))
    ]
    return rows


def _summary(data: dict[str, Any], incomplete: Sequence[str]) -> str:
    """Return the verdict in one line."""
    use = "test" if "test" in data["joints"][0]["before"] else "validation"
    judged = [joint for joint in data["joints"] if joint["judged"]]
    if data["verdict"] == "model_does_not_fit":
        first, last = data["misfit"][0], data["misfit"][-1]
        return f"arm {data['model']} does not fit these data: {'; '.join(dict.fromkeys((first, last)))}"
    if data["verdict"] == "effects_found":
        ratio = [joint["before"][use] / joint["after"][use] for joint in judged if joint["after"][use]]
        lacks = f"arm {data['model']} lacks {named(data['effects'], data['tie_sets'])}"
        if data["stand_in"]["flagged"]:
            lacks = standing_in(data, f"arm {data['model']}")
        if ratio and max(ratio) < POLICY.changed and min(ratio) < 1 / POLICY.changed:
            grown = f"the torque residual grows (of a joint {change_text(min(ratio))}, {use})"
            return f"{grown}, although the likelihood rises: {lacks}; {_explained(data)}"
        most = max(ratio, default=1.0)
        gained = f"torque residual of a joint {'up to ' if most >= POLICY.changed else ''}{change_text(most)} ({use})"
        return f"{lacks}; {gained}; {_explained(data)}"
    if data["verdict"] == "nothing_missing":
        return f"nothing is missing in arm {data['model']}: {_explained(data)}, and the rest is not predictable"
    return (
        f"something is missing in arm {data['model']} at {', '.join(incomplete)}, and no effect of the dictionary "
        f"explains it; {_explained(data)}"
    )


def _explained(data: dict[str, Any]) -> str:
    """Say how much of the torques is explained, rounded down; at a joint of noise the noise is what is left."""
    left = max(joint["left"]["share"] ** 2 for joint in data["joints"] if joint["judged"])
    share = np.floor(1000.0 * max(1.0 - left, 0.0)) / 10.0
    return f"{share:g} % of the variance of every joint's torque is explained, not counting its noise"
