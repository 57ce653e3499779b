"""Which order a model needs: held-out errors of each order, and the Hankel singular values of the data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from harness import registry
from harness.display import table
from harness.errors import FitError, InputError
from harness.models.arx_orders import ArxGrid, arx_order_grid
from harness.options import as_options
from harness.protocols import Identifier
from harness.rng import stream
from harness.scoring import predict
from harness.signals import Dataset, FloatArray, Trajectory, residual

IDENTIFIERS = ("arx", "n4sid", "ho-kalman")
"""One of each way to a linear model: lagged signals, a subspace of the data, the impulse response."""
ORDERS = range(1, 13)  # Orders that are tried where none are asked for.
BLOCKS = 20
"""Stretches of the judged records whose losses are taken as independent, for the standard error of a difference."""
WORTH = 0.05
"""Share of the NRMSE by which a larger order must be better to be worth its states; less is seldom seen in use."""
LARGEST = 1e12  # Squared error relative to the outputs' variance beyond which a free run counts as diverged.
ROUNDING = 1e-6  # NRMSE below which two orders are equal: what is left of exact data is rounding.


@dataclass(frozen=True, eq=False)
class OrderError:
    """What one identifier reaches with one order on data that it did not see."""

    identifier: str
    order: int
    # NRMSE over all outputs and judged records; inf where the free run diverged
    one_step: float
    free_run: float
    blocks: Mapping[str, FloatArray]
    """``one_step`` and ``free_run``: mean squared error of each stretch, relative to the outputs' variance."""
    refused: str = ""  # Why there is no model of this order; empty where there is one


@dataclass(frozen=True, eq=False)
class OrderSelection:
    """What :func:`order_selection` returns.

    Parameters
    ----------
    name : str
        Of the data set.
    judged : str
        What the orders were judged on.
    tried : tuple of OrderError
    singular_values : dict
        By identifier: Hankel singular values of the estimated impulse response (``ho-kalman``), or canonical
        correlations of past and future (``n4sid``), largest first.
    """

    name: str
    judged: str
    tried: tuple[OrderError, ...]
    singular_values: Mapping[str, FloatArray]

    def suggested(self, error: str = "one_step") -> dict[str, int]:
        """Return by identifier the smallest order that is as good as the best on the judged data.

        As good means: the mean difference of their losses over the stretches is within one standard error (Hastie,
        Tibshirani & Friedman 2009, sec. 7.10, with the error of the paired difference), or the NRMSE within 5 %.

        Parameters
        ----------
        error : {"one_step", "free_run"}
        """
        found: dict[str, int] = {}
        for name in dict.fromkeys(trial.identifier for trial in self.tried):
            rows = [trial for trial in self.tried if trial.identifier == name and np.isfinite(getattr(trial, error))]
            if not rows:
                continue
            best = min(rows, key=lambda trial: getattr(trial, error))
            for trial in rows:
                more = trial.blocks[error] - best.blocks[error]
                spread = float(more.std(ddof=1) / np.sqrt(more.size))
                close = getattr(trial, error) <= max((1 + WORTH) * getattr(best, error), ROUNDING)
                if close or float(more.mean()) <= spread:
                    found[name] = trial.order
                    break
        return found

    def rows(self) -> list[dict[str, Any]]:
        """Return one row for each identifier and order, with what is suggested."""
        by_step, by_run = self.suggested("one_step"), self.suggested("free_run")
        return [
            {
                "identifier": trial.identifier,
                "order": trial.order,
                "nrmse_one_step": trial.one_step if np.isfinite(trial.one_step) else None,
                "nrmse_free_run": trial.free_run if np.isfinite(trial.free_run) else None,
                "note": trial.refused
                or ", ".join(
                    f"enough {how}"
                    for how, chosen in (("one step ahead", by_step), ("in free run", by_run))
                    if chosen.get(trial.identifier) == trial.order
                )
                or ("" if np.isfinite(trial.free_run) else "the free run diverges"),
            }
            for trial in self.tried
        ]

    def printed(self) -> list[dict[str, Any]]:
        """Return the rows as people read them: orders in a row that are refused for one reason stand in one."""
        found: list[dict[str, Any]] = []
        refused = [trial.refused for trial in self.tried]
        for row, reason, before in zip(self.rows(), refused, ["", *refused], strict=False):
            if reason and reason == before and row["identifier"] == found[-1]["identifier"]:
                found[-1]["order"] = f"{str(found[-1]['order']).split(' ')[0]} to {row['order']}"
            else:
                found.append(row)
        return found

    def __repr__(self) -> str:
        told = ", ".join(f"{name} {order}" for name, order in self.suggested().items())
        return f"<OrderSelection of {self.name}: enough one step ahead: {told or 'none'}>"

    def _repr_html_(self) -> str:
        titles = ["identifier", "order", "NRMSE one step ahead", "NRMSE in free run", "note"]
        return table(
            titles,
            [
                tuple("" if v is None else f"{v:.4g}" if isinstance(v, float) else v for v in row.values())
                for row in self.printed()
            ],
        )

    def plot(self) -> Any:
        """Draw both errors against the order, with the suggested orders marked, and the singular values.

        Returns
        -------
        matplotlib.figure.Figure
        """
        from matplotlib.ticker import MaxNLocator

        from harness.plots import sheet

        figure = sheet(figsize=(8, 8), layout="constrained")
        axes = figure.subplots(3, 1)
        for axis, error, label in zip(axes, ("one_step", "free_run"), ("one step ahead", "in free run"), strict=False):
            chosen = self.suggested(error)
            for number, name in enumerate(dict.fromkeys(trial.identifier for trial in self.tried)):
                rows = [
                    trial for trial in self.tried if trial.identifier == name and np.isfinite(getattr(trial, error))
                ]
                orders = [trial.order for trial in rows]
                axis.semilogy(orders, [getattr(trial, error) for trial in rows], ".-", color=f"C{number}", label=name)
                for trial in rows:
                    if trial.order == chosen.get(name):
                        axis.semilogy(trial.order, getattr(trial, error), "o", ms=11, mfc="none", color=f"C{number}")
            axis.set_ylabel(f"NRMSE {label}")
            axis.set_title(f"{label}, on {self.judged} (ringed: the smallest order as good as the best)", fontsize=9)
        for name, values in self.singular_values.items():
            number = list(dict.fromkeys(trial.identifier for trial in self.tried)).index(name)
            axes[2].semilogy(
                np.arange(1, values.size + 1), values / values[0], "s--", ms=4, color=f"C{number}", label=name
            )
        axes[2].set_ylabel("relative to the largest")
        axes[2].set_title("singular values (ho-kalman: Hankel; n4sid: past and future)", fontsize=9)
        for axis in axes:
            axis.set_xlabel("order")
            axis.xaxis.set_major_locator(MaxNLocator(integer=True))
            axis.grid(alpha=0.3)
            if axis.get_legend_handles_labels()[0]:
                axis.legend(fontsize=8)
        return figure


