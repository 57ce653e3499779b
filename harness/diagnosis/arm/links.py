"""Which links have other masses than the URDF says: the set that must change is found by exchange, not one by one.

What a search adds one at a time can end with a spring, a rotor or a payload in the place of a second wrong link. So
once a log asks for other bodies at all, the base parameters are freed along every link's mass beside all that was
found: that fit is as near as this arm comes to the log in likelihood, and its errors weigh the rows. Then sets are
compared by their penalised likelihood in that metric, from several beginnings, by adding, dropping and exchanging
(Miller 2002, *Subset Selection in Regression*, sec. 3.9, replacing one variable at a time).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from harness.diagnosis.arm.effects import GAIN
from harness.diagnosis.arm.regression import Errors, RegressionForm, regression_detail
from harness.diagnosis.arm.wide_regression import ROTOR, WideRegression
from harness.diagnosis.policy import ARM_POLICY, Policy
from harness.diagnosis.search.outcome import Outcome
from harness.effects.effect import Placed
from harness.signals import FloatArray

LINK = "link_mass"
LOAD = ("payload", "payload_off_centre")
FINEST = 1e-10
"""Share of a column's power below which the others make it."""


@dataclass(frozen=True, eq=False)
class Elements:
    """What a set may hold, in the metric of the likelihood: rows are whitened, what every joint has is projected out.

    Attributes
    ----------
    power : array (p, p)
        Products of the columns.
    along : array (p,)
        Products of the columns with what is to be explained.
    places : dict
        Columns of every element, by name.
    low, high : array (p,)
        Bounds of their coefficients.
    price : dict
        Log-likelihood that an element has to bring.
    alone : frozenset
        Names of which a set holds one at most.
    """

    power: FloatArray
    along: FloatArray
    places: Mapping[str, Sequence[int]]
    low: FloatArray
    high: FloatArray
    price: Mapping[str, float]
    alone: frozenset[str] = frozenset()

    def value(self, chosen: frozenset[str]) -> float:
        """Return the log-likelihood that a set brings, less its price."""
        columns = [k for name in self.places if name in chosen for k in self.places[name]]
        return self._gain(columns) - sum(self.price[name] for name in chosen)

    def clashes(self, chosen: frozenset[str]) -> int:
        """Return how many elements of a set are the body of another one of it."""
        return max(len(chosen & self.alone) - 1, 0)

    def _gain(self, columns: list[int]) -> float:
        """Return the log-likelihood that columns bring within their bounds; one that would leave them stays there."""
        free, held = list(columns), dict[int, float]()
        while free:
            power = self.power[np.ix_(free, free)]
            size = np.sqrt(np.maximum(np.diag(power), 1e-300))
            rest = self.along[free] - sum((self.power[free, k] * x for k, x in held.items()), np.zeros(len(free)))
            x = np.linalg.lstsq(power / np.outer(size, size), rest / size, rcond=FINEST)[0] / size
            out = {k: float(np.clip(value, self.low[k], self.high[k])) for k, value in zip(free, x, strict=True)}
            beyond = [k for k, value in zip(free, x, strict=True) if not self.low[k] <= value <= self.high[k]]
            held |= {k: out[k] for k in beyond}
            if not beyond:
                held |= out
                break
            free = [k for k in free if k not in beyond]
        x = np.array([held[k] for k in columns])
        return float(x @ self.along[columns] - 0.5 * x @ self.power[np.ix_(columns, columns)] @ x)


@dataclass(frozen=True)
class LinkSet:
    """A set: effects on the whole arm, joints that keep a rotor, and for each effect what does as well."""

    effects: tuple[Placed, ...]
    rotors: tuple[int, ...]
    rivals: Mapping[str, tuple[Placed, ...]]


def settled(elements: Elements, starts: Sequence[frozenset[str]], tie: float) -> list[frozenset[str]]:
    """Return the sets that exchange reaches from some beginnings, the one of the highest value first.

    Parameters
    ----------
    elements : Elements
    starts : sequence of frozenset
    tie : float
        By how much exchanging one element for another has to gain.

    Examples
    --------
    >>> power, along = np.array([[4.0, 3.9], [3.9, 4.0]]), np.array([8.0, 7.8])
    >>> both = Elements(power, along, {"a": [0], "b": [1]}, np.full(2, -9.0), np.full(2, 9.0), {"a": 1.0, "b": 1.0})
    >>> [sorted(one) for one in settled(both, [frozenset({"b"}), frozenset({"a", "b"})], 0.1)]
    [['a']]
    """
    reached = dict.fromkeys(_settled(elements, start, tie) for start in starts)
    return sorted(reached, key=lambda one: (-elements.clashes(one), elements.value(one)), reverse=True)


