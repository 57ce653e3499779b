"""What a diagnosis asks of a form beyond the search: data of its own, records of fits, free runs, what is left."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, Self

from harness.diagnosis.forms.apart import Apart
from harness.diagnosis.search.fit import Fit, Form
from harness.diagnosis.systems import AnySystem
from harness.effects.effect import Placed
from harness.physics.compiled.kalman_pass import Filtered
from harness.physics.compiled.smoother import SmoothedStates
from harness.physics.fitting.maximum import NoiseModel
from harness.signals import Dataset, Trajectory


class WholeForm(Form, Protocol):
    """A form that a whole diagnosis stands on, see :class:`harness.diagnosis.forms.likelihood_form.LikelihoodForm`."""

    @property
    def nominal(self) -> AnySystem:
        """The nominal model."""
        ...

    @property
    def latent(self) -> bool:
        """True where every equation of motion has a latent force, False for output error."""
        ...

    @property
    def dataset(self) -> Dataset:
        """The data."""
        ...

    @property
    def records(self) -> Mapping[str, Sequence[Trajectory]]:
        """Measured samples by use."""
        ...

    @property
    def sizes(self) -> Mapping[str, Mapping[str, float]]:
        """Sizes of the data by port."""
        ...

    @property
    def noise_model(self) -> NoiseModel:
        """Sizes of forces and outputs, and which noise there is."""
        ...

    def on(self, dataset: Dataset) -> Self:
        """Return the same form of other data."""
        ...

    def judges(self, placed: Placed) -> bool:
        """Return True for an effect that can be judged with such a model."""
        ...

    def composed(self, effects: Sequence[Placed]) -> AnySystem:
        """Return the nominal model with effects."""
        ...

    def first_starts(self) -> list[dict[str, float]]:
        """Return parameters to start the nominal fit from."""
        ...

    def resize(self, nominal: Fit) -> bool:
        """Take sizes from the nominal fit; True where it must be made anew within them."""
        ...

    def record(self, fit: Fit) -> dict[str, Any]:
        """Return a finished fit as plain numbers."""
        ...

    def restored(self, effects: Sequence[Placed], record: Mapping[str, Any]) -> Fit | None:
        """Return the fit of a record; None if it cannot be filtered."""
        ...

    def paths(self, fit: Fit, use: str) -> tuple[list[Filtered], list[SmoothedStates]]:
        """Return the pass of a fit over every record of a use, and the smoothed states."""
        ...

    def with_day(self, fit: Fit) -> Fit:
        """Return a fit whose validation records have the friction and the zeros of their day."""
        ...

    def apart(self, fit: Fit) -> Apart | None:
        """Return how much likelier some of the records are with parameters of their own; None if nothing tells."""
        ...

    def with_deviations(self, fit: Fit) -> Fit:
        """Return a fit with deviations that count how its errors are coloured."""
        ...
