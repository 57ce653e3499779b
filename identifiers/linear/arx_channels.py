"""ARX models with orders of their own for every pair of channels: one regression for each output."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from harness.errors import FitError
from harness.models.arx_orders import Delay, arx_order_grid, input_delays
from harness.models.estimate import Estimate, RankDecision
from harness.signals import FloatArray, PlantSpec, Trajectory
from harness.units import quotient
from identifiers.common.excitation import Columns, refuse_feedback
from identifiers.common.neighbours import BIAS, LARGEST, coefficients_without
from identifiers.common.one_step_estimate import EXACT, LEVEL, foretold_output
from identifiers.common.one_step_estimate import LARGEST as MOST
from identifiers.common.records import lagged_blocks
from identifiers.common.regression import Solution, solve
from identifiers.common.scaling import sizes
from identifiers.linear.polynomials.orders import Counts, by_pair

HIGHEST = 8
"""Order up to which what is not given is chosen, by Schwarz's criterion over all of them (one factorisation)."""


@dataclass(frozen=True)
class ArxOrders:
    """Past outputs, coefficients and delays of every pair: rows of outputs; columns of outputs (na) or inputs."""

    na: tuple[tuple[int, ...], ...]
    nb: tuple[tuple[int, ...], ...]
    nk: tuple[tuple[int, ...], ...]

    @property
    def lags(self) -> int:
        """Samples that the longest memory reaches back."""
        inputs = [b + k - 1 for nb, nk in zip(self.nb, self.nk, strict=True) for b, k in zip(nb, nk, strict=True) if b]
        return max([1, *(n for row in self.na for n in row), *inputs])

    def columns(self, output: int, spec: PlantSpec) -> list[int]:
        """Return the columns of an output among those of all lags, without the constant."""
        ny, nu, found = spec.ny, spec.nu, []
        for j in range(self.lags):
            found += [j * ny + i for i in range(ny) if j < self.na[output][i]]
        for j in range(self.lags):
            pairs = enumerate(zip(self.nb[output], self.nk[output], strict=True))
            found += [self.lags * ny + j * nu + i for i, (nb, nk) in pairs if nk <= j + 1 < nk + nb]
        return found


def arx_orders_of(
    records: Sequence[Trajectory],
    na: Counts | None,
    nb: Counts | None,
    nk: Counts | Literal["auto"] | None,
    order: int | None,
    what: str,
) -> tuple[ArxOrders, dict[str, Any]]:
    """Return the orders that options give, the others by Schwarz's criterion, and what the notes say of delays.

    Raises FitError if a list or matrix has another size than the channels, or a delay is below 1.
    """
    spec, notes = records[0].spec, dict[str, Any]()
    if nk == "auto":
        found: list[list[Delay]] = [input_delays(records, output, least=1) for output in range(spec.ny)]
        delays = [[one.samples for one in row] for row in found]
        notes["delays"] = {
            f"{output.name} from {given.name}": one.to_dict()
            for output, row in zip(spec.outputs, found, strict=True)
            for given, one in zip(spec.inputs, row, strict=True)
        }
    else:
        delays = [list(row) for row in by_pair("nk", 1 if nk is None else nk, spec.ny, spec.nu, what)]
    if min((k for row in delays for k in row), default=1) < 1:
        raise FitError(
            f"{what}: nk",
            expected="delays of at least 1",
            got=str(nk),
            remedy="use prediction-error with structure arx for outputs that answer the input of the same sample",
        )
    if order is None and (na is None or nb is None):
        common = max(min(row, default=1) for row in delays)
        ladder = range(1, HIGHEST + 1)
        best = arx_order_grid(records, ladder, ladder if spec.nu else (0,), (common,)).best("bic")
        na, nb = best["na"] if na is None else na, best["nb"] if nb is None else nb
    a = by_pair("na", _given(na, order), spec.ny, spec.ny, what)
    b = by_pair("nb", _given(nb, order), spec.ny, spec.nu, what)
    return ArxOrders(tuple(a), tuple(b), tuple(map(tuple, delays))), notes


def _given(value: Counts | None, order: int | None) -> Counts:
    """Return an order, or that of all polynomials."""
    return (order or 1) if value is None else value


def arx_by_channel(
    records: Sequence[Trajectory], orders: ArxOrders, offset: bool, ridge: float, least_excitation: float, what: str
) -> tuple[FloatArray, list[Solution], Estimate | None]:
    """Return the coefficients (lags (ny + nu) + offset, ny) of all lags, the regressions, and their record.

    - ``ridge, least_excitation``: as of ``arx``
    """
    spec = records[0].spec
    full = Columns(spec, orders.lags)
    theta = np.zeros((orders.lags * (spec.ny + spec.nu) + int(offset), spec.ny))
    solutions = []
    for output in range(spec.ny):
        columns = _with_constant(orders.columns(output, spec), theta, offset)
        names = [full.names[j] for j in columns]
        rows = partial(_blocks, records, orders.lags, offset, output, columns)
        solution = solve(rows, what, ridge=ridge, names=names)
        theta[columns, output] = solution.coefficients[:, 0]
        solutions.append(solution)
    rms = np.array([float(one.residual_rms[0]) for one in solutions])  # the noise of all outputs among the regressors
    for output, solution in enumerate(solutions) if ridge == 0.0 else ():
        columns = _with_constant(orders.columns(output, spec), theta, offset)
        known = replace(solution, residual_rms=rms)
        refuse_feedback(known, _columns(full, orders, output, columns, spec), least_excitation, what)
    return theta, solutions, _estimate(records, orders, theta, solutions, offset) if ridge == 0.0 else None


