"""Dry friction of bristles: its level in steady motion, its spring at rest, its limit, and a truth by another hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sysid_lab.truths.simulation import DT
from sysid_lab.truths.simulation import simulate as truth

from harness.effects import Dictionary, Placed, builtin, compose, effect
from harness.effects.compose import moving, recommended_substeps
from harness.errors import InputError
from harness.physics import load_model

PENDULUM = load_model("pendulum")
BRISTLES = {"xs": 1e-3, "tau": 0.01, "T": 0.0}
LAWS: dict[str, tuple[dict[str, float], dict[str, float]]] = {
    # own values; those of the law that it refines
    "lugre_coulomb_friction": ({"Fc": 0.3}, {"Fc": 0.3}),
    "lugre_friction": ({"Fs": 0.5, "Fc": 0.2, "vs": 0.4}, {"Fs": 0.5, "Fc": 0.2, "vs": 0.4}),
    "lugre_asymmetric_friction": ({"Fp": 0.4, "Fm": 0.1}, {"Fp": 0.4, "Fm": 0.1}),
    "lugre_load_dependent_friction": ({"mu": 0.1, "L": 2.0}, {"mu": 0.1}),
    "lugre_position_dependent_friction": (
        {"Fc": 0.3, "a": 0.5, "phi": 0.2},
        {"Fc": 0.3, "a": 0.5, "phi": 0.2},
    ),
    "lugre_sublinear_friction": ({"Fr": 0.3, "a": 0.5}, {"Fr": 0.3, "a": 0.5}),
    "lugre_yield_friction": ({"Fr": 0.3, "a": 0.5, "Fc": 0.1}, {"Fr": 0.3, "a": 0.5, "Fc": 0.1}),
}


def force(name: str, z: float, q: float, v: float, **more: float) -> tuple[float, float]:
    """Return the force of a law and the rate of its bristles, under a load of 2."""
    block = builtin()[name]
    extras = {"load": 2.0} if "load" in block.extras else {}
    value, (rate,) = block.evaluate(0.0, [z], {**LAWS[name][0], **BRISTLES, **more}, q, v, **extras)
    return float(value), float(rate)


def level(name: str, q: float, v: float) -> float:
    """Return the force of the law that is refined, its sign sharp."""
    simple = builtin()[builtin()[name].nests[0]]
    extras = {"load": 2.0} if "load" in simple.extras else {}
    return float(simple.evaluate(0.0, [], {**LAWS[name][1], "w": 1e-9}, q, v, **extras)[0])


def settled(name: str, q: float, v: float, settle: float) -> float:
    """Return the deflection at which bristles no longer move, by bisection."""
    low, high = -1.0, 1.0
    for _ in range(200):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if force(name, middle, q, v, T=settle)[1] > 0 else (low, middle)
    return 0.5 * (low + high)


def test_every_law_of_bristles_refines_one_and_says_so():
    grown = {name for name, block in builtin().items() if block.grows == "bristles"}
    assert grown == set(LAWS)
    refined = [builtin()[name].nests[0] for name in grown]
    assert len(set(refined)) == len(refined), "one law of bristles for each level"
    for name in grown:
        assert not builtin()[builtin()[name].nests[0]].states
        assert builtin()[name].nests[0] in {law.name for law in Dictionary.builtin().nested(builtin()[name])}


def test_a_law_that_refines_none_is_refused():
    with pytest.raises(InputError, match="nests, the law that it refines"):
        effect("coordinate", {"c": "F"}, grows="bristles")


@given(
    name=st.sampled_from(sorted(LAWS)),
    q=st.floats(-3.0, 3.0),
    v=st.floats(0.01, 5.0),
    forwards=st.booleans(),
    settle=st.sampled_from([0.0, 1e-3]),
)
def test_in_steady_motion_the_force_is_the_level(name, q, v, forwards, settle):
    """Canudas de Wit et al. 1995, eq. 4; T delays it, and changes nothing of where it ends."""
    v = v if forwards else -v
    steady, rate = force(name, settled(name, q, v, settle), q, v, T=settle)
    assert abs(rate) < 1e-6
    assert steady == pytest.approx(level(name, q, v), rel=1e-4)


@pytest.mark.parametrize("name", sorted(LAWS))
def test_within_the_presliding_length_it_is_a_spring_with_a_damper(name):
    still, _ = force(name, 1e-5, 0.3, 0.0)
    stiffness = -still / 1e-5
    moved, rate = force(name, 0.0, 0.3, 1e-9)
    assert rate == pytest.approx(1e-9, rel=1e-2)
    assert moved == pytest.approx(-stiffness * BRISTLES["tau"] * rate, rel=1e-6)
    assert force(name, 2e-5, 0.3, 0.0)[0] == pytest.approx(2 * still)
    assert force(name, 1e-5, 0.3, 0.0, xs=2e-3)[0] == pytest.approx(0.5 * still)


def test_the_time_in_which_bristles_settle_bounds_the_steps_of_the_solver():
    x = moving(PENDULUM, {"theta": {"v": 2.0}})
    needed = {}
    for settle in (0.0, 0.2 * DT):
        values = {"Fc": 0.1, "xs": 1e-4, "tau": 0.0, "T": settle}
        system = compose(PENDULUM, [Placed(builtin()["lugre_coulomb_friction"], "theta", values)])
        needed[settle] = recommended_substeps(system, None, DT, x=np.append(x, 0.0))
    assert needed[0.0] > 50
    assert needed[0.2 * DT] <= 3


@pytest.mark.parametrize("settle", [0.0, 0.2 * DT])
def test_a_pendulum_with_it_moves_as_in_the_truth_written_by_hand(settle):
    """The truth is C, in steps of 0.2 ms; T costs less than a ten thousandth of what the friction does."""
    rng = np.random.default_rng(3)
    n = 2000
    u = np.interp(np.arange(n), np.arange(0, n + 50, 50), rng.standard_normal(n // 50 + 1)) * 0.5
    plant = {"J": 0.1, "mgl": 1.0, "b0": 0.02}
    bristles = {"Fss0": 0.15, "Fst0": 0.07, "vs0": 0.5, "bs0": 60.0, "bd0": 0.8}
    free = truth(plant, u, start=np.zeros(2)).q[:, 0]
    true = truth(plant | bristles, u, start=np.zeros(2)).q[:, 0]
    values = {"Fs": 0.15, "Fc": 0.07, "vs": 0.5, "xs": 0.15 / 60.0, "tau": 0.8 / 60.0, "T": settle}
    system = compose(
        PENDULUM.with_parameters({"J": 0.1, "mgl": 1.0, "b": 0.02}),
        [Placed(builtin()["lugre_friction"], "theta", values)],
    )
    simulator = system.simulator(DT, backend="casadi", substeps=20 if settle == 0.0 else 3)
    y = simulator.rollout(system.vector(None), np.zeros(system.nx), u[:, None])
    error = np.abs(y[:, 0] - true).max()
    effect = np.abs(free - true).max()
    assert effect > 0.3
    assert error < (1e-9 if settle == 0.0 else 1e-4) * effect
