"""How far physics alone bounds the masses of an arm that no motion shows, as an analysis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from harness.errors import InputError, refuse_unknown
from harness.models.analysis import Findings, Takes
from harness.physics.arms.inertial_fit import Bodies, InertialProblem, extent_of
from harness.physics.arms.mechanism import arm_of

_MOTIONS = 300
"""Random instants of exact torques: more than any arm has base parameters, so that nothing is left to the motion."""
_VAST = 1e3  # Masses beyond so many times the URDF's count as without bound: the solver stops somewhere there.


@dataclass(frozen=True)
class MassExtents:
    """Least and largest mass of every body of an arm that explains exact torques, physically consistent.

    Joint torques show combinations of parameters only. That every body must have a positive density bounds the rest,
    and so does the box around its shape (Wensing, Kim & Slotine 2018, *IEEE RA-L* 3:60, eq. 15): semidefinite programs
    say how much.

    Parameters
    ----------
    bodies : sequence of str, optional
        Joints whose bodies are asked about, by name; by default all that move.
    hull : bool
        Ask within the shapes of the URDF too, where it has any.
    """

    takes: ClassVar[Takes] = "definition"
    bodies: Sequence[str] | None = None
    hull: bool = True

    def of(self, subject: Any, *, rng: np.random.Generator) -> Findings:
        """Return the extents of the masses, by consistency alone and within the shapes."""
        from harness.physics.arms.inertia import is_consistent

        arm = arm_of(subject, "mass extents")
        joints = arm.arm.joints
        names = [joint.name for joint in joints]
        asked = list(self.bodies) if self.bodies is not None else [j.name for j in joints if j in arm.arm.moving]
        refuse_unknown("bodies of an arm", asked, names, remedy="name their joints")
        truth = np.asarray(arm.arm.parameters, dtype=float)
        light = [names[k] for k, row in enumerate(truth.reshape(-1, 10)) if not is_consistent(row)]
        if light:
            raise InputError(
                "bodies of the URDF are not physically consistent",
                expected="positive mass and inertia that a density makes, of every body",
                got=f"others behind {', '.join(light)}",
                remedy="correct the URDF",
            )
        q, v, a = rng.uniform(-1.0, 1.0, size=(3, _MOTIONS, arm.n))
        rows = arm.arm.regressor(q, v, a).reshape(_MOTIONS * arm.n, -1)
        gram = rows.T @ rows
        free = InertialProblem(gram, gram @ truth, Bodies(truth), None, np.zeros(0, dtype=bool))
        boxed = None
        if self.hull and arm.path is not None:
            from harness.physics.arms.urdf_shapes import bounding_boxes

            boxes = bounding_boxes(arm)
            if any(box is not None for box in boxes):
                boxed = InertialProblem(gram, gram @ truth, Bodies(truth, boxes=boxes), None, np.zeros(0, dtype=bool))
        table = []
        for name in asked:
            body = names.index(name)
            direction = np.zeros(truth.size)
            direction[10 * body] = 1.0
            mass = truth[10 * body]
            row: dict[str, Any] = {"body": name, "mass of the URDF [kg]": float(mass)}
            for title, problem in (("consistent", free), ("within its shape", boxed)):
                low, high = (np.nan, np.nan) if problem is None else extent_of(problem, direction)
                row[f"least, {title} [kg]"] = None if problem is None else float(low)
                row[f"most, {title} [kg]"] = float(high) if high < _VAST * mass else "no bound"
            table.append(row)
        words = ["from exact torques of random motions"]
        if boxed is None:
            words.append("no shapes: only consistency bounds")
        return Findings(f"mass extents of {arm.name}", table, words)
