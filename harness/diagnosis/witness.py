"""A second witness: the force that an effect claims must be found in the momentum balance of the measured motion.

Under an unmeasured disturbance the error of a long free run rings at the resonance of the plant: it has few independent
samples, and almost any effect can be tuned to take half of it away, on validation too. In the momentum balance of the
measured motion the same disturbance is only a coloured force. There the claimed force, at the size that the simulation
asked for, either is found or it is not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from harness.diagnosis.equation_form import EquationForm
from harness.diagnosis.forms import Fitted, stacked
from harness.diagnosis.momentum_form import MomentumForm, autoregression, filtered
from harness.diagnosis.motion import Motion
from harness.diagnosis.per_record import PER_RECORD
from harness.diagnosis.response import Family, force_along
from harness.effects.claimed import ClaimedForce, claimable
from harness.effects.effect import Placed
from harness.signals import FloatArray

__all__ = ["ENOUGH", "contradiction", "found_force", "found_function"]

ENOUGH = 4.0
"""Standard errors by which a claimed force must be found. Effects that are there reach 6 and more at 2 % of the torque,
made up ones stay below 3."""
ENOUGH_OF_ITS_OWN = 8.0
"""The same for an effect with parameters of each record: a frequency that was searched for, and phases fitted to the
very records that are asked, reach 4 or 5 on a disturbance alone; a line that is there reaches 70."""
ORDER = 12
"""Of the autoregression that whitens the balance, at most; the BIC chooses."""


def contradiction(weak: EquationForm | None, fitted: Fitted, added: Sequence[Placed]) -> list[str]:
    """Return a reason for each added effect whose force is not found in the momentum balance.

    Parameters
    ----------
    weak : EquationForm or None
        The momentum balance of the measured motion, where there is one.
    fitted : Fitted
        The model with the added effects.
    added : sequence of Placed
    """
    reasons = []
    for one in added:
        others = [other for other in fitted.effects if str(other) != str(one)]
        if weak is None or not all(weak.judges(other) for other in others):
            continue
        t = found_force(weak, fitted, one)
        asked = ENOUGH_OF_ITS_OWN if one.effect.name in PER_RECORD else ENOUGH
        if t is not None and not t >= asked:
            reasons.append(
                f"its force is not found in the momentum balance of the measured motion (t = {t:.1f}, not {asked:g})"
            )
    return reasons


def found_force(weak: EquationForm, fitted: Fitted, placed: Placed) -> float | None:
    """Return the t value with which the force of an effect shows in the momentum balance of all records.

    The residual of the balance without the effect is regressed on the effect's force at its fitted values and on what
    the other parameters can do (linearised). Both sides are whitened by an autoregression of the residual that is left
    (Cochrane & Orcutt, J. Am. Stat. Assoc. 44:32, 1949), one for each coordinate.

    Parameters
    ----------
    weak : EquationForm
        Of shape ``weak``; judges every other effect of the model.
    fitted : Fitted
        The model with the effect.
    placed : Placed
        Of the effect. Its hidden states are simulated along the measured motion, from rest.

    Returns
    -------
    float or None
        Positive where the balance asks for the effect with the sign that it has; 0 where it exerts no force. None where
        the balance cannot be asked: what rounds or cuts a reading, and masses behind a spring, are no force on the
        measured motion.
    """
    less = weak.equations([one for one in fitted.effects if str(one) != str(placed)])
    index = [k for k, one in enumerate(less.system.parameters) if not one.fixed]
    rows: list[tuple[FloatArray, FloatArray]] = []
    for use, own in (("estimation", {}), ("validation", fitted.refitted)):
        values = {**fitted.values, **own}
        p = less.system.vector({name: values[name] for name in less.system.parameter_names})
        for motion in weak.motions[use]:
            force = _claimed(weak, less.system, placed, values, motion)
            if force is None:
                return None
            r, j = less.residual(motion, p, "weak", index)
            rows.append((r, np.concatenate([j, weak.averaged(force[:, :, None], motion)], axis=2)))
    if not all(np.isfinite(r).all() and np.isfinite(x).all() for r, x in rows):
        return 0.0
    sides: list[FloatArray] = []
    for k in range(rows[0][0].shape[1]):
        sides += _white([np.column_stack([x[:, k], r[:, k]]) for r, x in rows])
    table = np.concatenate(sides)
    return _t_value(table[:, :-1], table[:, -1])


def found_function(balance: MomentumForm, fitted: Fitted, family: Family, coefficients: FloatArray) -> float:
    """Return the t value with which a force, a function of the motion, shows in the balance of the validation records.

    Parameters
    ----------
    balance : MomentumForm
    fitted : Fitted
        The model in the balance, without the force.
    family : Family
        Of functions of a force on a coordinate.
    coefficients : array (K,)
        Of its functions, fitted to estimation records.
    """
    equations = balance.equations(fitted.effects)
    index = [equations.system.parameter_names.index(name) for name in fitted.free]
    p = equations.system.vector({**fitted.values, **fitted.refitted})
    columns, left = [], []
    for motion in balance.motions["validation"]:
        r, j = equations.residual(motion, p, "weak", index)
        force = force_along(family, coefficients, balance.nominal, motion)
        columns.append(np.concatenate([j, balance.averaged(force[:, :, None], motion)], axis=2))
        left.append(r[:, :, None])
    return _t_value(stacked(columns), stacked(left)[:, 0])


def _t_value(x: FloatArray, r: FloatArray) -> float:
    """Return the t value of the last column of x (N, k) in the regression of r (N,) on all of them; 0 if undefined."""
    scale = np.linalg.norm(x, axis=0)
    if not (np.isfinite(x).all() and np.isfinite(r).all()) or scale[-1] == 0:
        return 0.0
    x = x / np.where(scale > 0, scale, 1.0)
    others = x[:, :-1]
    direction = x[:, -1] - others @ np.linalg.lstsq(others, x[:, -1], rcond=1e-8)[0]
    size = float(direction @ direction)
    if size < 1e-6:  # the other parameters do the same
        return 0.0
    slope = float(direction @ r) / size
    rest = r - others @ np.linalg.lstsq(others, r, rcond=1e-8)[0] - slope * direction
    spread = float(rest @ rest) / max(r.size - x.shape[1], 1)
    return slope * float(np.sqrt(size / max(spread, 1e-300)))


def _claimed(
    weak: EquationForm, system: Any, placed: Placed, values: Mapping[str, float], motion: Motion
) -> FloatArray | None:
    """Return the force (N, n) of an effect with its fitted values along a measured motion; None if it exerts none."""
    if not claimable(system, placed):
        return None
    own = {one.name: values[placed.name(one.name)] for one in placed.effect.parameters}
    known = {name: values[name] for name in system.parameter_names}
    force = ClaimedForce(system, placed, weak.sizes.get(placed.at, {}))(motion.signals(), own, known)
    return force if np.isfinite(force).all() else np.zeros_like(force)


def _white(records: Sequence[FloatArray]) -> list[FloatArray]:
    """Return the columns of records (N_i, k), the balance last, filtered so that what they leave of it is white."""
    table = np.concatenate(list(records))
    x, r = table[:, :-1], table[:, -1]
    scale = np.linalg.norm(x, axis=0)
    solution = np.linalg.lstsq(x / np.where(scale > 0, scale, 1.0), r, rcond=1e-8)[0]
    rest = r - (x / np.where(scale > 0, scale, 1.0)) @ solution
    cuts = np.cumsum([len(one) for one in records])[:-1]
    errors = np.split(rest, cuts)
    phi = autoregression(errors, ORDER)
    size = float(np.sqrt(np.mean(np.concatenate([filtered(one, phi) for one in errors]) ** 2)))
    return [filtered(one, phi) / max(size, 1e-300) for one in records]
