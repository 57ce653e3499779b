"""Our own FMUs against equations integrated elsewhere, their optional effects, and golden trajectories."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from harness.signals import FloatArray
from plants.fmu.mockups import cart_pole_fmu, drive_fmu, mass_spring_fmu, two_tanks_fmu
from plants.fmu.plant import FmuPlant
from plants.mockups import mockup

RNG = np.random.default_rng(0)
Rates = Callable[[FloatArray, float], Any]


def held(rates: Rates, x0: list[float], u: FloatArray, dt: float) -> FloatArray:
    """Integrate x' = rates(x, u) hold by hold, to 1e-11."""
    from scipy.integrate import solve_ivp

    rows = [np.array(x0)]
    for (force,) in u:
        done = solve_ivp(
            lambda _t, x, force=force: rates(x, force), (0, dt), rows[-1], rtol=1e-11, atol=1e-12, method="DOP853"
        )
        rows.append(done.y[:, -1])
    return np.array(rows)


def cart_pole(x: FloatArray, u: float) -> Any:
    """Mass matrix form of the cart-pole, solved by linear algebra."""
    mc, mp, length, g, bx, bt = 1.0, 0.2, 0.5, 9.81, 0.2, 0.005
    c, s = np.cos(x[1]), np.sin(x[1])
    mass = np.array([[mc + mp, mp * length * c], [mp * length * c, mp * length**2]])
    force = np.array([u - bx * x[2] + mp * length * s * x[3] ** 2, -bt * x[3] - mp * g * length * s])
    return np.concatenate([x[2:], np.linalg.solve(mass, force)])


SMOOTH: dict[str, tuple[Callable[[], FmuPlant], Rates, list[float]]] = {
    "cart-pole": (lambda: cart_pole_fmu(outputs=("x", "theta", "v", "omega")), cart_pole, [0.1, 2.0, 0.0, -1.0]),
    "mass-spring": (
        lambda: mass_spring_fmu(outputs=("q", "v"), k2=0.3, k3=2.0),
        lambda x, u: [x[1], u - 0.1 * x[1] - x[0] - 0.3 * x[0] ** 2 - 2.0 * x[0] ** 3],
        [0.5, 0.0],
    ),
    "drive": (
        lambda: drive_fmu(sample_time=0.01, outputs=("q", "v"), offset=3.0),
        lambda x, u: [x[1], (u - 200.0 * x[1] - 3.0) / 95.0],
        [0.0, 0.1],
    ),
    "tanks": (
        lambda: two_tanks_fmu(sample_time=0.5, outputs=("upper", "lower")),
        lambda x, u: [0.04 * max(u, 0) - 0.06 * np.sqrt(x[0]), 0.06 * np.sqrt(x[0]) - 0.06 * np.sqrt(x[1])],
        [2.0, 1.0],
    ),
}


@pytest.mark.parametrize("name", SMOOTH)
def test_equations(name: str) -> None:
    make, rates, x0 = SMOOTH[name]
    with make() as plant:
        u = 2.0 + 3.0 * np.sin(0.3 * np.arange(200)).reshape(-1, 1)
        names = [c.name for c in plant.spec.states][: len(x0)]
        first = plant.reset(rng=RNG, x0=dict(zip(names, x0, strict=True)))
        got = np.vstack([first, plant.rollout(u)])
        assert np.abs(got - held(rates, x0, u, plant.spec.sample_time)).max() < 1e-7


def test_cart_pole_keeps_energy_and_momentum() -> None:
    with cart_pole_fmu(bx=0.0, btheta=0.0, outputs=("x", "theta", "v", "omega")) as plant:
        y = np.vstack([plant.reset(rng=RNG, x0={"theta": 2.0, "v": 0.3}), plant.rollout(np.zeros((2000, 1)))])
    _, theta, v, omega = y.T
    c = np.cos(theta)
    energy = 0.6 * v**2 + 0.1 * c * v * omega + 0.5 * 0.05 * omega**2 - 0.2 * 9.81 * 0.5 * c
    momentum = 1.2 * v + 0.1 * c * omega
    assert np.ptp(energy) < 1e-8
    assert np.ptp(momentum) < 1e-9


def test_coulomb_friction_slows_the_cart_at_a_constant_rate() -> None:
    with drive_fmu(sample_time=0.01, Fv=0.0, Fc=20.0, outputs=("v",)) as plant:
        plant.reset(rng=RNG, x0={"v": 0.5})
        v = plant.rollout(np.zeros((200, 1)))[:, 0]
    assert np.diff(v) == pytest.approx(-20.0 / 95.0 * 0.01)


