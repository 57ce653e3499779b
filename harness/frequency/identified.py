"""A transfer function beside the frequency response that it was fitted to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.frequency.data import FrequencyResponse

WELL, POOR = 1.5, 3.0  # Mean square of the residuals over their variance up to which nothing, or little, is missing.


@dataclass(frozen=True, eq=False)
class IdentifiedResponse:
    """What :func:`harness.api.identify_response` returns."""

    data: FrequencyResponse
    model: Any

    def words(self) -> list[str]:
        """Return the transfer functions, what they leave of the data, and every number with its interval."""
        notes, lines = self.model.notes, str(self.model).splitlines()
        for output, misfit in zip(self.data.outputs, notes["misfit"], strict=True):
            if notes["variance_known"]:
                judged = "nothing but noise is left" if misfit <= WELL else "little is left beside noise"
                judged = judged if misfit <= POOR else "more is left than noise: another order, or another dead time"
                lines.append(f"{output.name}: residual over noise {np.sqrt(misfit):.3g}: {judged}")
            else:
                lines.append(f"{output.name}: residual {100 * misfit:.3g} % of the response (no variance is known)")
            criteria = notes["order_criterion"][output.name]
            if len(criteria) > 1:
                told = ", ".join(f"{order}: {value - min(criteria.values()):.4g}" for order, value in criteria.items())
                lines.append(f"{output.name}: orders by Schwarz's criterion over the best: {told}")
        estimate = self.model.estimate
        for name, unit, value in zip(estimate.names, estimate.units, estimate.values, strict=True):
            interval = estimate.interval(name)
            within = f" [{interval[0]:.6g}, {interval[1]:.6g}]" if interval else ""
            lines.append(f"  {name} = {value:.6g}{'' if unit == '1' else ' ' + unit}{within}")
        lines.append(f"  (95 %: {estimate.method})")
        return lines

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description."""
        return {"model": self.model.to_dict(), "estimate": self.model.estimate.to_dict()}

    def plot(self) -> Any:
        """Draw gain and phase, measured with two standard deviations, and the model with its 95 % band."""
        from harness.plots import sheet

        data = self.data
        figure = sheet(figsize=(8, 5.5), layout="constrained")
        axes = figure.subplots(2, 1, sharex=True)
        f = data.frequency[data.frequency > 0]
        fine = np.geomspace(f[0], f[-1], 400)
        response = self.model.frequency_response(fine)
        of_gain, of_phase = self.model.deviation(fine)
        measured = data.response[data.frequency > 0]
        for row, output in enumerate(data.outputs):
            for column, given in enumerate(data.inputs):
                size, model = np.abs(measured[:, row, column]), response[:, row, column]
                half = None
                if data.variance is not None:
                    half = 2 * np.sqrt(data.variance[data.frequency > 0][:, row, column] / 2)
                    half = np.minimum(half, 0.999 * size)
                name = f"{output.name} / {given.name}"
                drawn = axes[0].errorbar(
                    f, size, yerr=half, fmt=".", markersize=4, linewidth=0.7, label=f"{name} measured"
                )
                colour = drawn[0].get_color()
                start = np.unwrap(np.angle(model))
                near = np.interp(np.log(f), np.log(fine), start)
                turns = near + np.angle(measured[:, row, column] * np.exp(-1j * near))
                axes[1].semilogx(f, np.degrees(turns), ".", markersize=4, color=colour)
                gain, phase = 1.96 * of_gain[:, row, column], np.degrees(1.96 * of_phase[:, row, column])
                low = np.maximum(np.abs(model) - gain, 1e-3 * np.abs(model))
                axes[0].plot(fine, np.abs(model), linewidth=1.2, color=colour, label=f"{name} model")
                axes[0].fill_between(fine, low, np.abs(model) + gain, alpha=0.25, color=colour)
                axes[1].plot(fine, np.degrees(start), linewidth=1.2, color=colour)
                axes[1].fill_between(
                    fine, np.degrees(start) - phase, np.degrees(start) + phase, alpha=0.25, color=colour
                )
        axes[0].set(xscale="log", yscale="log", ylabel="magnitude")
        axes[1].set(xlabel="frequency [Hz]", ylabel="phase [deg]")
        axes[0].legend(fontsize=8)
        return figure

    def __repr__(self) -> str:
        return f"<IdentifiedResponse {str(self.model)!r} of {self.data!r}>"

    def _repr_html_(self) -> str:
        from harness.display import page
        from harness.plots import inlined

        return page(str(self.model), inlined(self.plot(), "frequency response, measured and of the model"))
