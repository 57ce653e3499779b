"""What an unknown push on an FMU's input would do to its outputs: spline functions, by finite differences.

The black-box counterpart of the linearised model in :mod:`harness.diagnosis.response`: the functions are added to the
inputs one at a time and the FMU is simulated.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from harness.diagnosis.fmu_form import FmuForm
from harness.diagnosis.forms import Fitted
from harness.diagnosis.response import Axis, Family, families_at
from harness.signals import FloatArray

__all__ = ["fmu_families"]


def fmu_families(form: FmuForm, fitted: Fitted) -> tuple[list[Any], dict[str, dict[str, list[FloatArray]]]]:
    """Return the families and what they do to the outputs, initial states taken out."""
    uses = ("estimation", "validation")
    system = fitted.system
    moved = {use: form.motion(fitted, use) for use in uses}

    def axis(name: str, unit: str, pick: Any) -> Axis:
        return Axis(name, unit, {use: [pick(k, use) for k in range(len(form.records[use]))] for use in uses})

    t = axis("time", "s", lambda k, use: form.records[use][k].t - form.records[use][k].t[0])
    inputs = [
        axis(c.name, c.unit, lambda k, use, j=j: form.records[use][k].u[:, j]) for j, c in enumerate(system.inputs)
    ]
    outputs = [axis(c.name, c.unit, lambda k, use, j=j: moved[use][k][2][:, j]) for j, c in enumerate(system.outputs)]
    families: list[Family] = []
    rows: dict[str, int] = {}
    driven = {one.force for one in system.coordinates}
    for row, one in enumerate(system.coordinates):
        q = axis(one.name, one.unit, lambda k, use, j=row: moved[use][k][0][:, j])
        v = axis(f"{one.name}'", f"{one.unit}/s", lambda k, use, j=row: moved[use][k][1][:, j])
        here = families_at(f"force on {one.name}", q, v, t, inputs)
        rows.update({family.name: one.force for family in here})
        families += here
    for row, channel in enumerate(system.inputs):
        if row not in driven:
            here = families_at(f"input {channel.name}", outputs[0], None, t, inputs)
            rows.update({family.name: row for family in here})
            families += here
    families += [
        Family(f"reading of {channel.name}", (one,)) for channel, one in zip(system.outputs, outputs, strict=True)
    ]
    made: dict[str, dict[str, list[FloatArray]]] = {}
    for use in uses:
        made[use] = {}
        for family in families:
            basis = family.basis(use)
            if family.name in rows:
                row = rows[family.name]
                parts = form.pushed(fitted, use, {row: basis})[row]
            else:
                column = [one.name for one in system.outputs].index(family.place.removeprefix("reading of "))
                parts = [np.zeros((len(one), len(form.weights), one.shape[1])) for one in basis]
                for part, phi in zip(parts, basis, strict=True):
                    part[:, column] = phi / form.weights[column]
            made[use][family.name] = list(form.without_states(fitted, parts, use))
    return families, made
