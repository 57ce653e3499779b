"""What a poor model lost comes back with the law that was missing: sensor noise, parameters that went to nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from harness.diagnosis.kinds import EquationsKind
from harness.effects import builtin
from harness.effects.compose import compose
from harness.effects.effect import Placed
from harness.physics import load_model
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory

DT, FINER, NOISE = 2e-3, 16, 2e-4
PLANT = {"m": 5e-6, "c": 2e-4, "k": 1.0}


def record(seed: int, n: int = 2500) -> Trajectory:
    """Return a hardening oscillator under a multisine up to 0.3 of the sampling frequency."""
    rng = np.random.default_rng(seed)
    lines = int(0.3 * n)
    spectrum = np.zeros(n * FINER // 2 + 1, dtype=complex)
    spectrum[1:lines] = np.exp(2j * np.pi * rng.random(lines - 1))
    u = np.fft.irfft(spectrum, n * FINER)[:, None]
    u *= 0.03 / u.std()
    law = Placed(builtin()["cubic_spring"], "q")
    plant = compose(load_model("oscillator"), [law])
    p = plant.vector({**PLANT, law.name("k3"): 4.0})
    y = plant.simulator(DT / FINER, intersample="foh", substeps=1).rollout(p, [0.0, 0.0], u)[::FINER]
    spec = PlantSpec((Channel("u", "N"),), (Channel("q", "m"),), DT)
    return Trajectory(np.arange(n) * DT, u[::FINER], y + NOISE * rng.normal(size=(n, 1)), spec)


def test_a_law_that_takes_up_the_force_gives_the_sensor_its_noise_back() -> None:
    runs = (Run(record(0), "estimation"), Run(record(1), "validation"))
    dataset = Dataset("hardening", runs, intersample="smooth")
    nominal = load_model("oscillator").with_parameters(PLANT)
    form = EquationsKind().form(nominal, dataset)
    poor = form.fit((), form.first_starts(), None)
    assert poor is not None
    point = poor.detail.points["estimation"]  # what is missing looks like a force, and a fit may end there
    poor.detail.points["estimation"] = replace(point, noise=replace(point.noise, r=np.array([1e-5 * NOISE])))
    form.resize(poor)
    law = Placed(builtin()["cubic_spring"], "q")
    fit = form.fit([law], [{**poor.values, law.name("k3"): 1.0}], poor)
    assert fit is not None
    assert fit.converged
    assert fit.detail.points["estimation"].noise.r[0] == pytest.approx(NOISE, rel=0.1)
    assert fit.values[law.name("k3")] == pytest.approx(4.0, rel=0.02)
    assert {name: fit.values[name] for name in PLANT} == pytest.approx(PLANT, rel=0.01)


def late_cart(seed: int, n: int = 2500) -> Trajectory:
    """Return a cart-pole with friction of 0.3 N s/m, its force 20 ms late, under an unknown force of 1 %."""
    rng = np.random.default_rng(seed)
    spectrum = np.zeros(n // 2 + 1, dtype=complex)
    spectrum[1:30] = np.exp(2j * np.pi * rng.random(29))  # up to 3 Hz
    u = np.fft.irfft(spectrum, n)[:, None]
    u *= 4.0 / u.std()
    unknown = lfilter([1.0], [1.0, -0.96], rng.normal(size=n))[:, None]
    law = Placed(builtin()["actuator_lag"], "u")
    plant = compose(load_model("cart-pole"), [law])
    p = plant.vector({**plant.values(), "bx": 0.3, law.name("tau"): 0.02})
    y = plant.simulator(4e-3, substeps=4).rollout(p, np.zeros(5), u + 0.04 * unknown / unknown.std())
    spec = PlantSpec((Channel("u", "N"),), (Channel("x", "m"), Channel("theta", "rad", period=2 * np.pi)), 4e-3)
    return Trajectory(np.arange(n) * 4e-3, u, y + 1e-4 * rng.normal(size=y.shape), spec)


@pytest.mark.slow
def test_a_parameter_that_went_to_nothing_comes_back() -> None:
    """Through a logarithm no derivative brings it back: without its lag the cart has no friction, and kept none."""
    dataset = Dataset("late", (Run(late_cart(0), "estimation"), Run(late_cart(1), "validation")))
    form = EquationsKind().form(load_model("cart-pole"), dataset)
    poor = form.fit((), form.first_starts(), None)
    assert poor is not None
    assert poor.values["bx"] < 1e-6
    form.resize(poor)
    law = Placed(builtin()["actuator_lag"], "u")
    fit = form.fit([law], [{**poor.values, law.name("tau"): 0.007}], poor)
    assert fit is not None
    assert fit.values["bx"] == pytest.approx(0.3, rel=0.02)
    assert fit.values[law.name("tau")] == pytest.approx(0.02, rel=0.01)
