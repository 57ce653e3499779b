"""The screen on the momentum equation of the measured motion: one linear regression for each effect.

The force that an effect would add along the measured motion is averaged over bumps like the momentum balance itself,
so no acceleration is needed. It needs no simulation, so it works where simulations of a wrong model go astray, and its
solution is the best start there is for a refit: nominal parameters and effect together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np

from harness.diagnosis.equation_form import EquationForm
from harness.diagnosis.residual_tests import effective_samples
from harness.diagnosis.screens import SEEN, Probe, Screen
from harness.diagnosis.surrogates import orthonormal
from harness.effects.columns import column_blocks
from harness.effects.effect import Placed
from harness.errors import HarnessError
from harness.signals import FloatArray

__all__ = ["WeakScreen", "weak_screen"]


@dataclass(frozen=True, eq=False)
class WeakScreen:
    """The screen with what else it knows.

    Attributes
    ----------
    screen : Screen
        Its probes' starts hold the effect's values.
    residual : tuple of array (rows_i, n)
        Momentum residual of the model so far, by record.
    parameters : dict
        For each effect the nominal parameters that go with its start.
    """

    screen: Screen
    residual: tuple[FloatArray, ...]
    parameters: dict[str, dict[str, float]] = field(repr=False, default_factory=dict)
    independent: float = 40.0

    def leaders(self, count: int) -> list[Probe]:
        """Return the best probes."""
        return self.screen.leaders(count)

    def pairs(self, count: int) -> list[tuple[Placed, Placed]]:
        """Return the pairs of effects that explain the momentum residual best, by BIC."""
        nominal = self.screen.nominal
        r = np.concatenate([one.reshape(-1) for one in self.residual])
        r = r - nominal @ (nominal.T @ r)
        power = float(r @ r)
        scored = []
        for one, two in combinations([probe for probe in self.screen.probes if probe.rank], 2):
            both = orthonormal(np.concatenate([one.basis, two.basis], axis=1), tolerance=1e-3)
            share = min(float(np.sum((both.T @ r) ** 2)) / power, 1 - 1e-12) if power > 0 else 0.0
            score = -self.independent * np.log1p(-share) - both.shape[1] * np.log(self.independent)
            scored.append((score, one.placed, two.placed))
        scored.sort(key=lambda one: -one[0])
        # a leader with every bystander would fill the list: each effect appears at most three times
        chosen: list[tuple[Placed, Placed]] = []
        seen: dict[str, int] = {}
        for _, a, b in scored:
            names = (str(a), str(b))
            if all(seen.get(name, 0) < 3 for name in names) and len(chosen) < count:
                chosen.append((a, b))
                seen.update({name: seen.get(name, 0) + 1 for name in names})
        return chosen


def weak_screen(
    form: EquationForm,
    effects: Sequence[Placed],
    values: Mapping[str, float],
    candidates: Sequence[Placed],
    sizes: Mapping[str, Mapping[str, float]],
) -> WeakScreen:
    """Regress the momentum residual on the columns of every candidate.

    Parameters
    ----------
    form : EquationForm
        Of shape ``weak``.
    effects : sequence of Placed
        What is in the model already; the form must judge them.
    values : mapping
        Parameters to start the nominal fit of the form from.
    candidates : sequence of Placed
        Effects to try; those that have no columns are left out.
    sizes : mapping
        Sizes of the data by port.
    """
    record = form.solve(effects, [dict(values)], seed=0)
    base = form.evaluate(effects, record)
    weights = form.weights
    motions = form.motions["estimation"]
    jacobian = np.concatenate([one.reshape(-1, len(base.free)) for one in base.jacobian])
    nominal = orthonormal(jacobian, tolerance=1e-7)
    r = np.concatenate([one.reshape(-1) for one in base.estimation])
    clean = r - nominal @ (nominal.T @ r)
    power = float(clean @ clean)
    independent = max(sum(effective_samples(one[:, j]) for one in base.estimation for j in range(one.shape[1])), 40.0)
    probes: list[Probe] = []
    parameters: dict[str, dict[str, float]] = {}
    failed: dict[str, str] = {}
    signals = [one.signals() for one in motions]
    for placed in candidates:
        if placed.effect.name == "input_gain":  # a common factor of all forces: the equation alone cannot know it
            continue
        try:
            blocks = [column_blocks(base.system, placed, one, parameters=base.values, sizes=sizes) for one in signals]
        except HarnessError as error:
            failed[str(placed)] = str(error)
            continue
        best: tuple[float, Probe, dict[str, float]] | None = None
        for choice in zip(*blocks, strict=False):
            rows = []
            for block, motion in zip(choice, motions, strict=True):
                slim = form.averaged(block.columns, motion)
                rows.append((slim / weights[:, None]).reshape(-1, slim.shape[2]))
            columns = np.concatenate(rows)
            if not np.isfinite(columns).all():
                continue
            found = _probe(placed, choice[0], columns, jacobian, nominal, clean, r, power, independent, base)
            if best is None or found[0] > best[0]:
                best = found
        if best is not None:
            probes.append(best[1])
            parameters[str(placed)] = best[2]
    probes.sort(key=lambda one: -one.score)
    return WeakScreen(Screen(tuple(probes), nominal, failed, clean), base.estimation, parameters, independent)


def _probe(
    placed: Placed,
    block: Any,
    columns: FloatArray,
    jacobian: FloatArray,
    nominal: FloatArray,
    clean: FloatArray,
    r: FloatArray,
    power: float,
    independent: float,
    base: Any,
) -> tuple[float, Probe, dict[str, float]]:
    """Return score, probe and nominal parameters of one block of columns."""
    size = float(np.linalg.norm(columns))
    left_over = columns - nominal @ (nominal.T @ columns)
    left = float(np.linalg.norm(left_over)) / size if size > 0 else 0.0
    basis = orthonormal(columns, without=nominal, tolerance=1e-3)
    if left < SEEN:
        basis = basis[:, :0]
    rank = basis.shape[1]
    r2 = min(float(np.sum((basis.T @ clean) ** 2)) / power, 1 - 1e-12) if rank and power > 0 else 0.0
    score = float(-independent * np.log1p(-r2) - rank * np.log(independent))
    # e = J dp - C c: how the nominal parameters move when the effect is in
    both = np.linalg.lstsq(np.concatenate([jacobian, -columns], axis=1), r, rcond=1e-8)[0]
    moved = dict(base.values)
    for name, step in zip(base.free, both[: jacobian.shape[1]], strict=True):
        one = base.system.parameter(name)
        value = base.values[name] + float(step)
        if one.minimum >= 0:
            value = max(value, 0.05 * abs(base.values[name]))
        moved[name] = float(np.clip(value, one.minimum, one.maximum))
    values = dict(block.given)
    for name, amount in zip(block.names, both[jacobian.shape[1] :], strict=True):
        if name != "effect":
            limits = placed.effect.parameter(name)
            values[name] = float(np.clip(amount + (limits.neutral or 0.0), limits.minimum, limits.maximum))
    change = columns[:, 0]
    direction = change - nominal @ (nominal.T @ change)
    length = float(np.linalg.norm(direction))
    direction = direction / length if length > 0 else direction
    return score, Probe(placed, (values,), r2, rank, left, score, basis, direction), moved
