"""The glider and the hydrodynamic cart-pole: against independent data, limits that are known, golden records."""

from __future__ import annotations

import numpy as np
import pytest

from plants.equations.surrogates import glider_ode, hydro_cart_pole_ode

RNG = np.random.default_rng


def test_the_glider_has_the_accelerations_of_the_textbook_data(recordings_folder):
    path = recordings_folder / "textbook" / "glider_sim_data.npz"
    if not path.is_file():
        pytest.skip(f"no textbook data at {path}")
    data = np.load(path)
    states, rates = data["states"], data["accels"]
    with glider_ode() as plant:
        simulator, p = plant.system.simulator(0.01), plant.system.vector()
        for run in range(len(states)):
            for k in range(0, 50, 7):
                found = simulator.derivative(states[run, k], rates[run, k, 3:4], p)
                assert found == pytest.approx(rates[run, k], abs=1e-9)


def test_the_glider_falls_freely_without_air_and_keeps_its_pitch_rate():
    with glider_ode(parameters={"rho": 0.0}) as plant:
        plant.reset(rng=RNG(0), x0={"thetadot": 1.0})
        y = plant.rollout(np.zeros((50, 1)))[-1]
    assert y == pytest.approx([-3.5 + 3.5, 0.1 - 9.81 * 0.125, 0.5, 0.0], abs=1e-9)


def test_air_takes_energy_from_the_glider_and_up_elevator_pitches_it_up():
    with glider_ode() as plant:
        plant.reset(rng=RNG(0))
        x = plant.rollout_truth(np.zeros((60, 1)))[1]
        energy = 0.08 * 9.81 * x[:, 1] + 0.04 * (x[:, 4] ** 2 + x[:, 5] ** 2) + 0.00075 * x[:, 6] ** 2
        assert (np.diff(energy) < 0).all()
        plant.reset(rng=RNG(0))
        pulled = plant.rollout(np.r_[np.full((10, 1), 3.0), np.zeros((20, 1))])
    assert pulled[-1, 2] < -0.1, "a trailing edge turned up lifts the nose: theta counts nose down"


def test_the_wing_weathervanes_and_upstream_is_unstable():
    with hydro_cart_pole_ode(parameters={"Cw": 0.0}) as plant:
        plant.reset(rng=RNG(0), x0={"theta": 0.5})
        y = plant.rollout(np.zeros((2000, 1)))
        assert np.abs(y[-100:, 1]).max() < 0.01
        plant.reset(rng=RNG(0), x0={"theta": np.pi - 0.01})
        assert plant.rollout(np.zeros((2000, 1)))[-1, 1] == pytest.approx(0.0, abs=0.05)


def test_the_wake_sheds_at_its_frequency_and_moves_the_wing():
    with hydro_cart_pole_ode(parameters={"mc": 1e6, "mw": 1e3}) as plant:  # held still: only the oscillator moves
        plant.reset(rng=RNG(0))
        wake = plant.rollout_truth(np.zeros((3000, 1)))[1][1000:, 4]
    assert np.abs(wake).max() == pytest.approx(2.0, abs=0.05), "limit cycle of van der Pol"
    crossings = np.flatnonzero((wake[:-1] < 0) & (wake[1:] >= 0))
    period = 0.02 * np.diff(crossings).mean()
    assert 2 * np.pi / period == pytest.approx(2.1, rel=0.02)


def test_without_water_energy_stays():
    free = {"rho": 0.0, "bx": 0.0, "btheta": 0.0}
    with hydro_cart_pole_ode(parameters=free) as plant:
        plant.reset(rng=RNG(0), x0={"thetadot": 5.0, "xdot": 0.3})
        x = plant.rollout_truth(np.zeros((300, 1)))[1]
    theta, v, w, arm = x[:, 1], x[:, 2], x[:, 3], 0.05
    energy = 0.6 * v**2 + 0.2 * arm * v * w * np.cos(theta) + 0.5 * (0.2 * arm**2 + 0.2 * 0.1**2 / 12) * w**2
    assert np.ptp(energy) < 1e-6 * energy[0]
