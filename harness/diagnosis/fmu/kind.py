"""An FMU as a kind of nominal model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from harness.blackbox.runner import Runner
from harness.blackbox.system import FmuSystem
from harness.diagnosis.fmu.form import FmuForm
from harness.diagnosis.fmu.prepare import choose_horizon
from harness.diagnosis.fmu.runs import FmuRuns
from harness.diagnosis.forms.form import WholeForm
from harness.diagnosis.records.columns_check import Doubt
from harness.diagnosis.records.horizon import Horizon
from harness.diagnosis.records.thinning import Thinned
from harness.diagnosis.systems import AnySystem
from harness.effects.dictionary import Dictionary
from harness.errors import HarnessError, PlantError
from harness.signals import Dataset, FloatArray


class BlackBox:
    """See :class:`harness.diagnosis.kinds.ModelKind`."""

    def prepared(self, dataset: Dataset, system: AnySystem) -> tuple[Dataset, list[Doubt]]:
        """Return the data, whose columns nothing doubts, with what is to be said about how the FMU is run."""
        assert isinstance(system, FmuSystem)
        return replace(dataset, warnings=(*dataset.warnings, *system.notes)), []

    def thinned(self, dataset: Dataset) -> Thinned:
        """Return the data as they are: an FMU takes its own steps within a sample, and its inputs stay held."""
        return Thinned.not_at_all(dataset)

    def horizon(self, system: AnySystem, values: Mapping[str, float], dataset: Dataset) -> Horizon:
        """Return how far a free run is compared, from how an error of the start grows."""
        assert isinstance(system, FmuSystem)
        try:
            return choose_horizon(system, values, dataset, Runner(system, dataset.spec.sample_time))
        except (HarnessError, ArithmeticError, np.linalg.LinAlgError) as error:
            if isinstance(error, PlantError) and error.status == "timeout":
                raise
            return Horizon(None, "how an error of the start grows is unknown: whole records are simulated")

    def form(self, system: AnySystem, dataset: Dataset, laws: Dictionary | None = None) -> FmuForm:
        """Return the likelihood of the data."""
        assert isinstance(system, FmuSystem)
        return FmuForm(system, dataset, {}, laws)

    def runs(self, form: WholeForm, dataset: Dataset, noise: FloatArray, horizon: Horizon) -> FmuRuns:
        """Return what simulates fitted models along the data."""
        nominal = form.nominal
        assert isinstance(nominal, FmuSystem)
        runner = Runner(nominal, dataset.spec.sample_time)
        return FmuRuns(nominal, dataset, sizes=form.sizes, horizon=horizon.seconds, weights=noise, runner=runner)

    def by_free_runs(self) -> None:
        """Return None: an FMU is judged by its free runs."""
