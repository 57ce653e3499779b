"""Finite Markov decision processes: transition probabilities by counting, in batch and online."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from harness.errors import FitError, InputError
from harness.models.distributions import Categories
from harness.protocols import Growth, Hindsight
from harness.scoring import same_language
from harness.signals import SAY_CATEGORIES, FloatArray, PlantSpec, Trajectory
from identifiers.common.described import Described
from identifiers.common.records import usable

SHOWN = 6  # Pairs that were never tried that are named; the model has all.


def count_transitions(trajectories: Sequence[Trajectory]) -> FloatArray:
    """Count the transitions of records of one finite process.

    - ``trajectories``: one category input (the action) or none, one category output (the state)
    - returns array (S, A, S): how often action a in state s led to s'. No transition is counted across a seam.
    """
    spec = trajectories[0].spec
    states, actions = finite_sizes(spec, "mdp-counting")
    flat = np.zeros(states * actions * states)
    for record in trajectories:
        y, u = record.y[:, 0], record.u[:, 0] if spec.nu else np.zeros(len(record))
        # Category numbers are exact in floats: one conversion a block, which stays in the cache.
        for low in range(0, len(record) - 1, 65_536):
            high = min(low + 65_536, len(record) - 1)
            index = (y[low:high] * actions + u[low:high]) * states + y[low + 1 : high + 1]
            np.add.at(flat, index.astype(np.intp), 1.0)
    return flat.reshape(states, actions, states)


def ergodic(follows: npt.NDArray[np.bool_]) -> bool:
    """Return True if every state leads to every other, without a cycle.

    - ``follows`` (S, S): whether some action led from s to s'; what was never tried leads nowhere

    Examples
    --------
    >>> ergodic(np.array([[True, True], [True, False]])), ergodic(np.array([[False, True], [True, False]]))
    (True, False)
    """
    from scipy.sparse.csgraph import connected_components

    if connected_components(follows, directed=True, connection="strong")[0] != 1:
        return False
    n, reach = len(follows), follows.astype(float)
    # Primitive: some power is positive; n^2 - 2n + 2 is enough (Wielandt 1950), squaring gets beyond it.
    for _ in range(int(np.ceil(np.log2(max(2, n * n - 2 * n + 2))))):
        reach = ((reach @ reach) > 0).astype(float)
    return bool((reach > 0).all())


def weissman_bound(count: FloatArray, states: int, confidence: float = 0.95) -> FloatArray:
    """Return the bound on the l1 error of an empirical distribution over ``states`` outcomes.

    ``||P_hat - P||_1 <= sqrt(2 ln((2^S - 2) / delta) / n)`` with probability ``confidence`` (Weissman et al. 2003, HP
    Labs HPL-2003-97, theorem 2.1).

    - ``count``: number of samples n; 0 gives infinity
    - ``states``: number of outcomes, at least 2
    - ``confidence``: 1 - delta

    Examples
    --------
    >>> float(weissman_bound(np.array(1000.0), 4).round(4))
    0.1062
    """
    log = states * np.log(2.0) + np.log1p(-(2.0 ** (1 - states))) - np.log(1.0 - confidence)
    with np.errstate(divide="ignore"):
        bound: FloatArray = np.sqrt(2.0 * log / np.asarray(count, dtype=float))
    return bound


@dataclass(frozen=True, eq=False)
class MdpModel(Described):
    """Transition probabilities of a finite process; the state of the model is the distribution over its states.

    Parameters
    ----------
    spec : PlantSpec
    transition : array (S, A, S)
        ``transition[s, a, s']``; every row sums to 1.
    visits : array (S, A)
        Samples behind each row; unvisited rows are the prior (uniform).
    """

    spec: PlantSpec
    transition: FloatArray
    visits: FloatArray
    kind = "mdp"
    burn_in: ClassVar[int] = 0
    notes: dict[str, Any] = field(default_factory=dict)

    @property
    def unvisited(self) -> list[tuple[int, int]]:
        """Pairs (s, a) that the data never showed: the model knows nothing about them."""
        return [(int(s), int(a)) for s, a in np.argwhere(self.visits == 0)]

    @property
    def bound(self) -> FloatArray:
        """Weissman bound (95 %) on the l1 error of every row (S, A)."""
        return weissman_bound(self.visits, self.transition.shape[0])

    @property
    def findings(self) -> tuple[str, ...]:
        """How well the rows are known, which are not known at all, and whether every state leads to every other."""
        seen, never = self.visits[self.visits > 0], self.unvisited
        said = [
            f"{seen.size} pairs of state and action, tried {seen.min():.0f} to {seen.max():.0f} times: the worst row "
            f"is off by at most {min(2.0, self.bound[self.visits > 0].max()):.3g} (l1, 95 %; 2 is all there is)"
        ]
        if never:
            shown = ", ".join(map(str, never[:SHOWN])) + (", ..." if len(never) > SHOWN else "")
            said.append(
                f"{len(never)} of {self.visits.size} pairs were never tried, of which nothing is known: {shown}"
            )
        if not self.notes.get("ergodic", True):
            said.append("not ergodic, as far as was tried: some states are not reached from others, or only in cycles")
        return tuple(said)

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the distribution (S,) that is certain of the first output."""
        same_language(self.spec, data)
        return self._certain(data.y[0])

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the most probable state (..., 1)."""
        best: FloatArray = np.argmax(x, axis=-1)[..., None].astype(float)
        return best

    def predictive(self, x: FloatArray, u: FloatArray) -> Categories:
        """Return the distribution of the state: the model's state itself."""
        return Categories((np.asarray(x, dtype=float),))

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the distribution (..., S) one step later."""
        return moved_beliefs(x, u, self.transition)

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the distribution (..., S) that is certain of the output just seen."""
        return self._certain(np.broadcast_to(y, (*x.shape[:-1], 1)))

    def _certain(self, y: FloatArray) -> FloatArray:
        return np.eye(self.transition.shape[0])[np.asarray(y)[..., 0].astype(np.int64)]


@dataclass(frozen=True)
class MdpCounting:
    """Transition probabilities by counting, with a symmetric Dirichlet prior if wanted.

    Parameters
    ----------
    prior : float
        Pseudo-counts for each next state; 0 is maximum likelihood (an unvisited pair is uniform and flagged).

    Examples
    --------
    >>> from harness.signals import Channel
    >>> spec = PlantSpec((), (Channel("s", kind="category", minimum=0, maximum=1),), 1.0)
    >>> y = np.array([[0.0], [1.0], [0.0], [0.0], [1.0]])
    >>> data = Trajectory(np.arange(5.0), np.zeros((5, 0)), y, spec)
    >>> MdpCounting().fit([data], rng=np.random.default_rng(0)).transition[:, 0].round(3).tolist()
    [[0.333, 0.667], [1.0, 0.0]]
    """

    prior: float = 0.0

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> MdpModel:
        """Return the model; unvisited pairs stand in its notes."""
        records, spec = usable(trajectories, samples=2, what="mdp-counting", holes="kept")
        counts = count_transitions(records)
        visits = counts.sum(axis=2)
        states = counts.shape[0]
        weights = counts + self.prior
        total = weights.sum(axis=2, keepdims=True)
        transition = np.where(total > 0, weights / np.where(total > 0, total, 1.0), 1.0 / states)
        model = MdpModel(spec, transition, visits)
        model.notes.update(unvisited=[list(pair) for pair in model.unvisited], ergodic=ergodic(counts.sum(axis=1) > 0))
        return model


@dataclass(frozen=True)
class OnlineCounting:
    """Counting while predicting: names the next state that followed the pair (s, a) most often so far.

    The loss is 1 for a wrong answer; the best fixed table of answers in hindsight names the majority of each pair.
    """

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> MdpModel:
        """Return the process after all records, each row the probabilities that :meth:`forecast` gives."""
        return MdpCounting(prior=0.5).fit(trajectories, rng=rng)

    def init(self, spec: PlantSpec, *, rng: np.random.Generator) -> tuple[FloatArray, int]:
        """Return empty counts."""
        states, actions = finite_sizes(spec, "mdp-counting")
        return np.zeros((states, actions, states)), -1

    def start(self, state: tuple[FloatArray, int], y: FloatArray) -> tuple[FloatArray, int]:
        """Return the state at the first output of a record."""
        return state[0], int(y[0])

    def predict(self, state: tuple[FloatArray, int], u: FloatArray) -> FloatArray:
        """Return the most frequent next state (1,); the present one for a pair that was never seen."""
        counts, now = state
        row = counts[now, int(u[0]) if len(u) else 0]
        return np.array([float(np.argmax(row)) if row.any() else float(now)])

    def update(self, state: tuple[FloatArray, int], u: FloatArray, y: FloatArray) -> tuple[FloatArray, int]:
        """Return the counts with one transition more."""
        counts, now = state
        new = counts.copy()
        new[now, int(u[0]) if len(u) else 0, int(y[0])] += 1
        return new, int(y[0])

    def hindsight(self, trajectories: Sequence[Trajectory]) -> Hindsight:
        """Return the losses of the best fixed table of answers: the majority of each pair."""
        best = np.argmax(count_transitions(trajectories), axis=2)
        losses = [(best[s, a] != later).astype(float) for s, a, later in map(_transitions, trajectories)]
        growth = Growth("bounded", None, "each pair has one likeliest next state (de Rooij et al. 2014, JMLR 15:1281)")
        return Hindsight(np.concatenate(losses), exact=True, growth=growth)

    def forecast(self, state: tuple[FloatArray, int], u: FloatArray) -> Categories:
        """Return the probabilities of the next state: counts plus a half for each state.

        The half is the estimator of Krichevsky and Trofimov (1981, *IEEE Trans. Inf. Theory* 27, 199-207), whose
        regret in log loss grows as (S - 1)/2 ln n for each pair (s, a), which is the least possible.
        """
        counts, now = state
        weights = counts[now, int(u[0]) if len(u) else 0] + 0.5
        return Categories((weights / weights.sum(),))

    def log_hindsight(self, trajectories: Sequence[Trajectory]) -> Hindsight:
        """Return the log losses of the best fixed table of probabilities: the frequencies of each pair."""
        counts = count_transitions(trajectories)
        share = counts / np.maximum(counts.sum(axis=2, keepdims=True), 1.0)
        losses = [-np.log(share[s, a, later]) for s, a, later in map(_transitions, trajectories)]
        return Hindsight(np.concatenate(losses), exact=True)


def _transitions(record: Trajectory) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return states, actions and next states of a record."""
    s = record.y[:, 0].astype(np.int64)
    a = record.u[:, 0].astype(np.int64) if record.spec.nu else np.zeros(len(record), dtype=np.int64)
    return s[:-1], a[:-1], s[1:]


def moved_beliefs(x: FloatArray, u: FloatArray, transition: FloatArray) -> FloatArray:
    """Return distributions (..., S) of the state one step later, under actions (..., 1); ``transition`` is (S, A, S).

    One product for each action: a matrix for each row would not fit into memory.
    """
    x = np.asarray(x, dtype=float)
    if transition.shape[1] == 1:
        return np.asarray(x @ transition[:, 0])
    action = np.broadcast_to(np.asarray(u)[..., 0], x.shape[:-1]).astype(np.int64)
    new = np.empty_like(x)
    for a in range(transition.shape[1]):
        chosen = action == a
        new[chosen] = x[chosen] @ transition[:, a]
    return new


def finite_sizes(spec: PlantSpec, what: str) -> tuple[int, int]:
    """Return the numbers of outputs (or states) and actions, or refuse signals that are no categories."""
    kinds = [channel.kind for channel in (*spec.inputs, *spec.outputs)]
    if spec.ny != 1 or spec.nu > 1 or any(kind != "category" for kind in kinds):
        inputs, outputs = ([one.name for one in side if one.kind == "category"] for side in (spec.inputs, spec.outputs))
        chosen = " ".join([*(f"--input {name}" for name in inputs[:1]), *(f"--output {name}" for name in outputs[:1])])
        raise FitError(
            f"{what} needs a finite process",
            expected="one category output and at most one category input",
            got=str(spec),
            remedy=f"choose the signals that it is of, such as {chosen}" if outputs else SAY_CATEGORIES,
        )
    try:
        return spec.outputs[0].categories, spec.inputs[0].categories if spec.nu else 1
    except InputError as error:
        raise FitError(error.what, expected=error.expected, got=error.got, remedy=error.remedy) from error
