"""What a likelihood is maximised over, and its maximum: noise, a place, a fit with its intervals."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from harness.physics.compiled.kalman_pass import Filtered, PassNoise
from harness.signals import FloatArray

if TYPE_CHECKING:
    from harness.physics.compiled.system import System

FIRST_DAMPING = 1e-3  # Of the first step of a search, over the diagonal.
LONGEST = 1.5  # Longest step of a logarithm.


@dataclass(frozen=True)
class NoiseModel:
    """Which noise is estimated, and within what."""

    force_scale: FloatArray  # (nl,): Typical size of each latent force [its unit]
    output_scale: FloatArray  # (ny,): Typical size of each output
    latent: bool = True  # False for no latent forces: the free run, output error
    white: bool = True  # Whether each has a white part too
    # Bounds of the time constants [s]
    shortest: float = 1e-3
    longest: float = 10.0
    least: FloatArray | None = None
    """(ny,): Smallest standard deviation of the noise of each output: that of its resolution."""

    @property
    def smallest(self) -> FloatArray:
        """Lower bounds of the noise of the outputs (ny,): what they resolve, or the last digits of a number."""
        exact = 1e-7 * self.output_scale
        return exact if self.least is None else np.maximum(exact, self.least)


@dataclass(eq=False)
class Point:
    """A place in the space of everything unknown."""

    p: FloatArray  # (np,)
    x0: list[FloatArray]  # list of array (start_size,): By record
    noise: PassNoise


@dataclass(eq=False)
class LikelihoodFit:
    """Maximum of the likelihood."""

    system: System  # Without the latent forces
    point: Point
    nll: float  # Minus the log-likelihood of all records
    terms: list[FloatArray]  # list of array (K,): The same by record and sample
    names: tuple[str, ...]  # What was estimated: parameters, ``x0[record].state``, noise
    covariance: FloatArray  # Of these, in the units of ``scaled``: logarithms for what cannot be negative
    logarithmic: npt.NDArray[np.bool_]
    converged: bool
    on_bound: tuple[str, ...]  # Parameters on a bound, and noise on its upper one
    iterations: int
    message: str = ""
    filtered: list[Filtered] = field(default_factory=list, repr=False)
    beyond: bool = False  # True if it was left because its steps would not have brought it within reach
    pace: float = 0.0  # Log-likelihood that its last step gained; 0 where it converged
    damping: float = FIRST_DAMPING  # Of its last step: a search that goes on from here begins with it
    undetermined: tuple[str, ...] = ()
    """What the records tell in combinations only: it can move along with others and nothing changes. ``covariance`` is
    that of the combinations.
    """

    @property
    def parameters(self) -> dict[str, float]:
        """Values of all parameters by name."""
        return dict(zip(self.system.parameter_names, (float(value) for value in self.point.p), strict=True))

    def deviation(self, name: str) -> float:
        """Return the standard deviation of an estimate, from the curvature; of its logarithm where that was fitted.

        Infinite where the records do not determine it.
        """
        if name in self.undetermined:
            return float("inf")
        k = self.names.index(name)
        return float(np.sqrt(max(self.covariance[k, k], 0.0)))

    def deviation_given(self, name: str, held: Collection[str]) -> float:
        """Return the same where other estimates are held, as one who knew them had it.

        Of what the records tell in combinations only, the covariance has the combinations alone: there it is known
        already.
        """
        rows = [k for k, other in enumerate(self.names) if other in held and other != name]
        k = self.names.index(name)
        if not rows or name in self.undetermined:
            return float(np.sqrt(max(self.covariance[k, k], 0.0)))
        both = self.covariance[np.ix_(rows, rows)]
        size = np.sqrt(np.maximum(np.diag(both), 1e-300))
        along = self.covariance[k, rows] / size
        explained = along @ np.linalg.lstsq(both / np.outer(size, size), along, rcond=1e-12)[0]
        return float(np.sqrt(max(self.covariance[k, k] - explained, 0.0)))

    def interval(self, name: str, level: float = 1.96) -> tuple[float, float]:
        """Return the 95 % interval of a parameter."""
        k = self.names.index(name)
        return interval(self.parameters[name], level * self.deviation(name), bool(self.logarithmic[k]))


def interval(value: float, half: float, logarithmic: bool) -> tuple[float, float]:
    """Return an interval about a value, or about its logarithm; without ends where the half width is infinite.

    Examples
    --------
    >>> interval(2.0, float("inf"), True), interval(2.0, 0.5, False)
    ((0.0, inf), (1.5, 2.5))
    """
    if not logarithmic:
        return value - half, value + half
    if not np.isfinite(half):
        return 0.0, float("inf")
    return float(value * np.exp(-min(half, 50.0))), float(value * np.exp(min(half, 50.0)))