def test_backlash_frees_the_load_for_the_width_of_the_gap() -> None:
    gap = 0.002
    with drive_fmu(gap=gap, Fv=500.0, FvL=50.0, outputs=("q", "q_load")) as plant:
        plant.reset(rng=RNG)
        u = 10.0 * np.sign(np.sin(2 * np.pi * 0.5 * 1e-3 * np.arange(8000))).reshape(-1, 1)
        q, load = plant.rollout(u).T
    play = q - load
    assert np.ptp(play) == pytest.approx(gap, rel=0.1)
    free = np.abs(play) < 0.45 * gap
    assert 0 < free.sum() < len(free) / 4
    with drive_fmu(gap=0.0, Fv=500.0, FvL=50.0, outputs=("q", "q_load")) as plant:
        plant.reset(rng=RNG, x0={"q": 0.3})
        rows = plant.rollout(u)
    assert np.array_equal(rows[:, 0], rows[:, 1])


def test_overflow_caps_the_upper_tank_and_feeds_the_lower_one() -> None:
    levels = {}
    for overflow in (False, True):
        for share in (0.0, 1.0):
            with two_tanks_fmu(overflow=overflow, rim=4.0, share=share, k_lower=0.1, outputs=("upper", "y")) as plant:
                plant.reset(rng=RNG)
                levels[overflow, share] = plant.rollout(np.full((600, 1), 5.0))
    assert levels[False, 0.0][:, 0].max() > 8.0
    assert np.array_equal(levels[False, 0.0], levels[False, 1.0])
    assert levels[True, 0.0][:, 0].max() == 4.0
    assert levels[True, 1.0][-1, 1] > levels[True, 0.0][-1, 1] + 1.0
    # at rest the lower tank passes on what it gets: with share 1 all of the pump's flow
    assert 0.1 * np.sqrt(levels[True, 1.0][-1, 1]) == pytest.approx(0.04 * 5.0, rel=1e-3)


@pytest.mark.parametrize("fmi", [2, 3])
def test_pi_controller_integrates_limits_and_winds_down(fmi: int) -> None:
    options = {"Kp": 2.0, "Ki": 4.0, "low": -1.0, "high": 3.0}
    with FmuPlant(mockup("pi_controller", fmi), sample_time=0.5, parameters=options) as law:
        assert "feedthrough" in law.abilities
        law.reset(rng=RNG)
        assert law.output(np.array([1.0, 0.5])) == pytest.approx([1.0])
        assert law.output(np.array([1.0, 0.9])) == pytest.approx([0.2])
        assert law.step(np.array([1.0, 0.5])) == pytest.approx([1.0 + 4.0 * 0.5 * 0.5])
        for _ in range(10):
            law.step(np.array([5.0, 0.0]))
        assert law.truth() == pytest.approx([1.0])
        assert law.output(np.array([0.0, 5.0])) == pytest.approx([-1.0])


@pytest.mark.parametrize("fmi", [2, 3])
def test_state_feedback(fmi: int) -> None:
    gains = {"K1": 1.0, "K2": -2.0, "K3": 3.0, "K4": 0.5, "high": 10.0}
    with FmuPlant(mockup("state_feedback", fmi), sample_time=0.1, parameters=gains) as law:
        law.reset(rng=RNG)
        x = np.array([0.3, -0.1, 0.7, 2.0])
        expected = 1.0 - np.array([1.0, -2.0, 3.0, 0.5]) @ x
        assert law.output(np.concatenate([[1.0], x])) == pytest.approx([expected])
        assert law.output(np.array([50.0, 0, 0, 0, 0])) == pytest.approx([10.0])


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize(("rounding", "rule"), [("nearest", np.rint), ("down", np.floor), ("toward_zero", np.trunc)])
def test_quantiser_counts_by_each_rule(fmi: int, rounding: str, rule: Callable[[FloatArray], FloatArray]) -> None:
    options = {"resolution": 0.25, "rounding": rounding, "bits": 4}
    with FmuPlant(mockup("quantiser", fmi), sample_time=0.1, parameters=options) as sensor:
        assert [c.kind for c in sensor.spec.outputs] == ["real", "integer"]
        sensor.reset(rng=RNG)
        u = np.linspace(-3, 3, 97)
        got = np.array([sensor.output(np.array([value])) for value in u])
    count = np.clip(rule(u / 0.25), -8, 7)
    assert np.array_equal(got[:, 1], count)
    assert np.array_equal(got[:, 0], 0.25 * count)


def test_quantiser_can_be_switched_off() -> None:
    with FmuPlant(mockup("quantiser"), sample_time=0.1, parameters={"enabled": False}) as sensor:
        sensor.reset(rng=RNG)
        assert sensor.output(np.array([0.12345]))[0] == 0.12345