def channel_neighbours(
    records: Sequence[Trajectory], orders: ArxOrders, theta: FloatArray, solutions: Sequence[Solution], offset: bool
) -> tuple[list[FloatArray], float, str] | None:
    """Return the coefficients of all lags without one stretch of the records each, their factor and a warning.

    None where there are too few rows or too many states.
    """
    spec = records[0].spec
    if orders.lags * (spec.ny + spec.nu) - spec.nu > LARGEST:
        return None
    near: list[FloatArray] = []
    factor = 1.0
    for output, solution in enumerate(solutions):
        columns = _with_constant(orders.columns(output, spec), theta, offset)
        found = coefficients_without(partial(_blocks, records, orders.lags, offset, output, columns), solution)
        if found is None:
            return None
        near = near or [theta.copy() for _ in found[0]]
        factor = found[1]
        for one, own in zip(near, found[0], strict=True):
            one[columns, output] = own[:, 0]
    every = [_with_constant(orders.columns(output, spec), theta, offset) for output in range(spec.ny)]
    biased = foretold_output(records, theta, orders.lags, offset, every) is not None
    return near, factor, BIAS if biased else ""


def _with_constant(columns: list[int], theta: FloatArray, offset: bool) -> list[int]:
    """Return columns with that of the constant."""
    return [*columns, len(theta) - 1] if offset else columns


def _blocks(
    records: Sequence[Trajectory], lags: int, offset: bool, output: int, columns: list[int]
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield some columns of the regressors, and the next values of one output."""
    for phi, y in lagged_blocks(records, lags, offset=offset):
        yield phi[:, columns], y[:, output : output + 1]


def _columns(full: Columns, orders: ArxOrders, output: int, columns: Sequence[int], spec: PlantSpec) -> Columns:
    """Return which of the chosen columns is what."""
    own = Columns(spec, orders.lags)
    own.output_of = {place: full.output_of[j] for place, j in enumerate(columns) if j in full.output_of}
    own.names = [full.names[j] for j in columns]
    first = orders.lags * spec.ny
    wanted = [first + (nk - 1) * spec.nu + i for i, (nb, nk) in _pairs(orders, output) if nb]
    own.now = [columns.index(j) for j in wanted]
    return own


def _pairs(orders: ArxOrders, output: int) -> list[tuple[int, tuple[int, int]]]:
    """Return of every input its number, coefficients and delay."""
    return list(enumerate(zip(orders.nb[output], orders.nk[output], strict=True)))


def _estimate(
    records: Sequence[Trajectory], orders: ArxOrders, theta: FloatArray, solutions: Sequence[Solution], offset: bool
) -> Estimate | None:
    """Return the record: covariance output by output (Ljung 1999, eq. 9.42), intervals where residuals are white."""
    from scipy.stats import t

    spec, full = records[0].spec, Columns(records[0].spec, orders.lags)
    sides = [c.unit for side in (spec.outputs, spec.inputs) for _ in range(orders.lags) for c in side] + ["1"]
    total = sum(len(one.coefficients) for one in solutions)
    if total > MOST:
        return None
    names, units, values, half = list[str](), list[str](), [], []
    covariance, place, exact = np.zeros((total, total)), 0, True
    size = sizes([record.y for record in records])
    every = [_with_constant(orders.columns(output, spec), theta, offset) for output in range(spec.ny)]
    for output, one in enumerate(solutions):
        columns = every[output]
        free = max(one.rows - len(columns), 1)
        inverse = np.linalg.pinv(one.factor) / one.scale[:, None]
        own = float(one.residual_rms[0]) ** 2 * one.rows / free * inverse @ inverse.T
        rows = slice(place, place + len(columns))
        covariance[rows, rows] = own
        place += len(columns)
        exact = exact and bool(one.residual_rms[0] <= EXACT * size[output])
        half.append(float(t.ppf(0.5 + LEVEL / 2, free)) * np.sqrt(np.diag(own)))
        values.append(theta[columns, output])
        names += [f"{spec.outputs[output].name} on {full.names[j]}" for j in columns]
        units += [quotient(spec.outputs[output].unit, sides[j]) for j in columns]
    found, spread, why = np.concatenate(values), np.concatenate(half), ""
    if exact:
        why = "no interval: the residuals are rounding"
    elif (foretold := foretold_output(records, theta, orders.lags, offset, every)) is not None:
        why = f"no interval: the residuals of {foretold} are correlated in time; use prediction-error with armax or bj"
    return Estimate(
        names=tuple(names),
        units=tuple(units),
        values=found,
        covariance=covariance,
        intervals=None if why else np.column_stack([found - spread, found + spread]),
        level=LEVEL,
        method=why or "least squares, white residuals",
        rank=RankDecision(total, total, rule="inputs move by more than their noise"),
        condition=max(one.condition for one in solutions),
    )
