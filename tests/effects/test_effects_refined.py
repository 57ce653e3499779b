"""Laws that refine hysteresis, elasticity and play: what they add, and what they are without it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sysid_lab.truths.simulation import DT
from sysid_lab.truths.simulation import simulate as truth

from harness.effects import Dictionary, Placed, builtin, compose
from harness.effects.compose import moving, recommended_substeps
from harness.physics import load_model

PENDULUM = load_model("pendulum")
SLIPS = {"Fh": 0.4, "xs": 0.02, "beta": 0.6, "T": 0.0}
PLAY = {"gap": 0.1, "k": 50.0, "Jm": 0.2, "d": 3.0, "c": 0.01}
JOINT = {"k": 30.0, "Jm": 0.2, "d": 0.5}
small, speed = st.floats(-0.99, 0.99), st.floats(-5.0, 5.0)


def passed(name: str, values: dict[str, float], lead: float, rate: float) -> float:
    """Return what a transmission passes on to a load at rest, nothing arriving at the motor."""
    value, rates = builtin()[name].evaluate(0.0, [lead, rate], values, 0.0, 0.0)
    assert rates[0] == rate
    assert rates[1] == pytest.approx(-value / values["Jm"])
    return float(value)


@pytest.mark.parametrize("name", ["parallel_hysteresis", "hardening_elasticity", "unilateral_backlash"])
def test_each_refines_the_law_that_it_names_first(name: str) -> None:
    law = builtin()[name]
    simple = builtin()[law.nests[0]]
    assert law.grows
    assert not simple.grows
    assert simple.name in {other.name for other in Dictionary.builtin().nested(law)}
    assert set(simple.parameter_names) <= set(law.parameter_names), "it starts from where that one ended"


@given(z=small, v=speed, share=st.floats(0.0, 1.0))
def test_elements_of_one_length_are_one_element(z: float, v: float, share: float) -> None:
    alone, (rate,) = builtin()["hysteresis"].evaluate(0.0, [z], SLIPS, 0.0, v)
    both, rates = builtin()["parallel_hysteresis"].evaluate(
        0.0, [z, z], {**SLIPS, "share": share, "ratio": 1.0}, 0.0, v
    )
    assert both == pytest.approx(alone)
    assert rates == pytest.approx([rate, rate])


def test_the_shorter_element_slips_first_and_gives_way_sooner() -> None:
    values = {**SLIPS, "share": 0.25, "ratio": 0.2}
    law = builtin()["parallel_hysteresis"]
    _, (slow, fast) = law.evaluate(0.0, [0.0, 0.0], values, 0.0, 1.0)
    assert (slow, fast) == pytest.approx((1 / 0.02, 1 / 0.004)), "springs of these lengths at first"
    force, rates = law.evaluate(0.0, [1.0, 1.0], values, 0.0, 1.0)
    assert force == pytest.approx(-0.4)
    assert rates == pytest.approx([0.0, 0.0]), "both slip"
    assert law.evaluate(0.0, [0.0, 1.0], values, 0.0, 0.0)[0] == pytest.approx(-0.1), "its share alone"


@pytest.mark.parametrize("name", ["hysteresis", "parallel_hysteresis"])
def test_hysteresis_settles_no_sooner_than_samples_show_and_at_the_same_force(name: str) -> None:
    more = {"share": 0.3, "ratio": 0.3} if name == "parallel_hysteresis" else {}
    block = builtin()[name]
    states = len(block.states)
    for time in (0.0, 1e-3):
        force, rates = block.evaluate(0.0, [1.0] * states, {**SLIPS, **more, "T": time}, 0.0, 3.0)
        assert force == pytest.approx(-0.4)
        assert rates == pytest.approx([0.0] * states)
    needed = []
    for time in (0.0, 0.2 * DT):
        values = {**SLIPS, **more, "xs": 1e-4, "T": time}
        system = compose(PENDULUM, [Placed(block, "theta", values)])
        x = np.append(moving(PENDULUM, {"theta": {"v": 2.0}}), np.zeros(states))
        needed.append(recommended_substeps(system, None, DT, x=x))
    assert needed[0] > 30
    assert needed[1] <= 3


@given(lead=st.floats(-0.5, 0.5), rate=speed)
def test_a_joint_without_cubic_stiffness_is_elastic(lead: float, rate: float) -> None:
    plain = passed("elasticity", JOINT, lead, rate)
    assert passed("hardening_elasticity", {**JOINT, "k3": 0.0}, lead, rate) == pytest.approx(plain)
    harder = passed("hardening_elasticity", {**JOINT, "k3": 40.0}, lead, rate)
    assert harder - plain == pytest.approx(40.0 * lead**3, abs=1e-9)


@given(lead=st.floats(-0.5, 0.5), rate=speed)
def test_flanks_push_and_never_pull(lead: float, rate: float) -> None:
    force = passed("unilateral_backlash", PLAY, lead, rate)
    rounding = 2 * PLAY["k"] * PLAY["c"] * PLAY["gap"]  # of its corners
    assert force * np.sign(lead) > -rounding
    inside = abs(lead) < PLAY["gap"] * 0.9
    pushing = PLAY["k"] * (abs(lead) - PLAY["gap"]) + PLAY["d"] * rate * np.sign(lead)
    if inside:
        assert abs(force) < rounding
    elif abs(lead) > PLAY["gap"] * 1.1:
        assert force * np.sign(lead) == pytest.approx(max(0.0, pushing), abs=rounding)
    assert passed("unilateral_backlash", PLAY, -lead, -rate) == pytest.approx(-force), "either flank alike"


def test_parting_flanks_are_where_it_differs_from_a_dead_band() -> None:
    assert passed("backlash", PLAY, 0.12, -2.0) < -4.0, "the damper of a dead band holds them together"
    assert abs(passed("unilateral_backlash", PLAY, 0.12, -2.0)) < 0.01
    assert passed("unilateral_backlash", PLAY, 0.2, 0.5) == pytest.approx(passed("backlash", PLAY, 0.2, 0.5), rel=1e-2)


@pytest.mark.parametrize(
    ("name", "values", "hidden"),
    [
        ("unilateral_backlash", {"gap": 0.05, "k": 200.0, "Jm": 0.02, "d": 2.0, "c": 0.01},
         {"kt": 200.0, "Jm": 0.02, "dt": 2.0, "gap": 0.05, "push": 1.0}),
        ("hardening_elasticity", {"k": 20.0, "k3": 4000.0, "Jm": 0.02, "d": 0.1},
         {"kt": 20.0, "hard": 200.0, "Jm": 0.02, "dt": 0.1}),
    ],
)  # fmt: skip
def test_a_pendulum_behind_it_moves_as_in_the_truth_written_by_hand(
    name: str, values: dict[str, float], hidden: dict[str, float]
) -> None:
    """The truth is C, in steps of 0.2 ms; corners are rounded here and sharp there."""
    rng = np.random.default_rng(3)
    n = 1000
    u = np.interp(np.arange(n), np.arange(0, n + 50, 50), rng.standard_normal(n // 50 + 1)) * 0.5
    plant = {"J": 0.1, "mgl": 1.0, "b0": 0.05}
    system = compose(
        PENDULUM.with_parameters({"J": 0.1, "mgl": 1.0, "b": 0.05}), [Placed(builtin()[name], "theta", values)]
    )
    y = system.simulator(DT, backend="casadi", substeps=20).rollout(
        system.vector(None), np.zeros(system.nx), u[:, None]
    )
    true = truth(plant | hidden, u, start=np.zeros(2)).q[:, 0]
    plain = {key: value for key, value in hidden.items() if key not in ("push", "hard")}
    simple = truth(plant | plain, u, start=np.zeros(2)).q[:, 0]
    difference = np.abs(simple - true).max()
    assert difference > 1e-3
    assert np.abs(y[:, 0] - true).max() < (0.4 if name == "unilateral_backlash" else 1e-3) * difference


@pytest.mark.parametrize("name", ["elasticity", "hardening_elasticity"])
def test_the_stiffness_of_a_transmission_does_not_start_from_how_far_a_cart_wanders(name: str) -> None:
    """Its resonance lies above the band of the motion, wherever that goes: at 2 to 10 times its rate to begin with."""
    stiffness = next(parameter for parameter in builtin()[name].parameters if parameter.name == "k")
    size, rate = {"F": 2.0, "v": 0.5, "a": 2.5}, 2.5 / 0.5
    near, far = (stiffness.start({**size, "q": q}) for q in (0.1, 4.0))
    assert near == far
    assert 2.0 < np.sqrt(near / (size["F"] / size["a"])) / rate < 10.0
