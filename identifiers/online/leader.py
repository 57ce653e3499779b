"""Follow the leader: any batch identifier as an online one, refitted as the stream goes on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from harness.errors import FitError, InputError
from harness.models.estimate import estimate_of
from harness.protocols import Growth, Hindsight, Identifier, Model
from harness.signals import FloatArray, PlantSpec, Trajectory, residual
from identifiers.common.named import named, wrong_options
from identifiers.common.records import real_signals

# While a record is shorter than this its initial state is estimated anew at every sample.
_YOUNG = 10


class _Tape:
    """Inputs and outputs of one record, appended in place by the state that knows it to its end."""

    def __init__(self, nu: int, ny: int, capacity: int = 256) -> None:
        self.u: FloatArray = np.zeros((capacity, nu))
        self.y: FloatArray = np.zeros((capacity, ny))
        self.filled = 0

    def with_sample(self, count: int, u: FloatArray, y: FloatArray) -> _Tape:
        """Return a tape with input ``count - 1`` and output ``count`` added; others' samples are left alone."""
        tape = self
        if count != self.filled or count == len(self.y):
            tape = _Tape(self.u.shape[1], self.y.shape[1], max(256, 2 * count))
            tape.u[:count], tape.y[:count] = self.u[:count], self.y[:count]
        if count:
            tape.u[count - 1] = u
        tape.y[count] = y
        tape.filled = count + 1
        return tape


@dataclass(frozen=True, eq=False)
class LeaderState:
    """What follow-the-leader knows: the records so far, the present model and its state at the last output."""

    spec: PlantSpec
    seed: int
    tapes: tuple[tuple[_Tape, int], ...]
    learned: int
    following: int
    fits: int
    model: Model | None
    x: FloatArray | None


