"""Before any data: what a planned experiment could tell apart, from a simulated run of the nominal model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.diagnosis.report.isolability import ALIKE, isolability, unseen
from harness.effects.effect import Effect
from harness.errors import InputError
from harness.rng import Streams
from harness.signals import Dataset, FloatArray, Run

__all__ = ["Planned", "isolability_of"]


@dataclass(frozen=True)
class Planned:
    """What a planned experiment could tell apart.

    Attributes
    ----------
    effects : tuple of str
        Visible effects, ``NAME@PORT``.
    cosines : array (n, n)
        Entry (i, j): share of effect i that effect j can mimic, see :func:`harness.diagnosis.report.isolability.isolability`.
    alike : tuple of (str, str, float)
        Pairs that mimic each other beyond 0.95, the most alike first.
    hidden : tuple of dict
        Effects that the experiment cannot show: ``name``, ``at``, ``reason``.
    horizon : str
        How long the model can be simulated, and why.
    """

    effects: tuple[str, ...]
    cosines: FloatArray
    alike: tuple[tuple[str, str, float], ...]
    hidden: tuple[dict[str, Any], ...]
    horizon: str

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {
            "effects": list(self.effects),
            "cosine": np.round(self.cosines, 4).tolist(),
            "alike": [list(one) for one in self.alike],
            "not_visible": list(self.hidden),
            "horizon": self.horizon,
        }


def isolability_of(
    model: Any,
    scenario: Any,
    *,
    parameters: Mapping[str, float] | None = None,
    sample_time: float = 0.01,
    seed: int = 0,
    dictionary: Sequence[Effect] | None = None,
) -> Planned:
    """Simulate the nominal model under a scenario and compare what every effect would do to its outputs.

    Parameters
    ----------
    model : System or str
        The nominal model, or the name of one.
    scenario : Scenario
        The planned experiment. Its noise weighs the outputs against each other; without noise each counts by its size.
    parameters : mapping, optional
        Values of the model's parameters; by default its nominal ones.
    sample_time : float
        Of the planned record [s].
    seed : int
        Keys the random numbers of the scenario.
    dictionary : sequence of Effect, optional
        By default the built-in effects.

    Raises
    ------
    InputError
        If the model or the scenario cannot be used.

    Examples
    --------
    >>> from harness import registry
    >>> from harness.effects import builtin
    >>> planned = registry.create("scenarios", "multisine", duration=5.0, amplitude=0.4)
    >>> found = isolability_of("pendulum", planned, dictionary=[builtin()["gravity_tilt"], builtin()["sensor_offset"]])
    >>> [(a, b) for a, b, _ in found.alike]
    [('gravity_tilt@base', 'sensor_offset@theta')]
    """
    from harness import registry
    from harness.diagnosis.records.prepare import choose_horizon, sizes_of
    from harness.diagnosis.runs.form import OutputForm
    from harness.diagnosis.screens import sensitivity_screen
    from harness.effects import place_all
    from harness.physics.levenberg import minimise_states
    from harness.physics.windows import Windows, data_states
    from harness.rollout import run

    plant = registry.create("plants", "ode", model=model, parameters=dict(parameters or {}), sample_time=sample_time)
    system, values = plant.nominal, {name: plant.true_parameters[name] for name in plant.nominal.parameter_names}
    record = run(plant, scenario, streams=Streams("planned", system.name, seed)).measured()
    dataset = Dataset("planned", (Run(record, "estimation"),))
    if not np.ptp(record.y, axis=0).any():
        raise InputError(
            "the planned experiment moves nothing",
            expected="an excitation or an initial state",
            got="outputs that stay where they are",
            remedy="raise the amplitude, or give x0",
        )
    system = system.with_parameters(values)
    horizon = choose_horizon(system, values, dataset)
    sizes = sizes_of(system, values, dataset)
    spread = np.std(record.y, axis=0)
    noise = getattr(scenario, "noise", None)
    weights = np.where(spread > 0, 0.01 * spread, 1.0)
    if isinstance(noise, int | float) and noise > 0:
        weights = np.full_like(spread, float(noise))
    floors = [None] * len(spread)
    form = OutputForm(system, dataset, sizes=sizes, horizon=horizon.seconds, weights=weights, floors=floors)
    p = system.vector(values)
    simulator = form.simulator(system, p)
    windows = Windows(simulator, [record], horizon.seconds, weights)
    x0 = minimise_states(windows, p, windows.starts_from([data_states(simulator, record, p)[0]]), 25)
    nominal = {"values": values, "converged": True, "message": "", "refitted": {}, "x0_validation": []}
    base = form.evaluate((), {**nominal, "x0": x0.tolist()})
    candidates = place_all(system, dictionary)
    screen = sensitivity_screen(form, base, candidates, lambda placed: sizes.get(placed.at, sizes.get("base", {})))
    names, cosines = isolability(screen)
    both = np.minimum(cosines, cosines.T)
    pairs = [
        (names[i], names[j], round(float(both[i, j]), 4))
        for i in range(len(names))
        for j in range(i + 1, len(names))
        if both[i, j] > ALIKE
    ]
    length = "whole records" if horizon.seconds is None else f"windows of {horizon.seconds:g} s"
    pairs.sort(key=lambda one: -one[2])
    return Planned(names, cosines, tuple(pairs), tuple(unseen(screen)), f"{length}: {horizon.reason}")
