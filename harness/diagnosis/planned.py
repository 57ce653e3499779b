"""Before any data: what a planned experiment could tell apart, from a simulated run of the nominal model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from harness.diagnosis.isolability import unseen
from harness.diagnosis.policy import PLAN_POLICY, POLICY, PlanPolicy, Policy
from harness.diagnosis.search.fit import Fit
from harness.diagnosis.search.scores import projected, score_test
from harness.effects.compose import compose
from harness.effects.effect import Effect, Placed
from harness.errors import FitError, InputError
from harness.physics.compiled.system import System
from harness.protocols import Scenario
from harness.rng import Streams, stream
from harness.signals import Dataset, FloatArray, Run, Trajectory

if TYPE_CHECKING:
    from harness.diagnosis.forms.equations_form import EquationsForm

USES: tuple[Literal["estimation", "validation"], ...] = ("estimation", "validation")


@dataclass(frozen=True)
class Planned:
    """What a planned experiment could tell apart.

    Attributes
    ----------
    effects : tuple of str
        Visible effects, ``NAME@PORT``.
    cosines : array (n, n)
        Entry (i, j): share of effect i that effect j can mimic, the parameters and initial states having done what they
        can; see :meth:`harness.diagnosis.search.score_test.ScoreTest.cosines`.
    alike : tuple of (str, str, float)
        Pairs that mimic each other beyond 0.95, the most alike first.
    hidden : tuple of dict
        Effects that the experiment cannot show: ``name``, ``at``, ``reason``, ``parameter``, ``left``; see
        :func:`harness.diagnosis.isolability.unseen`.
    smallest : dict
        By effect how far its main ``parameter`` must be from where it does nothing to be seen: ``value`` in ``unit``.
        Of effects that are linear in it.
    untested : tuple of str
        Effects that no first-order test tells anything about: play, hidden resonances.
    noise : str
        What the outputs are weighed by.
    """

    effects: tuple[str, ...]
    cosines: FloatArray
    alike: tuple[tuple[str, str, float], ...]
    hidden: tuple[dict[str, Any], ...]
    smallest: dict[str, dict[str, Any]]
    untested: tuple[str, ...]
    noise: str

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {
            "effects": list(self.effects),
            "cosine": np.round(self.cosines, 4).tolist(),
            "alike": [list(pair) for pair in self.alike],
            "not_visible": list(self.hidden),
            "visible_from": self.smallest,
            "not_tested": list(self.untested),
            "noise": self.noise,
        }


def isolability_of(
    model: System | str,
    scenario: Scenario,
    *,
    parameters: Mapping[str, float] | None = None,
    sample_time: float = 0.01,
    seed: int = 0,
    dictionary: Sequence[Effect] | None = None,
    policy: Policy = POLICY,
    plan: PlanPolicy = PLAN_POLICY,
) -> Planned:
    """Simulate the nominal model under a scenario and compare what every effect would do to its likelihood.

    The test of a diagnosis (:mod:`harness.diagnosis.search.score_test`) on records in which nothing is missing.

    Parameters
    ----------
    model : System or str
        The nominal model, or the name of one.
    scenario : Scenario
        The planned experiment. Its noise is that of the records; where it has none, 1 % of each output's size is taken.
    parameters : mapping, optional
        Values of the model's parameters; by default its nominal ones.
    sample_time : float
        Of the planned record [s].
    seed : int
        Keys the random numbers of the scenario.
    dictionary : sequence of Effect, optional
        By default the built-in effects.
    policy : Policy
        Its ``evidence`` decides from which size on an effect is seen.
    plan : PlanPolicy
        What counts as visible, and as alike.

    Raises
    ------
    InputError
        If the model or the scenario cannot be used.
    FitError
        If the model cannot be simulated along its own record.

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
    from harness.diagnosis.forms.equations_form import EquationsForm
    from harness.diagnosis.records.prepare import sizes_of
    from harness.effects import place_all
    from harness.rollout import run
    from harness.supervision.workers import one_thread

    plant = registry.create("plants", "ode", model=model, parameters=dict(parameters or {}), sample_time=sample_time)
    system, values = plant.nominal, {name: plant.true_parameters[name] for name in plant.nominal.parameter_names}
    records = [
        run(plant, scenario, streams=Streams("planned", system.name, seed), role=f"{use}/0").measured() for use in USES
    ]
    if not np.ptp(records[0].y, axis=0).any():
        raise InputError(
            "the planned experiment moves nothing",
            expected="an excitation or an initial state",
            got="outputs that stay where they are",
            remedy="raise the amplitude, or give x0",
        )
    records, noise = _noisy(records, scenario, seed)
    dataset = Dataset("planned", tuple(Run(record, use) for record, use in zip(records, USES, strict=True)))
    system = system.with_parameters(values)
    with one_thread():
        form = EquationsForm(system, dataset, sizes_of(system, values, dataset))
        fit = form.fit((), [values], None)
        if fit is None:
            raise FitError(
                f"model {system.name} under the planned experiment",
                expected="a state that stays finite",
                got="divergence",
                remedy="a smaller amplitude, a shorter record, or a controller as the scenario",
            )
        form.resize(fit)
        # what refines a law is looked for where that law was found
        candidates = [placed for placed in place_all(system, dictionary) if not placed.effect.grows]
        test = score_test(form, fit, candidates, replace(policy, seen=plan.visible))
        names, cosines = test.cosines(most=len(test.leads))
        both = np.minimum(cosines, cosines.T)
        pairs = [
            (names[i], names[j], round(float(both[i, j]), 4))
            for i in range(len(names))
            for j in range(i + 1, len(names))
            if both[i, j] > plan.alike
        ]
        pairs.sort(key=lambda pair: -pair[2])
        tested = {str(lead.placed) for lead in (*test.leads, *test.hidden)}
        return Planned(
            names,
            cosines,
            tuple(pairs),
            tuple(unseen(test, form, fit)),
            _smallest(form, fit, [lead.placed for lead in test.leads], policy),
            tuple(str(candidate) for candidate in candidates if str(candidate) not in tested),
            noise,
        )


