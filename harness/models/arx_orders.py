"""ARX models of every order from one triangular factor: losses, what criteria make of them, the inputs' delays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from harness.errors import FitError, InputError
from harness.signals import FloatArray, Trajectory

Criterion = Literal["held-out", "aic", "bic"]
CRITERIA: tuple[Criterion, ...] = ("held-out", "aic", "bic")
MEMORY = 12
"""Past samples beside the delays in the regression that delays are read from: noise of any colour is white in it."""
MOST = 30  # Samples of delay that are looked for at most.
EQUATIONS = 4  # Equations for each regressor, below which fewer delays are looked for.
LEVEL = 0.95
_BLOCK = 4096


@dataclass(frozen=True, eq=False)
class LagTriangle:
    """Triangular factor R of ``[1, y[k-1], ..., y[k-na], u[k-low], ..., u[k-high], y[k]]``, rows k of all records.

    Every regression of the outputs on some of the columns follows from R alone: ``|X_S theta - y| = |R_S theta - R_y|``
    (Ljung 1999, sec. 10.1). Rows with a missing reading are left out, and none reaches across a seam.
    """

    triangle: FloatArray  # (p + ny, p + ny)
    rows: int
    ny: int
    nu: int
    na: int
    low: int
    high: int

    @classmethod
    def of(cls, records: Sequence[Trajectory], na: int, low: int, high: int) -> LagTriangle:
        """Return the factor of the records; R of too short ones has no rows."""
        spec = records[0].spec
        width = 1 + na * spec.ny + (high - low + 1) * spec.nu + spec.ny
        triangle, rows, reach = np.zeros((0, width)), 0, max(na, high)
        for record in records:
            for start in range(reach, len(record), _BLOCK):
                block = _rows(record, np.arange(start, min(start + _BLOCK, len(record))), na, low, high)
                rows += len(block)
                triangle = np.asarray(np.linalg.qr(np.vstack([triangle, block]), mode="r"), dtype=np.float64)
        return cls(triangle, rows, spec.ny, spec.nu, na, low, high)

    @property
    def targets(self) -> list[int]:
        """Columns of the outputs that are foretold."""
        return list(range(self.triangle.shape[1] - self.ny, self.triangle.shape[1]))

    def columns(self, na: int, spans: Sequence[tuple[int, int]]) -> list[int]:
        """Return the columns of the constant, na lags of the outputs, and a first and last lag of each input."""
        first = 1 + self.na * self.ny
        of_inputs = [
            first + (lag - self.low) * self.nu + i
            for lag in range(self.low, self.high + 1)
            for i, (low, high) in enumerate(spans)
            if low <= lag <= high
        ]
        return [*range(1 + na * self.ny), *of_inputs]

    def reduced(self, columns: Sequence[int]) -> FloatArray:
        """Return the triangle of some columns and the outputs: the first k of them fit as its first k rows say."""
        return np.asarray(np.linalg.qr(self.triangle[:, [*columns, *self.targets]], mode="r"), dtype=np.float64)


@dataclass(frozen=True)
class Delay:
    """Samples that an input takes to reach an output, and how sure that is."""

    samples: int  # The likeliest
    # Of the likeliest delays that hold 95 % together
    low: int
    high: int
    probability: float  # Of ``samples``

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description."""
        return {"samples": self.samples, "interval": [self.low, self.high], "probability": self.probability}


