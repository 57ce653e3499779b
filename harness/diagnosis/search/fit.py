"""What a form offers the search: fitted candidates with their likelihood, and the score test's columns."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol, cast

import numpy as np

from harness.diagnosis.systems import AnySystem, Parametrised, Starts
from harness.effects.dictionary import Dictionary
from harness.effects.effect import Placed
from harness.physics.definition.parameters import FAR, FarOff, Parameter, far_off
from harness.physics.fitting.maximum import interval
from harness.signals import FloatArray

ColumnKind = Literal["linear", "wave", "drift"]
"""What columns stand for: derivatives by linear parameters, or test functions of a force; the sine and the cosine of
a wave; test functions of a force that changes through every record."""
WAVE = ("in phase", "quarter turn")
"""Names of the two columns of a wave."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A model with some effects at the maximum of its likelihood.

    Attributes
    ----------
    effects : tuple of Placed
    system : Parametrised
        The nominal one with the effects.
    values : dict
        All parameters by full name.
    free : tuple of str
        The estimated ones.
    count : int
        Everything estimated: parameters, hidden starts, noise; the initial states of the nominal model, which every
        candidate has, left out.
    terms : dict
        By use, for each record the log-density of every sample (N,); of the validation records with initial states (and
        what belongs to a record) fitted there, noise from the estimation records, and parameters as uncertain as these
        leave them, what that costs spread evenly over the samples.
    innovations : dict
        By use, for each record the innovations (N, ny) and their variances (N, ny); empty where a form has none.
    deviations : dict
        Standard deviation of every free parameter, of its logarithm where ``logarithmic``.
    beside : dict
        The same of effects' parameters where nominal ones of which the records tell nothing are held: a scale that the
        nominal model leaves open makes no law unknown. Empty where a form has no such values.
    logarithmic : frozenset of str
    converged : bool
    on_bound : tuple of str
    beyond : bool
        True if it was left on its way because it could not come near a rival any more, or not to what it costs.
    free_run : bool
        True if the innovations are errors of free runs: what is not modelled moves many of them together.
    own : dict
        Parameters of the validation records themselves.
    day : dict
        Levels of dry friction and zeros of instruments on the day of the validation records, where it is another day.
    line_rivals : dict
        By full name of an effect that repeats: the logarithm of the evidence of what a line that is drawn once in every
        record is held against, in the order of :data:`~harness.diagnosis.search.refusal.LINE_RIVALS`.
    detail : object
        What the form itself needs to go on from here.
    unseen : float
        How much faster than the readings show something of it moves at rest: the eigenvalue over the largest one that
        they show. Beyond 1 another law would do as well, of which what is over so soon is no part.
    """

    effects: tuple[Placed, ...]
    system: Parametrised
    values: dict[str, float]
    free: tuple[str, ...]
    count: int
    terms: dict[str, list[FloatArray]]
    deviations: dict[str, float]
    logarithmic: frozenset[str]
    converged: bool
    on_bound: tuple[str, ...]
    innovations: dict[str, list[tuple[FloatArray, FloatArray]]] = field(default_factory=dict, repr=False)
    own: dict[str, float] = field(default_factory=dict)
    day: dict[str, float] = field(default_factory=dict)
    line_rivals: dict[str, tuple[float, ...]] = field(default_factory=dict)
    detail: object = field(default=None, repr=False)
    beyond: bool = False
    free_run: bool = False
    beside: dict[str, float] = field(default_factory=dict)
    unseen: float = 0.0

    @property
    def model(self) -> AnySystem:
        """The system of a fit to whole records, which has inputs, outputs and states beside its parameters."""
        return cast(AnySystem, self.system)

    @property
    def samples(self) -> int:
        """Samples of the estimation records."""
        return sum(len(terms) for terms in self.terms["estimation"])

    def log_likelihood(self, use: str) -> float:
        """Return the log-likelihood of the records of a use."""
        return float(sum(terms.sum() for terms in self.terms[use]))

    @property
    def penalised(self) -> float:
        """Log-likelihood of the estimation records minus half the penalty of BIC (Schwarz 1978)."""
        return self.log_likelihood("estimation") - 0.5 * self.count * float(np.log(self.samples))

    def interval(self, name: str) -> tuple[float, float]:
        """Return the 95 % interval of a free parameter, from the curvature."""
        return interval(self.values[name], 1.96 * self.deviations[name], name in self.logarithmic)

    def far_off(self, declared: Iterable[Parameter], factor: float = FAR) -> tuple[FarOff, ...]:
        """Return the parameters that the data determine, and that lie a factor from what was declared."""
        intervals = {name: self.interval(name) for name in self.free if np.isfinite(self.deviations.get(name, np.nan))}
        values = {name: self.values[name] for name in self.free if name not in self.on_bound}
        return far_off(declared, values, intervals, factor)


def of_nothing(fit: Fit) -> list[tuple[Placed, tuple[float, float]]]:
    """Return the effects of a fit whose size may be nothing at all, with its 95 % interval."""
    found = []
    for one in fit.effects:
        main, name = one.effect.main, one.main()
        if main is None or name not in fit.free or name in fit.on_bound or not np.isfinite(fit.deviations[name]):
            continue
        low, high = fit.interval(name)
        if main.neutral is not None and low <= main.neutral <= high:
            found.append((one, (low, high)))
    return found


@dataclass(frozen=True, eq=False)
class Column:
    """What one choice of an effect's parameters does to the whitened innovations.

    Attributes
    ----------
    placed : Placed
    given : dict
        Values of the parameters in which the effect is not linear, by short name.
    names : tuple of str
        Short names of the linear ones, one for each column; ``("effect",)`` for the whole effect at ``given``.
    estimation : array (n, k)
    validation : array (m, k)
        Of test functions; of an effect, which is refitted before it is judged, it may have no rows.
    kind : {"linear", "wave", "drift"}
        See :data:`ColumnKind`.
    """

    placed: Placed | None
    given: dict[str, float]
    names: tuple[str, ...]
    estimation: FloatArray
    validation: FloatArray
    kind: ColumnKind = "linear"


@dataclass(frozen=True, eq=False)
class Linearised:
    """Whitened innovations of a fit by use (n,), and their derivatives by what is free already (n, p).

    The first columns belong to the parameters ``names``, which the validation records share; the others to initial
    states, which every record has for itself. ``spread`` (shared, k) is a square root of the covariance of the
    parameters, and ``moved`` (k,) how far along it they went for the validation records, see
    :func:`harness.diagnosis.forms.predictive.predictive`; without them, the parameters stay those of the estimation
    records.
    """

    residual: dict[str, FloatArray]
    nuisance: dict[str, FloatArray]
    names: tuple[str, ...]
    spread: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    moved: FloatArray = field(default_factory=lambda: np.zeros(0))
    states: dict[str, float] = field(default_factory=dict)

    @property
    def shared(self) -> int:
        """Number of the columns of parameters."""
        return len(self.names)


@dataclass(frozen=True, eq=False)
class Begun:
    """The first steps of a fit: the log-likelihood of the estimation records so far, and what the form goes on from.

    ``pace`` is what the last step gained; ``system`` the model that is fitted, where it has one.
    """

    effects: tuple[Placed, ...]
    log_likelihood: float
    values: dict[str, float]
    detail: object = field(repr=False)
    pace: float = 0.0
    system: Parametrised | None = field(default=None, repr=False)


@dataclass(frozen=True, eq=False)
class Suspect:
    """An effect that no score test sees, where to start from, and a fit of its own to go on from, if it has one."""

    placed: Placed
    starts: tuple[dict[str, float], ...]
    base: Fit | None = None


class StepwiseForm(Protocol):
    """What fits in two steps: see :class:`Form`."""

    def begin(self, effects: Sequence[Placed], starts: Sequence[Mapping[str, float]], base: Fit | None) -> Begun | None:
        """Take the first steps."""
        ...

    def finish(self, begun: Begun, base: Fit | None, rival: Fit | None = None) -> Fit | None:
        """Go on to the maximum."""
        ...


class InOneGo:
    """Adds ``fit`` to what begins and finishes."""

    def fit(
        self: StepwiseForm,
        effects: Sequence[Placed],
        starts: Sequence[Mapping[str, float]],
        base: Fit | None,
        rival: Fit | None = None,
    ) -> Fit | None:
        """Begin and finish."""
        begun = self.begin(effects, starts, base)
        return None if begun is None else self.finish(begun, base, rival)


@dataclass(frozen=True)
class Jump:
    """An instant at which something happened: a latent force changes faster than a disturbance does.

    Attributes
    ----------
    port : str
    use : str
    run : int
        Number of the record in its use.
    time : float
        [s]
    size : float
        Change within a sample over its standard deviation.
    share : float
        The step around it over the typical force.
    """

    port: str
    use: str
    run: int
    time: float
    size: float
    share: float


class Form(Protocol):
    """A way to give data a likelihood under a model with effects."""

    @property
    def nominal(self) -> Parametrised:
        """The nominal model."""
        ...

    @property
    def laws(self) -> Dictionary:
        """The effects of the run, and what they say of each other."""
        ...

    def begin(self, effects: Sequence[Placed], starts: Starts, base: Fit | None, hope: float = -np.inf) -> Begun | None:
        """Take the first steps of a fit of the nominal model with effects, from one or more starts.

        ``base`` is the fit to go on from: its noise and initial states. None where it cannot be simulated. What is not
        on its way to the log-likelihood ``hope`` may take fewer steps.
        """
        ...

    def finish(self, begun: Begun, base: Fit | None, rival: Fit | None = None, least: float = -np.inf) -> Fit | None:
        """Return the fit that was begun at its maximum, tried on the validation records.

        One that cannot come near a rival any more is left on its way there, not converged; so is one whose maximum
        lies below the log-likelihood ``least``, before the last digits of it are found.
        """
        ...

    def fit(
        self,
        effects: Sequence[Placed],
        starts: Sequence[Mapping[str, float]],
        base: Fit | None,
        rival: Fit | None = None,
    ) -> Fit | None:
        """Begin and finish."""
        ...

    def without_memory(self, fit: Fit) -> Fit | None:
        """Return a fit with latent forces that are as quick as the fitted ones and remember nothing, None if they do.

        A force that remembers a tenth of a record takes up what is constant along it, and no promise is left of that.
        """
        ...

    def linearised(self, fit: Fit) -> Linearised:
        """Return the whitened innovations of a fit and their derivatives."""
        ...

    def columns(self, fit: Fit, candidates: Sequence[Placed]) -> list[Column]:
        """Return what each candidate would do to the innovations of a fit."""
        ...

    def suspects(self, base: Fit, rival: Begun | None, candidates: Sequence[Placed]) -> list[Suspect]:
        """Return those candidates beside a base of which a first-order test says nothing.

        Where the best rival leaves nothing, hidden resonances and play have nothing to explain.
        """
        ...

    def test_functions(self, fit: Fit) -> list[Column]:
        """Return the same for functions of position, speed and input that are no effect of a dictionary."""
        ...

    def left_out(self) -> list[str]:
        """Return the effects that were not tried to the end, alone or beside others, as that would cost too much."""
        ...

    def limited(self) -> bool:
        """Return whether a search may end before it began all that promises something."""
        ...

    def change(self, fit: Fit, placed: Placed) -> float:
        """Return how much one of the effects of a fit changes of rates or readings, as a share of them.

        Infinite where nobody can tell.
        """
        ...

    def distance(self, fit: Fit, other: Fit) -> float:
        """Return how far another fit to the same records is from one, as such a share.

        Each has its own values and hidden states: it is what an effect does beyond what the other parameters can do as
        well. Infinite where nobody can tell.
        """
        ...

    def jumps(self, fit: Fit) -> list[Jump]:
        """Return where the force that nobody measured changes faster than a disturbance does; empty if none is told."""
        ...

    def damping(self, fit: Fit, at: str) -> tuple[FloatArray, FloatArray] | None:
        """Return places along the motion of a coordinate and the damping of all that brakes it there; None if unknown.

        See :func:`harness.diagnosis.directions.damping.damping_along`.
        """
        ...
