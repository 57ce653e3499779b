"""Hybrid automata from measured states: affine flows, guards, and the jump that the state makes where one is met."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from harness.errors import FitError, InputError
from harness.options import check_options
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.common.judge.excited import Excited
from identifiers.common.lag_state import LagModel
from identifiers.common.records import real_signals, usable
from identifiers.hybrid.jumps import StateJump, find_jumps
from identifiers.hybrid.piecewise_affine import PiecewiseAffine, PiecewiseAffineModel, affine

_MOST, _STARTS, _ROUNDS = 4, 20, 50  # Walls that are tried, random starts of each number, and rounds of one start.

_EXACT = 1e-7
"""Scatter below which planes are exact, in the scale of the positions: the instants of jumps are no better known."""


def grouped(
    places: FloatArray, count: int | None, *, least: int, reset: int, rng: np.random.Generator
) -> npt.NDArray[np.intp]:
    """Return the plane (n,) of each place: those near the same one, for the number of planes of least cost.

    Planes and members in turns, as k-means does with centres (Bradley & Mangasarian 2000, *J. Global Optim.* 16:23).
    The cost is minus twice the classification likelihood, plus ``log n`` for every parameter (Biernacki, Celeux &
    Govaert 2000, *IEEE Trans. PAMI* 22:719): it counts what it takes to say which plane a place belongs to, so noise
    about one plane is not cut in two.

    - ``places`` (n, m): positions at the jumps, each scaled to a size of 1
    - ``count``: of the planes; None chooses it
    - ``least``: members that a plane needs
    - ``reset``: parameters that each plane brings beside its own

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> z = np.repeat([0.0, 1.0], 30)[:, None] + 0.01 * rng.normal(size=(60, 1))
    >>> np.bincount(grouped(z, None, least=4, reset=6, rng=rng)).tolist()
    [30, 30]
    >>> int(grouped(z[:30], None, least=4, reset=6, rng=rng).max())
    0
    """
    n, m = places.shape
    numbers = range(1, _MOST + 1) if count is None else [count]
    best, of = np.inf, np.zeros(n, dtype=np.intp)
    for planes in numbers:
        if n < planes * least:
            break
        found = _planes(places, planes, least, rng)
        if found is None:
            continue
        members, squares = found
        share = np.bincount(members, minlength=planes) / n
        cost = n * np.log(squares / n + _EXACT**2) - 2 * n * float(share @ np.log(share))
        cost += planes * (m + reset) * np.log(n)
        if cost < best:
            best, of = cost, members
    return of


def _planes(
    places: FloatArray, planes: int, least: int, rng: np.random.Generator
) -> tuple[npt.NDArray[np.intp], float] | None:
    """Return members and sum of squared distances of the best of some starts; None where a plane stays too empty."""
    n, m = places.shape
    best: tuple[npt.NDArray[np.intp], float] | None = None
    for _ in range(_STARTS if planes > 1 else 1):
        seeds = [_plane(places[rng.choice(n, m, replace=False)]) for _ in range(planes)]
        members = np.argmin(_distances(places, seeds), axis=1)
        for _ in range(_ROUNDS):
            if np.bincount(members, minlength=planes).min() < least:
                break
            far = _distances(places, [_plane(places[members == k]) for k in range(planes)])
            old, members = members, np.argmin(far, axis=1)
            if (old == members).all():
                squares = float(np.sum(far.min(axis=1) ** 2))
                if best is None or squares < best[1]:
                    best = members, squares
                break
    return best


def _plane(places: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return centre and normal (m,) of the plane of least squared distances."""
    centre = places.mean(axis=0)
    return centre, np.linalg.svd(places - centre, full_matrices=True)[2][-1]


def _distances(places: FloatArray, planes: list[tuple[FloatArray, FloatArray]]) -> FloatArray:
    return np.stack([np.abs((places - centre) @ normal) for centre, normal in planes], axis=1)


_BISECTIONS = 30  # Halvings of the sample in which the guard is met.
_SHARP = 3.0  # The guard is told where jumps scatter along it by so many times as much as across it.

_TOLD = 0.02
"""Directions in which the states before the jumps scatter less than this, beside the largest, tell nothing."""

_RATE = "_rate"