@dataclass(frozen=True)
class FollowTheLeader:
    """Turn any batch identifier into an online one: predict with the model that fits the stream so far best.

    Parameters
    ----------
    identifier : str or Identifier
        Id of a registered identifier, or one made already.
    options : mapping
        Options of it, if it is given by id.
    burn_in : int
        Predicted samples before the first fit; until then the last output is held, by this and by the model in
        hindsight.
    growth : float
        The model is fitted anew whenever the stream has grown by this factor; 1 refits at every sample, which is follow
        the leader to the letter (Cesa-Bianchi & Lugosi 2006, sec. 3.2).

    Examples
    --------
    >>> from harness.signals import Channel
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> online = FollowTheLeader("arx", {"order": 1}, burn_in=10)
    >>> state = online.start(online.init(spec, rng=np.random.default_rng(0)), np.zeros(1))
    >>> y, rng = 0.0, np.random.default_rng(0)
    >>> for u in rng.normal(size=30):
    ...     y = 0.5 * y + 2.0 * u
    ...     state = online.update(state, np.array([u]), np.array([y]))
    >>> bool(abs(online.predict(state, np.ones(1))[0] - (0.5 * y + 2.0)) < 1e-6)
    True
    """

    identifier: str | Identifier = "arx"
    options: Mapping[str, Any] = field(default_factory=lambda: {"order": 2, "ridge": 1e-12})
    burn_in: int = 40
    growth: float = 1.1

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> Model:
        """Return the leader after all records, refitted to its last sample: the model of the batch identifier."""
        return self._made().fit(trajectories, rng=rng)

    def init(self, spec: PlantSpec, *, rng: np.random.Generator) -> LeaderState:
        """Return the state before any data."""
        if self.burn_in < 1 or not self.growth >= 1.0:
            raise wrong_options(self, "follow-the-leader", "burn_in >= 1, growth >= 1", "burn_in growth")
        real_signals(spec, "follow-the-leader")
        self._made()
        return LeaderState(spec, int(rng.integers(2**31)), (), 0, self.burn_in, 0, None, None)

    def start(self, state: LeaderState, y: FloatArray) -> LeaderState:
        """Return the state after the first output of a record."""
        tape = _Tape(state.spec.nu, state.spec.ny).with_sample(0, np.zeros(state.spec.nu), np.asarray(y, dtype=float))
        started = replace(state, tapes=(*state.tapes, (tape, 1)))
        return replace(started, x=None if state.model is None else _located(state.model, _record(started)))

    def predict(self, state: LeaderState, u: FloatArray) -> FloatArray:
        """Return the output (ny,) that ``u`` leads to."""
        tape, count = state.tapes[-1]
        held: FloatArray = tape.y[count - 1].copy()
        if state.model is None or state.x is None:
            return held
        return _next(state.model, state.x, np.asarray(u, dtype=float), held)[1]

    def update(self, state: LeaderState, u: FloatArray, y: FloatArray) -> LeaderState:
        """Return the state after ``u`` led to ``y``; the model is fitted anew where the stream has grown enough."""
        u, y = np.asarray(u, dtype=float), np.asarray(y, dtype=float)
        tape, count = state.tapes[-1]
        x = None
        if state.model is not None and state.x is not None:
            x = _next(state.model, state.x, u, tape.y[count - 1])[0]
        tapes = (*state.tapes[:-1], (tape.with_sample(count, u, y), count + 1))
        new = replace(state, tapes=tapes, learned=state.learned + 1, x=x)
        if new.learned >= new.following:
            following = max(new.learned + 1, int(np.ceil(new.learned * self.growth)))
            new = replace(new, following=following, fits=new.fits + 1)
            try:
                model = self._made().fit(_records(new), rng=np.random.default_rng([new.seed, new.fits]))
            except FitError:
                return self._placed(new)
            return replace(new, model=model, x=_located(model, _record(new)))
        return self._placed(new)

    def hindsight(self, trajectories: Sequence[Trajectory]) -> Hindsight:
        """Return the losses of the model fitted to the whole stream, predicting as the online one does.

        ``exact`` is False: it minimises the identifier's own criterion, which need not be the one-step loss.
        """
        spec = trajectories[0].spec
        model = self._made().fit(list(trajectories), rng=np.random.default_rng(0))
        losses, waited = [], 0
        for record in trajectories:
            x: FloatArray | None = _located(model, record[:1])
            guesses = record.y[:-1].copy()
            for k in range(len(record) - 1):
                if x is not None:
                    x, guess = _next(model, x, record.u[k], record.y[k])
                    if waited >= self.burn_in:
                        guesses[k] = guess
                if x is None or k + 2 <= _YOUNG:
                    x = _located(model, record[: k + 2])
                waited += 1
            losses.append(residual(spec.outputs, record.y[1:], guesses) ** 2)
        each = np.concatenate(losses)
        details = {"burn_in": self.burn_in, "growth": self.growth, "prior": "none"}
        return Hindsight(each.sum(axis=1), exact=False, details=details, per_output=each, growth=self._rate(model))

    def _rate(self, model: Model) -> Growth | None:
        """Return how regret grows where the model has a fixed number of parameters; a fit that waits is older."""
        estimate = estimate_of(model)
        if estimate is None:  # a linear model without one has a fixed number of them all the same
            return replace(Growth.of_least_squares(1.0), factor=None) if hasattr(model, "a_matrix") else None
        waited = (self.growth - 1.0) / np.log(self.growth) if self.growth > 1.0 else 1.0
        return Growth.of_least_squares(waited * len(estimate.names) / model.spec.ny)

    def _placed(self, state: LeaderState) -> LeaderState:
        """Return the state with the model's own state estimated anew while the record is young."""
        if state.model is None or (state.x is not None and state.tapes[-1][1] > _YOUNG):
            return state
        return replace(state, x=_located(state.model, _record(state)))

    def _made(self) -> Identifier:
        """Return the batch identifier."""
        if not isinstance(self.identifier, str):
            return self.identifier
        made = named("identifiers", self.identifier, self.options)
        if hasattr(made, "hindsight"):
            raise InputError(
                "identifier of follow-the-leader",
                expected="one that fits whole records",
                got=f"{self.identifier}, which is online itself",
                remedy="use it directly",
            )
        return made  # type: ignore[no-any-return]


def _next(model: Model, x: FloatArray, u: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the state before the next output is seen, and that output; of a model that diverged the output held.

    The input of the next sample is not known: a direct term answers to the present one.
    """
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        new = model.step(model.correct(x, u, y), u)
        guess = np.asarray(model.output(new, u), dtype=float)
    return new, guess if np.isfinite(guess).all() else np.array(y)


def _located(model: Model, record: Trajectory) -> FloatArray | None:
    """Return the state at the last output of a record, that output not yet seen by the filter."""
    few = record[: min(len(record), 50)]
    x = np.asarray(model.initial_state(few), dtype=float)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for k in range(len(record) - 1):
            x = model.step(model.correct(x, record.u[k], record.y[k]), record.u[k])
    return x if np.isfinite(x).all() else None


def _record(state: LeaderState) -> Trajectory:
    """Return the present record; its last input is not known yet and counts as held."""
    return _made_record(state, *state.tapes[-1])


def _records(state: LeaderState) -> list[Trajectory]:
    """Return all records so far."""
    return [_made_record(state, tape, count) for tape, count in state.tapes]


def _made_record(state: LeaderState, tape: _Tape, count: int) -> Trajectory:
    u: FloatArray = tape.u[:count].copy()
    if count > 1:
        u[-1] = u[-2]
    else:
        u[-1] = 0.0
    t: FloatArray = np.arange(count, dtype=np.float64) * state.spec.sample_time
    return Trajectory(t, u, tape.y[:count], state.spec)
