"""The contracts: what a plant, a model, an identifier and a scenario are. Structural: nothing to inherit.

The abilities beyond the minimum (:class:`Snapshots`, :class:`Feedthrough`, :class:`Batch`, :class:`Truth`,
:class:`BatchTruth`) are declared in ``Plant.abilities`` and proved by :mod:`harness.conformance`; nothing is
ever guessed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, Self, runtime_checkable

import numpy as np

from harness.rng import Streams
from harness.signals import FloatArray, PlantSpec, Trajectory

Ability = Literal["snapshots", "feedthrough", "batch", "truth", "batch-truth"]


@runtime_checkable
class Plant(Protocol):
    """Something that steps: inputs held for one sample time go in, sampled outputs come out.

    ``reset`` starts at time 0 and returns ``y[0]``; ``step(u)`` holds ``u`` for one sample time and returns the next
    output. Arrays are float64 of shape (nu,) and (ny,). An input of another shape, or not finite, is refused by
    :class:`harness.errors.InputError`; a plant that breaks, diverges or is closed raises
    :class:`harness.errors.PlantError` with a status. ``close`` may be called twice.
    """

    @property
    def spec(self) -> PlantSpec:
        """Channels and sample time."""
        ...

    @property
    def abilities(self) -> frozenset[Ability]:
        """The optional abilities that this plant declares."""
        ...

    def reset(self, *, rng: np.random.Generator, x0: Mapping[str, float] | None = None) -> FloatArray:
        """Start anew; ``x0`` sets named initial states (an unknown name is refused); returns ``y[0]`` (ny,)."""
        ...

    def step(self, u: FloatArray) -> FloatArray:
        """Hold ``u`` (nu,) for one sample time; returns the next output (ny,).

        Raises
        ------
        InputError
            If ``u`` has the wrong shape or is not finite.
        PlantError
            If the motion diverges, or the plant is closed.
        """
        ...

    def close(self) -> None:
        """Release the engine."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *exc: object) -> None: ...


@runtime_checkable
class Snapshots(Protocol):
    """Ability ``"snapshots"``: a state that can be taken and set, so that the continuation repeats bit for bit.

    Where an engine repeats only within a tolerance, the plant carries it as ``snapshot_tolerance`` (absolute, > 0).
    """

    def get_state(self) -> Any:
        """Return a state that stays valid while the plant moves on."""
        ...

    def set_state(self, state: Any) -> None:
        """Go back to a state of this same plant object."""
        ...


@runtime_checkable
class Feedthrough(Protocol):
    """Ability ``"feedthrough"``: ``y[k]`` depends on ``u[k]`` (accelerometer, contact force, D matrix)."""

    def output(self, u: FloatArray) -> FloatArray:
        """Return the output (ny,) with ``u`` applied, while no time passes."""
        ...


@runtime_checkable
class Batch(Protocol):
    """Ability ``"batch"``: many open-loop steps in one call, equal to stepping."""

    def rollout(self, inputs: FloatArray) -> FloatArray:
        """Apply ``inputs`` (N, nu) from the present state; row k of the result (N, ny) is what ``step`` returned."""
        ...


@runtime_checkable
class Truth(Protocol):
    """Ability ``"truth"``: the true states, in the order of ``spec.states``; for scoring only."""

    def truth(self) -> FloatArray:
        """Return the present true state (nx,)."""
        ...