@dataclass(frozen=True, eq=False)
class ArxGrid:
    """Losses of ARX models of every order of a grid, all on the same rows."""

    # Orders that were tried, for all channels: past outputs, coefficients of each input, delay
    na: tuple[int, ...]
    nb: tuple[int, ...]
    nk: tuple[int, ...]
    losses: FloatArray
    """(A, B, K, ny): Sums of squared one-step errors; NaN where there are fewer rows than coefficients."""
    held_out: FloatArray
    """(A, B, K, ny): The same of the fitted models on the rows of other records; NaN where there are none."""
    rows: int
    held_rows: int
    size: FloatArray  # (ny,): Mean squares of the outputs about their mean, over the rows that losses are summed over
    parameters: Any  # array of int (A, B, K): Coefficients of each output

    def values(self, criterion: Criterion) -> FloatArray:
        """Return a criterion of every order (A, B, K): less is better.

        ``aic`` and ``bic`` are ``N sum log(loss / N)`` with 2 (Akaike 1974) or log N (Schwarz 1978) for each
        coefficient, over all outputs; ``held-out`` is the NRMSE on the records held out.
        """
        if criterion == "held-out":
            return np.asarray(np.sqrt(np.mean(self.held_out / max(self.held_rows, 1) / self.size, axis=-1)))
        least = self.size * 1e-24
        told = self.rows * np.sum(np.log(np.maximum(self.losses / self.rows, least)), axis=-1)
        price = 2.0 if criterion == "aic" else float(np.log(self.rows))
        return np.asarray(told + price * self.losses.shape[-1] * self.parameters, dtype=np.float64)

    def best(self, criterion: Criterion) -> dict[str, int]:
        """Return the orders that a criterion prefers, of equal ones those with the fewest coefficients.

        Raises
        ------
        InputError
            If no order of the grid can be judged by it.
        """
        values = self.values(criterion)
        if not np.isfinite(values).any():
            raise InputError(
                f"no order by {criterion}",
                expected="records long enough, and for held-out records to judge on",
                got=f"{self.rows} rows, {self.held_rows} held out",
                remedy="lower the orders, or take another criterion",
            )
        least = float(np.nanmin(values))
        near = np.flatnonzero(values.ravel() <= least + 1e-9 * abs(least))
        chosen = int(near[np.argmin(self.parameters.ravel()[near])])
        a, b, k = np.unravel_index(chosen, values.shape)
        return {"na": self.na[int(a)], "nb": self.nb[int(b)], "nk": self.nk[int(k)]}

    def rows_of(self, most: int = 20) -> list[dict[str, Any]]:
        """Return one row for each of the best orders, by the error held out or else by BIC, and who prefers it."""
        values = {c: self.values(c) for c in CRITERIA}
        judged = [c for c in CRITERIA if np.isfinite(values[c]).any()]
        preferred = {c: self.best(c) for c in judged}
        nrmse = np.sqrt(np.mean(self.losses / self.rows / self.size, axis=-1))
        by = values["held-out" if "held-out" in judged else "bic"]
        by = np.where(np.isfinite(by), by, np.inf)
        order = list(np.argsort(by.ravel(), kind="stable"))
        mine = [int(np.ravel_multi_index(self._place(one), by.shape)) for one in preferred.values()]
        shown = list(dict.fromkeys([*map(int, order[:most]), *mine]))
        found = []
        for index in shown:
            a, b, k = np.unravel_index(index, by.shape)
            if not np.isfinite(nrmse[a, b, k]):
                continue
            orders = {"na": self.na[int(a)], "nb": self.nb[int(b)], "nk": self.nk[int(k)]}
            found.append(
                {
                    **orders,
                    "nrmse_one_step": float(nrmse[a, b, k]),
                    "nrmse_held_out": float(values["held-out"][a, b, k]) if "held-out" in judged else None,
                    "aic": float(values["aic"][a, b, k]),
                    "bic": float(values["bic"][a, b, k]),
                    "note": ", ".join(f"best by {name}" for name, one in preferred.items() if one == orders),
                }
            )
        return found

    def plot(self) -> Any:
        """Draw the best one-step error against the number of coefficients, and what each criterion prefers."""
        from harness.plots import sheet

        figure = sheet(figsize=(8, 4.5), layout="constrained")
        axis = figure.subplots()
        counts = np.unique(self.parameters)
        fitted = np.sqrt(np.mean(self.losses / self.rows / self.size, axis=-1))
        lines = [("on the rows fitted", fitted)]
        if np.isfinite(self.values("held-out")).any():
            lines.append(("held out", self.values("held-out")))
        for label, values in lines:
            seen = [np.nanmin(np.where(self.parameters == n, values, np.inf)) for n in counts]
            fine = np.isfinite(seen)
            axis.semilogy(counts[fine], np.array(seen)[fine], ".-", label=f"{label}, best of so many coefficients")
        for number, (criterion, mark) in enumerate(zip(CRITERIA, "osd", strict=True)):
            if not np.isfinite(self.values(criterion)).any():
                continue
            best = self.best(criterion)
            place = self._place(best)
            label = f"{criterion}: na {best['na']}, nb {best['nb']}, nk {best['nk']}"
            axis.semilogy(self.parameters[place], fitted[place], mark, ms=9 + 3 * number, mfc="none", label=label)
        axis.set(xlabel="coefficients of an output", ylabel="NRMSE one step ahead")
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
        return figure

    def _place(self, orders: dict[str, int]) -> tuple[int, int, int]:
        """Return where orders stand in the grid."""
        return self.na.index(orders["na"]), self.nb.index(orders["nb"]), self.nk.index(orders["nk"])


