"""``report.json`` of an arm: the keys of :mod:`harness.diagnosis.report_json` that apply, and one entry a joint.

``joints``
    By joint: ``joint`` (name of its position), ``link_joint`` (name in the URDF), ``judged``, ``standstill`` (share of
    the time), ``effects``, ``before`` and ``after`` (by use: rms of the torque residual while it moves), ``unit``,
    ``torque_rms``, ``clock_s`` (by how long its torque is recorded too late), ``rest``, ``not_tried``.
``closed_loop_bias``
    Says in ``text`` why the bias that feedback puts on the parameters is not tested.
``inertia``
    ``fixed`` (the URDF is believed) or ``calibrated``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from harness.diagnosis.arm import ArmDiagnosis, JointDiagnosis
from harness.diagnosis.arm_wide import SEEN, WideCandidate
from harness.diagnosis.exchange import Accepted
from harness.diagnosis.report.isolability import separating
from harness.diagnosis.runs.closed_loop_bias import BiasTest

__all__ = ["arm_report"]

FORMAT = "sysid-harness/close-loop/1"
NO_PATH = (
    "an arm is always held by its controller, and the planned path, from outside that loop, is not used; what shakes "
    "the arm and is answered by the controller may bias friction and gains"
)
"""Why the bias of feedback is not tested on an arm."""


def arm_report(found: ArmDiagnosis) -> dict[str, Any]:
    """Return the content of ``report.json``."""
    before = {use: found.before(use) for use in ("estimation", "validation", "test")}
    after = {use: found.after(use) for use in before}
    effects, ties, apart = _effects(found)
    data: dict[str, Any] = {
        "format": FORMAT,
        "dataset": found.dataset.name,
        "model": found.arm.name,
        "inertia": found.arm.inertia,
        "verdict": found.verdict,
        "adequacy": found.grade,
        "summary": "",
        "effects": effects,
        "tie_sets": ties,
        "separating_experiments": apart,
        "errors": {
            "before": {"equation_error": _errors(found, before)},
            "after": {"equation_error": _errors(found, after)},
        },
        "joints": [_joint(found, k, before, after) for k in range(found.arm.n)],
        "candidates": _candidates(found),
        "null": {"p": found.wide.p},
        "not_visible": _not_visible(found),
        "form": "inverse dynamics",
        "closed_loop_bias": BiasTest((), NO_PATH).to_dict({}),
        "warnings": list(dict.fromkeys(found.warnings)),
        "seconds": round(found.seconds, 2),
    }
    data["summary"] = _summary(data)
    return data


def known(value: float) -> float | None:
    """Return a finite number, or None."""
    return float(value) if np.isfinite(value) else None


def _errors(found: ArmDiagnosis, values: dict[str, Any]) -> dict[str, Any]:
    """Return the torque residual by use and joint."""
    result: dict[str, Any] = {"meaning": "torque residual of each joint, low-passed, while the joint moves"}
    for use, row in values.items():
        if found.runs[use]:
            result[use] = {
                one.name: {"rms": known(value), "unit": drive.unit}
                for one, drive, value in zip(found.arm.positions, found.arm.inputs, row, strict=True)
            }
    return result


def _effects(found: ArmDiagnosis) -> tuple[list[dict[str, Any]], list[list[dict[str, str]]], list[list[str]]]:
    """Return what was found, what each cannot be told from, and what would separate them."""
    effects: list[dict[str, Any]] = []
    ties: list[list[dict[str, str]]] = []
    apart: list[list[str]] = []
    for one, tie in zip(found.wide.accepted, found.wide.ties, strict=True):
        effects.append(_wide(one))
        members = [{"name": other.name, "at": other.at} for other in tie]
        if one.effect.name.startswith(("payload", "link_mass")):
            members.append({"name": "parameter", "at": "inertial parameters that the URDF gives the same link"})
        ties.append(members)
        apart.append(list(dict.fromkeys(other.experiment for other in tie if other.experiment)))
    for joint in found.joints:
        for accepted in joint.result.accepted:
            effects.append(_own(joint, accepted))
            members = [
                {"name": " + ".join(p.effect.name for p in group), "at": ", ".join(dict.fromkeys(p.at for p in group))}
                for group in accepted.tie
            ]
            if accepted.placed.effect.name == "input_gain":
                others = found.wide.gains.get(accepted.placed.at, ())
                members += [{"name": other.name, "at": other.at} for other in others]
                if joint.joint == found.arm.n - 1:
                    members.append({"name": "parameter", "at": "mass and inertia of the last link"})
            ties.append(members)
            apart.append(separating([placed for group in accepted.tie for placed in group]))
    return effects, ties, apart


def _wide(one: WideCandidate) -> dict[str, Any]:
    """Return one effect on the whole arm."""
    parameters = {
        name: {"value": known(i.value), "low": known(i.low), "high": known(i.high), "unit": unit, "meaning": meaning}
        for (name, unit, meaning), i in zip(one.effect.parameters, one.intervals, strict=True)
    }
    return {
        "name": one.effect.name,
        "at": one.effect.at,
        "parameters": parameters,
        "delta_bic": known(one.delta_bic),
        "formula": one.effect.formula,
        "summary": one.effect.summary,
    }


def _own(joint: JointDiagnosis, accepted: Accepted) -> dict[str, Any]:
    """Return one effect at a joint."""
    model, placed = joint.result.model, accepted.placed
    intervals = model.intervals()
    parameters = {}
    for one in placed.effect.parameters:
        name = placed.name(one.name)
        found = intervals.get(name)
        parameters[one.name] = {
            "value": known(model.values[name]),
            "low": None if found is None else known(found.low),
            "high": None if found is None else known(found.high),
            "unit": model.system.parameter(name).unit,
            "meaning": one.meaning,
        }
    return {
        "name": placed.effect.name,
        "at": placed.at,
        "parameters": parameters,
        "delta_bic": known(accepted.delta_bic),
        "formula": placed.effect.formula,
        "summary": placed.effect.summary,
    }


def _joint(found: ArmDiagnosis, k: int, before: dict[str, Any], after: dict[str, Any]) -> dict[str, Any]:
    """Return the entry of one joint."""
    judged = next((one for one in found.joints if one.joint == k), None)
    torque = np.concatenate([one.motion.u[:, k] for one in found.runs["estimation"]])
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
        "rest": None,
        "not_tried": [],
    }
    if judged is not None:
        entry["effects"] = [str(one.placed) for one in judged.result.accepted]
        entry["clock_s"] = known(judged.result.model.values["clock"])
        entry["rest"] = {**judged.adequacy.to_dict(), "predictable": judged.predictable}
        entry["not_tried"] = list(judged.drowned)
    return entry


def _candidates(found: ArmDiagnosis) -> list[dict[str, Any]]:
    """Return one row for each effect that was tried, with the reason against it."""
    taken = {str(one.effect) for one in found.wide.accepted}
    rows = []
    for one in found.wide.candidates:
        answer = str(one.effect) in taken and one.judgement.accepted
        rows.append(
            {
                "name": one.effect.name,
                "at": one.effect.at,
                "round": one.round,
                "refitted": one.values.size > 0,
                "accepted": answer,
                "reason": "; ".join(one.judgement.reasons)
                or ("" if answer else "another one explains more, or is simpler"),
                "delta_bic": known(one.delta_bic),
                "validation_gain": known(one.comparison.gain),
                "bootstrap_p": known(one.comparison.p),
            }
        )
    for joint in found.joints:
        own = {str(one.placed) for one in joint.result.accepted}
        for number, here in enumerate(joint.result.rounds, start=1):
            for other in sorted(here.candidates, key=lambda c: -c.delta_bic):
                answer = other.name in own and other.accepted
                rows.append(
                    {
                        "name": " + ".join(p.effect.name for p in other.added),
                        "at": ", ".join(p.at for p in other.added),
                        "round": number,
                        "refitted": True,
                        "accepted": answer,
                        "reason": "; ".join(other.judgement.reasons)
                        or ("" if answer else "another one explains more, or is simpler"),
                        "delta_bic": known(other.delta_bic),
                        "validation_gain": known(other.comparison.gain),
                        "bootstrap_p": known(other.comparison.p),
                    }
                )
    return rows


def _not_visible(found: ArmDiagnosis) -> list[dict[str, str]]:
    """Return what this experiment cannot show, with what would."""
    rows = [
        {"name": one.effect.name, "at": one.effect.at, "reason": one.effect.experiment}
        for one in found.wide.candidates
        if one.round == 1 and one.left < SEEN
    ]
    for joint in found.joints:
        for name in joint.drowned:
            effect, _, at = name.partition("@")
            rows.append({"name": effect, "at": at, "reason": "the torque is less than 20 times its noise: move faster"})
    return rows


def _summary(data: dict[str, Any]) -> str:
    """Return the verdict in one line."""
    use = "test" if "test" in data["joints"][0]["before"] else "validation"
    ratio = [one["before"][use] / one["after"][use] for one in data["joints"] if one["judged"] and one["after"][use]]
    if data["verdict"] == "effects_found":
        by_name: dict[str, list[str]] = {}
        for one in data["effects"]:
            by_name.setdefault(one["name"], []).append(one["at"])
        names = "; ".join(f"{name.replace('_', ' ')} at {', '.join(places)}" for name, places in by_name.items())
        gained = f"torque residual of a joint up to {max(ratio):.3g} times smaller ({use})"
        return f"arm {data['model']} lacks {names}; {gained}"
    largest = max((one["after"][use] / one["torque_rms"] for one in data["joints"] if one["judged"]), default=0.0)
    if data["verdict"] == "nothing_missing":
        level = f"{100 * largest:.2g} % of the torque"
        return (
            f"nothing is missing in arm {data['model']}: what is left at a joint is at most {level}, and unpredictable"
        )
    places = ", ".join(one["joint"] for one in data["joints"] if one["rest"] and one["rest"]["predictable"])
    return f"something is missing in arm {data['model']} at {places}, and no effect of the dictionary explains it"
