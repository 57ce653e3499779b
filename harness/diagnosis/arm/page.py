"""``report.html`` of an arm: the verdict, one line a joint, and the residual of every joint as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from harness.diagnosis.arm.found import ArmDiagnosis, JointDiagnosis
from harness.diagnosis.arm.motion import moving_rows
from harness.diagnosis.arm.regression import regression_detail
from harness.diagnosis.policy import POLICY
from harness.diagnosis.report.figures import AFTER, BEFORE, GREY, INK, Pictures, ResidualView, drawing, legend
from harness.diagnosis.report.figures import draw as draw_pictures
from harness.diagnosis.report.html import environment
from harness.diagnosis.report.words import recorded_units, shown_in
from harness.diagnosis.runs.equation import decimated
from harness.diagnosis.store import write_atomic
from harness.signals import FloatArray
from harness.units import told


def write_arm_html(data: dict[str, Any], figures: dict[str, str], path: Path) -> None:
    """Write the page of a diagnosis of an arm."""
    write_atomic(path, render_arm(data, figures))


def render_arm(data: dict[str, Any], figures: dict[str, str]) -> str:
    """Return the page.

    Parameters
    ----------
    data : dict
        Content of ``report.json``.
    figures : dict
        SVG texts: ``levels``, ``residual``.
    """
    made = environment()
    source = made.loader.get_source(made, "evidence.html.j2")[0]
    style = source[source.index("<style>") : source.index("</style>") + len("</style>")]
    use = "test" if "test" in data["joints"][0]["before"] else "validation"
    return str(
        made.get_template("arm.html.j2").render(
            data=data, figures=figures, style=style, use=use, cards=_cards(data, use), moved=_moved(data, use)
        )
    )


def _factor(joint: dict[str, Any], use: str) -> float | None:
    """Return how many times the residual of a joint is smaller than it was."""
    before, after = joint["before"][use], joint["after"][use]
    return before / after if before is not None and after else None


def _changed(joint: dict[str, Any], use: str) -> bool:
    """Return True where what was found changed the residual of a joint."""
    factor = _factor(joint, use)
    return factor is not None and not 1 / POLICY.changed < factor < POLICY.changed


def _moved(data: dict[str, Any], use: str) -> list[bool]:
    """Return for each joint whether its residual changed."""
    return [_changed(joint, use) for joint in data["joints"]]


def _cards(data: dict[str, Any], use: str) -> list[dict[str, Any]]:
    """Return the joints of the first cards: whose residual fell most, or grew where none fell; else is largest."""
    judged = [joint for joint in data["joints"] if joint["judged"]]
    if data["misfit"]:
        return []
    places = {joint["joint"] for joint in judged}
    if all(effect["at"] in places for effect in data["effects"]):  # a payload or a tilt moves all of them
        judged = [joint for joint in judged if joint["effects"]] or judged
    cards = [{**joint, "factor": _factor(joint, use)} for joint in judged]
    if not data["effects"]:
        return sorted(cards, key=lambda card: -(card["before"][use] or 0.0) / (card["torque_rms"] or 1.0))[:2]
    fell = any((card["factor"] or 0.0) >= POLICY.changed for card in cards)
    return sorted(cards, key=lambda card: -(card["factor"] or 0.0) if fell else card["factor"] or np.inf)[:3]


def arm_figures(found: ArmDiagnosis, data: dict[str, Any]) -> dict[str, str]:
    """Return the figures by name, as SVG texts."""
    views = []
    for k, channel in enumerate(found.arm.positions):
        run = max(found.runs["validation"], key=lambda run: run.motion.q.shape[0])
        keep = moving_rows(run.motion)[:, k] > 0
        before = run.slim(run.motion.u - run.rigid)[keep, k]
        closed = max(found.closed_runs["validation"], key=lambda run: run.motion.q.shape[0])
        after = run.slim(run.motion.u - found.wide.torque(closed))[keep, k]
        # friction is a function of speed; what hangs on the arm, of position
        speed = not found.wide.accepted or bool(found.misfit)
        rate = run.slim(run.motion.v if speed else run.motion.q)[keep, k]
        fitted = before - after if found.wide.accepted and not found.misfit else None
        joint = next((joint for joint in found.joints if joint.joint == k), None)
        own_effects = joint is not None and bool(joint.outcome.accepted) and not found.misfit
        alone = found.bodies is None and not found.wide.accepted
        if joint is not None and (own_effects or alone):
            speed = True
            rate, before, after, fitted = _joint_by_itself(joint, own_effects)
        changed = not found.misfit and (
            found.bodies is not None
            or bool(found.wide.accepted)
            or any(joint.outcome.accepted for joint in found.joints)
        )
        if alone and not own_effects:
            changed = False  # nothing was added here
        unit = f"{channel.unit}/s" if speed else channel.unit
        own = shown_in(unit, channel.name, recorded_units(found.dataset))
        views.append(
            ResidualView(
                axis=f"{channel.name}'" if speed else channel.name,
                unit=own, x=told(rate, unit, own, reading=not speed)[0], before=before,
                after=after if changed else None, fitted=fitted, residual_unit=found.arm.inputs[k].unit,
                port=found.arm.inputs[k].name,
            )
        )  # fmt: skip
    made = {"levels": _levels(data)}
    made.update(draw_pictures(Pictures(views=views)))
    return made


def _joint_by_itself(
    joint: JointDiagnosis, own_effects: bool
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray | None]:
    """Return speed, residual before and after, and what the joint's own effects explain, over its longest record.

    The delay of its torque is taken out; residuals are needed minus measured, and the torque that overcomes a force has
    the other sign.
    """
    regression, final = joint.regression, joint.final
    longest = int(np.argmax([motion.q.shape[0] for motion in regression.motions["validation"]]))
    motion = regression.motions["validation"][longest]
    inside = regression.counts["validation"][longest][:, 0] > 0
    rate = decimated(motion.v, motion)[inside, 0]
    before = -regression_detail(joint.nominal).residual["validation"][longest][inside, 0]
    if not own_effects:
        return rate, before, before, None
    effects = [accepted.placed for accepted in joint.outcome.accepted]
    fitted = -regression.force(final.values, effects, "validation")[longest][:, 0]
    return rate, before, -joint.residual("validation")[longest][inside, 0], fitted[inside]


def _levels(data: dict[str, Any]) -> str:
    """Draw torque, residual before and residual after of every joint."""
    use = "test" if "test" in data["joints"][0]["before"] else "validation"
    names = [joint["joint"] for joint in data["joints"]]
    place = np.arange(len(names))
    rows = [
        ("torque (rms)", [joint["torque_rms"] for joint in data["joints"]], GREY),
        (
            "residual before" if any(_moved(data, use)) else "residual",
            [joint["before"][use] for joint in data["joints"]],
            BEFORE,
        ),
    ]
    if any(_moved(data, use)):
        rows.append(("residual after", [joint["after"][use] for joint in data["joints"]], AFTER))
    words = "; ".join(
        f"{name}: {', '.join(f'{label} {values[k]:.2g}' for label, values, _ in rows if values[k] is not None)}"
        for k, name in enumerate(names)
    )
    words = f"Torque and its residual of every joint in {data['joints'][0]['unit']}. {words}."
    with drawing("levels", 10.5, 2.7, words, measured=True) as (figure, svg):
        axis = figure.subplots()
        width = 0.8 / len(rows)
        for number, (label, values, colour) in enumerate(rows):
            offset = (number - (len(rows) - 1) / 2) * width
            heights = [value or float("nan") for value in values]
            axis.bar(place + offset, heights, 0.92 * width, color=colour, label=label)
            for x, value in zip(place + offset, heights, strict=True):
                if np.isfinite(value):
                    axis.annotate(
                        f"{value:.2g}", (x, value), (0, 2), textcoords="offset points", ha="center", va="bottom",
                        fontsize=7, color=INK, rotation=90 if len(names) > 4 else 0,
                    )  # fmt: skip
        axis.set_xticks(place, names)
        axis.set(yscale="log", ylabel=f"torque [{data['joints'][0]['unit']}]")
        axis.margins(y=0.3)
        legend(figure)
    return svg[0]
