"""Bounds for a finite sample beside the intervals of a fit: what theorems promise, and what the record shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from harness.errors import InputError
from harness.judgement import feedback_of
from harness.models.analysis import Findings, Takes, as_dataset
from harness.models.spread import steps
from harness.models.whiteness import white
from harness.signals import FloatArray, Trajectory
from identifiers.common.excitation import Columns
from identifiers.common.named import named
from identifiers.common.neighbours import GROUPS
from identifiers.common.records import lagged, usable, without_holes
from identifiers.linear.bounds.regressions import ellipsoids, small_ball
from identifiers.linear.bounds.responses import (
    Responses,
    norm_of_spread,
    realisation_bound,
    realisation_spread,
    responses,
)
from identifiers.linear.markov import sums_without

_SHOWN = 12  # Coefficients that are listed.
_LAGS, _LONGEST = 10, 100  # Lags of the predictor where the fit tells none, and of a response at most.
_DIED = 0.01  # A response counts as died away where it stays below this share of its largest value.
_STATES = ("least-squares", "dmdc")  # Identifiers whose outputs are the states.


@dataclass(frozen=True)
class FiniteSample:
    """What theorems for finite samples promise of a linear fit, beside what the record shows.

    Three kinds of bounds, each on something that a fit determines, with the numbers of the record: ellipsoids of
    self-normalised martingales on the coefficients of one-step equations (also under feedback), those of small balls on
    [A B] of measured states (before any data), and bounds on responses and on the realisation made from them (open
    loop). Beside each stands what was measured: the interval of the same least squares, and that of the fit.

    A bound holds for every plant of its kind, and so is loose for this one: ``ratio`` says by how much. It is for
    proofs and for plans; what is believed of this model is its interval. The theorems, by the name in the table:

    - ``self-normalised``: Abbasi-Yadkori, Pal & Szepesvari 2011, theorem 1, the step of Sarkar & Rakhlin 2019 and
      Tsiamis & Pappas 2019; for coefficients of one-step equations.
    - ``small balls``: Simchowitz, Mania, Tu, Jordan & Recht 2018, theorem 2.4.
    - ``these inputs``: the rate of Oymak & Ozay 2019, theorem 3.1, with constants by Davidson & Szarek 2001, given the
      inputs of the record (as in ``response-control``).
    - ``Ho-Kalman``: Oymak & Ozay 2019, theorem 4.3.

    Parameters
    ----------
    identifier : str
    options : mapping
        Of the identifier.
    lags : int, optional
        Of the one-step equations; by default those of the fit.
    length : int, optional
        Samples of the response; by default until that of the fit has died away.
    confidence : float

    Examples
    --------
    >>> from harness.signals import Channel, Dataset, PlantSpec, Run
    >>> rng, y = np.random.default_rng(0), np.zeros((2000, 1))
    >>> u = rng.normal(size=(2000, 1))
    >>> for k in range(1999):
    ...     y[k + 1] = 0.5 * y[k] + u[k] + 0.1 * rng.normal()
    >>> record = Trajectory(np.arange(2000.0), u, y, PlantSpec((Channel("u"),), (Channel("y"),), 1.0))
    >>> found = FiniteSample("arx", {"order": 1}).of(Dataset("one", (Run(record),)), rng=rng)
    >>> row = found.rows[0]
    >>> row["of"], row["bound"] > row["measured"]
    ('y on y', True)
    """

    takes: ClassVar[Takes] = "data"
    identifier: str = "n4sid"
    options: Mapping[str, Any] = field(default_factory=dict)
    lags: int | None = None
    length: int | None = None
    confidence: float = 0.95

    def of(self, subject: Any, *, rng: np.random.Generator) -> Findings:
        """Return bounds and what was measured, row by row."""
        fine = 0 < self.confidence < 1 and (self.lags or 1) >= 1 and (self.length or 4) >= 4
        if not fine:
            raise InputError(
                "options of finite-sample", expected="confidence between 0 and 1, lags >= 1, length >= 4",
                got=f"{self.confidence}, {self.lags}, {self.length}", remedy="correct them",
            )  # fmt: skip
        made = named("identifiers", self.identifier, self.options)
        records = [record.measured() for record in as_dataset(subject, "finite-sample").estimation]
        return self.beside(made.fit(records, rng=rng), records, rng=rng)

    def beside(self, model: Any, records: Sequence[Trajectory], *, rng: np.random.Generator) -> Findings:
        """Return bounds beside a model that was fitted to the records already.

        Raises
        ------
        InputError
            If the model is not linear.
        """
        if not hasattr(model, "matrices"):
            raise InputError(
                "bounds for finite samples", expected="a linear model", got=type(model).__name__,
                remedy="use arx, least-squares, n4sid, ho-kalman or another linear identifier",
            )  # fmt: skip
        records = without_holes(list(records), samples=4, what="finite-sample")
        rows, words = self._of_equations(model, records)
        closed = feedback_of(records).found if records[0].spec.nu else False
        if closed:
            words.append("past outputs predict the inputs: bounds hold for open loops only, and none is given")
        elif records[0].spec.nu:
            more, said = self._of_responses(model, records, rng)
            rows += more
            words += said
        for row in rows:
            row["ratio"] = _ratio(row["bound"], row["measured"])
        finite = [row["ratio"] for row in rows if isinstance(row["ratio"], float)]
        silent = sum(not np.isfinite(row["bound"]) for row in rows)
        if not any(row["speaks from"] for row in rows):
            rows = [{name: cell for name, cell in row.items() if name != "speaks from"} for row in rows]
        words.insert(0, _looseness(finite, silent, self.confidence))
        details = {"confidence": self.confidence, "samples": sum(map(len, records))}
        return Findings("bounds for finite samples", rows, words, details)

    def _of_equations(self, model: Any, records: Sequence[Trajectory]) -> tuple[list[dict[str, Any]], list[str]]:
        """Return the bounds on coefficients of one-step equations."""
        spec, notes = records[0].spec, model.notes
        states = self.identifier in _STATES
        exact = states or self.identifier == "arx"
        told = 1 if states else notes.get("order" if self.identifier == "arx" else "past", _LAGS)
        lags = self.lags or int(told)
        long = [record for record in records if len(record) > lags + 1]
        if not long:
            return [], [f"no record is longer than {lags} lags"]
        phi = np.concatenate([np.hstack([lagged(one, lags), np.ones((len(one) - lags, 1))]) for one in long])
        y = np.concatenate([one.y[lags:] for one in long])
        found = ellipsoids(phi, y, self.confidence)
        words, rows = [], []
        rest = y - phi @ np.linalg.lstsq(phi, y, rcond=None)[0]
        coloured = [c.name for c, one in zip(spec.outputs, rest.T, strict=True) if not white([one], spec.ny)]
        if coloured:
            words.append(
                f"the residuals of {', '.join(coloured)} are correlated in time: neither bound nor interval of the "
                "equations holds, as noise on measured outputs biases them"
            )
        if found is None:
            words.append(f"{len(phi)} rows do not bear an ellipsoid for {phi.shape[1]} coefficients")
        else:
            names = [*Columns(spec, lags).names[: phi.shape[1] - 1], "1"]
            places = [(j, i) for i in range(spec.ny) for j in range(phi.shape[1] - 1)]
            shown = places[:_SHOWN] if exact else [max(places, key=lambda place: float(found.half[place]))]
            title = "" if exact else f"{lags} lags, largest: "
            for j, i in shown:
                rows.append(
                    _row(f"{title}{spec.outputs[i].name} on {names[j]}", "self-normalised", found.half[j, i],
                         found.measured[j, i])
                )  # fmt: skip
            if exact and len(places) > len(shown):
                words.append(f"{len(places) - len(shown)} more coefficients are not listed")
            if not exact:
                words.append(
                    "the predictor's coefficients are what n4sid and its kin start from (Tsiamis & Pappas 2019); what "
                    f"{lags} lags leave out is not in the bound: {_left_out(model, lags):.2g} of the predicted output"
                )
        if states and spec.nu:
            rows.append(self._of_states(model, phi, y, spec.ny))
        return rows, words

    def _of_states(self, model: Any, phi: FloatArray, y: FloatArray, ny: int) -> dict[str, Any]:
        """Return the bound on [A B] that is known before the data."""
        a, b = model.a_matrix[:ny, :ny], model.b_matrix[:ny]
        x, u = phi[:, :ny], phi[:, ny:-1]
        rest = y - phi @ np.linalg.lstsq(phi, y, rcond=None)[0]
        noise = np.cov(rest.T).reshape(ny, ny)
        found = small_ball(a, b, np.cov(u.T).reshape(u.shape[1], -1), noise, len(phi), self.confidence)
        size = np.concatenate([x, u], axis=1).std(axis=0)
        gram = np.cov(np.concatenate([x, u], axis=1).T / size[:, None])
        each = np.linalg.cholesky(np.linalg.inv(gram) / len(phi)).T
        out = np.linalg.cholesky(noise / np.outer(size[:ny], size[:ny]) + 1e-300 * np.eye(ny))
        draws = np.random.default_rng(0).standard_normal((1000, ny, len(size)))
        measured = np.quantile(np.linalg.norm(out @ draws @ each, ord=2, axis=(1, 2)), self.confidence)
        name = "[A B], signals at unit deviation"
        if found.needed > len(phi):
            row = _row(name, "small balls", float("inf"), float(measured))
            row["speaks from"] = f"{found.needed:.2g} samples"
            return row
        return _row(name, "small balls", found.bound, float(measured))

    def _of_responses(
        self, model: Any, records: Sequence[Trajectory], rng: np.random.Generator
    ) -> tuple[list[dict[str, Any]], list[str]]:
        """Return the bounds on responses and realisations."""
        spec = records[0].spec
        length = self.length or _length(model)
        if length is None:
            return [], [f"the response does not die away within {_LONGEST} samples: no bound on it"]
        long, _ = usable(records, samples=length + 2, what="finite-sample")
        found = responses(long, length, self.confidence, rng)
        if found is None:
            return [], [f"the inputs do not excite {length} lags: no bound on the response"]
        gain = "gain error, any frequency"
        rows = [
            _row(gain, "these inputs", found.gain, found.measured_gain),
            _row(f"norm of {length} Markov parameters", "these inputs", found.block, found.measured_block),
        ]
        if model.spread is not None:
            own = norm_of_spread(model.matrices, model.spread, self.confidence, rng)
            rows.insert(1, _row("same, of the fit", "these inputs", found.gain, own))
        words = [f"responses are those of least squares with {length} lags"]
        order = len(model.a_matrix)
        if self.identifier not in ("impulse-response", "arx") and 2 * order < length * min(spec.nu, spec.ny):
            rows.append(self._realised(found, long, order, length, rng))
        return rows, words

    def _realised(
        self, found: Responses, records: Sequence[Trajectory], order: int, length: int, rng: np.random.Generator
    ) -> dict[str, Any]:
        """Return the bound on A of a realisation."""
        bound, share = realisation_bound(found.markov, order, found.block)
        near = []
        for part in sums_without(records, length, offset=True):
            theta = np.linalg.lstsq(part.gram, part.right, rcond=None)[0][:-1]
            near.append(np.asarray(theta.reshape(length, -1, found.markov.shape[1]).transpose(0, 2, 1), dtype=float))
        measured = float("nan")
        if near:
            factor = (GROUPS - 1) / GROUPS
            measured = realisation_spread(found.markov, near, order, factor, self.confidence, rng)
        row = _row(f"A of order {order}, but for rotation", "Ho-Kalman", bound, measured)
        if not np.isfinite(bound):
            row["speaks from"] = f"{share**2 * found.rows:.2g} samples"
        return row


def _row(what: str, theorem: str, bound: float, measured: float) -> dict[str, Any]:
    return {
        "of": what,
        "theorem": theorem,
        "bound": float(f"{bound:.3g}"),
        "measured": float(f"{measured:.3g}"),
        "ratio": "",
        "speaks from": "",
    }


def _ratio(bound: float, measured: float) -> float | str:
    """Return how loose a bound is; nothing where one of both is unknown."""
    return float(f"{bound / measured:.3g}") if np.isfinite(bound) and measured > 0 else ""


def _looseness(ratios: Sequence[float], silent: int, confidence: float) -> str:
    """Return how loose the bounds are on this record, in words."""
    if not ratios:
        return "no theorem says anything of so short a record; what was measured does"
    text = (
        f"on this record bounds of {confidence:.0%} are {min(ratios):.3g} to {max(ratios):.3g} times what was "
        f"measured, so they would ask for {min(ratios) ** 2:.3g} to {max(ratios) ** 2:.3g} times the samples: believe "
        "the interval, and use a bound where something must hold for every plant"
    )
    return text + (f"; {silent} say nothing yet" if silent else "")


def _length(model: Any) -> int | None:
    """Return the samples until the response of a model has died away; None beyond a hundred."""
    found = np.abs(steps(model.matrices, 4 * _LONGEST, "impulse")).reshape(4 * _LONGEST, -1)
    if not np.isfinite(found).all():
        return None
    alive = np.flatnonzero((found > _DIED * found.max(axis=0)).any(axis=1))
    length = max(int(alive[-1]) + 2 if alive.size else 4, 4)
    return length if length <= _LONGEST else None


def _left_out(model: Any, lags: int) -> float:
    """Return the size of what a predictor forgets after so many lags, relative to its state's part of the output."""
    a, c = model.a_matrix, model.c_matrix
    closed = a - a @ model.filter_gain @ c
    whole = float(np.linalg.norm(c))
    return float(np.linalg.norm(c @ np.linalg.matrix_power(closed, lags))) / whole if whole > 0 else 0.0
