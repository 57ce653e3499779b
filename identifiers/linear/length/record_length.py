"""How long to record for an accuracy: an analysis of pilot records, or of a model with a planned excitation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, get_args

import numpy as np

from harness.errors import InputError
from harness.models.analysis import Findings, Takes
from harness.rng import Streams
from harness.signals import Dataset, FloatArray
from identifiers.common.named import named
from identifiers.linear.length.physical import mechanism_of
from identifiers.linear.length.pilot import (
    Pilot,
    PilotEntry,
    fitted_pilot,
    linear_plan,
    mechanism_plan,
    scenario_inputs,
)
from identifiers.linear.length.quantities import Asked, quantile_of_norm

_DRAWS = 2000  # Draws of what the pilot may have been mistaken by.
_TOLD = 1.0  # Relative error, with 95 %, from which on a pilot does not tell a quantity from zero.
_SHORTER = 0.25  # Share of the pilot below which a length is no forecast.
_NOISE = 0.01  # Noise of a planned record of a mechanism where nothing says it, relative to each output.


@dataclass(frozen=True)
class Needed:
    """How long a record must be."""

    now: float  # Relative error that 95 % of pilots like this one stay below
    samples: float  # That bring it to the accuracy asked for, by the pilot
    # 90 % of what the length may be, the pilot having been lucky or unlucky
    low: float
    high: float
    safe: float  # That suffice with the certainty asked for


def needed_length(
    entry: PilotEntry, samples: int, accuracy: float, certainty: float, rng: np.random.Generator, ratio: float = 1.0
) -> Needed:
    """Return the length at which 95 % of records have a relative error below an accuracy.

    Errors fall with the square root of the length, as the information of a steady excitation adds up. What the pilot
    says of their size is uncertain by its degrees of freedom (chi-square), and the value that they are relative to by
    themselves.

    - ``samples``: of the pilot
    - ``accuracy``: relative
    - ``certainty``: probability that the ``safe`` length suffices
    - ``ratio``: error at another amplitude over that of the pilot

    Examples
    --------
    >>> from identifiers.linear.length.quantities import Item
    >>> item = Item("gain", "1", None, np.array([2.0]))
    >>> found = needed_length(PilotEntry(item, np.array([[0.04]]), 1e6, {}), 100, 0.05, 0.9, np.random.default_rng(0))
    >>> round(found.now, 3), round(found.samples)
    (0.196, 1537)
    >>> found.low < found.samples < found.safe < found.high
    True
    """
    item, covariance = entry.item, entry.covariance * ratio**2
    if not np.isfinite(covariance).all():
        return Needed(*(float("inf"),) * 5)
    radius = quantile_of_norm(covariance, entry.freedom, rng)
    now = radius / item.size
    # the error of a longer record has many degrees of freedom: Student's quantile is that of the pilot alone
    ahead = quantile_of_norm(covariance, np.inf, rng) / item.size
    along = float(np.sqrt(max(float(item.value @ covariance @ item.value), 0.0))) / item.size**2
    draws = (entry.freedom / rng.chisquare(entry.freedom, _DRAWS)) / (1.0 + along * rng.standard_normal(_DRAWS)) ** 2
    length = samples * (ahead / accuracy) ** 2
    low, safe, high = (float(np.quantile(draws, q)) for q in (0.05, certainty, 0.95))
    return Needed(now, length, length * low, length * high, length * safe)


@dataclass(frozen=True)
class RecordLength:
    """How long to record until 95 % of estimates err by less than an accuracy.

    From pilot records: an identifier is fitted to them, its spread is that of the fits without one stretch each (or the
    estimate's covariance), and it falls with the square root of the length. From a model and a scenario: the Fisher
    information of the planned record. Both say what another amplitude of the inputs would do: the part of the
    information that the inputs bring grows with its square, that of the noise which the model filters does not; of a
    mechanism the sensitivities are taken at that amplitude anew.

    Given the pilot the length itself is uncertain; ``safe`` suffices with the ``certainty`` asked for. What no length
    mends (a bias, an order that is wrong) is not in it, and is said where the fit knows of it.

    Parameters
    ----------
    accuracy : float or str
        Relative error, ``0.05`` or ``"5%"``.
    quantity : {"gain", "pole", "response", "parameter"}
        Gains at rest (or at ``frequency``), poles in 1/s, impulse responses, or the parameters of the estimate.
    frequency : float, optional
        [Hz] of a gain.
    identifier : str
        Id of the identifier that is fitted to pilot records.
    options : mapping
        Its options; an order that is given is the one that the long record is fitted with too.
    scenario : str, optional
        Id of the excitation that is planned, where a model is given instead of records.
    scenario_options : mapping
        Its options: the length of the plan, the amplitude, the band.
    noise : float or sequence of float, optional
        Standard deviations of the sensors' white noise in a plan: one number, or one for each output. By default the
        residuals that a linear model was fitted with, the noise of the scenario, or 1 % of each output of a mechanism.
    sample_time : float
        [s], of a plan for a mechanism.
    amplitudes : sequence of float
        Of the inputs, over those of the pilot.
    certainty : float

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec, Run, Trajectory
    >>> rng, y = np.random.default_rng(0), np.zeros((600, 1))
    >>> u = rng.normal(size=(600, 1))
    >>> for k in range(599):
    ...     y[k + 1] = 0.8 * y[k] + 0.4 * u[k]
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> record = Trajectory(np.arange(600.0), u, y + rng.normal(size=y.shape), spec)
    >>> asked = RecordLength(accuracy="5%", quantity="gain", options={"order": 1})
    >>> found = asked.of(Dataset("pilot", (Run(record),)), rng=rng)
    >>> 600 < found.rows[0]["samples"] < found.rows[0]["safe"] < 20000
    True
    """

    takes: ClassVar[Takes] = "records"
    accuracy: float | str = "5%"
    quantity: Asked = "gain"
    frequency: float | None = None
    identifier: str = "n4sid"
    options: Mapping[str, Any] = field(default_factory=dict)
    scenario: str | None = None
    scenario_options: Mapping[str, Any] = field(default_factory=dict)
    noise: float | Sequence[float] | None = None
    sample_time: float = 0.01
    amplitudes: Sequence[float] = (0.5, 2.0)
    certainty: float = 0.9

    def of(self, subject: Any, *, rng: np.random.Generator) -> Findings:
        """Return the length for every quantity, and what another amplitude would do to it."""
        accuracy = self._checked()
        if isinstance(subject, Dataset):
            if self.scenario is not None:
                _refuse("scenario", "a model, to plan a record for it", "a data set", "leave scenario out")
            # a pilot judges no model: what a table keeps for validation is part of it
            records = [record.measured() for record in (*subject.estimation, *subject.validation)]
            made = named("identifiers", self.identifier, self.options)
            model = made.fit(records, rng=rng)
            pilot = fitted_pilot(model, records, self.quantity, self.frequency, self.amplitudes, rng)
        else:
            pilot = self._planned(subject, rng)
        if not pilot.entries:
            _refuse(self.quantity, "a model that has one", "none", "ask for another quantity")
        return self._found(pilot, accuracy, rng)

    def _checked(self) -> float:
        """Return the accuracy as a number; refuse options that mean nothing."""
        text = str(self.accuracy).strip()
        try:
            accuracy = float(text.rstrip("% ")) / (100.0 if text.endswith("%") else 1.0)
        except ValueError:
            accuracy = float("nan")
        fine = self.quantity in get_args(Asked) and all(a > 0 for a in self.amplitudes) and self.sample_time > 0
        if not (0.0 < accuracy < 1.0 and 0.0 < self.certainty < 1.0 and fine):
            _refuse(
                "options of record-length",
                "accuracy such as 5%, quantity gain, pole, response or parameter, amplitudes and sample_time above 0, "
                "certainty between 0 and 1",
                f"{self.accuracy}, {self.quantity}, {list(self.amplitudes)}, {self.sample_time}, {self.certainty}",
                "correct them",
            )
        return accuracy

    def _planned(self, subject: Any, rng: np.random.Generator) -> Pilot:
        """Return what a planned record would say of a model."""
        if self.scenario is None:
            _refuse("record-length of a model", "a scenario", "none", "give -O scenario=prbs, or pilot records")
        scenario = named("scenarios", str(self.scenario), self.scenario_options)
        seed = int(rng.integers(2**31))
        if hasattr(subject, "parameter_names"):
            return self._of_system(subject, None, self.sample_time, (), scenario, seed)
        if hasattr(subject, "recipe") and hasattr(subject, "system"):
            names = tuple((subject.notes.get("estimate") or {}).get("names", ()))
            return self._of_system(
                subject.system(), dict(subject.parameters), subject.spec.sample_time, names, scenario, seed
            )
        if not hasattr(subject, "matrices"):
            _refuse("record-length", "records, a linear model or a physical one", type(subject).__name__, "give one")
        if self.quantity == "parameter":
            _refuse("a plan for parameters", "a physical model", "a linear one", "ask for gain, pole or response")
        streams = Streams("record-length", str(self.scenario), seed)
        u = scenario_inputs(scenario, subject.spec, streams, "estimation/0")
        noise = None if self.noise is None else self._noise(subject.spec.ny)
        return linear_plan(subject, [u], noise, self.quantity, self.frequency, self.amplitudes, rng)

    def _of_system(
        self,
        system: Any,
        values: dict[str, float] | None,
        sample_time: float,
        names: Sequence[str],
        scenario: Any,
        seed: int,
    ) -> Pilot:
        """Return what a planned record would say of the parameters of a mechanism."""
        from dataclasses import replace

        from harness.rollout import perform

        if self.quantity != "parameter":
            _refuse("a plan for a mechanism", "quantity=parameter", self.quantity, "ask for its parameters")
        made = mechanism_of(system, sample_time, values, names)
        given = {name: float(v) for name, v in zip(made.simulator.parameter_names, made.values, strict=True)}
        runs, noise = {}, np.zeros(0)
        with named("plants", "ode", {"model": system, "parameters": given, "sample_time": sample_time}) as plant:
            for amplitude in sorted({1.0, *self.amplitudes}):
                streams = Streams("record-length", system.name, seed)
                experiment = scenario.prepare(plant.spec, streams=streams, role="estimation/0")
                experiment = replace(experiment, excitation=amplitude * experiment.excitation, disturbance=None)
                record = perform(plant, experiment, rng=streams("estimation/0/plant"))
                assert record.x is not None
                runs[amplitude] = (record.u, record.x[0])
                if amplitude == 1.0:
                    noise = self._noise(plant.spec.ny, record.y, getattr(scenario, "noise", None))
        units = {one.name: one.unit for one in system.parameters}
        return mechanism_plan(made, runs, noise, units, plant.spec)

    def _noise(self, outputs: int, y: FloatArray | None = None, own: Any = None) -> FloatArray:
        """Return the noise (ny,) of the sensors in a plan."""
        given = self.noise if self.noise is not None else (own if isinstance(own, int | float) and own > 0 else None)
        if given is None:
            assert y is not None
            return np.asarray(np.maximum(_NOISE * y.std(axis=0), 1e-300), dtype=np.float64)
        noise = np.broadcast_to(np.asarray(given, dtype=float), (outputs,)) if np.size(given) in (1, outputs) else None
        if noise is None or not np.all(noise > 0):
            _refuse("noise", f"one number above 0, or {outputs}", str(given), "correct it")
        return np.asarray(noise, dtype=np.float64)

    def _found(self, pilot: Pilot, accuracy: float, rng: np.random.Generator) -> Findings:
        """Return the table, the words and the picture."""
        seconds = pilot.spec.sample_time
        rows, needs = [], []
        for entry in pilot.entries:
            need = needed_length(entry, pilot.samples, accuracy, self.certainty, rng)
            needs.append(need)
            value = complex(*entry.item.value) if len(entry.item.value) == 2 else None
            shown = f"{value:.4g}" if value is not None else f"{entry.item.size * np.sign(entry.item.value[0]):.4g}"
            row: dict[str, Any] = {
                "what": entry.item.name,
                "value": shown if self.quantity != "response" else f"norm {entry.item.size:.4g}",
                "unit": entry.item.unit,
                "now [%]": float(f"{100 * need.now:.3g}"),
                "samples": _whole(need.samples),
                "low": _whole(need.low),
                "high": _whole(need.high),
                "safe": _whole(need.safe),
                "safe [s]": _rounded(need.safe * seconds),
            }
            for amplitude, ratio in sorted(entry.ratios.items()):
                if amplitude != 1.0:
                    row[f"at {amplitude:g} x input"] = _whole(need.samples * ratio**2)
            rows.append(row)
        worst = int(np.argmax([need.samples for need in needs]))
        words = self._words(pilot, needs, worst, accuracy)
        details = {"pilot_samples": pilot.samples, "accuracy": accuracy, "certainty": self.certainty}
        return Findings(
            f"length of a record for {100 * accuracy:g} %",
            rows,
            words,
            details,
            lambda: _drawn(pilot, pilot.entries[worst], needs[worst], accuracy),
        )

    def _words(self, pilot: Pilot, needs: Sequence[Needed], worst: int, accuracy: float) -> tuple[str, ...]:
        """Return what the table means."""
        need, entry = needs[worst], pilot.entries[worst]
        if not np.isfinite(need.samples):
            return (f"nothing of {entry.item.name} is told by {pilot.name}: no length of this kind does", *pilot.words)
        times = need.safe / pilot.samples
        words = [
            f"record {_whole(need.safe)} samples ({_rounded(need.safe * pilot.spec.sample_time):g} s), {times:.3g} "
            f"times {pilot.name} of {pilot.samples}, for {100 * accuracy:g} % of {entry.item.name}, which takes "
            f"longest: 95 % of such records keep it, {100 * self.certainty:g} % sure"
        ]
        known = [one.efficiency for one in pilot.entries if np.isfinite(one.efficiency)]
        if known:
            words.append(f"the fit errs {np.median(known):.3g} times as much as the best unbiased one could")
        if need.safe < _SHORTER * pilot.samples:
            words.append(
                f"it is kept by far with {pilot.name}; of records so much shorter this is no forecast, as they are "
                "mostly start: plan a shorter one to see"
            )
        vague = [one.item.name for one, what in zip(pilot.entries, needs, strict=True) if what.now > _TOLD]
        if vague:
            words.append(
                f"the pilot hardly tells {', '.join(vague)} from zero: record more before trusting that length"
            )
        if not any(one.ratios for one in pilot.entries):
            words.append("what another amplitude would do is known of gains, poles, responses and mechanisms only")
        return (*words, *pilot.words)


def _drawn(pilot: Pilot, entry: PilotEntry, need: Needed, accuracy: float) -> Any:
    """Draw the error over the length, by amplitude, with what the pilot leaves open."""
    from harness.plots import sheet

    figure = sheet(figsize=(6.4, 4.2), layout="constrained")
    axis = figure.subplots()
    seconds = pilot.spec.sample_time
    longest = max(need.high if np.isfinite(need.high) else 10 * pilot.samples, 2.0 * pilot.samples)
    n = np.geomspace(0.5 * min(pilot.samples, need.low), 3.0 * longest, 60)
    middle = 100 * accuracy * np.sqrt(need.samples / n)
    low, high = (100 * accuracy * np.sqrt(edge / n) for edge in (need.low, need.high))
    axis.fill_between(n * seconds, low, high, alpha=0.25, lw=0, label="90 % of what the pilot leaves open")
    axis.plot(n * seconds, middle, label="inputs as in the pilot")
    for amplitude, ratio in sorted(entry.ratios.items()):
        if amplitude != 1.0 and np.isfinite(ratio):
            axis.plot(n * seconds, ratio * middle, "--", lw=1, label=f"inputs {amplitude:g} times as large")
    axis.axhline(100 * accuracy, color="k", lw=0.8)
    axis.plot([pilot.samples * seconds], [100 * accuracy * np.sqrt(need.samples / pilot.samples)], "o", color="k")
    axis.annotate("pilot", (pilot.samples * seconds, 100 * accuracy * np.sqrt(need.samples / pilot.samples)),
                  textcoords="offset points", xytext=(6, 4))  # fmt: skip
    axis.axvline(need.safe * seconds, color="C3", lw=1, label=f"record {_rounded(need.safe * seconds):g} s")
    axis.set(xscale="log", yscale="log", xlabel="length [s]", ylabel="error that 95 % stay below [%]")
    axis.set_title(entry.item.name, fontsize=10)
    axis.grid(alpha=0.3, which="both")
    axis.legend(fontsize=8)
    return figure


def _whole(number: float) -> float:
    """Return a number of samples, rounded up; infinity stays."""
    return int(np.ceil(number)) if np.isfinite(number) else float("inf")


def _rounded(number: float) -> float:
    return float(f"{number:.4g}")


def _refuse(what: str, expected: str, got: str, remedy: str) -> None:
    raise InputError(what, expected=expected, got=got, remedy=remedy)