def _noisy(records: Sequence[Trajectory], scenario: Scenario, seed: int) -> tuple[list[Trajectory], str]:
    """Return records with sensor noise, and words about it: that of the scenario, else 1 % of each output's size."""
    noise = getattr(scenario, "noise", None)
    outputs = records[0].spec.outputs
    if isinstance(noise, int | float) and noise > 0:
        return list(records), f"sensor noise of the scenario, {noise:g} on every output"
    size = np.std(records[0].y, axis=0)
    deviations = np.where(size > 0, PLAN_POLICY.noise * size, 1.0)
    made = []
    for number, record in enumerate(records):
        draw = stream("planned-noise", number, seed).standard_normal(record.y.shape)
        made.append(replace(record, y=record.y + deviations * draw))
    each = ", ".join(f"{channel.name} {d:.3g} {channel.unit}" for channel, d in zip(outputs, deviations, strict=True))
    return made, f"sensor noise of 1 % of each output, as the scenario has none: {each}"


def _smallest(form: EquationsForm, fit: Fit, visible: Sequence[Placed], policy: Policy) -> dict[str, dict[str, Any]]:
    """Return the size of each effect's main parameter at which the likelihood is expected to rise as much as asked.

    At first order a size s gains s^2 |c|^2 / 2, c being the whitened column of the parameter without what is free
    already (Rao 1948); asked are ``policy.evidence`` and half the penalty of BIC.
    """
    basis, _ = projected(form, fit)
    asked = policy.evidence + 0.5 * float(np.log(fit.samples))
    smallest: dict[str, dict[str, Any]] = {}
    for column in form.columns(fit, visible) if visible else ():
        placed = column.placed
        main = None if placed is None else placed.effect.main
        if placed is None or main is None or main.name not in column.names:
            continue
        own = column.estimation[:, column.names.index(main.name)]
        left = float(np.linalg.norm(own - basis @ (basis.T @ own)))
        value = float(np.sqrt(2.0 * asked)) / left if left > 0 else np.inf
        if np.isfinite(value) and value < smallest.get(str(placed), {"value": np.inf})["value"]:
            unit = compose(form.nominal, [placed]).parameter(placed.name(main.name)).unit
            smallest[str(placed)] = {"parameter": main.name, "value": value, "unit": unit}
    return smallest
