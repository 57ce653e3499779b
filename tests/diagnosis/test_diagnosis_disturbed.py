"""A plant that something unmeasured disturbs: the momentum balance finds forces, and speaks against made up ones."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import harness.diagnosis.horizons as horizons
import harness.diagnosis.leftover as leftover
import harness.diagnosis.subset as subset
import harness.diagnosis.witness as witness
from harness.diagnosis import diagnose
from harness.diagnosis.disturbed import BALANCE, Balance
from harness.diagnosis.equation_form import EquationForm
from harness.diagnosis.exchange import Accepted
from harness.diagnosis.forms import fit_here, vanished
from harness.diagnosis.momentum_form import ORDER, MomentumForm, autoregression, filtered
from harness.diagnosis.noise import NoiseFloor
from harness.diagnosis.nominal import fit_nominal
from harness.diagnosis.output_form import OutputForm
from harness.diagnosis.prepare import rough_values, sizes_of
from harness.diagnosis.refitter import Refitter
from harness.diagnosis.residual_tests import max_autocorrelation
from harness.diagnosis.store import Store
from harness.diagnosis.subset import Search, SearchResult
from harness.diagnosis.witness import ENOUGH, contradiction, found_force
from harness.effects import builtin
from harness.effects.effect import Placed
from harness.physics import load_model
from harness.study.plan import NOISE, Task
from harness.study.records import make_records

from .conftest import pendulum_dataset

DISTURBED = 0.03  # rms of the unknown torque over that of the command
COULOMB = Placed(builtin()["coulomb_friction"], "theta")
COGGING = Placed(builtin()["cogging"], "theta")


def _prepared(law=None, seed: int = 1, **options):
    """Return data of a disturbed pendulum, its model, first parameters and sizes."""
    dataset = pendulum_dataset(seed, law, coloured=DISTURBED, n=3000, noise=1e-4, **options)
    system = load_model("pendulum")
    values = rough_values(system, dataset)
    return dataset, system, values, sizes_of(system, values, dataset)


def _dry(q: float, v: float, u: float, t: float) -> float:
    return -0.03 * np.tanh(v / 0.02)


# ---- whitening -------------------------------------------------------------------------------------------------------


@given(pole=st.floats(-0.9, 0.95), seed=st.integers(0, 2**16))
@settings(max_examples=30, deadline=None)
def test_what_an_autoregression_leaves_is_white(pole: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = np.zeros(3000)
    for k in range(1, x.size):
        x[k] = pole * x[k - 1] + rng.standard_normal()
    phi = autoregression([x[:1500], x[1500:]], ORDER)
    white = filtered(x[:, None], phi)
    assert white.shape == (3000 - phi.size, 1)
    assert max_autocorrelation(white[:, 0]) < 0.1
    assert np.std(white) == pytest.approx(1.0, rel=0.1)


def test_the_balance_of_a_disturbed_pendulum_is_white_and_finds_its_parameters() -> None:
    dataset, system, values, sizes = _prepared()
    form = MomentumForm(system, dataset, sizes=sizes, values=values)
    assert form.filters[0].size > 0  # the disturbance is coloured
    for one in (*form.start.estimation, *form.start.validation):
        assert max_autocorrelation(one[:, 0]) < 0.25
        assert np.std(one) == pytest.approx(1.0, rel=0.25)
    for name, truth in (("J", 0.1), ("mgl", 1.0), ("b", 0.05)):
        interval = form.start.intervals()[name]
        assert interval.low - 0.02 * truth < truth < interval.high + 0.02 * truth


def test_the_balance_names_dry_friction_and_nothing_else() -> None:
    dataset, system, values, sizes = _prepared(_dry)
    form = MomentumForm(system, dataset, sizes=sizes, values=values)
    candidates = [COULOMB, COGGING, Placed(builtin()["quadratic_drag"], "theta"), Placed(builtin()["dead_zone"], "u")]
    search = Search(form, None, candidates, sizes, Refitter(form, Store(None, "")), 0)
    found = search.run(form.start)
    assert [str(one.placed) for one in found.accepted] == ["coulomb_friction@theta"]
    assert found.model.values["coulomb_friction@theta.Fc"] == pytest.approx(0.03, rel=0.25)
    assert all(one.judge == "momentum" for one in found.rounds)


def test_a_trace_of_smoothing_is_no_spring() -> None:
    task = Task("none", "cart-pole", "laws", (), "", "drawn", 0.02, 8, 0)  # the hinge: undisturbed, noise 1e-4
    records, system = make_records(task), load_model("cart-pole")
    values = rough_values(system, records.dataset)
    sizes = sizes_of(system, values, records.dataset)
    form = MomentumForm(system, records.dataset, sizes=sizes, values=values)
    spring = Placed(builtin()["linear_spring"], "theta")
    found = Search(form, None, [spring], sizes, Refitter(form, Store(None, "")), 0).run(form.start)
    assert not found.accepted
    ((only,),) = [here.candidates for here in found.rounds]
    (reason,) = only.judgement.reasons  # all the rest of the rule would have let it pass
    assert "a detail of the smoothed motion" in reason


def test_a_balance_that_noise_drowns_is_not_asked() -> None:
    dataset, system, values, sizes = _prepared()
    floors = [NoiseFloor("theta", "rad", 1e-4, "declared")]
    momentum, why = Balance(system, dataset, sizes, values, floors, 0).asked()
    assert why == []
    assert not Balance(system, dataset, sizes, momentum.start.values, floors, 0).unexplained()
    assert momentum is not None
    shares = [momentum.noise_share(dataset, [noise], np.random.default_rng(0)) for noise in (1e-4, 1e-3, 1e-2)]
    assert shares[1] == pytest.approx(10 * shares[0], rel=0.5)
    assert shares[2] == pytest.approx(10 * shares[1], rel=0.5)
    momentum, (reason,) = Balance(system, dataset, sizes, values, [replace(floors[0], value=2e-2)], 0).asked()
    assert momentum is None
    assert "was not asked: sensor noise is" in reason


def test_forces_that_miss_all_of_the_motion_are_no_disturbance() -> None:
    task = Task("confusion", "cart-pole", "laws", ("sensor_rectification@theta",), "nominal", "low", 0.0, 0, 0)
    found = _diagnosed(task, "coulomb_friction", "force_bias")  # at 200 noise floors; the balance misses all
    assert found.verdict == "unexplained"
    assert found.adequacy.too_large
    assert any("of the change of momentum is not the model's" in one for one in found.warnings)


def test_a_motion_that_drowns_in_noise_is_not_missing_forces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(NOISE, "low", 3e-5)  # a balanced cart-pole: smoothing leaves three quarters of the momentum
    task = Task("none", "cart-pole", "balanced", (), "", "low", 0.0, 1, 0)
    dataset, system = make_records(task).dataset, load_model("cart-pole")
    values = rough_values(system, dataset)
    floors = [NoiseFloor(one.name, one.unit, 3e-5, "declared") for one in dataset.spec.outputs]
    sizes = sizes_of(system, values, dataset)
    assert MomentumForm(system, dataset, sizes=sizes, values=values).rest(values) > 0.5
    assert Balance(system, dataset, sizes, values, floors, 0).unexplained() == ""


# ---- the witness -----------------------------------------------------------------------------------------------------


def test_a_force_that_is_there_is_found_and_one_that_is_made_up_is_not() -> None:
    dataset, system, values, sizes = _prepared(_dry)
    weak = EquationForm(system, dataset, sizes=sizes, shape="weak")
    real = fit_here(weak, (COULOMB,), [{**values, "coulomb_friction@theta.Fc": 0.02}])
    assert found_force(weak, real, COULOMB) > ENOUGH
    assert contradiction(weak, real, [COULOMB]) == []
    wrong = {**real.record, "values": {**real.values, "coulomb_friction@theta.Fc": -0.03}}
    assert found_force(weak, weak.evaluate((COULOMB,), wrong), COULOMB) < 0  # it asks for the other sign
    usual = COGGING.effect.complete({}, sizes["theta"])
    shape = {"values": {**real.values, **{COGGING.name(k): v for k, v in usual.items()}}}
    made_up = weak.evaluate((COULOMB, COGGING), {**shape, "converged": True, "message": ""})
    assert abs(found_force(weak, made_up, COGGING)) < ENOUGH
    assert found_force(weak, made_up, COULOMB) > ENOUGH
    (reason,) = contradiction(weak, made_up, [COGGING])
    assert "not found in the momentum balance" in reason
    rounded = Placed(builtin()["sensor_quantisation"], "theta")
    step = {**real.values, **{rounded.name(k): v for k, v in rounded.effect.complete({}, sizes["theta"]).items()}}
    late = replace(real, effects=(COULOMB, rounded), values=step)
    assert found_force(weak, late, rounded) is None  # no force on the measured motion: the balance cannot be asked
    assert contradiction(weak, late, [rounded]) == []


def test_a_bent_bristle_is_asked_for_too() -> None:
    dataset, system, values, sizes = _prepared(_dry)
    weak = EquationForm(system, dataset, sizes=sizes, shape="weak")
    bristle = Placed(builtin()["hysteresis"], "theta")
    assert not weak.judges(bristle)  # a state of its own: simulated along the measured motion
    real = fit_here(weak, (COULOMB,), [{**values, "coulomb_friction@theta.Fc": 0.02}])
    usual = {bristle.name(k): v for k, v in bristle.effect.complete({}, sizes["theta"]).items()}
    size = bristle.main()
    alone = {k: v for k, v in real.values.items() if "@" not in k}
    for sign in (1.0, -1.0):
        model = replace(real, effects=(bristle,), values={**alone, **usual, size: sign * abs(usual[size])})
        t = found_force(weak, model, bristle)
        assert (t > ENOUGH) == (sign > 0)
        assert bool(contradiction(weak, model, [bristle])) == (sign < 0)


ALARM = Task("none", "pendulum", "laws", (), "", "drawn", 0.02, 72, 30_000)
"""Seen when the rule was made, not in a judged study since: its disturbance alone looks like cogging."""


def _diagnosed(task: Task, *names: str):
    records = make_records(task)
    some = [builtin()[name] for name in names]
    return diagnose(records.dataset, load_model(task.plant), seed=task.seed, dictionary=some, workers=1)


def test_a_disturbance_that_looks_like_cogging_in_simulations_is_no_cogging(monkeypatch: pytest.MonkeyPatch) -> None:
    found = _diagnosed(ALARM, "cogging", "coulomb_friction", "force_bias")
    assert found.verdict == "nothing_missing"
    rejected = [one for here in found.result.rounds for one in here.candidates if one.name == "cogging@theta"]
    assert any("not found in the momentum balance" in why for one in rejected for why in one.judgement.reasons)
    monkeypatch.setattr(subset, "contradiction", lambda *_: [])
    unguarded = _diagnosed(ALARM, "cogging", "coulomb_friction", "force_bias")
    assert [str(one.placed) for one in unguarded.result.accepted] == ["cogging@theta"]


def test_a_line_that_was_searched_for_must_stand_out_further(monkeypatch: pytest.MonkeyPatch) -> None:
    task = replace(
        ALARM, index=24, base=60_000
    )  # seen in a judged study; its disturbance alone holds a line of t = 4.5
    found = _diagnosed(task, "periodic_disturbance", "coulomb_friction")
    assert found.verdict == "nothing_missing"
    monkeypatch.setattr(witness, "ENOUGH_OF_ITS_OWN", ENOUGH)
    unguarded = _diagnosed(task, "periodic_disturbance", "coulomb_friction")
    assert [str(one.placed) for one in unguarded.result.accepted] == ["periodic_disturbance@theta"]


# ---- the second opinion ----------------------------------------------------------------------------------------------


def test_under_a_disturbance_the_balance_names_what_simulations_miss() -> None:
    task = Task("confusion", "pendulum", "laws", ("dead_zone@u",), "nominal", "low", 0.02, 0, 0)
    found = _diagnosed(task, "dead_zone", "coulomb_friction", "input_delay", "force_bias", "saturation")
    assert [str(one.placed) for one in found.result.accepted] == ["dead_zone@u"]
    assert BALANCE in found.warnings
    assert {one.judge for one in found.result.rounds} == {"simulation", "momentum"}
    assert found.horizon.seconds is not None  # refitted over short windows
    assert "disturbs" in found.horizon.reason


def test_without_a_disturbance_the_balance_is_not_asked() -> None:
    task = Task("confusion", "pendulum", "laws", ("coulomb_friction@theta",), "nominal", "low", 0.0, 0, 0)
    found = _diagnosed(task, "coulomb_friction", "input_delay", "force_bias")
    assert [str(one.placed) for one in found.result.accepted] == ["coulomb_friction@theta"]
    assert {one.judge for one in found.result.rounds} == {"simulation"}
    assert BALANCE not in found.warnings


# ---- what is left ----------------------------------------------------------------------------------------------------


def test_a_rest_that_only_long_simulations_predict_needs_a_force_in_the_balance(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    alone = Task("none", "pendulum", "laws", (), "", "drawn", 0.02, 6, 0)  # the disturbance is all that is left
    found = _diagnosed(alone, "coulomb_friction", "force_bias")
    assert found.verdict == "nothing_missing"
    monkeypatch.setattr(leftover, "CONFIRMED", -np.inf)
    assert _diagnosed(alone, "coulomb_friction", "force_bias").verdict == "unexplained"


def test_a_law_that_the_dictionary_lacks_stays_visible_under_a_disturbance() -> None:
    even = Task("outside", "pendulum", "laws", ("even_drag@theta",), "nominal", "high", 0.02, 0, 0)
    found = _diagnosed(even, "coulomb_friction", "dead_zone")  # a drag that does not change its sign with the speed
    assert found.verdict == "unexplained"
    assert found.adequacy.best is not None
    assert found.adequacy.best.axes.startswith("force on theta of theta'")


# ---- horizons --------------------------------------------------------------------------------------------------------


class _Search:
    """A search that knows what it would find, and remembers what it was asked."""

    candidates = (COULOMB,)

    def __init__(self, first: object, result: SearchResult, finds: bool) -> None:
        self.first, self.result, self.finds, self.asked = first, result, finds, []

    def detected(self, model: object) -> bool:
        return True

    def round(self, model: object) -> object:
        self.asked.append("round")
        return self.first

    def winner(self, candidates: object) -> object:
        return candidates if self.finds else None

    def run(self, nominal: object, *, first: object = None) -> SearchResult:
        self.asked.append("run" if first is None else "run on")
        return self.result


@pytest.mark.parametrize("finds", [True, False])
def test_long_windows_judge_where_short_ones_find_nothing_and_they_do(
    finds: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset, system, values, sizes = _prepared()
    form = OutputForm(system, dataset, sizes=sizes, horizon=None, weights=np.ones(1), floors=[1e-4])
    nominal = fit_here(form, (), [values])
    empty = SearchResult(nominal, (), ())
    answer = SearchResult(nominal, (Accepted(COULOMB, 50.0, ((COULOMB,),)),), ())
    round_ = SimpleNamespace(candidates=[SimpleNamespace(fitted=None)])
    long, short = _Search(round_, answer, finds), _Search(round_, empty, False)
    monkeypatch.setattr(horizons, "_clearest", lambda *_: 2.0)
    used, _, result = horizons.searched(
        form, nominal, lambda one: long if one is form else short, lambda placed: sizes[placed.at]
    )
    assert short.asked == ["round", "run on"]
    assert long.asked == (["round", "run on"] if finds else ["round"])
    assert (used is form, result is answer) == (finds, finds)


# ---- the nominal fit -------------------------------------------------------------------------------------------------


class _Trap:
    """A form whose descent never comes back from 0: only a start with friction ends with friction, and lower."""

    nominal = load_model("pendulum")

    def solve(self, effects: object, starts: list[dict[str, float]], *, seed: int) -> dict[str, object]:
        alive = starts[0]["b"] > 1e-6
        values = {"J": 0.1, "b": 0.05 if alive else 1e-12, "mgl": 1.0}
        return {"cost": 1.0 if alive else 2.0, "values": values, "converged": True, "message": ""}

    def evaluate(self, effects: object, record: dict[str, object]) -> SimpleNamespace:
        residual = np.full((50, 1), np.sqrt(record["cost"]))
        return SimpleNamespace(finite=True, estimation=(residual,), values=record["values"], record=record)


def test_friction_that_a_fit_lost_at_zero_is_tried_again() -> None:
    form = _Trap()
    start = {"J": 0.1, "b": 1e-14, "mgl": 1.0}
    assert vanished(form.nominal, form.solve((), [start], seed=0)["values"]) == ["b"]
    fitted, _ = fit_nominal(form, start, 0)
    assert fitted.values["b"] == 0.05
