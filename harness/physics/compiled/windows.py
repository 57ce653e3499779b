"""Windows of records: simulating them all at once, and the normal equations of an output-error fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from harness.physics.compiled.rollout_call import Asked, Given, Sums
from harness.physics.fitting.smoothing import smooth
from harness.signals import FloatArray, Trajectory

if TYPE_CHECKING:
    from harness.physics.compiled.simulator import Simulator


@dataclass(frozen=True, eq=False)
class WindowGroup:
    """Windows of equal length: which record each comes from and where it starts."""

    record: list[int]
    first: list[int]
    length: int
    order: list[int]  # Place of each window in the list of all windows.


@dataclass(eq=False)
class Evaluation:
    """What one simulation of all windows gave.

    ``cost`` is half the sum of squared weighted residuals, infinite where a window diverged; ``costs`` (W,) by window.
    ``gram`` (W, ns, ns) and ``gradient`` (W, ns) are J'J and J'r of the weighted outputs by (p, x0), r = measured minus
    predicted, so that J'r is minus the gradient of the cost.
    """

    cost: float
    costs: FloatArray
    gram: FloatArray
    gradient: FloatArray
    squares: FloatArray  # Sum of squared unweighted residuals by output (ny,).
    residuals: list[FloatArray] = field(default_factory=list)
    states: list[FloatArray] = field(default_factory=list)  # By window: (L, ny) and (L, nx).
    jacobian: FloatArray | None = None
    """As :meth:`Windows.jacobian` returns it; None if it was not asked for, or a window diverged."""
    starts: list[FloatArray] = field(default_factory=list)
    """With the Jacobian: by window an orthonormal basis (L * ny, k) of what its initial state can do."""


class Windows:
    """All windows of some records at one horizon.

    - ``horizon``: length of a window [s]; None for whole records. A remainder shorter than half a window joins the last
      one.
    - ``sigma`` (ny,): weights are 1 / sigma
    """

    def __init__(
        self, simulator: Simulator, trajectories: Sequence[Trajectory], horizon: float | None, sigma: FloatArray
    ) -> None:
        self.simulator, self.trajectories, self.sigma = simulator, list(trajectories), np.asarray(sigma, dtype=float)
        self.horizon = horizon
        self.places: list[tuple[int, int, int]] = []
        for number, record in enumerate(self.trajectories):
            self.places += [(number, first, last) for first, last in _cuts(len(record), horizon, simulator.dt)]
        lengths: dict[int, WindowGroup] = {}
        for order, (number, first, last) in enumerate(self.places):
            group = lengths.setdefault(last - first, WindowGroup([], [], last - first, []))
            group.record.append(number)
            group.first.append(first)
            group.order.append(order)
        self.groups = list(lengths.values())
        self.periods = [channel.period for channel in simulator.spec.outputs]
        self._wraps = np.array([period or 0.0 for period in self.periods])
        self._y = [self._cut(group, [record.y for record in self.trajectories]) for group in self.groups]
        self._t = [
            np.array([self.trajectories[r].t[k] for r, k in zip(group.record, group.first, strict=True)])
            for group in self.groups
        ]
        self._u: list[FloatArray] | None = None
        if not simulator.sampled.input_delays:
            nothing = np.zeros((1, simulator.np))
            seen = [simulator.seen(record.u[None], nothing, False)[0][0] for record in self.trajectories]
            self._u = [self._cut(group, seen, simulator.pieces) for group in self.groups]

    def __len__(self) -> int:
        return len(self.places)

    @property
    def n_data(self) -> int:
        """Number of scalar measurements."""
        return sum(len(record) * record.spec.ny for record in self.trajectories)

    def _cut(self, group: WindowGroup, arrays: list[FloatArray], each: int = 1) -> FloatArray:
        """Return the part of every record's array that belongs to a window, ``each`` rows from sample to sample."""
        rows = (group.length - 1) * each + 1
        return np.stack([arrays[r][k * each : k * each + rows] for r, k in zip(group.record, group.first, strict=True)])

    def _inputs(self, p: FloatArray) -> tuple[list[FloatArray], list[FloatArray | None]]:
        """Return the inputs that the equations see; delays reach back beyond the window into the record."""
        if self._u is not None:
            return self._u, [None] * len(self.groups)
        seen, input_jacobians = [], []
        for record in self.trajectories:
            u, input_jacobian = self.simulator.seen(record.u[None], p[None], True)
            assert input_jacobian is not None
            seen.append(u[0])
            input_jacobians.append(input_jacobian[0])
        inputs = [self._cut(group, seen, self.simulator.pieces) for group in self.groups]
        return inputs, [self._cut(group, input_jacobians, self.simulator.pieces) for group in self.groups]

    def evaluate(self, p: FloatArray, x0: FloatArray, *, keep: bool = False, jacobian: bool = False) -> Evaluation:
        """Simulate all windows.

        - ``p`` (np,)
        - ``x0`` (W, nx)
        - ``keep``: keep residuals and states of every window
        - ``jacobian``: keep the Jacobian by the parameters as well, unless a window diverges
        """
        return self._evaluated(p, x0, keep, jacobian)

    def trial(
        self,
        p: FloatArray,
        x0: FloatArray,
        *,
        columns: npt.NDArray[np.intp] | None = None,
        limits: FloatArray | None = None,
        budget: float = np.inf,
        keep: bool = False,
    ) -> Evaluation:
        """Simulate all windows as far as a step of a fit needs it; more is computed where there is no compiled code.

        - ``p, x0, keep``: as for :meth:`evaluate`
        - ``columns`` array of int: which of (p, x0) are asked for; the rest of ``gram`` and ``gradient`` need not hold
        - ``limits`` (W,): a window whose cost exceeds its limit may be pruned, with an infinite cost; one with a
          negative limit is not simulated
        - ``budget``: all windows may be pruned, with infinite costs, once their costs together exceed it
        """
        if not self._summing:
            return self.evaluate(p, x0, keep=keep)
        return self._evaluated(p, x0, keep, False, columns, limits, budget)

    @property
    def _summing(self) -> bool:
        """True if the simulator can sum up the normal equations by itself (that of an FMU cannot)."""
        return hasattr(self.simulator, "sums")

    def _evaluated(
        self,
        p: FloatArray,
        x0: FloatArray,
        keep: bool,
        jacobian: bool,
        columns: npt.NDArray[np.intp] | None = None,
        limits: FloatArray | None = None,
        budget: float = np.inf,
    ) -> Evaluation:
        """Simulate group by group, by compiled sums where they are to be had."""
        ns, ny = self.simulator.np + self.simulator.nx, self.simulator.spec.ny
        count = len(self.places)
        result = Evaluation(0.0, np.zeros(count), np.zeros((count, ns, ns)), np.zeros((count, ns)), np.zeros(ny))
        if keep:
            result.residuals = [np.zeros(0)] * count
            result.states = [np.zeros(0)] * count
        rows: list[FloatArray] = [np.zeros(0)] * count
        if jacobian:
            result.starts = [np.zeros(0)] * count
        inputs, input_jacobians = self._inputs(p)
        for number, group in enumerate(self.groups):
            values = np.ascontiguousarray(np.broadcast_to(p, (len(group.order), p.shape[0])))
            given = Given(
                values,
                np.ascontiguousarray(x0[group.order]),
                inputs[number],
                input_jacobians[number],
                self._t[number],
            )
            found = None
            if self._summing:
                limit = None if limits is None else np.ascontiguousarray(limits[group.order])
                data = self._y[number], self.sigma, self._wraps
                found = self.simulator.sums(given, Asked(data, columns, limit, budget, keep, jacobian))
            if found is None:
                found = self._summed(number, given)
            budget = min(budget, found.budget)
            result.costs[group.order], result.squares = found.costs, result.squares + found.squares
            result.gram[group.order], result.gradient[group.order] = found.gram, found.gradient
            if keep and found.residuals is not None and found.states is not None:
                for row, order in enumerate(group.order):
                    result.residuals[order], result.states[order] = found.residuals[row], found.states[row]
            if jacobian and found.sensitivities is not None and np.isfinite(found.costs).all():
                for row, order in enumerate(group.order):
                    by = found.sensitivities[row] / self.sigma[:, None]
                    rows[order], result.starts[order] = self._without_state(by.reshape(-1, ns))
        result.cost = float(np.sum(result.costs))
        if jacobian and np.isfinite(result.cost):
            result.jacobian = np.vstack(rows)
        return result

    def _summed(self, number: int, given: Given) -> Sums:
        """Return the sums of a group of windows from their sensitivities."""
        x, y, s = self.simulator.windows(*given)
        assert s is not None
        m = y.shape[0]
        r = self._y[number] - y
        for column, period in enumerate(self.periods):
            if period is not None:
                r[..., column] = (r[..., column] + period / 2) % period - period / 2
        with np.errstate(over="ignore", invalid="ignore"):
            squares = np.einsum("wki,wki->i", r, r)
            weighted = (r / self.sigma).reshape(m, -1)
            j = (s / self.sigma[:, None]).reshape(m, -1, s.shape[-1])
            costs = 0.5 * np.einsum("wk,wk->w", weighted, weighted)
            gram = j.transpose(0, 2, 1) @ j
            gradient = (weighted[:, None, :] @ j)[:, 0]
        costs[~(np.isfinite(costs) & np.isfinite(gram).all(axis=(1, 2)))] = np.inf
        return Sums(costs, squares, gram, gradient, np.inf, x, r, s)

    def jacobian(self, p: FloatArray, x0: FloatArray) -> FloatArray:
        """Return d(predicted / sigma)/dp (n_data, np), the directions of each window's x0 projected out.

        Rows: windows in order, in each the samples in order, in each the outputs in order.
        """
        simulator = self.simulator
        rows: list[FloatArray] = [np.zeros(0)] * len(self.places)
        inputs, input_jacobians = self._inputs(p)
        for number, group in enumerate(self.groups):
            values = np.ascontiguousarray(np.broadcast_to(p, (len(group.order), p.shape[0])))
            _, _, s = simulator.windows(
                values, np.ascontiguousarray(x0[group.order]), inputs[number], input_jacobians[number], self._t[number]
            )
            assert s is not None
            for row, order in enumerate(group.order):
                rows[order] = self._without_state((s[row] / self.sigma[:, None]).reshape(-1, s.shape[-1]))[0]
        return np.vstack(rows)

    def _without_state(self, j: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives by p of one window without what its initial state can do, and a basis of that."""
        by_p, by_x = j[:, : self.simulator.np], j[:, self.simulator.np :]
        left = np.zeros((len(j), 0))
        if by_x.shape[1]:
            left, sizes, _ = np.linalg.svd(by_x, full_matrices=False)
            left = left[:, sizes > 1e-10 * max(sizes[0], 1e-300)]
            by_p = by_p - left @ (left.T @ by_p)
        return np.ascontiguousarray(by_p), left

    def together(self, parts: list[FloatArray]) -> list[FloatArray]:
        """Return arrays by window put together by record."""
        joined: list[list[FloatArray]] = [[] for _ in self.trajectories]
        for (record, _, _), part in zip(self.places, parts, strict=True):
            joined[record].append(part)
        return [np.vstack(pieces) for pieces in joined]

    def starts_from(self, states: list[FloatArray]) -> FloatArray:
        """Return x0 (W, nx) of these windows from states by record (N_i, nx)."""
        return np.array([states[record][first] for record, first, _ in self.places])


def _cuts(n: int, horizon: float | None, dt: float) -> list[tuple[int, int]]:
    """Return the first and last-plus-one sample of each window of a record."""
    if horizon is None:
        return [(0, n)]
    length = max(2, round(horizon / dt))
    count = max(1, n // length)
    edges = [k * length for k in range(count)]
    if n - count * length >= max(2, length / 2):
        edges.append(count * length)
    return list(zip(edges, [*edges[1:], n], strict=True))


def _earlier(signal: FloatArray, samples: float) -> FloatArray:
    """Return a smoothed signal so many samples earlier than it was read; at its end it is held."""
    if not samples > 0 or len(signal) < 4:
        return signal
    from scipy.interpolate import CubicSpline

    rows = np.arange(len(signal))
    return np.asarray(CubicSpline(rows, signal)(np.minimum(rows + samples, rows[-1])))


def data_states(simulator: Simulator, record: Trajectory, p: FloatArray) -> tuple[FloatArray, list[bool]]:
    """Return what a record tells about the states (N, nx), and which states it tells.

    An output that is a state is smoothed, and read as early as its sensor is late; the rate of a coordinate is the
    derivative of its smoothed output unless it is measured itself. An unmeasured state is where a measured one of the
    same unit is, else 0; hidden states of effects are at their declared start.
    """
    system = simulator.system
    n = len(record)
    x, known = np.zeros((n, system.nx)), [False] * system.nx
    values: dict[int, FloatArray] = {}
    rates: dict[int, FloatArray] = {}
    output_jacobian = simulator.functions.output_jacobian(np.full(system.nx, 0.1), np.zeros(system.nu), p, 0.0).full()
    for row, channel in enumerate(system.outputs):
        where = np.flatnonzero(np.abs(output_jacobian[row]) > 1e-12)
        if len(where) != 1 or not np.isfinite(output_jacobian[row]).all():
            continue
        state = int(where[0])
        # The output is c x + d (a gain or an offset of the sensor): undo it.
        zero = simulator.functions.output(np.zeros(system.nx), np.zeros(system.nu), p, 0.0).full()[row, 0]
        found = smooth(record.y[:, row], simulator.dt, period=channel.period)
        late = sum(
            float(p[column])
            for kind, at, column in simulator.sampled.output_blocks
            if (kind, at) == ("output_delay", row)
        )
        value, rate = (_earlier(part, late / simulator.dt) for part in (found.value, found.rate))
        values[state] = (value - zero) / output_jacobian[row, state]
        rates[state] = rate / output_jacobian[row, state]
    for state, value in values.items():
        x[:, state], known[state] = value, True
    for coordinate in system.coordinates:
        if known[coordinate.q] and not known[coordinate.v]:
            x[:, coordinate.v], known[coordinate.v] = rates[coordinate.q], True
    base = system.nx - system.hidden_count
    for state in range(base):
        if known[state]:
            continue
        same = [k for k in range(base) if known[k] and system.states[k].unit == system.states[state].unit != "1"]
        if same and not system.coordinates:
            x[:, state] = x[:, same[0]]
    if system.hidden_count:
        many = simulator.functions.initial.map(n)
        hidden = many(x.T, record.u.T, np.tile(p[:, None], n)).full().T
        x[:, base:] = np.where(np.isfinite(hidden), hidden, 0.0)
    return x, known