def _settled(elements: Elements, start: frozenset[str], tie: float) -> frozenset[str]:
    """Return where adding, dropping and exchanging end; a clash goes first, whatever it brings."""
    now, worth, clashes = start, elements.value(start), elements.clashes(start)
    while True:  # every move leads to a better set, and there are finitely many
        inside, outside = [name for name in elements.places if name in now], set(elements.places) - now
        moves = [(0.0, now - {name}) for name in inside]
        moves += [(0.0, now | {name}) for name in sorted(outside)]
        moves += [(tie, now - {one} | {other}) for one in inside for other in sorted(outside)]
        gains = [
            (clashes - elements.clashes(new), elements.value(new) - worth - least, at)
            for at, (least, new) in enumerate(moves)
        ]
        fewer, most, at = max(gains, default=(0, 0.0, 0))
        if (fewer, most) <= (0, 0.0):
            return now
        now = frozenset(moves[at][1])
        worth, clashes = elements.value(now), elements.clashes(now)


def exchanged(form: RegressionForm, outcome: Outcome, policy: Policy) -> list[LinkSet]:
    """Return the sets of effects that exchange ends at, links among them; none where nothing asks for other bodies.

    What was found one by one is among them, if it is a set at all.

    Parameters
    ----------
    form : RegressionForm
        Of a :class:`harness.diagnosis.arm.wide_regression.WideRegression`.
    outcome : Outcome
        What the search found one by one.
    policy : Policy

    Notes
    -----
    A load and the mass of the last link are one body: a set holds one of them at most, for together they exchange that
    body for another of the same weight, which is what errors of the motion ask for. A rotor is an element here, of a
    cheaper price and no inertia below nothing: what would have to take inertia from a joint is a link that is lighter
    than the URDF has it.
    """
    regression = form.regression
    assert isinstance(regression, WideRegression)
    found = [one.placed for one in outcome.accepted]
    if not any(regression.effects[str(one)].of_bodies or one.effect.name == GAIN for one in found):
        return []
    known = {str(one): one for one in found}
    known |= {key: one.placed for key, one in regression.effects.items() if one.placed.effect.name in (LINK, LOAD[0])}
    full = form.fit(list(known.values()), [outcome.model.values], outcome.model)
    if full is None:
        return []
    rotors = {name: k for k in regression.joints if (name := regression.own_name(k, ROTOR)) in full.values}
    last = [key for key, one in regression.effects.items() if one.placed.effect.name == LINK][-1:]
    one_body = frozenset([*last, *(key for key in known if known[key].effect.name in LOAD)])
    elements = replace(
        _elements(form, regression_detail(full).errors["estimation"], known, rotors, policy, full.samples),
        alone=one_body,
    )
    begun = frozenset(map(str, found))
    turning = frozenset(name for name in rotors if outcome.model.values.get(name, 0.0) > 0)
    loads = frozenset(name for name, one in known.items() if one.effect.name in LOAD)
    starts = [begun | turning, begun, frozenset(elements.places) - loads, frozenset(elements.places), frozenset()]
    sets = dict.fromkeys([*settled(elements, starts, policy.tie)[: ARM_POLICY.sets], begun | turning])
    return [_named(elements, known, rotors, one, policy.tie) for one in sets if len(one & one_body) < 2]


def _named(
    elements: Elements, known: Mapping[str, Placed], rotors: Mapping[str, int], best: frozenset[str], tie: float
) -> LinkSet:
    """Return a set with what does as well in the place of each effect."""
    least = elements.value(best) - tie
    rivals = {
        name: tuple(
            known[other] for other in known if other not in best and elements.value(best - {name} | {other}) > least
        )
        for name in best
        if name in known
    }
    kept = tuple(rotors[name] for name in rotors if name in best)
    return LinkSet(tuple(known[name] for name in known if name in best), kept, rivals)


def _elements(
    form: RegressionForm,
    errors: Errors,
    known: Mapping[str, Placed],
    rotors: Mapping[str, int],
    policy: Policy,
    samples: int,
) -> Elements:
    """Return the columns of effects and rotors, whitened by the errors of the fit of them all."""
    equation = form.regression.equation(list(known.values()))
    names = equation.system.parameter_names
    parts = equation.residual(np.zeros(len(names)), "estimation")
    white = form.whitened([j for _, j in parts], "estimation", errors)
    wanted = -form.whitened([r for r, _ in parts], "estimation", errors)
    places: dict[str, list[int]] = {}
    low, high, used = list[float](), list[float](), list[int]()
    for key, placed in known.items():
        places[key] = list(range(len(used), len(used) + len(placed.effect.parameters)))
        for parameter in placed.effect.parameters:
            used.append(names.index(placed.name(parameter.name)))
            low.append(parameter.minimum)
            high.append(parameter.maximum)
    for name in rotors:
        places[name] = [len(used)]
        used.append(names.index(name))
        low.append(0.0)
        high.append(np.inf)
    beside = white[:, [k for k in range(len(names)) if k not in used]]
    size = np.linalg.norm(beside, axis=0)
    left, singular, _ = np.linalg.svd(beside[:, size > 0] / size[size > 0], full_matrices=False)
    basis = left[:, singular > FINEST * singular.max(initial=1e-300)]
    columns = white[:, used]
    columns = columns - basis @ (basis.T @ columns)
    each = 0.5 * float(np.log(samples))
    price = {key: each * len(places[key]) + (policy.evidence if key in known else 0.0) for key in places}
    return Elements(columns.T @ columns, columns.T @ wanted, places, np.array(low), np.array(high), price)