def arx_order_grid(
    records: Sequence[Trajectory],
    na: Sequence[int],
    nb: Sequence[int],
    nk: Sequence[int] = (1,),
    *,
    held_out: Sequence[Trajectory] = (),
) -> ArxGrid:
    """Return the losses of all ARX models of a grid of orders, from one QR factorisation of the data.

    All are judged on the rows that the largest order leaves. A small triangle for each pair (na, nk) holds the losses
    of every nb in its last columns.

    Parameters
    ----------
    records : sequence of Trajectory
    na, nb, nk : sequence of int
        Past outputs (0: finite impulse responses), coefficients of each input, delays.
    held_out : sequence of Trajectory
        Records that the fitted models are judged on, from one factorisation too.

    Raises
    ------
    InputError
        If an order is negative or the grid empty.
    FitError
        If the records are too short for the smallest.

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec
    >>> rng, y = np.random.default_rng(0), np.zeros(800)
    >>> u = rng.normal(size=800)
    >>> for k in range(3, 800):
    ...     y[k] = 1.2 * y[k - 1] - 0.5 * y[k - 2] + u[k - 3] + 0.1 * rng.normal()
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> data = Trajectory(np.arange(800.0), u[:, None], y[:, None], spec)
    >>> arx_order_grid([data], range(5), range(1, 4), range(1, 6)).best("bic")
    {'na': 2, 'nb': 1, 'nk': 3}
    """
    wanted = [tuple(sorted(set(one))) for one in (na, nb, nk)]
    if not all(wanted) or min(min(one) for one in wanted) < 0:
        raise InputError(
            "orders of the grid",
            expected="whole numbers from 0 on",
            got=f"na {na}, nb {nb}, nk {nk}",
            remedy="correct them",
        )
    (a, b, k), spec = wanted, records[0].spec
    whole = LagTriangle.of(records, a[-1], k[0], k[-1] + max(b[-1], 1) - 1)
    judge = LagTriangle.of(held_out, whole.na, whole.low, whole.high) if held_out else None
    shape = (len(a), len(b), len(k), spec.ny)
    losses, held = np.full(shape, np.nan), np.full(shape, np.nan)
    parameters = np.array([[[1 + i * spec.ny + j * spec.nu for _ in k] for j in b] for i in a])
    for place, order in enumerate(a):
        for late, delay in enumerate(k):
            columns = whole.columns(order, [(delay, delay + b[-1] - 1)] * spec.nu)
            small = whole.reduced(columns)
            for number, count in enumerate(b):
                p = 1 + order * spec.ny + count * spec.nu
                if p >= whole.rows:
                    continue
                losses[place, number, late] = np.sum(small[p:, -spec.ny :] ** 2, axis=0)
                if judge is not None and judge.rows:
                    held[place, number, late] = _judged(judge, small, columns[:p])
    if not np.isfinite(losses).any():
        raise FitError(
            "orders of ARX models",
            expected=f"more than {int(parameters.min())} rows after {max(whole.na, whole.high)} samples",
            got=str(whole.rows),
            remedy="record longer, or lower the orders",
        )
    return ArxGrid(
        a, b, k, losses, held, whole.rows, 0 if judge is None else judge.rows, _size(judge or whole), parameters
    )


