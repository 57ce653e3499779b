"""Hidden Markov models and POMDPs with actions: Baum-Welch from several starts, a spectral estimator, the order."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal

import numpy as np
import numpy.typing as npt

from harness.errors import FitError
from harness.models.distributions import Categories
from harness.options import check_options
from harness.scoring import same_language
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.common.described import Described
from identifiers.common.records import usable
from identifiers.finite.hmm_errors import probability_errors
from identifiers.finite.hmm_pass import Record, expected_counts, filtered_beliefs
from identifiers.finite.mdp import finite_sizes, moved_beliefs

_MOST_STATES = 12  # Where the number of states is asked of the data, more are not tried.

_SHORT = 20
"""Iterations of every start before the best ones go on: by then the likelihoods of good and bad starts differ."""

_KEPT = 2  # Starts that go on.
SHOWN, LIKELY = 8, 0.1  # Hidden states that are described, and the least probability of an observation that is named.
POORLY = 0.075  # Standard error from which a probability counts as not known: a 95 % interval wider than 0.3.


@dataclass(frozen=True, eq=False)
class HmmModel(Described):
    """A partially observed finite process; the state of the model is the belief, the distribution over hidden states.

    Parameters
    ----------
    spec : PlantSpec
        One category output (the observation), one category input (the action) or none.
    initial : array (S,)
        Distribution of the first hidden state.
    transition : array (S, A, S)
        ``transition[s, a, s']``.
    emission : array (S, O)
        ``emission[s, o]``.
    transition_error, emission_error : array, optional
        Standard errors of both tables (:func:`identifiers.finite.hmm_errors.probability_errors`).
    """

    spec: PlantSpec
    initial: FloatArray
    transition: FloatArray
    emission: FloatArray
    kind = "hidden-markov"
    burn_in: ClassVar[int] = 0
    notes: dict[str, Any] = field(default_factory=dict)
    transition_error: FloatArray | None = None
    emission_error: FloatArray | None = None

    @property
    def findings(self) -> tuple[str, ...]:
        """How many hidden states, by what criterion, and what each of them shows most."""
        count = len(self.initial)
        tried = ", ".join(f"{states}: {value:.1f}" for states, value in self.notes.get("criterion", ()))
        said = [f"{count} hidden state{'s' if count > 1 else ''}" + (f", by half the BIC ({tried})" if tried else "")]
        for number, row in enumerate(self.emission[:SHOWN]):
            most = [o for o in np.argsort(-row, kind="stable") if row[o] >= LIKELY]
            stays = ", ".join(f"{p:.2f}" for p in self.transition[number, :, number])
            shows = ", ".join(f"{o} ({row[o]:.2f})" for o in most)
            said.append(f"state {number} shows {shows}; stays with {stays}" + (" by action" if self.spec.nu else ""))
        if never := int(np.sum(self.emission.max(axis=0) == 0)):
            said.append(f"{never} of {self.emission.shape[1]} observations never occurred: they count as impossible")
        if self.transition_error is not None and self.emission_error is not None:
            worst = self.transition_error.max(), self.emission_error.max()
            said.append("standard errors: at most {:.2g} of a transition, {:.2g} of an observation".format(*worst))
        return tuple(said)

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the distribution (S,) of the first hidden state, before any observation."""
        same_language(self.spec, data)
        return np.array(self.initial)

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the most probable observation (..., 1)."""
        best: FloatArray = np.argmax(np.asarray(x) @ self.emission, axis=-1)[..., None].astype(float)
        return best

    def predictive(self, x: FloatArray, u: FloatArray) -> Categories:
        """Return the distribution of the observation."""
        return Categories((np.asarray(x, dtype=float) @ self.emission,))

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the belief (..., S) one step later."""
        return moved_beliefs(x, u, self.transition)

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the belief (..., S) after an observation (Bayes); as it was if the observation was impossible."""
        x = np.asarray(x, dtype=float)
        seen = np.broadcast_to(np.asarray(y)[..., 0], x.shape[:-1]).astype(np.int64)
        joint = x * self.emission.T[seen]
        total = joint.sum(axis=-1, keepdims=True)
        return np.asarray(np.where(total > 0, joint / np.where(total > 0, total, 1.0), x))

    def log_likelihood(self, trajectories: Sequence[Trajectory]) -> float:
        """Return the log likelihood of records, in nats."""
        tables = (self.initial, self.transition, self.emission)
        return float(sum(filtered_beliefs(_record(record), *tables)[1] for record in trajectories))

    def beliefs(self, data: Trajectory) -> FloatArray:
        """Return the beliefs (N, S) after each observation."""
        same_language(self.spec, data)
        return filtered_beliefs(_record(data), self.initial, self.transition, self.emission)[0]

    def relabelled(self, order: npt.ArrayLike) -> HmmModel:
        """Return the same model with its hidden states in another order."""
        index = np.asarray(order, dtype=np.intp)
        moved, seen = self.transition_error, self.emission_error
        return HmmModel(
            self.spec,
            self.initial[index],
            self.transition[index][:, :, index],
            self.emission[index],
            self.notes,
            None if moved is None else moved[index][:, :, index],
            None if seen is None else seen[index],
        )

    def matched(self, emission: FloatArray) -> HmmModel:
        """Return the model with its states in the order in which the emissions are closest to a table (S, O)."""
        from scipy.optimize import linear_sum_assignment

        cost = np.abs(np.asarray(emission)[:, None] - self.emission[None]).sum(axis=2)
        return self.relabelled(linear_sum_assignment(cost)[1])


@dataclass(frozen=True)
class HiddenMarkov:
    """Hidden Markov model, or POMDP where there are actions, of one category output.

    Parameters
    ----------
    states : int, optional
        Hidden states. Without it 1, 2, 3, ... are tried as long as the Bayesian information criterion falls.
    method : {"em", "spectral"}
        Baum-Welch (maximum likelihood, Rabiner 1989, sec. III C), or moments of three successive observations
        (:func:`spectral_estimate`), which have no local optima and need more data. Baum-Welch takes the moments as one
        of its starts where they can be had.
    starts : int
        Random starts of Baum-Welch.
    prior : float
        Pseudo-counts for every transition and observation; 0 is maximum likelihood.
    iterations : int
        At most, after the short runs that choose between starts.
    tolerance : float
        Baum-Welch ends when a sample gains less log likelihood than this.

    Examples
    --------
    >>> from harness.registry import create
    >>> from harness.rng import Streams
    >>> from harness.rollout import run
    >>> plant = create("plants", "finite-pomdp", transition=[[[0.9, 0.1]], [[0.2, 0.8]]], observation=[[1, 0], [0, 1]])
    >>> data = run(plant, create("scenarios", "random-policy", samples=500), streams=Streams("p", "s", 0))
    >>> model = HiddenMarkov(states=2).fit([data], rng=np.random.default_rng(0))
    >>> bool(np.abs(model.transition[:, 0] - [[0.9, 0.1], [0.2, 0.8]]).max() < 0.1)
    True
    """

    states: int | None = None
    method: Literal["em", "spectral"] = "em"
    starts: int = 8
    prior: float = 0.0
    iterations: int = 500
    tolerance: float = 1e-7

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> HmmModel:
        """Return the model; its log likelihood after every iteration stands in its notes."""
        what = "hidden-markov"
        check_options(self, what, states=">= 1")
        given, spec = usable(trajectories, samples=4, what=what, holes="kept")
        observations, actions = finite_sizes(spec, "hidden-markov")
        records = [_record(record) for record in given]
        samples = sum(len(seen) for seen, _ in records)
        if self.states is not None:
            return self._judged(self._fitted(records, spec, self.states, actions, observations, rng), records)
        best, table = None, []
        least = np.inf
        for states in range(1, _MOST_STATES + 1):
            try:
                model = self._fitted(records, spec, states, actions, observations, rng)
            except FitError:
                if best is None:
                    raise
                break
            free = (states - 1) + states * actions * (states - 1) + states * (observations - 1)
            criterion = 0.5 * free * np.log(samples) - model.notes["log_likelihood"][-1]
            table.append([states, float(criterion)])
            if criterion >= least:
                break
            best, least = model, criterion
        if best is None:  # pragma: no cover - the first order is finite or refused above
            raise FitError(what, expected="a finite criterion", got="none", remedy="give option states")
        best.notes["criterion"] = table
        return self._judged(best, records)

    def _judged(self, model: HmmModel, records: list[Record]) -> HmmModel:
        """Return a model of maximum likelihood with its standard errors, and a warning where they are large."""
        if self.method != "em":
            return model
        tables = (model.initial, model.transition, model.emission)
        moves, shows = probability_errors(records, *tables, prior=self.prior)
        poor = int((moves > POORLY).sum() + (shows > POORLY).sum())
        notes = dict(model.notes)
        if poor:
            notes["warning"] = (
                f"{poor} of {moves.size + shows.size} probabilities are known no better than within {2 * POORLY:.2g} "
                f"(95 %; at worst within {2 * max(moves.max(), shows.max()):.2g}): the records are too short for "
                f"{len(model.initial)} hidden states (record longer, or ask for fewer states)"
            )
        return replace(model, notes=notes, transition_error=moves, emission_error=shows)

    def _fitted(
        self,
        records: list[Record],
        spec: PlantSpec,
        states: int,
        actions: int,
        observations: int,
        rng: np.random.Generator,
    ) -> HmmModel:
        """Return the model of one order."""
        if self.method == "spectral":
            tables = spectral_estimate(records, states, actions, observations)
            trace = [expected_counts(records, *(np.maximum(table, 1e-12) for table in tables)).log_likelihood]
        else:
            tables, trace = self._baum_welch(records, states, actions, observations, rng)
        occupied = expected_counts(records, *(np.maximum(table, 1e-300) for table in tables)).emission.sum(axis=1)
        if len(records) < states:  # the first states of so few records say nothing of the next record's
            tables = (occupied / occupied.sum(), *tables[1:])
        model = HmmModel(spec, *tables, notes={"log_likelihood": trace, "method": self.method, "states": states})
        return model.relabelled(np.argsort(tables[2] @ np.arange(observations), kind="stable"))

    def _baum_welch(
        self, records: list[Record], states: int, actions: int, observations: int, rng: np.random.Generator
    ) -> tuple[tuple[FloatArray, FloatArray, FloatArray], list[float]]:
        """Return the tables of the likeliest start and the objective after each of its iterations."""
        starts = [_random_start(states, actions, observations, rng) for _ in range(max(1, self.starts))]
        with suppress(FitError):  # fewer observations than states, or too few samples: the random starts do
            initial, transition, emission = spectral_estimate(records, states, actions, observations)
            starts.append((_lifted(initial), _lifted(transition), _lifted(emission)))
        short = [self._iterated(records, start, _SHORT) for start in starts]
        short.sort(key=lambda result: -result[1][-1])
        whole = []
        for tables, trace in short[:_KEPT]:
            further, continued = self._iterated(records, tables, self.iterations)
            whole.append((further, trace + continued))
        return max(whole, key=lambda result: result[1][-1])

    def _iterated(
        self, records: list[Record], tables: tuple[FloatArray, FloatArray, FloatArray], iterations: int
    ) -> tuple[tuple[FloatArray, FloatArray, FloatArray], list[float]]:
        """Return the tables after some iterations, and the objective at the tables before each and at the last."""
        samples = sum(len(seen) for seen, _ in records)
        trace: list[float] = []
        for number in range(iterations + 1):
            counts = expected_counts(records, *tables)
            objective = counts.log_likelihood
            if self.prior:
                with np.errstate(divide="ignore"):
                    objective += self.prior * float(np.log(tables[1]).sum() + np.log(tables[2]).sum())
            trace.append(objective)
            settled = len(trace) > 1 and trace[-1] - trace[-2] < self.tolerance * samples
            if number == iterations or settled:
                break
            tables = (
                _normalised(counts.first, tables[0]),
                _normalised(counts.transition + self.prior, tables[1]),
                _normalised(counts.emission + self.prior, tables[2]),
            )
        return tables, trace


def spectral_estimate(
    records: Sequence[Record], states: int, actions: int, observations: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return initial (S,), transition (S, A, S) and emission (S, O) from moments of three successive observations.

    The middle one of three observations, weighted by a direction of the third, is diagonal in the hidden states
    (Anandkumar, Hsu and Kakade 2012, *COLT*, algorithm B); so the emissions come from an eigenproblem, and with them
    the transitions of every action by least squares from pairs of observations. Needs emissions of full rank, so no
    more states than observations, and actions that do not depend on what was observed. Raises FitError if there are
    more states than observations, or the pairs of observations have a lower rank.
    """
    if states > observations:
        raise FitError(
            "spectral method",
            expected=f"at most {observations} hidden states, as many as observations",
            got=str(states),
            remedy="use method em, or fewer states",
        )
    triple = np.zeros((observations,) * 3)
    pairs = np.zeros((actions, observations, observations))
    for seen, action in records:
        np.add.at(triple, (seen[:-2], seen[1:-1], seen[2:]), 1.0)
        np.add.at(pairs, (action[:-1], seen[:-1], seen[1:]), 1.0)
    return _from_moments(triple / max(triple.sum(), 1.0), pairs, states)


def _from_moments(triple: FloatArray, pairs: FloatArray, states: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the tables from the joint of three observations (O, O, O) and counts of pairs by action (A, O, O)."""
    actions, observations = pairs.shape[:2]
    p13, p12 = triple.sum(axis=1), triple.sum(axis=2)
    left, size, right = np.linalg.svd(p13)
    if size[states - 1] < 1e-8 * size[0]:
        raise FitError(
            "spectral method",
            expected=f"{states} hidden states that leave a trace in pairs of observations",
            got=f"rank {int(np.sum(size > 1e-8 * size[0]))}",
            remedy="use fewer states, record longer, or use method em",
        )
    u1, u3 = left[:, :states], right[:states].T
    inverse = np.linalg.inv(u1.T @ p13 @ u3)
    # Each row o of `operators` is similar to diag(O[:, o]); mixed with random weights the eigenvalues are apart.
    operators = np.einsum("ai,aob,bj->oij", u1, triple, u3) @ inverse
    best: tuple[float, FloatArray] | None = None
    for attempt in range(8):
        weights = np.random.default_rng(attempt).normal(size=observations)
        values, vectors = np.linalg.eig(np.einsum("o,oij->ij", weights, operators))
        apart = float(np.abs(values[:, None] - values[None] + np.eye(states) * 1e9).min()) if states > 1 else 1.0
        if best is None or apart > best[0]:
            diagonal = np.einsum("si,oij,js->so", np.linalg.pinv(vectors), operators, vectors)
            best = (apart, np.real(diagonal))
    assert best is not None
    emission = _normalised(np.maximum(best[1], 0.0), np.ones((states, observations)))
    inverse_emission = np.linalg.pinv(emission)
    occupied = _normalised(np.maximum(p12.sum(axis=1) @ inverse_emission, 0.0), np.ones(states))
    transition = np.empty((states, actions, states))
    for a in range(actions):
        total = pairs[a].sum()
        joint = inverse_emission.T @ (pairs[a] / total) @ inverse_emission if total else np.zeros((states, states))
        transition[:, a] = _normalised(np.maximum(joint, 0.0), np.ones((states, states)))
    return occupied, transition, emission


def _random_start(
    states: int, actions: int, observations: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return drawn tables without zeros, which no iteration could leave."""
    return (
        np.full(states, 1.0 / states),
        0.5 * rng.dirichlet(np.ones(states), size=(states, actions)) + 0.5 / states,
        0.5 * rng.dirichlet(np.ones(observations), size=states) + 0.5 / observations,
    )


def _lifted(table: FloatArray) -> FloatArray:
    """Return distributions without zeros, which no iteration could leave."""
    return np.asarray(0.9 * table + 0.1 / table.shape[-1])


def _normalised(weights: FloatArray, otherwise: FloatArray) -> FloatArray:
    """Return weights whose last axis sums to 1; rows without any weight are those of `otherwise`."""
    total = weights.sum(axis=-1, keepdims=True)
    other = otherwise / otherwise.sum(axis=-1, keepdims=True)
    return np.asarray(np.where(total > 0, weights / np.where(total > 0, total, 1.0), other))


def _record(record: Trajectory) -> Record:
    """Return observations and actions of a record as C integers."""
    seen: npt.NDArray[np.intc] = record.y[:, 0].astype(np.intc)
    return seen, record.u[:, 0].astype(np.intc) if record.spec.nu else np.zeros(len(record), dtype=np.intc)
