"""What free runs of a physical model say of its parameters: sensitivities, initial states taken out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.signals import FloatArray
from identifiers.linear.length.information import covariance_of_slopes

if TYPE_CHECKING:
    from harness.physics import System

_STARTS = 1e-6
"""Singular value, of effects of initial states at unit length, below which they are one: rounding tells them apart."""


@dataclass(frozen=True, eq=False)
class SampledMechanism:
    """A physical model with its parameters, sampled.

    Parameters
    ----------
    simulator : harness.physics.compiled.simulator.Simulator
    values : array (np,)
        Of all parameters.
    names : tuple of str
        Of those that are asked for, in the order of a covariance.
    """

    simulator: Any
    values: FloatArray
    names: tuple[str, ...]

    def covariance(
        self, inputs: Sequence[FloatArray], starts: Sequence[FloatArray], noise: FloatArray
    ) -> tuple[FloatArray, tuple[FloatArray, FloatArray]]:
        """Return the least covariance (k, k) of the parameters, and the information of first and second halves.

        White noise on the outputs; the initial state of every record is free (Ljung 1999, sec. 7.4 and 9.4).

        Parameters
        ----------
        inputs : sequence of array (N_i, nu)
        starts : sequence of array (nx,)
        noise : array (ny,)
            Standard deviations.
        """
        chosen = [self.simulator.parameter_names.index(name) for name in self.names]
        k = len(chosen)
        information, halves = np.zeros((k, k)), np.zeros((2, k, k))
        for u, x0 in zip(inputs, starts, strict=True):
            _, by_p, by_x = self.simulator.sensitivities(self.values, x0, u)
            slopes, free = (by_p[..., chosen] / noise[:, None]), by_x / noise[:, None]
            rows, nuisance = slopes.reshape(-1, k), free.reshape(-1, free.shape[-1])
            if not (np.isfinite(rows).all() and np.isfinite(nuisance).all()):
                return np.full((k, k), np.inf), (halves[0], halves[1])
            size = np.linalg.norm(nuisance, axis=0)
            nuisance = nuisance[:, size > 0] / size[size > 0]
            left, values, _ = np.linalg.svd(nuisance, full_matrices=False)
            left = left[:, values > _STARTS * max(float(values[0]) if values.size else 1.0, 1e-300)]
            rest = rows - left @ (left.T @ rows)
            information += rest.T @ rest
            middle = len(u) // 2 * len(noise)
            halves[0] += rest[:middle].T @ rest[:middle]
            halves[1] += rest[middle:].T @ rest[middle:]
        return covariance_of_slopes(np.eye(k), information), (halves[0], halves[1])


def mechanism_of(
    system: System,
    sample_time: float,
    values: dict[str, float] | None,
    names: Sequence[str] = (),
    simulator: Any = None,
) -> SampledMechanism:
    """Return a system, sampled, with its parameters; all that are not fixed are asked for where none is named.

    Examples
    --------
    >>> from harness.physics.models import pendulum
    >>> made = mechanism_of(pendulum().system(), 0.05, {"J": 0.2, "b": 0.05, "mgl": 1.0})
    >>> u = np.random.default_rng(0).normal(size=(400, 1))
    >>> short = made.covariance([u], [np.zeros(2)], np.array([0.01]))[0]
    >>> quiet = made.covariance([u], [np.zeros(2)], np.array([0.005]))[0]
    >>> made.names, bool(np.allclose(short, 4.0 * quiet))
    (('J', 'b', 'mgl'), True)
    """
    free = tuple(names) or tuple(one.name for one in system.parameters if not one.fixed)
    made = system.simulator(sample_time) if simulator is None else simulator
    return SampledMechanism(made, np.asarray(system.vector(values), dtype=float), free)
