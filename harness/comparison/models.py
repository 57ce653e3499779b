"""Models side by side on one data set: fit, residuals, frequency responses, one page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from harness.comparison.residuals import LAGS, Correlation, correlations
from harness.comparison.spectra import Spectrum, spectrum
from harness.comparison.uncertain import bode_lines, is_linear, pole_figure, pole_rows, response_figure
from harness.display import STYLE, page, table
from harness.errors import HarnessError, InputError
from harness.models.determined import bands_of, bands_words
from harness.plots import inlined
from harness.protocols import Model
from harness.scoring import Score, equation_error, predict, simulation_error
from harness.signals import Dataset, Use, residual
from harness.units import own_record, own_values

MOST_POLES, MOST_SAMPLES = 40, 3000  # Poles in the table of a page, and samples in its picture over time.
LEGEND = (
    "Over time: what was measured, and the free run of every model with a band of 1.96 times the rms by which it "
    "misses the estimation data. Residuals are those of one-step predictions; the shaded regions hold 99 % of the "
    "lags of a white residual that is independent of the input. Bands and ellipses of models hold the truth with "
    "95 % if their structure does; crosses are poles, pale where their ellipse would be wider than the "
    "unit circle, circles zeros; dotted: frequencies that their data do not determine."
)


@dataclass(frozen=True, eq=False)
class Compared:
    """One model on one data set: scores by use, and what its one-step residuals still hold.

    Parameters
    ----------
    one_step, free_run : dict
        Scores by use of the data.
    residuals : dict
        By output name: correlations on the first validation record (the first estimation record without one).
    """

    name: str
    model: Model
    one_step: dict[Use, list[Score]]
    free_run: dict[Use, list[Score]]
    residuals: dict[str, Correlation]

    def errors(self) -> dict[str, tuple[float, str]]:
        """Return the rms of the free run on validation data, with its unit; see :func:`free_run_errors`."""
        return free_run_errors(self.model, self.free_run)


def free_run_errors(model: Model, scores: Mapping[Use, Sequence[Score]]) -> dict[str, tuple[float, str]]:
    """Return by output the rms of free runs over all validation records, with its unit.

    Where none validates, over the estimation records.
    """
    own = scores.get("validation") or scores.get("estimation") or ()
    samples = np.array([score.samples for score in own], dtype=float)
    if not len(samples):
        return {}
    squares = np.array([score.rms**2 for score in own])
    rms = np.sqrt(samples @ squares / samples.sum())
    return {channel.name: (float(value), channel.unit) for channel, value in zip(model.spec.outputs, rms, strict=True)}


@dataclass(frozen=True, eq=False)
class Comparison:
    """What :func:`compare` returns."""

    dataset: Dataset
    models: tuple[Compared, ...]
    spectrum: Spectrum | None

    def rows(self) -> list[dict[str, Any]]:
        """Return one row for each model, use and output: fit in per cent, and whether the residual is white."""
        found = []
        for compared in self.models:
            for use in compared.one_step:
                for k, channel in enumerate(self.dataset.spec.outputs):
                    steps = [score.fit_percent[k] for score in compared.one_step[use]]
                    runs = [score.fit_percent[k] for score in compared.free_run[use]]
                    held = compared.residuals[channel.name]
                    found.append(
                        {
                            "model": compared.name,
                            "use": use,
                            "output": channel.name,
                            "fit_one_step": float(np.mean(steps)),
                            "fit_free_run": float(np.mean(runs)),
                            "white": held.white,
                            "independent": held.independent,
                        }
                    )
        return found

    def __repr__(self) -> str:
        return f"<Comparison of {', '.join(compared.name for compared in self.models)} on {self.dataset.name}>"

    def _table(self) -> str:
        titles = ["model", "use", "output", "fit one step %", "fit free run %", "residual white", "free of the input"]
        words = {True: "yes", False: "no"}
        rows = [
            (
                *(r[key] for key in ("model", "use", "output")),
                *(f"{r[key]:.2f}" for key in ("fit_one_step", "fit_free_run")),
                *(words[r[key]] for key in ("white", "independent")),
            )
            for r in self.rows()
        ]
        return table(titles, rows)

    def _repr_html_(self) -> str:
        """Return the table and the pictures over time and frequency, as a notebook shows them."""
        pictures = [inlined(_time_figure(self), "measured and simulated")]
        if self.spectrum is not None and self.linear():
            pictures.append(inlined(_bode_figure(self), "frequency responses"))
        return page(
            f"{', '.join(compared.name for compared in self.models)} on {self.dataset.name}", self._table(), *pictures
        )

    def linear(self) -> dict[str, Model]:
        """Return the models that have a frequency response, by name."""
        return {compared.name: compared.model for compared in self.models if is_linear(compared.model)}

    def _poles(self) -> str:
        """Return the table of poles, and what is to be said of models."""
        linear = self.linear()
        if not linear:
            return ""
        rows = [row for name, model in linear.items() for row in pole_rows(name, model)]
        said = []
        for name, model in linear.items():
            if bands := bands_of(model):
                said.append(f"{name} is determined by its data: {bands_words(bands)}.")
            spread = getattr(model, "spread", None)
            if spread is None:
                said.append(f"{name} knows no intervals.")
            elif spread.warning:
                said.append(f"{name}: {spread.warning}.")
        words = "".join(f"<p>{escape(line)}</p>" for line in said)
        titles = ["model", "modulus of the pole (95 %)", "frequency [Hz]", "damping"]
        return f'<div style="margin-top: 1.2em">{table(titles, rows[:MOST_POLES])}</div>{words}'

    def html(self) -> str:
        """Return the page: table, residual correlations, Bode diagrams with the bands of the data."""
        linear = self.linear()
        figures = [
            inlined(_time_figure(self), "measured and simulated"),
            inlined(_residual_figure(self), "correlations of the residuals"),
            *([inlined(_bode_figure(self), "frequency responses")] if self.spectrum else []),
            *(
                [
                    inlined(response_figure(linear, self.dataset.recorded), "step responses"),
                    inlined(response_figure(linear, self.dataset.recorded, "impulse"), "impulse responses"),
                    inlined(pole_figure(linear), "poles and zeros"),
                ]
                if linear
                else []
            ),
        ]
        names = ", ".join(escape(compared.name) for compared in self.models)
        return (
            f'<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
            f"<title>{names}</title><style>{STYLE}</style><h1>{names} on {escape(self.dataset.name)}</h1>"
            f"<div>{self._table()}</div>{self._poles()}<p>{LEGEND}</p>{''.join(figures)}</html>"
        )


def compare(models: Mapping[str, Model], dataset: Dataset) -> Comparison:
    """Score models on one data set, and look at what their residuals still hold.

    Parameters
    ----------
    models : mapping
        By name.
    dataset : Dataset

    Raises
    ------
    InputError
        If a model does not speak the language of the data.
    """
    uses: list[Use] = [use for use in ("estimation", "validation", "test") if dataset.using(use)]
    judged = (dataset.validation or dataset.estimation)[0].measured()
    found = []
    for name, model in models.items():
        try:
            steps = {use: [equation_error(model, record) for record in dataset.using(use)] for use in uses}
            runs = {use: [simulation_error(model, record) for record in dataset.using(use)] for use in uses}
            guess = predict(model, judged, horizon=1)
        except InputError as error:
            raise error.located(place=name) from error
        miss = residual(dataset.spec.outputs, judged.y, np.asarray(guess))[model.burn_in :]
        kept = np.isfinite(miss).all(axis=1)
        held = {
            channel.name: correlations(miss[kept, k], judged.u[model.burn_in :][kept], dataset.spec.ny)
            for k, channel in enumerate(dataset.spec.outputs)
        }
        found.append(Compared(name, model, steps, runs, held))
    try:
        shown: Spectrum | None = spectrum([record.measured() for record in dataset.estimation])
    except HarnessError:
        shown = None  # without an input, or too short: the page goes without
    return Comparison(dataset, tuple(found), shown)


def _time_figure(found: Comparison) -> Any:
    """Draw the record that judges, and the free run of every model over it, each with what it may miss by."""
    from harness.plots import sheet

    record = (found.dataset.validation or found.dataset.estimation)[0].measured()
    channels, recorded = found.dataset.spec.outputs, found.dataset.recorded
    own = own_record(record, recorded)
    outputs = own.spec.outputs
    figure = sheet(figsize=(10, 1.9 * len(outputs) + 0.4), layout="constrained")
    axes = figure.subplots(len(outputs), 1, squeeze=False, sharex=True)[:, 0]
    shown = slice(0, min(len(record), MOST_SAMPLES))
    for axis, channel, measured in zip(axes, outputs, own.y.T, strict=True):
        axis.plot(record.t[shown], measured[shown], color="#777777", linewidth=0.9, label="measured")
        axis.set_ylabel(f"{channel.name} [{channel.unit}]", fontsize=9)
    for compared in found.models:
        run = np.asarray(predict(compared.model, record, horizon=None))
        scores = compared.free_run.get("estimation") or next(iter(compared.free_run.values()))
        miss = 1.96 * np.sqrt(np.mean([np.square(score.rms) for score in scores], axis=0))
        lines = (own_values(values, channels, recorded).T for values in (run, run - miss, run + miss))
        for axis, path, low, high in zip(axes, *lines, strict=True):
            (line,) = axis.plot(record.t[shown], path[shown], linewidth=1.0, label=compared.name)
            axis.fill_between(record.t[shown], low[shown], high[shown], color=line.get_color(), alpha=0.18, linewidth=0)
    for axis, measured in zip(axes, own.y[shown].T, strict=True):
        low, high = np.nanmin(measured), np.nanmax(measured)
        room = 0.4 * (high - low) or 1.0
        axis.set_ylim(low - room, high + room)  # a free run that leaves the data does not shrink them to a line
    axes[0].legend(fontsize=8, loc="upper right", ncols=4)
    axes[-1].set_xlabel("time [s]", fontsize=9)
    return figure


def _residual_figure(found: Comparison) -> Any:
    """Draw the correlations of every model's residuals."""
    from harness.plots import sheet

    outputs = [channel.name for channel in found.dataset.spec.outputs]
    nu = found.dataset.spec.nu
    figure = sheet(figsize=(10, 1.9 * len(found.models) * len(outputs) + 0.4), layout="constrained")
    axes = figure.subplots(len(found.models) * len(outputs), 1 + nu, squeeze=False)
    row = 0
    for compared in found.models:
        for output in outputs:
            held = compared.residuals[output]
            axes[row, 0].axhspan(-held.auto_bound, held.auto_bound, color="#dddddd")
            axes[row, 0].vlines(np.arange(1, LAGS + 1), 0, held.auto[1:], linewidth=2)
            axes[row, 0].set_title(f"{compared.name}: residual of {output} with itself", fontsize=9)
            for column in range(nu):
                bound = held.cross_bound[column]
                axes[row, 1 + column].axhspan(-bound, bound, color="#dddddd")
                axes[row, 1 + column].vlines(np.arange(-LAGS, LAGS + 1), 0, held.cross[column], linewidth=2)
                name = found.dataset.spec.inputs[column].name
                axes[row, 1 + column].set_title(f"{compared.name}: residual of {output} with {name}", fontsize=9)
            row += 1
    for axis in axes[-1]:
        axis.set_xlabel("lag [samples]", fontsize=9)
    return figure


def _bode_figure(found: Comparison) -> Any:
    """Draw what the data show, with its band, and the response of each linear model."""
    assert found.spectrum is not None
    spec = found.dataset.spec
    # data are grey, as they are over time, where that tells them apart: each model has one colour in all pictures
    figure = found.spectrum.as_recorded(found.dataset.recorded).plot("#777777" if spec.nu * spec.ny == 1 else None)
    f = found.spectrum.frequency[1:]
    for name, model in found.linear().items():
        bode_lines(figure.axes[:2], name, model, f, found.dataset.recorded)
    figure.axes[0].legend(fontsize=8)
    return figure
