"""Scores of predicted distributions: log score, calibration, and regret in log loss.

The log score is the mean log density (or probability) that a model gave to what then happened: strictly proper, so
that no model gains by saying other than what it believes (Gneiting and Raftery 2007, *J. Am. Stat. Assoc.* 102, sec.
3 and 4). Calibration compares how often something happened with how often the model said that it would.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harness.errors import FitError, InputError
from harness.models.distributions import Categories, normal
from harness.protocols import Distribution, Model, OnlineIdentifier, OnlinePredictive, Predictive
from harness.scoring.prediction import states_ahead
from harness.scoring.regret import Regret
from harness.signals import FloatArray, PlantSpec, Trajectory

LEVELS = (0.5, 0.8, 0.9, 0.95)
"""Probabilities whose sets are checked: half, the usual three, and no further, because a record of a few hundred
samples holds only a few outside 99 %."""

_FIRST = 50  # Samples from which the initial state is estimated, as for the equation error.


@dataclass(frozen=True, eq=False)
class ProbabilityScore:
    """How good predicted distributions are."""

    log_score: FloatArray
    """(ny,): Mean log density (real outputs; it depends on the unit) or log probability (categories), in nats. -inf if
    something happened that the model had called impossible."""
    skill: FloatArray
    """(ny,): ``log_score`` minus that of the record's own marginal distribution (a normal one, or its frequencies),
    which knows nothing but the record's spread; more than 0 is worth something."""
    levels: FloatArray  # (L,)
    coverage: FloatArray  # (L, ny): Share of the samples in the sets that should hold ``levels`` of them
    horizon: int  # Steps ahead
    # Samples left out at the start, and scored
    burn_in: int
    samples: int
    impossible: int  # Outcomes that the model had given the probability 0

    def __str__(self) -> str:
        shares = ", ".join(
            f"{100 * level:g} % holds {100 * float(np.mean(row)):.1f} %"
            for level, row in zip(self.levels, self.coverage, strict=True)
        )
        scores = ", ".join(f"{value:.4g}" for value in self.log_score)
        return f"log score {scores} nats; {shares} ({self.samples} samples)"


@dataclass(frozen=True, eq=False)
class Reliability:
    """A reliability diagram: of all events forecast with about the same probability, the share that happened."""

    # (B,): Mean probability of the events of each bin, and the share of them that happened
    forecast: FloatArray
    happened: FloatArray
    count: FloatArray  # (B,): Events of each bin; empty bins are left out

    @property
    def calibration_error(self) -> float:
        """Mean distance between forecast and share, weighted by the number of events."""
        return float(np.sum(self.count * np.abs(self.forecast - self.happened)) / np.sum(self.count))


def forecast(model: Model, data: Trajectory, horizon: int = 1, *, initial_samples: int | None = None) -> Distribution:
    """Return the predicted distributions of the samples ``horizon .. N - 1`` of a record.

    Parameters
    ----------
    model : Model
        One that is :class:`harness.protocols.Predictive`.
    data : Trajectory
    horizon : int
        Steps ahead.
    initial_samples : int, optional
        As for :func:`harness.scoring.predict`.

    Raises
    ------
    InputError
        If the model predicts no distributions, or does not fit the data.
    """
    if not isinstance(model, Predictive):
        raise InputError(
            f"a model of class {type(model).__name__} predicts no distributions",
            expected="a model with predictive(x, u), such as those of mdp-counting, hidden-markov, gaussian-process",
            got="output(x, u) only",
            remedy="score it by equation error and simulation error, or use another identifier",
        )
    states = states_ahead(model, data, horizon, initial_samples=initial_samples)
    return model.predictive(states, data.u[horizon:])


def probability_score(
    model: Model,
    data: Trajectory,
    *,
    horizon: int = 1,
    burn_in: int | None = None,
    levels: Sequence[float] = LEVELS,
) -> ProbabilityScore:
    """Score the predicted distributions of a record.

    Parameters
    ----------
    model : Model
        One that is :class:`harness.protocols.Predictive`.
    data : Trajectory
        Held out from the fit.
    horizon : int
        Steps ahead.
    burn_in : int, optional
        Samples not scored; by default what the model declares, and at least ``horizon``.
    levels : sequence of float
        Probabilities of the sets whose coverage is counted.

    Raises
    ------
    InputError
        If the model predicts no distributions, or the record is too short.

    Examples
    --------
    >>> from identifiers.finite.mdp import MdpModel
    >>> from harness.signals import Channel
    >>> spec = PlantSpec((), (Channel("coin", kind="category", minimum=0, maximum=1),), 1.0)
    >>> model = MdpModel(spec, np.full((2, 1, 2), 0.5), np.ones((2, 1)))
    >>> data = Trajectory(np.arange(6.0), np.zeros((6, 0)), np.array([[0.0, 1, 1, 0, 1, 0]]).T, spec)
    >>> probability_score(model, data).log_score.round(4).tolist()
    [-0.6931]
    """
    if any(not 0 < level < 1 for level in levels):
        raise InputError("levels", expected="probabilities between 0 and 1", got=str(tuple(levels)), remedy="correct")
    skip = max(horizon, model.burn_in if burn_in is None else burn_in)
    if len(data) <= skip:
        raise InputError(
            "record too short to be scored",
            expected=f"more than {skip} samples (horizon and burn-in)",
            got=str(len(data)),
            remedy="score a longer record",
        )
    predicted = forecast(model, data, horizon, initial_samples=_FIRST)
    y, kept = data.y[horizon:], slice(skip - horizon, None)
    scores = predicted.log_score(y)[kept]
    covered = np.array([predicted.covered(y, level)[kept].mean(axis=0) for level in levels])
    total = scores.mean(axis=0)
    reference = _marginal(data.spec, data.y[skip:]).log_score(data.y[skip:]).mean(axis=0)
    with np.errstate(invalid="ignore"):
        skill = total - reference
    return ProbabilityScore(
        total, skill, np.array(levels), covered, horizon, skip, len(scores), int(np.isneginf(scores).sum())
    )


