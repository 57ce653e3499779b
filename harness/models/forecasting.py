"""Forecasts of linear models with the bands that the noise of a record leaves open."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.errors import InputError
from harness.signals import FloatArray, PlantSpec, Trajectory

FEW = 10  # Innovations below which their size is not known.


@dataclass(frozen=True, eq=False)
class Forecast:
    """Outputs after the end of a record."""

    t: FloatArray  # (M,): [s], on the record's clock
    y: FloatArray  # (M, ny)
    deviation: FloatArray  # (M, ny): Standard deviation of what will be measured, from the noise alone
    level: float
    reach: float  # Deviations to either side of a band
    spec: PlantSpec

    @property
    def low(self) -> FloatArray:
        """Lower ends of the bands (M, ny)."""
        return self.y - self.reach * self.deviation

    @property
    def high(self) -> FloatArray:
        """Upper ends of the bands (M, ny)."""
        return self.y + self.reach * self.deviation

    def plot(self) -> Any:
        """Return a matplotlib figure: each output with its band."""
        from harness.plots import sheet

        figure = sheet(figsize=(8, 2.2 * self.spec.ny + 0.4), layout="constrained")
        axes = figure.subplots(self.spec.ny, 1, squeeze=False, sharex=True)[:, 0]
        for column, (axis, channel) in enumerate(zip(axes, self.spec.outputs, strict=True)):
            axis.plot(self.t, self.y[:, column], linewidth=1.2)
            axis.fill_between(self.t, self.low[:, column], self.high[:, column], alpha=0.25)
            axis.set_ylabel(str(channel), fontsize=9)
        axes[-1].set_xlabel("time [s]", fontsize=9)
        return figure

    def __repr__(self) -> str:
        return f"<Forecast {len(self.t)} samples, bands of {100 * self.level:g} %: {self.spec}>"


def forecast_bands(model: Any, past: Trajectory, predicted: FloatArray, y: FloatArray, level: float) -> Forecast:
    """Return a forecast with its bands.

    With the innovations' covariance S from the record, the state that it leaves is certain and then
    ``P+ = A (P + L S L') A'``; a new output has the covariance ``C P C' + S`` (Ljung 1999, sec. 3.2).

    - ``predicted`` (N, ny): one step ahead; NaN where there is none
    - ``y`` (M, ny): the forecast
    """
    from scipy.stats import norm

    if not 0 < level < 1:
        raise InputError("level of a band", expected="between 0 and 1", got=f"{level:g}", remedy="correct it")
    miss = (past.y - predicted)[min(model.burn_in, max(len(past) - FEW, 0)) :]
    miss = miss[np.isfinite(miss).all(axis=1)]
    if len(miss) < FEW:
        raise InputError(
            "record before a forecast",
            expected=f"{FEW} samples or more beyond the model's memory of {model.burn_in}",
            got=str(len(past)),
            remedy="give a longer one",
        )
    size = miss.T @ miss / len(miss)
    a, c, gain = (np.asarray(getattr(model, name)) for name in ("a_matrix", "c_matrix", "filter_gain"))
    p, found = np.zeros_like(a), np.empty_like(y)
    for k in range(len(y)):
        found[k] = np.sqrt(np.maximum(np.diag(c @ p @ c.T + size), 0.0))
        p = a @ (p + gain @ size @ gain.T) @ a.T
    t = past.t[-1] + model.spec.sample_time * np.arange(1, len(y) + 1)
    return Forecast(t, y, found, level, float(norm.ppf(0.5 + level / 2)), model.spec)
