"""Sparse regression of pysindy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from harness.errors import FitError
from harness.scoring import same_language
from harness.signals import FloatArray, PlantSpec, Trajectory
from harness.specs import spec_from_dict, spec_to_dict
from sysid_peers.records import NO_JUDGE, called, package, real_records

__all__ = ["PySindy", "SindyModel"]


@dataclass(frozen=True)
class PySindy:
    """Discrete SINDy: the next measured state as a sparse polynomial of state and input.

    Parameters
    ----------
    degree : int
        Of the polynomials.
    threshold : float
        Coefficients below it are dropped (STLSQ).
    """

    degree: int = 2
    threshold: float = 1e-3
    expected_failures: ClassVar[Mapping[str, str]] = NO_JUDGE

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> SindyModel:
        """Return the model."""
        pysindy = package("pysindy", "pysindy")
        records, spec = real_records(trajectories, 20, "pysindy")
        with called("pysindy"):
            found = pysindy.DiscreteSINDy(
                optimizer=pysindy.STLSQ(threshold=self.threshold),
                feature_library=pysindy.PolynomialLibrary(degree=self.degree),
            )
            found.fit([one.y for one in records], t=1, u=[one.u for one in records])
            coefficients = np.array(found.coefficients(), dtype=float)
            powers = np.asarray(found.feature_library.powers_, dtype=int)
        if not np.isfinite(coefficients).all() or coefficients.shape != (spec.ny, len(powers)):
            raise FitError("pysindy", expected="finite coefficients", got="others", remedy="record more")
        return SindyModel(spec, coefficients, powers)


@dataclass(frozen=True, eq=False)
class SindyModel:
    """x+ = coefficients times monomials of (x, u); the outputs are the state."""

    spec: PlantSpec
    coefficients: FloatArray
    powers: Any

    burn_in = 1

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the first output."""
        same_language(self.spec, data)
        return np.array(data.y[0])

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the state."""
        return np.array(x)

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the state that was measured."""
        return np.array(y)

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next state."""
        u = np.broadcast_to(u, (*x.shape[:-1], self.spec.nu))
        signals = np.concatenate([x, u], axis=-1)
        with np.errstate(over="ignore", invalid="ignore"):
            monomials = np.prod(signals[..., None, :] ** self.powers, axis=-1)
            return np.asarray((monomials[..., None, :] * self.coefficients).sum(axis=-1))

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description."""
        return {
            "kind": "peer-pysindy",
            "spec": spec_to_dict(self.spec),
            "coefficients": self.coefficients.tolist(),
            "powers": self.powers.tolist(),
        }

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> Self:
        """Return the model of a description."""
        spec = spec_from_dict(content["spec"])
        return cls(spec, np.array(content["coefficients"]), np.array(content["powers"], dtype=int))