def reliability(model: Model, data: Trajectory, *, horizon: int = 1, bins: int = 10) -> Reliability:
    """Return the reliability diagram of a model of categories: every category of every sample is one event.

    Parameters
    ----------
    model, data, horizon
        As for :func:`probability_score`.
    bins : int
        Of equal width in the forecast probability.

    Raises
    ------
    InputError
        If the outputs are not all categories.
    """
    predicted = forecast(model, data, horizon, initial_samples=_FIRST)
    if not isinstance(predicted, Categories):
        raise InputError(
            "reliability diagram",
            expected="category outputs",
            got=str(data.spec),
            remedy="for real outputs read the coverage of probability_score",
        )
    skip = max(0, model.burn_in - horizon)
    chances, events = [], []
    for column, table in enumerate(predicted.tables):
        chances.append(table[skip:].ravel())
        named = data.y[horizon + skip :, column].astype(np.intp)
        events.append((np.arange(table.shape[-1]) == named[:, None]).astype(float).ravel())
    chance, event = np.concatenate(chances), np.concatenate(events)
    which = np.minimum((chance * bins).astype(np.intp), bins - 1)
    count = np.bincount(which, minlength=bins).astype(float)
    full = count > 0
    said = np.bincount(which, weights=chance, minlength=bins)[full] / count[full]
    came = np.bincount(which, weights=event, minlength=bins)[full] / count[full]
    return Reliability(said, came, count[full])


def log_regret(online: OnlineIdentifier, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> Regret:
    """Run an online identifier over records and compare its log loss with that of the best fixed distributions.

    The loss is minus the log score summed over the outputs.

    Parameters
    ----------
    online : OnlineIdentifier
        One that is :class:`harness.protocols.OnlinePredictive`.
    trajectories : sequence of Trajectory
        The stream; the identifier is told of each seam.
    rng : numpy.random.Generator

    Raises
    ------
    InputError
        If the identifier predicts no distributions.
    FitError
        If there is nothing to predict, or the hindsight losses do not belong to the same samples.
    """
    if not isinstance(online, OnlinePredictive):
        raise InputError(
            f"{type(online).__name__} predicts no distributions",
            expected="an online identifier with forecast() and log_hindsight()",
            got="predict() only",
            remedy="score it by regret",
        )
    if not trajectories or all(len(one) < 2 for one in trajectories):
        raise FitError("an empty stream", expected="at least 2 samples", got="fewer", remedy="record more")
    state = online.init(trajectories[0].spec, rng=rng)
    losses: list[float] = []
    for record in trajectories:
        state = online.start(state, record.y[0])
        for k in range(len(record) - 1):
            losses.append(-float(np.sum(online.forecast(state, record.u[k]).log_score(record.y[k + 1]))))
            state = online.update(state, record.u[k], record.y[k + 1])
    best = online.log_hindsight(trajectories)
    own = np.array(losses)
    if best.losses.shape != own.shape:
        raise FitError(
            "log hindsight of the online identifier",
            expected=f"one loss for each predicted sample, shape {own.shape}",
            got=str(best.losses.shape),
            remedy="let log_hindsight() predict the same samples, y[1:] of every record",
        )
    return Regret(own, np.asarray(best.losses, dtype=float), best.exact)


def _marginal(spec: PlantSpec, y: FloatArray) -> Distribution:
    """Return the distribution of a record that forgets the order of its samples."""
    if all(channel.kind == "category" for channel in spec.outputs):
        tables = []
        for column, channel in enumerate(spec.outputs):
            share = np.bincount(y[:, column].astype(np.intp), minlength=channel.categories) / len(y)
            tables.append(np.broadcast_to(share, (len(y), share.size)))
        return Categories(tuple(tables))
    std = np.maximum(y.std(axis=0), np.finfo(float).tiny)
    return normal(np.broadcast_to(y.mean(axis=0), y.shape), std, spec.outputs)
