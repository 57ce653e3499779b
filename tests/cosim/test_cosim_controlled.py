"""Lines within a step are of second order; a controlled step keeps its error; both go back bit for bit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from harness import registry
from harness.cosim import Connection, Coupled
from harness.errors import InputError, PlantError
from plants.fmu.mockups import pendulum_fmu
from plants.fmu.plant import FmuPlant
from plants.mockups import mockup

ARM, KP, KI, WISH = {"J": 0.05, "b": 0.1, "mgl": 1.0}, 0.5, 0.2, 0.4
ORDERS = pytest.mark.parametrize("order", ["jacobi", "gauss-seidel"])


def loop(h: float, **options: Any) -> Coupled:
    """Return a pendulum FMU under a PI controller FMU."""
    law = FmuPlant(mockup("pi_controller"), sample_time=h, parameters={"Kp": KP, "Ki": KI})
    return Coupled(
        {"arm": pendulum_fmu(sample_time=h, substep=1e-3, **ARM), "law": law},
        [Connection("wish", "law.r"), Connection("arm.theta", "law.y"), Connection("law.u", "arm.u", gain_unit="N m")],
        inputs={"wish": "law.r"},
        outputs=["arm.theta", "law.u"],
        **options,
    )


def moved(plant: Coupled, n: int) -> np.ndarray:
    plant.reset(rng=np.random.default_rng(0), x0={"arm.theta": 0.7})
    return np.array([plant.step(np.array([WISH])) for _ in range(n)])[:, 0]


def exact(times: np.ndarray) -> np.ndarray:
    """Return theta of the loop in continuous time."""

    def rates(_t: float, s: np.ndarray) -> list[float]:
        torque = KP * (WISH - s[0]) + s[2]
        return [s[1], (torque - ARM["b"] * s[1] - ARM["mgl"] * np.sin(s[0])) / ARM["J"], KI * (WISH - s[0])]

    return np.asarray(solve_ivp(rates, (0, 2), [0.7, 0, 0], t_eval=times, rtol=1e-11, atol=1e-12).y[0])


@ORDERS
def test_lines_within_a_step_are_of_second_order(order: str) -> None:
    errors = []
    for h in (0.05, 0.025, 0.0125):
        n = round(2 / h)
        with loop(h, order=order, hold="linear") as plant:
            errors.append(float(np.abs(moved(plant, n) - exact(h * np.arange(1, n + 1))).max()))
    assert np.log2(errors[1] / errors[2]) == pytest.approx(2.0, abs=0.15)
    with loop(0.0125, order=order) as plain:
        assert np.abs(moved(plain, 160) - exact(0.0125 * np.arange(1, 161))).max() > 10 * errors[2]


@ORDERS
@pytest.mark.parametrize("hold", ["constant", "linear"])
def test_a_tighter_bound_brings_a_smaller_error_with_more_exchanges(order: str, hold: str) -> None:
    errors, exchanges = [], []
    for bound in (3e-2, 3e-3, 1e-3):
        with loop(0.1, order=order, hold=hold, error=bound) as plant:
            errors.append(float(np.abs(moved(plant, 20) - exact(0.1 * np.arange(1, 21))).max()))
            exchanges.append(plant._controlled.exchanges)  # type: ignore[union-attr]
    assert sorted(errors, reverse=True) == errors
    assert sorted(exchanges) == exchanges
    assert all(error < 25 * bound for error, bound in zip(errors, (3e-2, 3e-3, 1e-3), strict=True))


@pytest.mark.parametrize("options", [{"hold": "linear"}, {"error": 1e-3}, {"hold": "linear", "error": 1e-3}])
def test_a_state_is_gone_back_to_bit_for_bit(options: dict[str, Any]) -> None:
    with loop(0.05, **options) as plant:
        moved(plant, 8)
        state = plant.get_state()
        first = [plant.step(np.array([WISH])) for _ in range(6)]
        plant.set_state(state)
        again = [plant.step(np.array([WISH])) for _ in range(6)]
        assert np.array_equal(first, again)
        assert np.array_equal(moved(plant, 8), moved(plant, 8))


def test_parts_of_a_sample_make_the_sample() -> None:
    options = {"sample_time": 0.02, "substep": 1e-3, **ARM}
    with pendulum_fmu(**options) as whole, pendulum_fmu(**options) as cut:  # type: ignore[arg-type]
        for one in (whole, cut):
            one.reset(rng=np.random.default_rng(0), x0={"theta": 0.3})
        u = np.array([0.2])
        for _ in range(3):
            y = [cut.step_part(u, k, 4) for k in range(4)][-1]
            np.testing.assert_allclose(y, whole.step(u), atol=1e-12)


def test_what_cannot_be_controlled_is_refused_by_name() -> None:
    parts = {"arm": pendulum_fmu(), "law": registry.create("plants", "pendulum-ode", sample_time=0.01)}
    wires = [Connection("p", "arm.u"), Connection("p", "law.u")]
    with pytest.raises(InputError, match="not so: law"):
        Coupled(parts, wires, inputs={"p": "arm.u"}, outputs=["arm.theta"], error=1e-3)
    for options, words in (
        ({"error": 0.0}, "positive"),
        ({"hold": "cubic"}, "one of constant, linear"),
        ({"hold": "linear", "iterations": 3}, "several passes"),
    ):
        with pytest.raises(InputError, match=words):
            loop(0.05, **options)
    with loop(0.2, error=1e-12) as plant, pytest.raises(PlantError, match="exchanges in a communication step"):
        moved(plant, 1)