def order_selection(
    dataset: Dataset,
    *,
    identifiers: Sequence[str] = IDENTIFIERS,
    orders: Sequence[int] = ORDERS,
    options: Mapping[str, Any] | None = None,
    seed: int = 0,
) -> OrderSelection:
    """Fit models of every order and judge them on data that they did not see (Ljung 1999, sec. 16.4).

    Parameters
    ----------
    dataset : Dataset
        Judged are its validation records; without any, the last third of every estimation record, and the models
        are fitted to the rest.
    identifiers : sequence of str
        Ids of registered identifiers with the option ``order``.
    orders : sequence of int
    options : mapping, optional
        Further options of the identifiers.
    seed : int
        For identifiers that draw random numbers.

    Raises
    ------
    InputError
        If an identifier has no order, an order is below 1, or no identifier finds a model of any order.

    Examples
    --------
    >>> from scipy.signal import lfilter
    >>> from harness.signals import Channel, PlantSpec, Run
    >>> rng = np.random.default_rng(0)
    >>> u = rng.normal(size=3000)
    >>> y = lfilter([0.0, 0.4, 0.1], [1.0, -1.3, 0.6], u) + lfilter([0.05], [1.0, -1.3, 0.6], rng.normal(size=3000))
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> record = Trajectory(np.arange(3000.0), u[:, None], y[:, None], spec)
    >>> data = Dataset("second order", (Run(record[:2000]), Run(record[2000:], "validation")))
    >>> order_selection(data, identifiers=["arx"], orders=[1, 2, 3]).suggested()
    {'arx': 2}
    """
    wanted = sorted(set(orders))
    if not wanted or wanted[0] < 1:
        raise InputError("orders", expected="whole numbers from 1 on", got=f"{list(orders)}", remedy="correct them")
    for name in identifiers:
        if "order" not in registry.named_options("identifiers", name):
            raise InputError(
                f"identifier {name!r} has no order",
                expected=f"an identifier with the option order, such as {', '.join(IDENTIFIERS)}",
                got=f"options {', '.join(registry.named_options('identifiers', name)) or 'none'}",
                remedy="name another (--identifier)",
            )
    records, judged, text = _fitted_and_judged(dataset)
    tried: list[OrderError] = []
    singular: dict[str, FloatArray] = {}
    for name in identifiers:
        fits = _fits(name, wanted, as_options(options), records, seed)
        skip = max((fit.burn_in for fit in fits.values() if not isinstance(fit, str)), default=0) + 1
        for order, model in fits.items():
            if isinstance(model, str):
                tried.append(OrderError(name, order, np.inf, np.inf, {}, model))
                continue
            blocks = {"one_step": _blocks(model, judged, 1, skip), "free_run": _blocks(model, judged, None, skip)}
            step, run = (float(np.sqrt(blocks[error].mean())) for error in ("one_step", "free_run"))
            tried.append(OrderError(name, order, step, run, blocks))
            notes = getattr(model, "notes", {})
            values = notes.get("hankel_singular_values") or notes.get("singular_values")
            if values and len(values) > len(singular.get(name, ())):
                singular[name] = np.asarray(values, dtype=float)
    if all(trial.refused for trial in tried):
        raise FitError(
            "no model of any order",
            expected="records that one identifier can fit",
            got="; ".join(f"{trial.identifier} {trial.order}: {trial.refused}" for trial in tried[:1]),
            remedy="record longer, excite more richly, or name other identifiers",
        )
    return OrderSelection(dataset.name, text, tuple(tried), singular)


