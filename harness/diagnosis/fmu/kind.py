"""An FMU as a kind of nominal model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from harness.blackbox.runner import Runner
from harness.diagnosis.fmu.form import FmuForm
from harness.diagnosis.fmu.prepare import choose_horizon
from harness.diagnosis.fmu.runs import FmuRuns
from harness.diagnosis.forms.likelihood_form import LikelihoodForm
from harness.diagnosis.records.columns_check import Doubt
from harness.diagnosis.records.horizon import Horizon
from harness.errors import HarnessError
from harness.signals import Dataset, FloatArray

__all__ = ["BlackBox"]


class BlackBox:
    """See :class:`harness.diagnosis.kinds.Kind`."""

    def prepared(self, dataset: Dataset, system: Any) -> tuple[Dataset, list[Doubt]]:
        """Return the data as they are: an FMU steps at the rate of its records."""
        return dataset, []

    def horizon(self, system: Any, values: Mapping[str, float], dataset: Dataset) -> Horizon:
        """Return how far a free run is compared, from how an error of the start grows."""
        try:
            return choose_horizon(system, values, dataset, Runner(system, dataset.spec.sample_time))
        except (HarnessError, ArithmeticError, np.linalg.LinAlgError):
            return Horizon(None, "how an error of the start grows is unknown: whole records are simulated")

    def form(self, system: Any, dataset: Dataset) -> LikelihoodForm:
        """Return the likelihood of the data."""
        return FmuForm(system, dataset, {})

    def runs(self, form: LikelihoodForm, dataset: Dataset, noise: FloatArray, horizon: Horizon) -> FmuRuns:
        """Return what simulates fitted models along the data."""
        runner = Runner(form.nominal, dataset.spec.sample_time)
        return FmuRuns(form.nominal, dataset, sizes=form.sizes, horizon=horizon.seconds, weights=noise, runner=runner)
