"""The record of an estimate of lumped parameters, and of the physical parameters that follow from them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.models.estimate import Estimate, RankDecision
from harness.signals import FloatArray

if TYPE_CHECKING:
    from harness.physics import LumpedModel, System
    from identifiers.mechanics.simulated_records import EstimateSpread

LEVEL = 0.95
STEP = 1e-6  # Relative step of the derivatives of lumped by physical parameters.


def lumped_estimate(
    system: System,
    regression: LumpedModel,
    values: Mapping[str, float],
    spread: EstimateSpread | None,
    how: str,
    rank: RankDecision,
    condition: float,
) -> Estimate:
    """Return the record of lumped parameters; intervals only if their spread is known."""
    names = regression.names
    units = tuple(lumped_unit(system, combination) for combination in regression.combinations)
    found = np.array([values[name] for name in names])
    covariance = None if spread is None else spread.covariance
    return Estimate(
        names,
        (*units, *("1" for _ in names[len(units) :])),
        found,
        covariance,
        None if spread is None else _intervals(found, spread.covariance, spread.count),
        LEVEL,
        how,
        rank,
        condition,
    )


def physical_estimate(
    system: System, regression: LumpedModel, parameters: Mapping[str, float], record: Estimate
) -> Estimate:
    """Return the record of the physical parameters that lumped ones determine, by the law of propagation.

    Parameters that no lumped combination determines alone have an infinite variance, no interval, and stand in the
    null directions.
    """
    wanted = {str(symbol) for combination in regression.combinations for symbol in combination.free_symbols}
    names = tuple(parameter.name for parameter in system.parameters if parameter.name in wanted)
    point = np.array([parameters[name] for name in names])
    columns = []
    scale = np.maximum(np.abs(record.values), 1e-12 * np.abs(record.values).max(initial=1.0))
    size = np.maximum(np.abs(point), 1e-3)
    for row, name in enumerate(names):
        step = STEP * size[row]
        high, low = ({**parameters, name: point[row] + sign * step} for sign in (1, -1))
        columns.append((regression.values(high) - regression.values(low)) / (2 * step) * size[row] / scale)
    jacobian = np.column_stack(columns) if columns else np.zeros((len(scale), 0))
    left, singular, right = np.linalg.svd(jacobian, full_matrices=True)
    rank = int(np.sum(singular > 1e-6 * singular.max(initial=0.0)))
    null = right[rank:].T
    loose = np.sum(null**2, axis=1) > 1e-6
    covariance = intervals = None
    if record.covariance is not None and record.intervals is not None:
        back = right[:rank].T @ (left[:, :rank] / singular[:rank]).T
        carry = size[:, None] * back / scale
        covariance = carry @ record.covariance @ carry.T
        covariance[np.diag_indices(len(names))] = np.where(loose, np.inf, np.diag(covariance))
        widths = (record.intervals[:, 1] - record.intervals[:, 0]) / 2
        deviations = np.sqrt(np.diag(record.covariance))
        factor = float(np.median(widths / np.where(deviations > 0, deviations, 1.0)))
        half = np.where(loose, np.nan, factor * np.sqrt(np.where(loose, 0.0, np.diag(covariance))))
        intervals = np.column_stack([point - half, point + half])
    # parameters move by size * z for a direction z of the scaled Jacobian
    decision = RankDecision.of(names, null, 1.0 / size, loose, f"what {len(record.names)} lumped parameters determine")
    return Estimate(
        names,
        tuple(system.parameter(name).unit for name in names),
        point,
        covariance,
        intervals,
        record.level,
        record.method,
        decision,
        record.condition,
        record.converged,
        record.message,
    )


def lumped_unit(system: System, combination: Any) -> str:
    """Return the unit of a lumped combination as text: the product of the units in one term, ``"kg m^2"``.

    A term with a factor may hide a length (``0.2*m3``): the first parameter of the system that stands alone counts.
    """
    import sympy as sp

    order = {name: place for place, name in enumerate(system.parameter_names)}
    plain = [summand for summand in sp.Add.make_args(sp.expand(combination)) if abs(summand.as_coeff_Mul()[0]) == 1]
    terms = plain or list(sp.Add.make_args(sp.expand(combination)))
    term = min(
        terms, key=lambda summand: min((order[str(symbol)] for symbol in summand.free_symbols), default=len(order))
    )
    powers: dict[str, Any] = {}
    for base, power in term.as_powers_dict().items():
        unit = system.parameter(str(base)).unit if base.is_Symbol else "1"
        if unit != "1":
            powers[unit] = powers.get(unit, 0) + power
    parts = []
    # mass before length: kg m^2
    for unit, power in sorted(powers.items(), key=lambda item: (not item[0].startswith(("kg", "N")), item[0])):
        base_unit = f"({unit})" if power != 1 and (" " in unit or "/" in unit) else unit
        parts.append(base_unit if power == 1 else f"{base_unit}^{power}")
    return " ".join(parts) or "1"


def _intervals(values: FloatArray, covariance: FloatArray, count: int) -> FloatArray:
    """Return 95 % intervals: Student's t, because the variance comes of so many samples; the bias is as uncertain."""
    from scipy.stats import t as student

    factor = float(student.ppf(0.5 + LEVEL / 2, count - 1)) * np.sqrt(1 + 1 / count)
    half = factor * np.sqrt(np.diag(covariance))
    return np.column_stack([values - half, values + half])