_MOST_JUMPS = 10  # In one sample: a state between walls that close in does not end.


@dataclass(frozen=True, eq=False)
class HybridModel(LagModel):
    """Affine flows between jumps; a jump where one of the guards is met from above.

    Parameters
    ----------
    flow : PiecewiseAffineModel
        One step between jumps.
    guards : array (g, ny + 1)
        The state jumps when ``guard @ [y, 1]`` falls through 0 for one of them, the first that does: where all are
        above 0 is a polyhedron. Only positions have weights.
    within : array (g, ny + 1)
        The part of each guard that counts, ``within @ [y, 1] >= 0``: legs are level in mid-swing as well.
    resets : array (g, ny, ny + 1)
        The state after a jump at a guard is ``reset @ [y, 1]`` of that before it.
    jump_variance : array (ny,)
        Of the error of a step with a jump in it.
    """

    flow: PiecewiseAffineModel
    guards: FloatArray
    within: FloatArray
    resets: FloatArray
    jump_variance: FloatArray
    kind = "hybrid-automaton"

    def mode(self, rows: FloatArray) -> npt.NDArray[np.intp]:
        """Return the flow's mode (...) of regressors (..., p)."""
        return self.flow.mode(rows)

    @property
    def findings(self) -> tuple[str, ...]:
        """Guards and resets as equations, and how well the guards tell the jumps."""
        flow = self.flow.findings if len(self.flow.coefficients) > 1 else ()
        if not self.notes.get("jumps"):
            return flow
        names, said = [channel.name for channel in self.spec.outputs], []
        for guard, within, reset in zip(self.guards, self.within, self.resets, strict=True):
            where = f" while {affine(within, names)} >= 0" if np.any(within[:-1]) else ""
            said.append(f"jumps where {affine(guard, names)} falls through 0{where}")
            said += [f"after a jump {name} = {affine(row, names)}" for name, row in zip(names, reset, strict=True)]
        told = 100 * self.notes["jumps told by the guards"]
        return (*said, f"{self.notes['jumps']} jumps, {told:.0f} % of them told by the guards to the sample", *flow)

    def heights(self, y: FloatArray) -> FloatArray:
        """Return how far states (..., ny) are above the guards (..., g)."""
        return np.asarray(np.asarray(y) @ self.guards[:, :-1].T + self.guards[:, -1])

    def jumps(self, rows: FloatArray) -> npt.NDArray[np.bool_]:
        """Return whether the step from regressors (..., p) has a jump in it."""
        ahead = self.flow.ahead(rows)[0]
        return np.asarray((self._armed(rows[..., : self.spec.ny]) & (self.heights(ahead) <= 0.0)).any(axis=-1))

    def ahead(self, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean and variance (..., ny) of the next output."""
        mean, variance = self.flow.ahead(rows)
        for place in np.argwhere(self.jumps(rows)):
            at = tuple(place)
            mean[at] = self._over_jumps(rows[at])
            variance[at] = self.jump_variance
        return mean, variance

    def _armed(self, y: FloatArray) -> npt.NDArray[np.bool_]:
        """Return which guards (..., g) states (..., ny) move towards, on the part that counts."""
        # Falling, and not yet above it: just after a jump noise may put the state on either side.
        return np.asarray((y @ self._approach.T < 0.0) & (y @ self.within[:, :-1].T + self.within[:, -1] >= 0.0))

    @cached_property
    def _approach(self) -> FloatArray:
        """Return the weights (g, ny) of the outputs in the rates of the heights above the guards."""
        names = [channel.name for channel in self.spec.outputs]
        weights = np.zeros((len(self.guards), len(names)))
        for g, i in np.argwhere(self.guards[:, :-1]):
            weights[g, names.index(names[i] + _RATE)] = self.guards[g, i]
        return weights

    @cached_property
    def _generators(self) -> list[FloatArray | None]:
        """Return of each mode the logarithm of its step in [y, u, 1]; None where it has no real one."""
        from scipy.linalg import logm

        ny, found = self.spec.ny, []
        for table in self.flow.coefficients:
            whole = np.eye(table.shape[1])
            whole[:ny] = table
            generator = logm(whole)
            real = np.abs(np.imag(generator)).max() < 1e-9 and np.isfinite(generator).all()
            found.append(np.real(generator) if real else None)
        return found

    def _part(self, row: FloatArray, part: float) -> FloatArray:
        """Return the state a part of a sample later, without a jump."""
        from scipy.linalg import expm

        generator, ny = self._generators[int(self.flow.mode(row))], self.spec.ny
        if generator is None:
            return np.asarray(row[:ny] + part * (self.flow.ahead(row)[0] - row[:ny]))
        return np.asarray((expm(part * generator)[:ny]) @ np.append(row, 1.0))

    def _over_jumps(self, row: FloatArray) -> FloatArray:
        """Return the next state: flow to the first guard, jump, flow on, and so to the end of the sample."""
        ny, left = self.spec.ny, 1.0
        for _ in range(_MOST_JUMPS):
            met = np.flatnonzero(self._armed(row[:ny]) & (self.heights(self._part(row, left)) <= 0.0))
            if not met.size:
                break
            low, high = 0.0, left
            for _ in range(_BISECTIONS):
                middle = 0.5 * (low + high)
                under = self.heights(self._part(row, middle))[met] <= 0.0
                low, high, met = (low, middle, met[under]) if under.any() else (middle, high, met)
            after = self.resets[met[0]] @ np.append(self._part(row, high), 1.0)
            row, left = np.concatenate([after, row[ny:]]), left - high
        return self._part(row, left)


@dataclass(frozen=True)
class HybridAutomaton(Excited):
    """Flow, guards and resets of a plant whose state jumps, from records of the whole state.

    Jumps are found where the record does not continue smoothly, and timed within the sample by the positions, which do
    not jump (:mod:`identifiers.hybrid.jumps`). Between jumps the flow is piecewise affine (``piecewise-affine``). The
    guards are the planes on which the positions before the jumps lie (:func:`grouped`); the reset of each is an
    affine map, by least squares from the states before and after. Positions keep their values through it.

    Parameters
    ----------
    modes : int, optional
        Of the flow between jumps; None chooses it.
    guards : int, optional
        Walls that are met; None chooses it, up to four.
    swaps : sequence of pairs of str
        Outputs that change roles in a jump, with their rates: legs at heel strike.
    width : int
        Samples on each side of a jump from which it is timed.
    starts : int
        Random starts of the flow.

    Raises
    ------
    FitError
        If there are jumps, but too few for a guard or its reset, or all alike.

    Examples
    --------
    >>> from harness.registry import create
    >>> from harness.rng import Streams
    >>> from harness.rollout import run
    >>> push = create("scenarios", "multisine", duration=12.0, amplitude=4.0, band=[0.1, 3.0])
    >>> data = run(create("plants", "bouncing-mass-pymunk"), push, streams=Streams("p", "s", 0))
    >>> model = HybridAutomaton(modes=1).fit([data.measured()], rng=np.random.default_rng(0))
    >>> bool(abs(model.resets[0, 1, 1] + 0.8) < 0.02)
    True
    """

    modes: int | None = 1
    guards: int | None = None
    swaps: Sequence[Sequence[str]] = ()
    width: int = 6
    starts: int = 2

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> HybridModel:
        """Return the model; jumps, and how well they fit guard and reset, stand in its notes."""
        what = "hybrid-automaton"
        check_options(self, what, width=">= 3", guards=">= 1")
        records, spec = usable(trajectories, samples=4 * self.width, what=what)
        real_signals(spec, what)
        positions = _positions(spec)
        roles = _roles(spec, self.swaps)
        jumps = find_jumps(records, positions, roles, width=self.width)
        least = spec.ny + 2
        if 0 < len(jumps) < least:
            raise FitError(
                f"{what}: too few jumps of the state",
                expected=f"at least {least}, for a reset of {spec.ny} states",
                got=str(len(jumps)),
                remedy="record more of them, or use piecewise-affine for a plant whose state does not jump",
            )
        flow = PiecewiseAffine(modes=self.modes, starts=self.starts, least_excitation=self.least_excitation).fit(
            _between(records, jumps), rng=rng
        )
        if not jumps:
            never = np.eye(spec.ny + 1)[-1:]
            notes = {**flow.notes, "jumps": 0, "warning": "no jump was found: the model is the flow alone"}
            still = np.eye(spec.ny, spec.ny + 1)[None]
            return HybridModel(spec, 1, flow.scaling, flow, never, never, still, flow.variance[0], notes=notes)
        size = np.concatenate([record.y for record in records]).std(axis=0)
        places = np.array([jump.before for jump in jumps])[:, positions] / np.where(size > 0, size, 1.0)[positions]
        of = grouped(places, self.guards, least=least, reset=spec.ny * (spec.ny + 1), rng=rng)
        if self.guards is not None and int(of.max()) + 1 != self.guards:
            raise FitError(
                f"{self.guards} guards",
                expected=f"{least} jumps or more at each of them",
                got=f"{len(jumps)} jumps, which do not lie on so many planes",
                remedy="leave guards out, or record more jumps at every wall",
            )
        found = [
            _facet(spec, [one for one, g in zip(jumps, of, strict=True) if g == k], positions, roles, size, records)
            for k in range(int(of.max()) + 1)
        ]
        guards, within, resets = (np.array([getattr(one, name) for one in found]) for name in _FACET)
        model = HybridModel(spec, 1, flow.scaling, flow, guards, within, resets, np.zeros(spec.ny))
        rows = np.array([np.append(records[j.record].y[j.sample], records[j.record].u[j.sample]) for j in jumps])
        crossed = model.jumps(rows)
        wrong = model.ahead(rows)[0] - np.array([records[j.record].y[j.sample + 1] for j in jumps])
        wrong = wrong[crossed] if crossed.any() else wrong
        notes = {
            **flow.notes,
            "jumps": len(jumps),
            "jumps of each guard": np.bincount(of).tolist(),
            "guard scatter": [one.scatter for one in found],
            "reset rms": [one.missed.tolist() for one in found],
            "reset rank": [one.rank for one in found],
            "jumps told by the guards": float(crossed.mean()),
        }
        rank = min(one.rank for one in found)
        if rank < spec.ny:
            notes["warning"] = (
                f"the states before the jumps span {rank} of a guard's {spec.ny} directions: the reset is known only "
                "along them (start from other states, or push harder)"
            )
        variance = np.maximum(np.mean(wrong**2, axis=0), flow.variance.min(axis=0))
        return replace(model, jump_variance=variance, notes=notes)


_FACET = ("guard", "within", "reset")


@dataclass(frozen=True, eq=False)
class _Facet:
    """A guard, the part of it that counts, its reset, and how well the jumps fit them."""

    guard: FloatArray
    within: FloatArray
    reset: FloatArray
    scatter: float
    missed: FloatArray
    rank: int


def _facet(
    spec: PlantSpec, jumps: Sequence[StateJump], positions: npt.NDArray[np.intp], roles: npt.NDArray[np.intp],
    size: FloatArray, records: Sequence[Trajectory],
) -> _Facet:  # fmt: skip
    """Return the guard and the reset of jumps that meet the same wall."""
    before, after = np.array([jump.before for jump in jumps]), np.array([jump.after for jump in jumps])
    guard, scatter = _guard(spec, before, positions, records, jumps, "hybrid-automaton")
    reset, missed, rank = _reset(before, after, positions, roles, size)
    return _Facet(guard, _within(before, after, positions), reset, scatter, missed, rank)


def _positions(spec: PlantSpec) -> npt.NDArray[np.intp]:
    """Return the outputs whose rates are outputs too."""
    names = [channel.name for channel in spec.outputs]
    found = [i for i, name in enumerate(names) if name + _RATE in names]
    if not found:
        raise FitError(
            "hybrid-automaton: no position with its rate among the outputs",
            expected="outputs such as z and z_rate, the whole state",
            got=", ".join(names),
            remedy=f"measure or differentiate the rates and name them with the ending {_RATE}",
        )
    return np.array(found, dtype=np.intp)


def _roles(spec: PlantSpec, swaps: Sequence[Sequence[str]]) -> npt.NDArray[np.intp]:
    """Return which output every output is after a jump."""
    names = [channel.name for channel in spec.outputs]
    roles = np.arange(len(names), dtype=np.intp)
    for pair in swaps:
        if len(pair) != 2 or not set(pair) <= set(names):
            raise InputError(
                "option swaps", expected=f"pairs of outputs among {', '.join(names)}", got=repr(pair), remedy="correct"
            )
        for ending in ("", _RATE):
            if pair[0] + ending in names and pair[1] + ending in names:
                first, second = names.index(pair[0] + ending), names.index(pair[1] + ending)
                roles[[first, second]] = roles[[second, first]]
    return roles


def _between(records: Sequence[Trajectory], jumps: Sequence[StateJump]) -> list[Trajectory]:
    """Return the stretches between jumps as records of their own."""
    pieces = []
    for number, record in enumerate(records):
        cuts = [0, *(jump.sample + 1 for jump in jumps if jump.record == number), len(record)]
        pieces += [record[low:high] for low, high in pairwise(cuts) if high - low >= 4]
    return pieces


def _guard(
    spec: PlantSpec,
    before: FloatArray,
    positions: npt.NDArray[np.intp],
    records: Sequence[Trajectory],
    jumps: Sequence[StateJump],
    what: str,
) -> tuple[FloatArray, float]:
    """Return the guard (ny + 1,) and the rms distance of the jumps from it."""
    place = before[:, positions]
    centre = place.mean(axis=0)
    _, sizes, axes = np.linalg.svd(place - centre, full_matrices=False)
    if len(positions) > 1 and sizes[-2] < _SHARP * sizes[-1]:
        raise FitError(
            f"{what}: the jumps are all alike, so the guard cannot be told",
            expected=f"places that scatter along the guard {_SHARP:g} times as much as across it",
            got=f"{sizes[-2] / max(sizes[-1], 1e-300):.3g} times",
            remedy="start from other states, or push harder",
        )
    guard = np.zeros(spec.ny + 1)
    guard[positions] = axes[-1]
    guard[-1] = -float(axes[-1] @ centre)
    earlier = np.array([records[jump.record].y[max(jump.sample - 2, 0)] for jump in jumps])
    if np.median(earlier @ guard[:-1] + guard[-1]) < 0.0:
        guard = -guard
    return guard, float(sizes[-1] / np.sqrt(len(place)))


def _within(before: FloatArray, after: FloatArray, positions: npt.NDArray[np.intp]) -> FloatArray:
    """Return the half-space (ny + 1,) of positions before a jump; all where those after it are no others."""
    found = np.zeros(before.shape[1] + 1)
    found[-1] = 1.0
    apart = (before - after)[:, positions]
    middle = apart.mean(axis=0)
    if not np.linalg.norm(middle) > _SHARP * np.linalg.norm(apart.std(axis=0)):
        return found
    found[positions] = middle
    found[-1] = -float(middle @ (0.5 * (before + after)[:, positions]).mean(axis=0))
    return found


def _reset(
    before: FloatArray,
    after: FloatArray,
    positions: npt.NDArray[np.intp],
    roles: npt.NDArray[np.intp],
    size: FloatArray,
) -> tuple[FloatArray, FloatArray, int]:
    """Return the reset (ny, ny + 1), the rms of what it misses, and the rank of what determines it."""
    ny = before.shape[1]
    reset = np.zeros((ny, ny + 1))
    # Only what scatters among the jumps tells anything: on the guard one position follows from the others.
    centre, size = before.mean(axis=0), np.where(size > 0, size, 1.0)
    scaled = np.hstack([(before - centre) / size, np.ones((len(before), 1))])
    _, values, axes = np.linalg.svd(scaled, full_matrices=False)
    kept = values > _TOLD * values[0]
    for i in range(ny):
        if i in positions:
            reset[roles[i], i] = 1.0
            continue
        target = after[:, roles[i]] - after[:, roles[i]].mean()
        theta = axes[kept].T @ ((axes[kept] @ (scaled.T @ target)) / values[kept] ** 2)
        slopes = theta[:-1] / size
        reset[roles[i], :-1] = slopes
        reset[roles[i], -1] = after[:, roles[i]].mean() + theta[-1] - float(slopes @ centre)
    missed = np.sqrt(np.mean((np.hstack([before, np.ones((len(before), 1))]) @ reset.T - after) ** 2, axis=0))
    return reset, missed, int(kept.sum())
