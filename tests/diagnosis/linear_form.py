"""A form whose answers are known in closed form: linear in everything, white noise of a known size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.diagnosis.search.fit import Begun, Column, Fit, Jump, Linearised, Suspect
from harness.diagnosis.search.outcome import Outcome
from harness.diagnosis.search.search import search
from harness.diagnosis.search.table import Accepted, Answer, FitTable, Round
from harness.diagnosis.systems import Starts
from harness.effects import Dictionary, builtin
from harness.effects.effect import Placed
from harness.signals import FloatArray

USES = ("estimation", "validation")
NAMES = ("linear_spring", "quadratic_spring", "cubic_spring", "quadratic_drag", "force_bias", "viscous_friction")
"""Effects with one parameter, which scales a regressor."""


def placed(name: str) -> Placed:
    """Return an effect of the dictionary at ``theta``."""
    return Placed(builtin()[name], "theta")


def main(name: str) -> str:
    """Return the full name of the only parameter of an effect."""
    found = placed(name).main()
    assert found is not None
    return found


@dataclass
class Records:
    """Regressors (n, k) by name and outputs (n,) by use."""

    x: dict[str, dict[str, FloatArray]]
    y: dict[str, FloatArray]


def linear_records(
    seed: int,
    hidden: Mapping[str, float],
    *,
    n: int = 1000,
    alike: Mapping[str, str] | None = None,
    absorbed: Mapping[str, float] | None = None,
) -> Records:
    """Return records of ``a x1 + b x2 + hidden + noise`` with white regressors.

    ``alike`` names effects whose regressor is nearly another's; ``absorbed`` those that a nominal one takes up but for
    a share.
    """
    x: dict[str, dict[str, FloatArray]] = {}
    y: dict[str, FloatArray] = {}
    for number, use in enumerate(USES):
        rng = np.random.default_rng([seed, number])
        own = {name: rng.standard_normal(n) for name in ("a", "b", *NAMES)}
        for name, other in (alike or {}).items():
            own[name] = own[other] + 0.02 * own[name]
        for name, share in (absorbed or {}).items():
            own[name] = own["a"] + share * own[name]
        x[use] = own
        y[use] = 2.0 * own["a"] - own["b"] + rng.standard_normal(n)
        y[use] = y[use] + sum((size * own[name] for name, size in hidden.items()), np.zeros(n))
    return Records(x, y)


def mixed(records: Records, name: str, **shares: float) -> None:
    """Make the regressor of an effect a sum of shares of others."""
    for own in records.x.values():
        own[name] = sum((share * own[other] for other, share in shares.items()), np.zeros(len(own[name])))


class LinearForm:
    """Least squares, the noise known to be 1: see :class:`harness.diagnosis.search.fit.Form`."""

    nominal: Any = None
    laws = Dictionary.builtin()

    def __init__(self, records: Records) -> None:
        self.records = records
        self.fits = 0

    def _matrix(self, effects: Sequence[Placed], use: str) -> FloatArray:
        own = self.records.x[use]
        return np.column_stack([own["a"], own["b"], *(own[one.effect.name] for one in effects)])

    def fit(
        self,
        effects: Sequence[Placed],
        starts: Starts,
        base: Fit | None,
        rival: Fit | None = None,
    ) -> Fit:
        self.fits += 1
        names = ("a", "b", *(one.main() or "" for one in effects))
        x = self._matrix(effects, "estimation")
        values = np.linalg.lstsq(x, self.records.y["estimation"], rcond=None)[0]
        spread = np.sqrt(np.diag(np.linalg.inv(x.T @ x)))
        terms = {}
        for use in USES:
            error = self.records.y[use] - self._matrix(effects, use) @ values
            terms[use] = [-0.5 * np.log(2 * np.pi) - 0.5 * error**2]
        return Fit(
            effects=tuple(effects),
            system=None,
            values=dict(zip(names, map(float, values), strict=True)),
            free=names,
            count=len(names),
            terms=terms,
            deviations=dict(zip(names, map(float, spread), strict=True)),
            logarithmic=frozenset(),
            converged=True,
            on_bound=(),
        )

    def without_memory(self, fit: Fit) -> Fit | None:
        """Return nothing: there is no latent force."""
        return None

    def begin(self, effects: Sequence[Placed], starts: Starts, base: Fit | None, hope: float = -np.inf) -> Begun:
        made = self.fit(effects, starts, base)
        return Begun(tuple(effects), made.log_likelihood("estimation"), made.values, made)

    def finish(self, begun: Begun, base: Fit | None, rival: Fit | None = None, least: float = -np.inf) -> Fit:
        made: Fit = begun.detail
        return made

    def linearised(self, fit: Fit) -> Linearised:
        values = np.array([fit.values[name] for name in fit.free])
        matrices = {use: self._matrix(fit.effects, use) for use in USES}
        residual = {use: self.records.y[use] - matrices[use] @ values for use in USES}
        return Linearised(residual, {use: -matrices[use] for use in USES}, tuple(fit.free))

    def columns(self, fit: Fit, candidates: Sequence[Placed]) -> list[Column]:
        found = []
        for one in candidates:
            x = {use: -self.records.x[use][one.effect.name][:, None] for use in USES}
            name = one.effect.main
            assert name is not None
            found.append(Column(one, {}, (name.name,), x["estimation"], x["validation"]))
        return found

    def suspects(self, base: Fit, rival: Begun | None, candidates: Sequence[Placed]) -> list[Suspect]:
        return []

    def left_out(self) -> list[str]:
        return []

    def limited(self) -> bool:
        return False

    def change(self, fit: Fit, placed: Placed) -> float:
        return float("inf")

    def distance(self, fit: Fit, other: Fit) -> float:
        return float("inf")

    def jumps(self, fit: Fit) -> list[Jump]:
        return []

    def damping(self, fit: Fit, at: str) -> None:
        return None

    def test_functions(self, fit: Fit) -> list[Column]:
        own = self.records.x
        return [
            Column(None, {}, (f"theta over {name}", name), -own["estimation"][name][:, None],
                   -own["validation"][name][:, None])
            for name in NAMES
        ]  # fmt: skip


ALL = [placed(name) for name in NAMES]


def answer_of(model: Fit, *chosen: Placed) -> Answer:
    """Return an answer with some effects, each told from everything else."""
    return Answer(model, tuple(Accepted(one, ((one,),), 1, 1) for one in chosen))


def table_of(form: LinearForm, nominal: Fit, *rounds: Round) -> FitTable:
    """Return a table in which some rounds were made."""
    return FitTable(form, nominal, ALL, rounds=list(rounds))


def found_in(hidden: Mapping[str, float], seed: int = 0, **more: object) -> Outcome:
    form = LinearForm(linear_records(seed, hidden, **more))  # type: ignore[arg-type]
    return search(form, form.fit((), [], None), ALL)


def accepted(outcome: Outcome | Answer) -> set[str]:
    return {one.placed.effect.name for one in outcome.accepted}


def tie_of(outcome: Outcome, name: str) -> set[str]:
    (tie,) = [one.tie for one in outcome.accepted if one.placed.effect.name == name]
    return {member[0].effect.name for member in tie}
