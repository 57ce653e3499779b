"""What a form does in its own way for each kind of system: built, simulated, smoothed, asked for columns."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Generic

import numpy as np

from harness.diagnosis.search.fit import Column, Fit, Jump
from harness.diagnosis.systems import SystemT
from harness.effects.effect import Placed
from harness.physics.compiled.kalman_pass import Filtered, Pass
from harness.physics.compiled.smoother import SmoothedStates
from harness.signals import FloatArray, Trajectory


class SystemForm(ABC, Generic[SystemT]):
    """What :class:`harness.diagnosis.forms.likelihood_form.LikelihoodForm` leaves to each kind of system."""

    @abstractmethod
    def judges(self, placed: Placed) -> bool:
        """Return True for an effect that can be judged with such a model."""

    @abstractmethod
    def has_latent_forces(self) -> bool:
        """Return False for output error."""

    def force_scale(self, values: Mapping[str, float] | None = None) -> FloatArray:
        """Return the typical force at every latent one, of declared parameters or others; none for output error."""
        return np.zeros(0)

    @abstractmethod
    def composed(self, effects: Sequence[Placed]) -> SystemT:
        """Return the nominal model with effects."""

    @abstractmethod
    def substeps(self, system: SystemT, values: Mapping[str, float]) -> int:
        """Return the steps of the solver within a sample."""

    def unseen(self, system: SystemT, values: Mapping[str, float]) -> float:
        """Return how much faster than the readings show something moves at rest, see :class:`Fit`."""
        return 0.0

    @abstractmethod
    def passes(self, system: SystemT, substeps: int) -> Pass:
        """Return the filter of a model."""

    @abstractmethod
    def first_state(self, system: SystemT, record: Trajectory, p: FloatArray) -> FloatArray:
        """Return the initial state that a record tells, (nx,)."""

    @abstractmethod
    def smooth(self, passed: Filtered) -> SmoothedStates:
        """Return the states given the whole record."""

    def limited(self) -> bool:
        """See :class:`harness.diagnosis.search.fit.Form`; only an FMU's search may end so."""
        return False

    @abstractmethod
    def first_starts(self) -> list[dict[str, float]]:
        """Return parameters to start the nominal fit from."""

    @abstractmethod
    def resize(self, nominal: Fit) -> bool:
        """Take the sizes from which effects start from the nominal fit; True where it must be made anew."""

    @abstractmethod
    def columns(self, fit: Fit, candidates: Sequence[Placed]) -> list[Column]:
        """See :class:`harness.diagnosis.search.fit.Form`."""

    @abstractmethod
    def test_functions(self, fit: Fit) -> list[Column]:
        """See :class:`harness.diagnosis.search.fit.Form`."""

    @abstractmethod
    def change(self, fit: Fit, placed: Placed) -> float:
        """Return how much an effect changes of rates or readings along the estimation records, as a share of them."""

    def distance(self, fit: Fit, other: Fit) -> float:
        """Return how far another fit is from one, as such a share; infinity where nobody can tell."""
        return float("inf")

    def jumps(self, fit: Fit) -> list[Jump]:
        """Return where a latent force changes faster than a disturbance does; none is known here."""
        return []

    def damping(self, fit: Fit, at: str) -> tuple[FloatArray, FloatArray] | None:
        """Return places along the motion of a coordinate and what brakes it there; None where forces have no text."""
        return None

    def line_rivals_of(self, fit: Fit, placed: Placed) -> tuple[float, ...]:
        """Return the evidence of what a line may be instead; none is known where forces have no text."""
        return ()
