"""What a pilot says: how uncertain each thing asked for is after it, and how that falls with amplitude."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from harness.errors import InputError
from harness.models.estimate import estimate_of
from harness.models.spread import covariance_of
from harness.scoring import predict
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.common.neighbours import GROUPS
from identifiers.linear.length.information import information_of_linear, variance_of
from identifiers.linear.length.physical import SampledMechanism, mechanism_of
from identifiers.linear.length.quantities import Asked, Item, items_of_estimate, items_of_matrices

_UNEVEN = 4.0
"""Information of the halves of a record that differs by more than this factor is no steady excitation; of a lightly
damped plant under white inputs it differs by 2 in 500 samples by chance."""
_ANALYTIC = 1e6  # Degrees of freedom of a covariance that no scatter was counted for.


@dataclass(frozen=True, eq=False)
class PilotEntry:
    """One thing asked for, after the pilot."""

    item: Item
    covariance: FloatArray  # (k, k): Of its error after the pilot; infinite where the pilot says nothing
    freedom: float  # Degrees of freedom of that covariance
    ratios: Mapping[float, float]  # By amplitude: error over that at the pilot's amplitude
    efficiency: float = float("nan")
    """Error over the least that any unbiased method could have (Cramer & Rao); nan where that is not known."""


@dataclass(frozen=True, eq=False)
class Pilot:
    """A record that was made, or one that is planned."""

    samples: int  # In all records together
    spec: PlantSpec
    entries: Sequence[PilotEntry]
    words: Sequence[str] = field(default_factory=tuple)  # What was found on the way
    name: str = "the records"  # ``"the records"`` or ``"the planned record"``


def fitted_pilot(
    model: Any,
    records: Sequence[Trajectory],
    asked: Asked,
    frequency: float | None,
    amplitudes: Sequence[float],
    rng: np.random.Generator,
) -> Pilot:
    """Return the pilot of records and the model that was fitted to them."""
    words = _warnings(model)
    rows = sum(map(len, records))
    if asked == "parameter":
        pairs = items_of_estimate(model)
        if not pairs:
            estimate = estimate_of(model)
            raise InputError(
                "parameters of the fit", expected="an estimate with a covariance",
                got="none" if estimate is None else (estimate.method or "none"),
                remedy="ask for gain, pole or response, or use another identifier",
            )  # fmt: skip
        free = GROUPS - 1.0 if hasattr(model, "spread") else _ANALYTIC
        ratios, bound, said = _of_mechanism(model, records, [item.name for item, _ in pairs], amplitudes)
        entries = [
            PilotEntry(item, variance, free, ratios.get(item.name, {}), _over(variance, bound.get(item.name)))
            for item, variance in pairs
        ]
        return Pilot(rows, records[0].spec, entries, (*words, *said))
    if not hasattr(model, "matrices"):
        raise InputError(
            f"{asked} of the fit", expected="a linear model", got=type(model).__name__, remedy="ask for parameter"
        )
    items, more = items_of_matrices(model.matrices, records[0].spec, asked, frequency)
    noise = _innovations(model, records)
    inputs = [record.u - np.concatenate([one.u for one in records]).mean(axis=0) for record in records]
    found = information_of_linear(model.matrices, model.a_matrix @ model.filter_gain, noise, inputs, rng=rng)
    entries = []
    for item in items:
        assert item.of is not None
        least = {a: variance_of(item, model.matrices, found, a) for a in {1.0, *amplitudes}}
        measured = model.spread is not None
        covariance = covariance_of(model, item.of) if measured else least[1.0]
        covariance = np.atleast_2d(covariance)
        free = model.spread.freedom if measured else _ANALYTIC
        entries.append(PilotEntry(item, covariance, free, _ratios(least, amplitudes), _over(covariance, least[1.0])))
    if model.spread is None:
        more.append("the fit kept no neighbours: errors are the least that an unbiased method could have")
    return Pilot(rows, records[0].spec, entries, (*words, *more, *_uneven(*found.halves)))


def linear_plan(
    model: Any,
    inputs: Sequence[FloatArray],
    noise: FloatArray | None,
    asked: Asked,
    frequency: float | None,
    amplitudes: Sequence[float],
    rng: np.random.Generator,
) -> Pilot:
    """Return what a planned record would say of a linear model that is believed.

    - ``model``: its filter gain and its residuals tell the noise where none is given
    - ``inputs`` sequence of array (N, nu)
    - ``noise`` (ny,): standard deviations of white noise of the sensors
    - ``asked, frequency, amplitudes, rng``: as of :func:`fitted_pilot`
    """
    items, words = items_of_matrices(model.matrices, model.spec, asked, frequency)
    gain = 0.0 * model.filter_gain
    if noise is None:
        rms = model.notes.get("residual_rms")
        if rms is None:
            raise InputError(
                "noise",
                expected="standard deviations",
                got="none in the model",
                remedy="give -O noise=STANDARD_DEVIATION",
            )
        noise, gain = np.asarray(rms, dtype=float), model.a_matrix @ model.filter_gain
    inputs = [u - u.mean(axis=0) for u in inputs]
    found = information_of_linear(model.matrices, gain, np.diag(noise**2), inputs, rng=rng)
    entries = []
    for item in items:
        least = {a: variance_of(item, model.matrices, found, a) for a in {1.0, *amplitudes}}
        entries.append(PilotEntry(item, least[1.0], _ANALYTIC, _ratios(least, amplitudes)))
    words.append("errors are the least that an unbiased method could have (Cramer and Rao), with the model as it is")
    return Pilot(sum(map(len, inputs)), model.spec, entries, (*words, *_uneven(*found.halves)), "the planned record")


def mechanism_plan(
    made: SampledMechanism,
    runs: Mapping[float, tuple[FloatArray, FloatArray]],
    noise: FloatArray,
    units: Mapping[str, str],
    spec: PlantSpec,
) -> Pilot:
    """Return what planned records of a physical model would say of its parameters.

    - ``runs`` mapping of float to (array (N, nu), array (nx,)): inputs and initial state by amplitude; that of 1 is the
      plan
    - ``noise`` (ny,)
    - ``units``: of the parameters
    """
    known = {a: made.covariance([u], [x0], noise) for a, (u, x0) in runs.items()}
    values = dict(zip(made.simulator.parameter_names, made.values, strict=True))
    entries = []
    for row, name in enumerate(made.names):
        least = {a: covariance[row : row + 1, row : row + 1] for a, (covariance, _) in known.items()}
        if values[name] != 0:
            item = Item(name, units[name], None, np.array([values[name]]))
            entries.append(PilotEntry(item, least[1.0], _ANALYTIC, _ratios(least, list(runs))))
    words = ("errors are the least that an unbiased method could have (Cramer and Rao), with the parameters as given",)
    return Pilot(len(runs[1.0][0]), spec, entries, (*words, *_uneven(*known[1.0][1])), "the planned record")


def _of_mechanism(
    model: Any, records: Sequence[Trajectory], names: Sequence[str], amplitudes: Sequence[float]
) -> tuple[dict[str, dict[float, float]], dict[str, FloatArray], list[str]]:
    """Return, of a grey box, ratios by parameter and amplitude, and least variances; nothing of another model."""
    if not (hasattr(model, "simulator") and hasattr(model, "system")):
        return {}, {}, []
    system = model.system()
    made = mechanism_of(system, model.spec.sample_time, model.parameters, names, model.simulator)
    rests = [record.y - predict(model, record, None) for record in records]
    noise = np.sqrt(np.mean(np.concatenate(rests) ** 2, axis=0))
    starts = [np.asarray(model.initial_state(record))[: system.nx] for record in records]
    known, halves = {}, (np.zeros((0, 0)),) * 2
    for a in {1.0, *amplitudes}:
        inputs = [record.u.mean(axis=0) + a * (record.u - record.u.mean(axis=0)) for record in records]
        known[a], found = made.covariance(inputs, starts, np.maximum(noise, 1e-300))
        halves = found if a == 1.0 else halves
    least = {a: {name: c[i : i + 1, i : i + 1] for i, name in enumerate(names)} for a, c in known.items()}
    ratios = {name: _ratios({a: least[a][name] for a in known}, amplitudes) for name in names}
    return ratios, least[1.0], _uneven(*halves)


def _ratios(least: Mapping[float, FloatArray], amplitudes: Sequence[float]) -> dict[float, float]:
    """Return the error at each amplitude over that at 1."""
    own = float(np.trace(least[1.0]))
    with np.errstate(invalid="ignore"):
        return {a: float(np.sqrt(np.trace(least[a]) / own)) if own > 0 else float("nan") for a in amplitudes}


def _over(covariance: FloatArray, least: FloatArray | None) -> float:
    """Return an error over the least there is."""
    if least is None or not float(np.trace(least)) > 0 or not np.isfinite(least).all():
        return float("nan")
    return float(np.sqrt(np.trace(covariance) / np.trace(least)))


def _innovations(model: Any, records: Sequence[Trajectory]) -> FloatArray:
    """Return the covariance (ny, ny) of the one-step errors."""
    rests = []
    for record in records:
        rest = record.y - predict(model, record, 1)
        rests.append(rest[max(int(model.burn_in), 1) + 1 :])
    together = np.concatenate(rests)
    together = together[np.isfinite(together).all(axis=1)]
    return np.atleast_2d(together.T @ together / max(len(together), 1))


def _uneven(first: FloatArray, second: FloatArray) -> list[str]:
    """Return words where one half of the records tells far more than the other."""
    size = np.sqrt(np.diag(first + second))
    seen = size > 0
    if not seen.any():
        return []
    parts = [float(np.trace(half[np.ix_(seen, seen)] / np.outer(size[seen], size[seen]))) for half in (first, second)]
    if min(parts) * _UNEVEN >= max(parts):
        return []
    more, less = ("first", "second") if parts[0] > parts[1] else ("second", "first")
    return [
        f"the {more} half tells {max(parts) / max(min(parts), 1e-300):.3g} times what the {less} half does: the "
        "excitation is not steady, and lengths hold for repeated records of this kind, not for a longer one"
    ]


def _warnings(model: Any) -> list[str]:
    """Return what the fit warns of: a bias that no length mends."""
    notes = getattr(model, "notes", None) or {}
    spread = getattr(model, "spread", None)
    said = [str(notes[key]) for key in ("warning",) if notes.get(key)]
    if spread is not None and spread.warning and spread.warning not in said:
        said.append(spread.warning)
    return [f"a longer record does not mend this: {text}" for text in said]


def scenario_inputs(scenario: Any, spec: PlantSpec, streams: Any, role: str) -> FloatArray:
    """Return the inputs of an open-loop scenario for a model's channels (N, nu).

    Raises InputError if the scenario has a controller, which a linear model alone cannot answer, or does not suit the
    channels.
    """
    experiment = scenario.prepare(spec, streams=streams, role=role)
    if experiment.controller is not None:
        raise InputError(
            "scenario of a plan", expected="an open loop", got="a controller",
            remedy="record a pilot under the controller and give that",
        )  # fmt: skip
    return np.asarray(experiment.excitation, dtype=float)