@runtime_checkable
class BatchTruth(Protocol):
    """Ability ``"batch-truth"``: a batch that brings the true states along; needs ``"batch"`` and ``"truth"``."""

    def rollout_truth(self, inputs: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the outputs (N, ny) of ``rollout``, and the true states (N, nx) at the same instants."""
        ...


class Controller(Protocol):
    """A feedback law: a fresh one for each run, so it may keep a state."""

    def __call__(self, t: float, y: FloatArray) -> FloatArray:
        """Return the input (nu,) from the time [s] and the *measured* output (ny,)."""
        ...


def _identity(k: int, y: FloatArray) -> FloatArray:
    """Measure without error."""
    return y


@dataclass(frozen=True, eq=False)
class Experiment:
    """One run, made ready: everything random in it is already drawn.

    Parameters
    ----------
    excitation : array (N, nu)
        Open-loop part of the input; N is the number of samples.
    controller : Controller, optional
        Its output is added to the excitation.
    disturbance : array (N, nu), optional
        Added to the input inside the plant, never recorded (process noise, hidden input).
    measure : callable
        ``measure(k, y) -> y_measured``: sensor noise, quantisation. The controller sees only this.
    x0 : mapping, optional
        Named initial states for the plant.
    """

    excitation: FloatArray
    controller: Controller | None = None
    disturbance: FloatArray | None = None
    measure: Callable[[int, FloatArray], FloatArray] = _identity
    x0: Mapping[str, float] | None = None


@runtime_checkable
class Scenario(Protocol):
    """How a plant is excited and measured."""

    def prepare(self, spec: PlantSpec, *, streams: Streams, role: str) -> Experiment:
        """Return the experiment of one role (``"estimation/0"``, ``"validation/0"``) for a plant of this spec.

        Random numbers come from ``streams(f"{role}/excitation")`` and the like.
        """
        ...


class Model(Protocol):
    """A discrete-time model with a state: what an identifier returns.

    ``output`` and ``step`` are pure and accept leading batch axes: x (..., nx), u (..., nu). Continuous-time models
    offer ``discretize(dt)`` and are refused undiscretized.

    Attributes
    ----------
    burn_in : int
        Samples at the start of a record that the model needs before its predictions count.
    """

    @property
    def spec(self) -> PlantSpec:
        """Channels and sample time; data of another sample time are refused."""
        ...

    @property
    def burn_in(self) -> int:
        """Samples needed before predictions count."""
        ...

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the state (nx,) at ``data.t[0]``, estimated from the record given (which may be a short prefix)."""
        ...

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the output (..., ny) in state x (..., nx) under input u (..., nu)."""
        ...

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next state (..., nx)."""
        ...

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the state (..., nx) after the output y (..., ny) of the same instant was seen."""
        ...

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description with a ``"kind"`` that a ``sysid_harness.model_readers`` entry reads."""
        ...


@runtime_checkable
class FreeRun(Protocol):
    """A model that runs freely faster than step by step, with equal results."""

    def free_run(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the outputs (M, N, ny) from states x (M, nx) under inputs u (M, N, nu)."""
        ...


@runtime_checkable
class Filter(Protocol):
    """A model that filters a record faster than step by step, with equal results."""

    def filtered(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the states (N, nx) from the first, x (nx,), each after its output was seen: u (N, nu), y (N, ny)."""
        ...


@runtime_checkable
class Distribution(Protocol):
    """What a model says of outputs that it has not seen: how likely each value is, output by output.

    :mod:`harness.models.distributions` has the usual ones.
    """

    def log_score(self, y: FloatArray) -> FloatArray:
        """Return the log density (real) or log probability (category) of y (..., ny), in nats (..., ny)."""
        ...

    def covered(self, y: FloatArray, level: float) -> FloatArray:
        """Return whether the set that should hold y with probability ``level`` holds it, 0 to 1 (..., ny)."""
        ...


@runtime_checkable
class Predictive(Protocol):
    """A model that says how sure it is; scored by :mod:`harness.scoring.predictive`."""

    def predictive(self, x: FloatArray, u: FloatArray) -> Distribution:
        """Return the distribution of the measured output (..., ny) in state x (..., nx) under input u (..., nu)."""
        ...


@runtime_checkable
class Identifier(Protocol):
    """Learns a model from records. Options are frozen; ``fit`` changes nothing outside.

    Trajectories are separate records: nothing is differenced or windowed across a seam.
    """

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> Model:
        """Return a model; raises :class:`harness.errors.FitError` if the data cannot give one."""
        ...


@runtime_checkable
class OnlineIdentifier(Protocol):
    """Learns while it predicts; scored by regret on its own stream.

    The prediction of ``y[k+1]`` is made from the state and ``u[k]`` before ``y[k+1]`` is shown.
    """

    def init(self, spec: PlantSpec, *, rng: np.random.Generator) -> Any:
        """Return the state before any data."""
        ...

    def start(self, state: Any, y: FloatArray) -> Any:
        """Return the state after the first output ``y[0]`` (ny,) of a record; called at every seam."""
        ...

    def predict(self, state: Any, u: FloatArray) -> FloatArray:
        """Return the output (ny,) that ``u`` (nu,) leads to."""
        ...

    def update(self, state: Any, u: FloatArray, y: FloatArray) -> Any:
        """Return a new state after ``u`` led to ``y``; the old state stays valid."""
        ...

    def hindsight(self, trajectories: Sequence[Trajectory]) -> Hindsight:
        """Return the best fixed predictor of the same model class and loss on these records."""
        ...


@runtime_checkable
class Tracking(OnlineIdentifier, Protocol):
    """An online identifier that learns from a stretch of a record faster than sample by sample, with equal results."""

    def track(self, state: Any, u: FloatArray, y: FloatArray) -> tuple[FloatArray, Any]:
        """Return predictions (n, ny) and the state after inputs u (n, nu) led to outputs y (n, ny)."""
        ...


@runtime_checkable
class OnlinePredictive(Protocol):
    """An online identifier that predicts distributions; :func:`harness.scoring.predictive.log_regret` scores it."""

    def forecast(self, state: Any, u: FloatArray) -> Distribution:
        """Return the distribution of the output (ny,) that ``u`` (nu,) leads to."""
        ...

    def log_hindsight(self, trajectories: Sequence[Trajectory]) -> Hindsight:
        """Return the log losses of the best fixed distributions of the same model class on these records."""
        ...


@dataclass(frozen=True)
class Growth:
    """How theory lets the regret of an online identifier grow with the samples n."""

    law: Literal["log", "root", "linear", "bounded"]
    """{"log", "root", "linear", "bounded"}: As ln n, as the root of n, as n, or not at all."""
    factor: float | None = None
    """What multiplies it, in losses of the minimiser for a sample; None where only the law is known."""
    source: str = ""  # Whose theorem, and what it asks of the stream

    def of(self, n: FloatArray) -> FloatArray:
        """Return the law at numbers of samples (P,), each at least 1."""
        n = np.asarray(n, dtype=float)
        laws: dict[str, FloatArray] = {"log": np.log(n), "root": np.sqrt(n), "linear": n, "bounded": np.ones_like(n)}
        return laws[self.law]

    @classmethod
    def of_least_squares(cls, parameters: float, forgetting: float = 1.0) -> Growth:
        """Return that of ``parameters`` coefficients for each output, learned by exponentially weighted least squares.

        Examples
        --------
        >>> Growth.of_least_squares(4).law, Growth.of_least_squares(4, 0.9).law
        ('log', 'linear')
        """
        if forgetting < 1.0:
            share = (1.0 - forgetting) / (1.0 + forgetting)
            return cls(
                "linear",
                parameters * share,
                "misadjustment of forgetting, white errors (Haykin 2014, *Adaptive Filter Theory*)",
            )
        return cls("log", float(parameters), "d n sigma^2 ln T, white errors (Cesa-Bianchi & Lugosi 2006, sec. 11.7)")


@dataclass(frozen=True, eq=False)
class Hindsight:
    """The batch minimiser that regret is measured against."""

    losses: FloatArray
    """(M,): Loss of the minimiser at each predicted sample of the stream, records in order, ``sum(N_i - 1)`` of
    them."""
    exact: bool  # True where the minimiser is global (convex loss); False reads "best found"
    details: dict[str, Any] = field(default_factory=dict)  # Anything a report may show (coefficients, condition number)
    per_output: FloatArray | None = None
    """(M, ny): The same, output by output, where the loss is a sum over outputs; regret can then scale each by its
    size."""
    growth: Growth | None = None  # How theory lets the regret against it grow; None where no theorem says
