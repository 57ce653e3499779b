"""Step and impulse responses of linear models."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.errors import InputError
from harness.models.spread import quantile, step_deviation
from harness.signals import FloatArray, PlantSpec

DECAYED = 1e-2
"""What is left of the slowest mode where a response ends by itself: then nothing more is seen in a picture."""
SAMPLES = (20, 2000)  # Fewest and most samples of a response whose length nobody chose; an integrator would never end.


@dataclass(frozen=True, eq=False)
class Response:
    """Outputs after a unit step or pulse of each input.

    Parameters
    ----------
    kind : {"step", "impulse"}
    t : array (N,)
        [s], from 0.
    y : array (N, ny, nu)
        ``y[k, i, j]``: output i after input j.
    spec : PlantSpec
    deviation : array (N, ny, nu), optional
        Standard deviation of ``y``, where the model knows its own.
    reach : float
        Standard deviations to either side of an interval of 95 %.
    """

    kind: str
    t: FloatArray
    y: FloatArray
    spec: PlantSpec
    deviation: FloatArray | None = None
    reach: float = 1.96

    def plot(self) -> Any:
        """Return a matplotlib figure: a panel for each output and input."""
        from harness.plots import sheet

        ny, nu = self.y.shape[1:]
        figure = sheet(figsize=(4.5 * nu, 2.4 * ny + 0.4), layout="constrained")
        axes = figure.subplots(ny, nu, squeeze=False, sharex=True)
        for i, output in enumerate(self.spec.outputs):
            for j, given in enumerate(self.spec.inputs):
                axes[i, j].step(self.t, self.y[:, i, j], where="post")
                if self.deviation is not None:
                    low, high = (self.y[:, i, j] + sign * self.reach * self.deviation[:, i, j] for sign in (-1, 1))
                    axes[i, j].fill_between(self.t, low, high, step="post", alpha=0.25)
                axes[i, j].set_title(f"{output} after a unit {self.kind} of {given}", fontsize=9)
        for axis in axes[-1]:
            axis.set_xlabel("time [s]", fontsize=9)
        return figure

    def __repr__(self) -> str:
        return f"<Response to a unit {self.kind}: {self.spec}; {len(self.t)} samples>"

    def _repr_html_(self) -> str:
        from harness.display import page
        from harness.plots import inlined

        return page(repr(self).strip("<>"), inlined(self.plot(), f"{self.kind} response"))


def response(model: Any, kind: str, duration: float | None = None) -> Response:
    """Return the step or impulse response of a linear model, from rest.

    Parameters
    ----------
    model : LinearModel
    kind : {"step", "impulse"}
    duration : float, optional
        [s]; by default until 1 % of the slowest mode is left.

    Raises
    ------
    InputError
        If the model has no input, or the duration is not positive.
    """
    spec: PlantSpec = model.spec
    if not spec.nu:
        raise InputError(
            f"{kind} response of a model without inputs",
            expected="a model with inputs",
            got=str(spec),
            remedy="use forecast(past, steps=...)",
        )
    if duration is not None and not (np.isfinite(duration) and duration > 0):
        raise InputError("duration", expected="seconds, more than 0", got=repr(duration), remedy="correct it")
    count = length(model) if duration is None else 1 + round(duration / spec.sample_time)
    pulse: FloatArray = np.asarray(model.impulse_response(count))
    y = pulse if kind == "impulse" else np.cumsum(pulse, axis=0)
    t = spec.sample_time * np.arange(count, dtype=np.float64)
    spread = getattr(model, "spread", None)
    if spread is None:
        return Response(kind, t, y, spec)
    return Response(kind, t, y, spec, step_deviation(model, count, kind), quantile(spread))


def length(model: Any) -> int:
    """Return the samples until the slowest mode of a linear model has decayed."""
    radius = float(np.abs(np.linalg.eigvals(np.asarray(model.a_matrix))).max(initial=0.0))
    few, many = SAMPLES
    if radius >= 1.0:
        return many // 10
    return int(np.clip(np.log(DECAYED) / np.log(max(radius, 1e-9)), few, many))