def arx_orders(dataset: Dataset, na: Sequence[int], nb: Sequence[int], nk: Sequence[int] = (1,)) -> ArxGrid:
    """Return the losses of ARX models of all orders of a grid, on the records fitted and on those held out.

    One QR factorisation of either serves the whole grid (:func:`harness.models.arx_orders.arx_order_grid`).

    Parameters
    ----------
    dataset : Dataset
        Held out are its validation records; without any, the last third of every estimation record.
    na, nb, nk : sequence of int
        Past outputs, coefficients of each input, delays.

    Raises
    ------
    InputError
        If an order is negative or the grid empty.
    FitError
        If the records are too short.
    """
    records, judged, _ = _fitted_and_judged(dataset)
    return arx_order_grid(records, na, nb, nk, held_out=judged)


def _fitted_and_judged(dataset: Dataset) -> tuple[list[Trajectory], list[Trajectory], str]:
    """Return the records that models are fitted to, those that they are judged on, and what these are called."""
    records = [record.measured() for record in dataset.estimation]
    if judged := [record.measured() for record in dataset.validation]:
        return records, judged, "validation records"
    judged = [record[2 * len(record) // 3 :] for record in records]
    return [record[: 2 * len(record) // 3] for record in records], judged, "the last third of the estimation records"


def _fits(
    name: str, orders: Sequence[int], options: dict[str, Any], records: Sequence[Trajectory], seed: int
) -> dict[int, Any]:
    """Return by order the model, or why there is none."""
    found: dict[int, Any] = {}
    for order in orders:
        made = cast(Identifier, registry.create("identifiers", name, **{**options, "order": order}))
        try:
            found[order] = made.fit(records, rng=stream("order", name, seed))
        except FitError as error:
            found[order] = " ".join(str(error).split())
    return found


def _blocks(model: Any, judged: Sequence[Trajectory], horizon: int | None, skip: int) -> FloatArray:
    """Return the mean squared error of each stretch of the judged records, relative to the outputs' variance."""
    outputs = model.spec.outputs
    size = np.sqrt(np.mean(np.concatenate([record.y - record.y.mean(axis=0) for record in judged]) ** 2, axis=0))
    misses = []
    for record in judged:
        with np.errstate(invalid="ignore"):  # a run that grew to infinity is an error without bound
            miss = residual(outputs, record.y, np.asarray(predict(model, record, horizon)))[skip:]
        with np.errstate(over="ignore", invalid="ignore"):  # a free run that diverges
            misses.append(np.mean((miss / np.where(size > 0, size, 1.0)) ** 2, axis=1))
    every = np.concatenate(misses)
    if every.size < BLOCKS:
        raise InputError(
            "records too short to judge an order",
            expected=f"at least {BLOCKS} samples after the {skip} that the models start from",
            got=str(every.size),
            remedy="record longer, or ask for lower orders",
        )
    every = np.where(np.isfinite(every) & (every < LARGEST), every, np.inf)
    return np.array([part.mean() for part in np.array_split(every, BLOCKS)])
