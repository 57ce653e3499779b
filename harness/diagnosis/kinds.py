"""What a diagnosis does in its own way for each kind of nominal model: one given by equations here."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from harness.diagnosis.forms.equations_form import EquationsForm, OutputErrorForm
from harness.diagnosis.forms.form import WholeForm
from harness.diagnosis.records.columns_check import Doubt, check_columns
from harness.diagnosis.records.horizon import Horizon, choose_horizon
from harness.diagnosis.records.prepare import sizes_of
from harness.diagnosis.records.thinning import Thinned, thinned_dataset
from harness.diagnosis.runs.form import FreeRunForm
from harness.diagnosis.systems import AnySystem, by_equations
from harness.effects.dictionary import Dictionary
from harness.errors import HarnessError, InputError
from harness.signals import Dataset, FloatArray


class ModelKind(Protocol):
    """How a kind of nominal model is prepared, fitted and simulated."""

    def prepared(self, dataset: Dataset, system: AnySystem) -> tuple[Dataset, list[Doubt]]:
        """Return the data as they are judged, and why their columns are in doubt."""
        ...

    def thinned(self, dataset: Dataset) -> Thinned:
        """Return the data at the rate at which the likelihood looks at them."""
        ...

    def horizon(self, system: AnySystem, values: Mapping[str, float], dataset: Dataset) -> Horizon:
        """Return how far a free run is compared."""
        ...

    def form(self, system: AnySystem, dataset: Dataset, laws: Dictionary | None = None) -> WholeForm:
        """Return the likelihood of the data; without ``laws`` the built-in ones are known."""
        ...

    def runs(self, form: WholeForm, dataset: Dataset, noise: FloatArray, horizon: Horizon) -> FreeRunForm:
        """Return what simulates fitted models along the data, its residuals over the sensor noise."""
        ...

    def by_free_runs(self) -> ModelKind | None:
        """Return the kind that judges the same model by its free runs; None if there is none, or this one does."""
        ...


class EquationsKind:
    """A system given by its equations."""

    def prepared(self, dataset: Dataset, system: AnySystem) -> tuple[Dataset, list[Doubt]]:
        """See :class:`ModelKind`."""
        if not system.nx:  # no force and no rate that could be missing: all at the input would be called invisible
            raise InputError(
                f"the model {system.name} is static",
                expected="a model with states, as what it lacks is looked for in its forces and rates",
                got="outputs that follow from the inputs of the same instant",
                remedy="give it the dynamics of the plant (a lag of the sensor or the drive, say), or fit its "
                "parameters alone with fit_output_error",
            )
        assert by_equations(system)
        return dataset, check_columns(system, dataset)

    def thinned(self, dataset: Dataset) -> Thinned:
        """See :class:`ModelKind`."""
        return thinned_dataset(dataset)

    def horizon(self, system: AnySystem, values: Mapping[str, float], dataset: Dataset) -> Horizon:
        """See :class:`ModelKind`."""
        assert by_equations(system)
        try:
            return choose_horizon(system, values, dataset)
        except (HarnessError, ArithmeticError, np.linalg.LinAlgError):
            return Horizon(None, "the poles of the nominal model are unknown: whole records are simulated")

    def form(self, system: AnySystem, dataset: Dataset, laws: Dictionary | None = None) -> EquationsForm:
        """See :class:`ModelKind`."""
        assert by_equations(system)
        return EquationsForm(system, dataset, sizes_of(system, system.values(), dataset), laws)

    def runs(self, form: WholeForm, dataset: Dataset, noise: FloatArray, horizon: Horizon) -> FreeRunForm:
        """See :class:`ModelKind`."""
        return FreeRunForm(form.nominal, dataset, sizes=form.sizes, horizon=horizon.seconds, weights=noise)

    def by_free_runs(self) -> ModelKind | None:
        """See :class:`ModelKind`."""
        return OutputErrorKind()


class OutputErrorKind(EquationsKind):
    """A mechanical system that is judged by its free runs, as a process is."""

    def form(self, system: AnySystem, dataset: Dataset, laws: Dictionary | None = None) -> EquationsForm:
        """See :class:`ModelKind`."""
        assert by_equations(system)
        return OutputErrorForm(system, dataset, sizes_of(system, system.values(), dataset), laws)

    def by_free_runs(self) -> ModelKind | None:
        """Return None: this kind does."""
        return None
