"""Screens: which effects of the dictionary could explain the residual, at the price of one simulation each.

The sensitivity screen adds every effect at about 5 % of the force to the fitted nominal model, takes out of the change
what the nominal parameters and initial states could do themselves, and correlates the rest with the residual. The
weak-form screen does the same on the momentum equation of the measured motion. They fail in complementary places: the
weak form misses effects with a hidden state, the sensitivity screen misses on rotating or near-separatrix data.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np

from harness.diagnosis.forms import Fitted, Form, stacked
from harness.diagnosis.residual_tests import effective_samples
from harness.diagnosis.surrogates import orthonormal
from harness.effects.effect import Placed
from harness.signals import FloatArray

__all__ = ["ALWAYS", "Probe", "Screen", "isolability", "sensitivity_screen", "shortlist", "start_grid", "unseen"]

ALWAYS = ("input_delay", "sensor_offset", "force_bias")
SEEN = 0.02
"""An effect of which less than this share is left beside the nominal Jacobian cannot be told from the parameters."""
MOST_STARTS = 8
INVISIBLE = 0.03
"""Share of a barely visible effect that must be left beside the nominal parameters (a simulation is not linear)."""
MOST = 26
WEAKER = 0.3
"""A probe is repeated if the residual is smaller than this part of the change that it makes."""


@dataclass(frozen=True)
class Probe:
    """What a screen found out about one effect.

    Attributes
    ----------
    placed : Placed
    starts : tuple of dict
        Values (by the effect's own parameter names) worth starting a fit from, best first.
    r2 : float
        Share of the residual in the span of the effect's columns.
    rank : int
        Number of those columns that are independent.
    left : float
        Share of the effect that the nominal parameters and initial states cannot mimic (0 to 1).
    basis : array (rows, rank)
        Orthonormal, nominal Jacobian removed.
    direction : array (rows,)
        The change itself, unit length, nominal Jacobian removed.
    absorbed_by : str
        Nominal parameter that mimics it best, where ``least`` is small.
    least : float
        ``left`` at the strength where it was smallest: far from small effects a motion that magnifies everything makes
        any two of them look apart.
    """

    placed: Placed
    starts: tuple[dict[str, float], ...]
    r2: float
    rank: int
    left: float
    score: float
    basis: FloatArray = field(repr=False)
    direction: FloatArray = field(repr=False)
    absorbed_by: str = ""
    least: float = 1.0


@dataclass(frozen=True)
class Screen:
    """All probes of one screen, best score first; the nominal basis and the residual they were made against."""

    probes: tuple[Probe, ...]
    nominal: FloatArray = field(repr=False)
    failed: dict[str, str] = field(default_factory=dict)
    residual: FloatArray | None = field(default=None, repr=False)

    def share(self, *effects: Placed) -> float:
        """Return the share of the residual in the span of several effects together (0 to 1), linearised."""
        names = {str(one) for one in effects}
        bases = [one.basis for one in self.probes if str(one.placed) in names and one.rank]
        if self.residual is None or not bases:
            return 0.0
        power = float(self.residual @ self.residual)
        both = orthonormal(np.concatenate(bases, axis=1), tolerance=1e-3)
        return float(np.sum((both.T @ self.residual) ** 2)) / power if power > 0 else 0.0

    def leaders(self, count: int) -> list[Probe]:
        """Return the best probes that can be seen at all."""
        return [one for one in self.probes if one.left >= SEEN and one.rank > 0][:count]


def start_grid(placed: Placed, sizes: Mapping[str, float]) -> list[dict[str, float]]:
    """Return values worth probing: the usual ones, and the declared factors on parameters with several minima."""
    free = [one for one in placed.effect.parameters if not one.fixed]
    base = placed.effect.complete(placed.values, sizes)
    axes = [
        one.starts(sizes) if not one.nuisance and one.name not in placed.values else (base[one.name],) for one in free
    ]
    while np.prod([len(axis) for axis in axes]) > MOST_STARTS:
        longest = int(np.argmax([len(axis) for axis in axes]))
        axes[longest] = axes[longest][:-1]
    return [{**base, **dict(zip([one.name for one in free], point, strict=True))} for point in product(*axes)]


def sensitivity_screen(
    form: Form,
    base: Fitted,
    candidates: Iterable[Placed],
    sizes: Callable[[Placed], Mapping[str, float]],
    *,
    progress: Callable[[str], None] | None = None,
) -> Screen:
    """Probe every candidate against the residual of a fitted model.

    An effect that moves the outputs much more than the residual is probed once more, so weakly that it moves them as
    much: only there does the linearised model say what the effect could explain.

    Parameters
    ----------
    form : Form
        How model and data are compared.
    base : Fitted
        The model so far.
    candidates : iterable of Placed
        Effects to add, one at a time.
    sizes : callable
        Sizes of the data at an effect's port.
    """
    jacobian = stacked(base.jacobian) if base.free else np.zeros((sum(r.size for r in base.estimation), 0))
    nominal = orthonormal(jacobian, tolerance=1e-7)
    residual = stacked(form.clean(base, [r[:, :, None] for r in base.estimation]))[:, 0]
    residual = residual - nominal @ (nominal.T @ residual)
    independent = max(sum(effective_samples(r[:, j]) for r in base.estimation for j in range(r.shape[1])), 40.0)
    probes: list[Probe] = []
    failed: dict[str, str] = {}
    for placed in candidates:
        if progress is not None:
            progress(str(placed))
        found = _probe(form, base, placed, sizes(placed), nominal, jacobian, residual, independent)
        if found is None:
            failed[str(placed)] = "the model with it cannot be simulated"
        else:
            probes.append(found)
    probes.sort(key=lambda one: -one.score)
    return Screen(tuple(probes), nominal, failed, residual)


def shortlist(
    sensitivity: Screen, weak: Screen | None, candidates: Sequence[Placed], *, most: int = 16
) -> list[Placed]:
    """Return the candidates to confirm: leaders of both screens, families of the first of each, and the usual three.

    Parameters
    ----------
    sensitivity, weak : Screen
        The weak form is None where the motion is not measured.
    candidates : sequence of Placed
        All effects at all ports they fit.
    most : int
        Length of the list; families and the usual three are cut before leaders.
    """
    seen = {str(one.placed): one for one in sensitivity.probes}
    first = sensitivity.leaders(5) + ([] if weak is None else weak.leaders(3))
    chosen: dict[str, Placed] = {str(one.placed): one.placed for one in first}
    names: list[tuple[str, str]] = []
    for leader in sensitivity.leaders(1) + ([] if weak is None else weak.leaders(1)):
        names += [(name, leader.placed.at) for name in leader.placed.effect.family]
    for name, at in names:
        for one in _at(candidates, name, at):
            chosen.setdefault(str(one), one)
    for name in ALWAYS:
        for one in _at(candidates, name, None):
            chosen.setdefault(str(one), one)
    kept = {key: one for key, one in chosen.items() if key not in seen or seen[key].left >= SEEN}
    return list(kept.values())[:most]


def _at(candidates: Sequence[Placed], name: str, at: str | None) -> list[Placed]:
    """Return the placements of an effect: at the port if it fits there, else at every port it fits."""
    found = [one for one in candidates if one.effect.name == name]
    here = [one for one in found if one.at == at]
    return here or found


def _probe(
    form: Form,
    base: Fitted,
    placed: Placed,
    sizes: Mapping[str, float],
    nominal: FloatArray,
    jacobian: FloatArray,
    residual: FloatArray,
    independent: float,
) -> Probe | None:
    """Return the probe of one effect: the best of its start values, all of them kept as starts."""
    tried: list[tuple[float, float, float, int, dict[str, float], FloatArray, FloatArray, FloatArray]] = []
    grid = start_grid(placed, sizes)
    usual, power = len(grid), float(residual @ residual)
    for number, values in enumerate(grid):  # it grows on the way
        parts = form.responses(base, placed, values)
        if parts is None:
            continue
        columns = stacked(parts)
        change = columns[:, 0]
        size = float(np.linalg.norm(change))
        if not np.isfinite(size) or size == 0:
            continue
        weaker = _weaker(placed, values, np.sqrt(power) / size) if number < usual else None
        if weaker is not None:
            grid.append(weaker)
        direction = change - nominal @ (nominal.T @ change)
        left = float(np.linalg.norm(direction)) / size
        basis = orthonormal(columns, without=nominal, tolerance=1e-3)
        if left < SEEN:
            basis = basis[:, :0]
        rank = basis.shape[1]
        r2 = float(np.sum((basis.T @ residual) ** 2)) / power if rank and power > 0 else 0.0
        r2 = min(r2, 1 - 1e-12)
        score = -independent * np.log1p(-r2) - rank * np.log(independent)
        start = _refined(placed, values, columns, nominal, residual)
        tried.append((score, r2, left, rank, start, basis, direction / max(left * size, 1e-300), change / size))
    if not tried:
        return None
    order = sorted(range(len(tried)), key=lambda k: -tried[k][0])
    score, r2, left, rank, _, basis, direction, change = tried[order[0]]
    absorbed, least = "", min(one[2] for one in tried)
    if least < 0.3 and base.free:
        norms = np.linalg.norm(jacobian, axis=0)
        cosines = np.abs(change @ jacobian) / np.where(norms > 0, norms, np.inf)
        absorbed = base.free[int(np.argmax(cosines))]
    starts = tuple(tried[k][4] for k in order[:3])
    return Probe(placed, starts, r2, rank, left, float(score), basis, direction, absorbed, least)


def _weaker(placed: Placed, values: Mapping[str, float], factor: float) -> dict[str, float] | None:
    """Return values with the strength of an effect times a factor; None if it is not needed or has no strength."""
    neutral = {
        one.name: one.neutral
        for one in placed.effect.parameters
        if one.linear and not one.fixed and one.neutral is not None
    }
    if not 0 < factor < WEAKER or not neutral:
        return None
    return {**values, **{name: zero + factor * (values[name] - zero) for name, zero in neutral.items()}}


def _refined(
    placed: Placed, values: dict[str, float], columns: FloatArray, nominal: FloatArray, residual: FloatArray
) -> dict[str, float]:
    """Return start values with the linear parameters moved to where the linearised model wants them."""
    free = [one for one in placed.effect.parameters if not one.fixed]
    linear = [k for k, one in enumerate(free) if one.linear]
    if not linear:
        return dict(values)
    moving = columns[:, [1 + k for k in linear]]
    moving = moving - nominal @ (nominal.T @ moving)
    change = columns[:, 0] - nominal @ (nominal.T @ columns[:, 0])
    step = np.linalg.lstsq(moving, residual - change, rcond=1e-6)[0]
    result = dict(values)
    for k, amount in zip(linear, step, strict=True):
        one = free[k]
        new = values[one.name] + float(amount)
        size = abs(values[one.name]) or 1.0
        if one.minimum >= 0:
            new = max(new, 0.05 * size, one.minimum)
        result[one.name] = float(np.clip(new, max(one.minimum, -200 * size), min(one.maximum, 200 * size)))
    return result


def isolability(screen: Screen, *, first: Sequence[str] = ()) -> tuple[tuple[str, ...], FloatArray]:
    """Return how well each effect's change of the outputs is mimicked by every other.

    Parameters
    ----------
    screen : Screen
        Of the nominal model.
    first : sequence of str
        Effects to show in any case, e.g. those found.

    Returns
    -------
    names : tuple of str
    cosines : array (n, n)
        Entry (i, j): cosine between the change of effect i and the span of effect j (its parameters free), the nominal
        Jacobian and the initial states taken out of both; 1 means that j can do all that i does.
    """
    seen = [one for one in screen.probes if one.left >= SEEN and one.rank]
    seen.sort(key=lambda one: (str(one.placed) not in first, str(one.placed)))
    seen = seen[:MOST]
    cosines = np.eye(len(seen))
    for i, a in enumerate(seen):
        for j, b in enumerate(seen):
            if i != j:
                cosines[i, j] = min(float(np.linalg.norm(b.basis.T @ a.direction)), 1.0)
    return tuple(str(one.placed) for one in seen), cosines


def unseen(screen: Screen) -> list[dict[str, Any]]:
    """Return the effects that this experiment cannot show, each with the reason."""
    rows = []
    for one in screen.probes:
        if one.left < SEEN or one.least < INVISIBLE or not one.rank:
            by = f"nominal parameter {one.absorbed_by}" if one.absorbed_by else "nominal parameters or initial states"
            rows.append(
                {
                    "name": one.placed.effect.name,
                    "at": one.placed.at,
                    "reason": f"the {by} can do the same" if one.absorbed_by else f"{by} can do the same",
                    "parameter": one.absorbed_by or None,
                }
            )
    return sorted(rows, key=lambda row: (row["name"], row["at"]))
