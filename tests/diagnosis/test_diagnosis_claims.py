"""The balance of momentum with lags, delays, bristles and sensors: what they claim is fitted, judged, told apart."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.diagnosis import diagnose
from harness.diagnosis.accept import LEVEL, compare_blocks
from harness.diagnosis.claiming import Claiming
from harness.diagnosis.confirm import assess
from harness.diagnosis.forms import fit_here
from harness.diagnosis.momentum_form import DETAIL, MomentumForm
from harness.diagnosis.prepare import choose_horizon, rough_values, sizes_of
from harness.effects import builtin
from harness.effects.effect import Placed
from harness.physics import load_model
from harness.study.plan import Task
from harness.study.records import make_records

from .conftest import pendulum_dataset

COULOMB = Placed(builtin()["coulomb_friction"], "theta")
LAG = Placed(builtin()["actuator_lag"], "u")
DELAY = Placed(builtin()["input_delay"], "u")


def _form(law=None, seed: int = 1, coloured: float = 0.03) -> tuple[MomentumForm, dict[str, float]]:
    """Return the whitened balance of a disturbed pendulum, and first parameters."""
    dataset = pendulum_dataset(seed, law, coloured=coloured, n=3000, noise=1e-4)
    system = load_model("pendulum")
    values = rough_values(system, dataset)
    return MomentumForm(system, dataset, sizes=sizes_of(system, values, dataset), values=values), values


@pytest.fixture(scope="module")
def dry() -> tuple[MomentumForm, dict[str, float]]:
    return _form(lambda q, v, u, t: -0.03 * np.tanh(v / 0.02))


def test_the_balance_judges_all_but_hidden_masses_rounding_and_a_common_factor(
    dry: tuple[MomentumForm, dict[str, float]],
) -> None:
    form, _ = dry
    at = {"u": "u", "theta": "theta"}
    for name, place, judged in (
        ("coulomb_friction", "theta", True),
        ("hysteresis", "theta", True),
        ("actuator_lag", "u", True),
        ("input_delay", "u", True),
        ("sensor_gain", "theta", True),
        ("sensor_delay", "theta", True),
        ("input_gain", "u", False),
        ("elasticity", "theta", False),
        ("backlash", "theta", False),
        ("sensor_quantisation", "theta", False),
    ):
        assert form.judges(Placed(builtin()[name], at[place])) is judged, name


@given(tau=st.floats(0.01, 0.08), inertia=st.floats(0.08, 0.12), fc=st.floats(0.005, 0.05))
@settings(max_examples=5, deadline=None)
def test_derivatives_of_a_claim_are_those_of_the_residual(tau: float, inertia: float, fc: float) -> None:
    form, values = _form()
    equations = form.equations((COULOMB, LAG))
    assert isinstance(equations, Claiming)
    known = {**equations.system.values(), **values, "J": inertia, "actuator_lag@u.tau": tau}
    p = equations.system.vector({**known, "coulomb_friction@theta.Fc": fc})
    motion = form.motions["estimation"][0]
    _, slopes = equations.residual(motion, p)
    names = equations.system.parameter_names
    for name in ("J", "mgl", "coulomb_friction@theta.Fc", "actuator_lag@u.tau"):
        k = names.index(name)
        step = 1e-4 * p[k]
        up, down = p.copy(), p.copy()
        up[k], down[k] = p[k] + step, p[k] - step
        central = (equations.residual(motion, up)[0] - equations.residual(motion, down)[0]) / (2 * step)
        assert np.abs(slopes[:, :, k] - central).max() < 0.02 * np.abs(central).max(), name


def test_the_filter_is_applied_once() -> None:
    form, _ = _form()
    late = form.equations((DELAY,))
    p = late.system.vector({**form.start.values, "input_delay@u.tau": 0.0})
    motion = form.motions["estimation"][0]
    plain = form.equations(()).residual(motion, form.nominal.vector(form.start.values), "weak")[0]
    assert np.allclose(late.residual(motion, p)[0], plain, atol=1e-9)
    assert np.std(plain) == pytest.approx(1.0, rel=0.3)


def test_a_trace_and_a_force_are_told_by_what_parameters_cannot_take_up(
    dry: tuple[MomentumForm, dict[str, float]],
) -> None:
    form, values = dry
    real = fit_here(form, (COULOMB,), [{**values, "coulomb_friction@theta.Fc": 0.02}])
    nothing = fit_here(form, (), [values])
    assert form.apart(real, real) == 0.0
    assert form.apart(real, nothing) > DETAIL
    assert form.details(real, [COULOMB]) == []
    tiny = form.evaluate((COULOMB,), {**real.record, "values": {**nothing.values, "coulomb_friction@theta.Fc": 1e-5,
                                                                  "coulomb_friction@theta.w": 0.02}})  # fmt: skip
    (reason,) = form.details(tiny, [COULOMB])
    assert "a detail of the smoothed motion" in reason
    wider = Placed(builtin()["asymmetric_friction"], "theta")
    general = fit_here(form, (wider,), [{**real.values, "asymmetric_friction@theta.Fp": 0.03}])
    assert form.alike(real, general, [COULOMB])
    assert not form.alike(real, nothing, [COULOMB])


def test_a_line_without_two_periods_is_none(dry: tuple[MomentumForm, dict[str, float]]) -> None:
    form, values = dry
    line = Placed(builtin()["periodic_disturbance"], "theta")
    usual = {line.name(k): v for k, v in line.effect.complete({}, form.sizes["theta"]).items()}
    seconds = max(one.t[-1] - one.t[0] for one in form.motions["estimation"])
    for periods, said in ((0.4, True), (5.0, False)):
        start = {**values, **usual, line.name("omega"): 2 * np.pi * periods / seconds}
        record = {"values": start, "converged": True, "message": ""}
        one = form.evaluate((line,), record)
        (judged,) = assess(form, form.start, [((line,), one)], surrogate_p=None, seed=0)
        assert any("nothing that repeats" in why for why in judged.judgement.reasons) is said


# ---- validation in white noise ---------------------------------------------------------------------------------------


def test_of_made_up_changes_one_in_a_hundred_passes_for_there() -> None:
    rng = np.random.default_rng(3)
    passed = 0
    for _ in range(300):
        before = rng.standard_normal((1000, 1))
        change = 0.05 * np.convolve(rng.standard_normal(1000), np.ones(10) / 3, "same")[:, None]
        found = compare_blocks([before], [before - change], rng=rng, white=True, draws=500)
        passed += found.p <= LEVEL
    assert passed <= 12  # 3 expected; the bootstrap of 20 blocks is a little eager


def test_a_change_that_is_there_shows_sooner_than_its_squares() -> None:
    rng = np.random.default_rng(4)
    usual, white = 0, 0
    for _ in range(100):
        force = 0.13 * np.sin(np.arange(1000) / 7.0)[:, None]
        before = force + rng.standard_normal((1000, 1))
        usual += compare_blocks([before], [before - force], rng=rng, draws=500).p <= LEVEL
        white += compare_blocks([before], [before - force], rng=rng, draws=500, white=True).p <= LEVEL
    assert white > 60
    assert white > usual + 30


# ---- the whole diagnosis ---------------------------------------------------------------------------------------------


def _diagnosed(task: Task, *names: str):
    records = make_records(task)
    some = [builtin()[name] for name in names]
    return diagnose(records.dataset, load_model(task.plant), seed=task.seed, dictionary=some, workers=1)


@pytest.mark.parametrize(
    ("hidden", "others"),
    [
        ("input_delay@u", ("actuator_lag", "coulomb_friction", "sensor_delay")),
        ("hysteresis@theta", ("coulomb_friction", "quadratic_drag")),
    ],
)
def test_blocks_with_a_memory_are_named_under_a_disturbance_of_their_size(hidden: str, others: tuple[str, ...]) -> None:
    task = Task("confusion", "pendulum", "laws", (hidden,), "quarter", "high", 0.02, 7 if "delay" in hidden else 1, 0)
    found = _diagnosed(task, hidden.split("@")[0], *others)
    (one,) = found.result.accepted
    assert hidden in {str(placed) for tied in one.tie for placed in tied}


def test_what_one_judge_names_has_the_ties_of_both() -> None:
    task = Task("confusion", "pendulum", "laws", ("position_dependent_friction@theta",), "quarter", "low", 0.02, 5, 0)
    found = _diagnosed(task, "position_dependent_friction", "coulomb_friction", "load_dependent_friction")
    (one,) = found.result.accepted
    tied = {str(placed) for other in one.tie for placed in other}
    assert {"coulomb_friction@theta", "position_dependent_friction@theta"} <= tied


def test_a_sensor_that_hides_the_sign_does_not_make_the_pendulum_an_integrator() -> None:
    dataset = pendulum_dataset(1, n=1500)
    system = load_model("pendulum")
    lost = {"J": 4e-4, "b": 2e-16, "mgl": 1e-22}
    assert choose_horizon(system, lost, dataset).seconds is None