def input_delays(
    records: Sequence[Trajectory], output: int = 0, *, least: int | None = None, most: int = MOST
) -> list[Delay]:
    """Return the delay from every input to an output, with its probability.

    In a long ARX model, which takes noise of any colour, an input acts by its lags from its delay to some last one, and
    ``-N/2 log loss - k/2 log N`` with its number of lags k is the logarithm of such a pair's probability but for a
    constant (Schwarz 1978); N counts what the lags of outputs and other inputs leave. The losses of all first lags are
    read from one small triangle for each last one.

    Parameters
    ----------
    records : sequence of Trajectory
    output : int
        Column of the output.
    least : int, optional
        By default 0 where the spec declares feedthrough, else 1.
    most : int
        Less where the records are short.

    Raises
    ------
    FitError
        If the records are too short to tell.

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec
    >>> rng = np.random.default_rng(0)
    >>> u = rng.normal(size=(600, 2))
    >>> y = np.zeros(600)
    >>> for k in range(5, 600):
    ...     y[k] = 0.8 * y[k - 1] + u[k - 2, 0] + 0.5 * u[k - 5, 1] + 0.3 * rng.normal()
    >>> spec = PlantSpec((Channel("u"), Channel("v")), (Channel("y"),), 1.0)
    >>> [found.samples for found in input_delays([Trajectory(np.arange(600.0), u, y[:, None], spec)])]
    [2, 5]
    """
    spec = records[0].spec
    first = int(not spec.feedthrough) if least is None else least
    lone = replace(spec, outputs=(spec.outputs[output],), states=())
    column = slice(output, output + 1)
    alone = [
        Trajectory(r.t, r.u, r.y[:, column], lone, missing=None if r.missing is None else r.missing[:, column])
        for r in records
    ]
    total, longest = sum(map(len, records)), max(map(len, records))
    memory = MEMORY
    room = (total // EQUATIONS - 1 - memory) // max(spec.nu, 1) - memory
    last = min(most, room, longest // 3 - memory)
    if last < first:
        raise FitError(
            "delays of the inputs",
            expected=f"at least {EQUATIONS * (1 + memory + spec.nu * (memory + first + 1))} samples",
            got=str(total),
            remedy="record longer, or give nk",
        )
    whole = LagTriangle.of(alone, memory, first, last + memory)
    found = []
    for i in range(spec.nu):
        delays = np.arange(first, last + 1)
        chance = _chances(whole, i, delays)
        ranked = np.argsort(-chance, kind="stable")
        kept = delays[ranked[: int(np.searchsorted(np.cumsum(chance[ranked]), LEVEL)) + 1]]
        best = int(ranked[0])
        found.append(Delay(int(delays[best]), int(kept.min()), int(kept.max()), float(chance[best])))
    return found


def _chances(whole: LagTriangle, i: int, delays: npt.NDArray[np.int_]) -> FloatArray:
    """Return the probabilities of the delays of an input (K,), summed over the last lag by which it acts."""
    others = [(whole.low, whole.high)] * whole.nu
    others[i] = (1, 0)
    known = whole.columns(whole.na, others)
    own = whole.columns(0, [(whole.low, whole.high) if j == i else (1, 0) for j in range(whole.nu)])[1:]
    # rows beyond those that the others take: all that follows is small
    rest = whole.reduced([*known, *own])[len(known) :, len(known) :]
    count, told = max(whole.rows - len(known), 2), np.full((len(own), len(delays)), -np.inf)
    for end in range(len(own)):
        small = np.asarray(np.linalg.qr(rest[:, [*range(end, -1, -1), len(own)]], mode="r"))[:, -1] ** 2
        losses = np.cumsum(small[::-1])[::-1]  # beyond so many lags
        k = np.arange(1, end + 2)
        begin = end + 1 - k
        fine = begin < len(delays)
        left = np.append(losses, 0.0)[k]
        told[end, begin[fine]] = (-count / 2 * np.log(np.maximum(left, 1e-300)) - k / 2 * np.log(count))[fine]
    chance = np.exp(told - told.max()).sum(axis=0)
    return np.asarray(chance / chance.sum(), dtype=np.float64)


def _rows(record: Trajectory, index: Any, na: int, low: int, high: int) -> FloatArray:
    """Return the rows (n, p + ny) of some samples of a record, without those of a missing reading."""
    columns = [np.ones((len(index), 1)), *(record.y[index - j] for j in range(1, na + 1))]
    columns += [record.u[index - j] for j in range(low, high + 1)]
    found = np.hstack([*columns, record.y[index]])
    if record.missing is None:
        return found
    gone = np.any([record.missing[index - j].any(axis=1) for j in range(na + 1)], axis=0)
    return np.asarray(found[~gone], dtype=np.float64)


def _judged(judge: LagTriangle, small: FloatArray, columns: Sequence[int]) -> FloatArray:
    """Return the sums of squares (ny,) on other rows of the model that a reduced triangle's first columns say."""
    p, ny = len(columns), judge.ny
    theta = np.linalg.lstsq(small[:p, :p], small[:p, -ny:], rcond=1e-12)[0]
    return np.asarray(np.sum((judge.triangle[:, judge.targets] - judge.triangle[:, columns] @ theta) ** 2, axis=0))


def _size(triangle: LagTriangle) -> FloatArray:
    """Return the mean squares of the outputs about their mean (ny,)."""
    small = triangle.reduced([0])
    size = np.sum(small[1:, -triangle.ny :] ** 2, axis=0) / max(triangle.rows, 1)
    return np.where(size > 0, size, 1.0)
