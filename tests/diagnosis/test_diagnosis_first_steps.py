"""How far a refit is begun: what may still come to the hope goes on, what may not is left after two looks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from sysid_lab.plan import Task
from sysid_lab.records import make_records

from harness.diagnosis.effort import EFFORT
from harness.diagnosis.forms.equations_form import EquationsForm
from harness.diagnosis.forms.first_steps import in_sight, looked
from harness.diagnosis.forms.likelihood_form import LikelihoodForm
from harness.diagnosis.kinds import EquationsKind
from harness.diagnosis.search.compare import judged
from harness.diagnosis.search.refusal import Kind, Refusal
from harness.diagnosis.search.table import FitTable
from harness.effects import builtin
from harness.effects.effect import Placed
from harness.physics import load_model
from harness.physics.fitting.maximum import Point
from harness.signals import Dataset, PlantSpec, Run, Trajectory


@dataclass
class Valley:
    """A point on a way down, of which each step gains as much as ``gains`` says."""

    nll: float
    gains: tuple[float, ...]
    converged: bool = False
    pace: float = 0.0


class Slope:
    """A likelihood that is followed step by step."""

    def __init__(self) -> None:
        self.steps = 0

    def maximise(self, start: Valley, *, most: int, **_: Any) -> Valley:
        """Return where so many steps lead."""
        taken, left = start.gains[:most], start.gains[most:]
        self.steps += len(taken)
        return Valley(start.nll - sum(taken), left, not left, taken[-1] if taken else 0.0)


def _oscillating(n: int, seed: int) -> EquationsForm:
    """Return the form of an oscillator under steps of its input, with nothing missing."""
    system, dt, rng = load_model("oscillator"), 0.01, np.random.default_rng(seed)
    spec, runs = PlantSpec(system.inputs, system.outputs, dt), []
    for use in ("estimation", "validation"):
        u = np.repeat(rng.normal(size=(n // 20, 1)), 20, axis=0)
        y = system.simulator(dt).rollout(system.vector(None), np.zeros(system.nx), u)
        runs.append(Run(Trajectory(np.arange(n) * dt, u, y + 1e-3 * rng.normal(size=y.shape), spec), use))
    return EquationsKind().form(system, Dataset("oscillator", tuple(runs)))


@pytest.mark.parametrize(
    ("gains", "steps", "reached"),
    [
        # 116 below the base, and 68 with every step, as an end stop was: it goes on until it is above the hope
        ((68.0,) * 30, EFFORT.first_steps, 116.0 - 5 * 68.0),
        ((22.0,) * 30, 2 * EFFORT.first_steps, 116.0 - 10 * 22.0),
        # what would not come near by as many steps again is left
        ((1.0,) * 30, EFFORT.looks, 114.0),
        # and what slows down on its way is left there
        ((40.0, 40.0, 20.0, 5.0, 0.5) + (0.01,) * 30, EFFORT.first_steps, 10.5),
    ],
)
def test_a_start_from_afar_goes_on_while_each_step_gains(gains: tuple[float, ...], steps: int, reached: float) -> None:
    slope = Slope()
    first = looked(slope, [Valley(116.0, gains)], hope=10.0)[0]  # type: ignore[arg-type, list-item]
    assert slope.steps == steps
    assert first.nll == pytest.approx(reached)


def test_without_a_hope_every_start_takes_its_first_steps_and_no_more() -> None:
    slope = Slope()
    looked(slope, [Valley(116.0, (68.0,) * 30)], hope=-np.inf)  # type: ignore[arg-type, list-item]
    assert slope.steps == EFFORT.first_steps


def test_a_start_that_is_behind_goes_on_where_its_steps_may_bring_it_to_the_best_one() -> None:
    """The best start after two looks led a play to a maximum 430 below that of the one that was left."""
    slope = Slope()
    best, behind, lost = (Valley(nll, (gain,) * 30) for nll, gain in ((100.0, 1.0), (200.0, 30.0), (200.0, 5.0)))
    tried = looked(slope, [best, behind, lost])  # type: ignore[arg-type, list-item]
    assert [fit.nll for fit in tried] == [200.0 - 5 * 30.0, 100.0 - 5 * 1.0, 200.0 - 2 * 5.0]
    assert slope.steps == 2 * EFFORT.first_steps + EFFORT.looks


def test_what_is_near_the_best_start_or_may_come_to_it_is_in_sight() -> None:
    best = Valley(100.0, (), pace=0.0)
    near, far = Valley(99.9 + EFFORT.close, ()), Valley(100.1 + EFFORT.close, ())
    ahead = EFFORT.close / EFFORT.first_steps
    coming, late = replace(far, pace=ahead + 0.1), replace(far, pace=ahead - 0.1)
    ended = replace(coming, converged=True)
    tried: Any = [best, near, far, coming, late, ended]
    assert in_sight(tried) == [best, near, coming]


@pytest.mark.parametrize("spare", [True, False])
@pytest.mark.parametrize("hope", [-np.inf, 10.0])
def test_steps_are_spared_where_there_is_a_choice_or_a_hope(spare: bool, hope: float) -> None:
    slope = Slope()
    looked(slope, [Valley(500.0, (0.1,) * 30)], spare=spare, hope=hope)  # type: ignore[arg-type, list-item]
    assert slope.steps == (EFFORT.looks if spare and hope > 0 else EFFORT.first_steps)


@pytest.mark.parametrize(("share", "before", "found"), [(0.25, 1e3, 0.25), (0.1, 1e3, 0.1), (0.25, -1e3, 1.0)])
def test_a_start_that_went_too_far_is_taken_back_towards_its_base(share: float, before: float, found: float) -> None:
    """Parameters and initial states together; one that is likelier than its base stays."""
    system = load_model("oscillator")
    names = list(system.parameter_names)
    base, start = (system.vector({**system.values(), "k": k}) for k in (1.0, 9.0))
    nothing: Any = None

    def nll(point: Point) -> float:
        off = np.append(point.p - base - share * (start - base), point.x0[0] - share * np.array([4.0, 0.0]))
        return float(off @ off)

    form: Any = SimpleNamespace(_starts=lambda *_: [np.zeros(2)])
    fit: Any = SimpleNamespace(log_likelihood=lambda use: before)
    gone = {"k": 1.0}
    point = Point(start, [np.array([4.0, 0.0])], nothing)
    likelihood: Any = SimpleNamespace(nll=nll)
    best = LikelihoodForm._back(form, system, nothing, likelihood, point, gone, fit)
    assert best.p[names.index("k")] == pytest.approx(1.0 + found * 8.0)
    assert best.x0[0] == pytest.approx([found * 4.0, 0.0])


def test_a_maximum_below_what_is_asked_of_it_is_left_without_its_last_digits() -> None:
    """It costs as much as the rest, where the law is stiff: it is no answer, whatever they are."""
    form = _oscillating(600, 0)
    nominal = form.fit((), form.first_starts(), None)
    assert nominal is not None
    assert nominal.logarithmic == {"m", "c", "k"} == set(nominal.free), "what cannot be negative, and no state"
    law = Placed(builtin()["cubic_spring"], "q")
    begun = form.begin([law], [{**nominal.values, law.name("k3"): 0.1}], nominal)
    assert begun is not None
    whole = form.finish(begun, nominal)
    assert whole is not None
    assert whole.converged
    before = whole.log_likelihood("estimation")
    asked = form.finish(begun, nominal, None, before - 5.0)
    assert asked is not None
    assert asked.converged
    assert asked.values == whole.values
    left = form.finish(begun, nominal, None, before + 5.0)
    assert left is not None
    assert left.beyond
    assert not left.converged
    assert Refusal(Kind.STOPPED) in judged(form, [law], left, nominal, nominal).refusals
    assert left.log_likelihood("estimation") == pytest.approx(before, abs=0.5)


def test_a_candidate_is_simulated_with_steps_as_fine_as_what_it_is_compared_with() -> None:
    """With coarser ones it loses by its steps and not by its law; without what needed them it may take its own."""
    form = _oscillating(400, 1)
    nominal = form.fit((), form.first_starts(), None)
    assert nominal is not None
    first, second = (Placed(builtin()[name], "q") for name in ("cubic_spring", "quadratic_drag"))
    base = form.fit([first], [{**nominal.values, first.name("k3"): 0.1}], nominal)
    assert base is not None
    own = base.detail.passes.substeps
    base.detail.passes = form.passes(base.system, 4 * own)
    start = {**base.values, second.name("c"): 0.01}
    beside, alone = (form.begin(effects, [start], base) for effects in ([first, second], [second]))
    assert beside is not None
    assert alone is not None
    assert [one.detail.passes.substeps for one in (beside, alone)] == [4 * own, own]


def test_a_motor_that_lost_its_mass_is_no_answer_and_takes_no_finer_steps() -> None:
    """It took 64 steps of the solver a sample, so did all that was tried beside it, and a search did not end."""
    form, law = _oscillating(200, 2), Placed(builtin()["elasticity"], "q")
    nominal = form.fit((), form.first_starts(), None)
    assert nominal is not None
    system = form.composed([law])
    for mass, seen in ((0.1, True), (1e-4, False)):
        spring = {law.name("k"): 50.0, law.name("d"): 0.5, law.name("Jm"): mass}
        values = {**system.values(), **spring}
        assert (form.unseen(system, values) <= 1.0) == seen
        assert form.substeps(system, values) <= 9
    fast = replace(nominal, values=values, unseen=form.unseen(system, values))
    assert Kind.UNSEEN in {refusal.kind for refusal in judged(form, [law], fast, nominal, nominal).refusals}
    assert not FitTable(form, nominal, [law]).lawful(fast)


def test_values_of_other_readings_stay_until_states_and_noise_suit_them() -> None:
    """At once with them they were led away to a bound, 104 below the maximum, and a force did what the friction did."""
    hidden = Task("confusion", "pendulum", "hardware", ("stribeck_friction@theta",), "quarter", "high", 0.0, 0, 4100)
    records = make_records(hidden, samples=5000)
    form, (effect,) = EquationsKind().form(load_model("pendulum"), records.dataset), records.known
    law = Placed(builtin()[effect.name], effect.at)
    named = {law.name(name): value for name, value in effect.named.items()}
    fit = form.fit([law], [{**records.parameters, **named}], None)
    assert fit is not None
    assert fit.converged
    assert not fit.on_bound
    for name, value in {**records.parameters, **named}.items():
        assert abs(fit.values[name] - value) < 5.0 * fit.deviations[name] * (value if name in fit.logarithmic else 1.0)
