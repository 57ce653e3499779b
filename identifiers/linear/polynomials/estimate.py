"""The record of a prediction-error estimate: covariance and intervals in the units of the channels, or why none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harness.models.estimate import Estimate, RankDecision
from harness.models.whiteness import DOUBT
from harness.signals import FloatArray, PlantSpec
from harness.units import quotient
from identifiers.common.one_step_estimate import EXACT, LARGEST, LEVEL
from identifiers.common.scaling import Scaling
from identifiers.linear.polynomials.model import Polynomials

DEPENDENT = 1e-7
"""Singular values of the gradients below this share of the largest: a direction that the data do not determine."""


@dataclass(frozen=True, eq=False)
class FittedOutput:
    """The end of the search for one output, in scaled signals."""

    model: Polynomials
    covariance: FloatArray  # (k, k): Of its parameter vector
    rms: float  # Of the residuals
    whiteness: float  # Probability of residuals at least so correlated in time, were they white
    singular_values: FloatArray  # Of the gradients of the errors, columns at unit length
    arrived: bool
    free: int  # Samples beyond the number of unknowns
    stabilized: bool = False  # Searched again among stable models
    moves: FloatArray | None = None  # (G, k): How the parameter vector moves without one stretch of the records each

    @property
    def errors(self) -> list[float]:
        """Standard errors of the parameter vector."""
        return [float(error) for error in np.sqrt(np.diag(self.covariance))]


def in_units(fit: FittedOutput, scaling: Scaling, output: int) -> tuple[Polynomials, FloatArray]:
    """Return the polynomials of one output, and their standard errors (p,), in the units of the channels."""
    own, orders = float(scaling.outputs[output]), fit.model.orders
    gains = [np.full(nb, own / size) for nb, size in zip(orders.nb, scaling.inputs, strict=True)]
    rest = np.ones(orders.nc + orders.nd + sum(orders.nf))
    scale = np.concatenate([np.ones(orders.na), *gains, rest, [own]])
    return Polynomials.of(fit.model.vector * scale, orders), np.array(fit.errors) * scale


def prediction_error_estimate(spec: PlantSpec, fits: Sequence[FittedOutput], scaling: Scaling) -> Estimate | None:
    """Return the record of all outputs; intervals only where the residuals of all are white.

    Covariance ``sigma^2 (Psi' Psi)^-1`` of the gradients of the prediction errors (Ljung 1999, eq. 9.42). It holds at
    the minimum, for residuals that are white: of an output-error model under coloured noise it does not, and none is
    claimed.

    - ``fits``: one for each output
    - ``scaling``: what the signals were divided by
    - returns None beyond 200 coefficients
    """
    from scipy.stats import t

    names: list[str] = []
    units: list[str] = []
    values, scales = [], []
    for fit, output, own in zip(fits, spec.outputs, scaling.outputs, strict=True):
        rows = _rows(fit.model, spec, output.name, output.unit, float(own), scaling.inputs)
        names += [name for name, _, _ in rows]
        units += [unit for _, unit, _ in rows]
        scales.append(np.array([scale for _, _, scale in rows]))
        values.append(fit.model.vector * scales[-1])
    if len(names) > LARGEST:
        return None
    covariance = np.zeros((len(names),) * 2)
    half, place = [], 0
    for fit, scale in zip(fits, scales, strict=True):
        k = scale.size
        covariance[place : place + k, place : place + k] = fit.covariance * np.outer(scale, scale)
        half.append(float(t.ppf(0.5 + LEVEL / 2, fit.free)) * np.array(fit.errors) * scale)
        place += k
    rank = RankDecision(
        sum(int(np.sum(fit.singular_values > DEPENDENT * fit.singular_values[0])) for fit in fits),
        sum(fit.singular_values.size for fit in fits),
        rule="gradients of the prediction errors, initial states among them",
    )
    coloured = [c.name for fit, c in zip(fits, spec.outputs, strict=True) if fit.whiteness < DOUBT / len(fits)]
    arrived = all(fit.arrived for fit in fits)
    why = ""
    if all(fit.rms <= EXACT for fit in fits):
        why = "no interval: the residuals are rounding"
    elif coloured:
        why = f"no interval: the residuals of {', '.join(coloured)} are correlated in time; use structure armax or bj"
    elif not rank.full:
        why = "no interval: the data do not determine every coefficient; lower the order"
    found = np.concatenate(values)
    spread = np.concatenate(half)
    return Estimate(
        tuple(names),
        tuple(units),
        found,
        covariance,
        None if why else np.column_stack([found - spread, found + spread]),
        LEVEL,
        why or "curvature of the squared prediction errors, white residuals",
        rank,
        float(max(fit.singular_values[0] / max(fit.singular_values[-1], 1e-300) for fit in fits)),
        arrived,
        "" if arrived else "the search for the least prediction error did not arrive",
    )


def _rows(
    model: Polynomials, spec: PlantSpec, output: str, unit: str, own: float, inputs: FloatArray
) -> list[tuple[str, str, float]]:
    """Return name, unit and scale of every coefficient of a parameter vector."""
    orders = model.orders
    rows = [(f"{output}: a{j}", "1", 1.0) for j in range(1, orders.na + 1)]
    for channel, size, nb, nk in zip(spec.inputs, inputs, orders.nb, orders.nk, strict=True):
        by = quotient(unit, channel.unit)
        rows += [(f"{output}: b{j} of {channel.name}", by, own / float(size)) for j in range(nk, nk + nb)]
    for letter, count in (("c", orders.nc), ("d", orders.nd)):
        rows += [(f"{output}: {letter}{j}", "1", 1.0) for j in range(1, count + 1)]
    for count, group in zip(orders.nf, orders.groups, strict=False):
        of = f" of {spec.inputs[group[0]].name}" if len(orders.nf) > 1 else ""
        rows += [(f"{output}: f{j}{of}", "1", 1.0) for j in range(1, count + 1)]
    return [*rows, (f"{output}: level", unit, own)]
