"""Two tanks in cascade: the outlets and zeros that can be chosen."""

from __future__ import annotations

import numpy as np
import pytest

from harness.errors import InputError
from harness.physics import load_model
from harness.physics.fitting.output_error import fit_output_error
from harness.signals import Trajectory

X, U = np.array([4.0, 2.25]), np.array([3.0])


def rates(**options: object) -> tuple[np.ndarray, float]:
    """Return the derivative at (X, U) and the reading, the zeros at -1 V and 2 V where the model has them."""
    system = load_model("two-tanks", **options)
    values = {"k_pump": 0.1, "k_upper": 0.05, "k_lower": 0.06, "u_0": -1.0, "y_0": 2.0}
    p = system.vector({name: values[name] for name in system.parameter_names})
    simulator = system.simulator(1.0, backend="casadi")
    return np.asarray(simulator.derivative(X, U, p)), float(simulator.output(X, U, p)[0])


@pytest.mark.parametrize("zeros", [False, True])
@pytest.mark.parametrize(("outlet", "through"), [("orifice", 0.05 * (np.sqrt(4.0001) - 0.01)), ("linear", 0.05 * 4.0)])
def test_outlet_and_zeros_are_the_chosen_ones(outlet: str, through: float, zeros: bool) -> None:
    rate, reading = rates(upper_outlet=outlet, pump_offset=zeros, sensor_zero=zeros)
    pumped = 0.1 * (2.0 if zeros else 3.0)
    leaving = 0.06 * (np.sqrt(2.2501) - 0.01)
    assert rate == pytest.approx([pumped - through, through - leaving], rel=1e-12)
    assert reading == pytest.approx(4.25 if zeros else 2.25)


def test_another_outlet_is_refused() -> None:
    with pytest.raises(InputError, match="outlet of the upper tank"):
        load_model("two-tanks", upper_outlet="laminar")


def test_the_zero_of_the_sensor_is_found_from_its_bound() -> None:
    system = load_model("two-tanks", upper_outlet="linear", sensor_zero=True)
    truth = {"k_pump": 0.05, "k_upper": 0.03, "k_lower": 0.06, "y_0": 2.0}
    t = np.arange(400) * 4.0
    u = 2.0 + np.sin(0.011 * t) + 0.6 * np.sin(0.031 * t)
    simulator = system.simulator(4.0)
    y = simulator.rollout(system.vector(truth), np.array([3.0, 2.0]), u[:, None])
    run = Trajectory(t, u[:, None], y, simulator.spec)
    found = fit_output_error(system, [run], start={**truth, "k_pump": 0.04, "y_0": 0.0})
    assert found.parameters == pytest.approx(truth, rel=1e-3)
