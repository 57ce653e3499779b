"""A quarter of a car, its equations typed with a mass matrix: what acts between two masses acts along its travel."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from harness.diagnosis import close_loop
from harness.physics.symbolic.typed import read_equations
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory

State = tuple[float, float, float, float]

BODY, WHEEL, SPRING, TYRE, DAMPER, DT = 250.0, 35.0, 16e3, 160e3, 1000.0, 0.005
SPEC = PlantSpec((Channel("z", "m"),), (Channel("zs", "m"), Channel("zu", "m")), DT)
NOMINAL = f"""
input  z [m]
state  e [m], zu [m], ve [m/s], vu [m/s]
motion e: ve
motion zu: vu
ms = {BODY} kg fixed
mu = 40 kg        >= 0
ks = 14000 N/m    >= 0
kt = 180000 N/m   >= 0
c = 800 N s/m     >= 0
e' = ve
zu' = vu
e: ms*(vu' + ve') = -ks*e - c*ve
zu: (ms + mu)*vu' + ms*ve' = -kt*(zu - z)
output zs = zu + e [m]
output zu
"""


def drive(force: Callable[[float, float], float], seed: int) -> Trajectory:
    """Return 15 s over a rough road, by Runge-Kutta steps of the two masses written out; 0.1 mm of noise."""
    rng, t = np.random.default_rng(seed), np.arange(3000) * DT
    road = (
        0.012
        * np.sqrt(2 / 14)
        * np.sin(2 * np.pi * np.outer(t, np.linspace(0.3, 12, 14)) + rng.uniform(0, 6.28, 14)).sum(axis=1)
    )

    def after(by: float, x: State, rate: State) -> State:
        return x[0] + by * rate[0], x[1] + by * rate[1], x[2] + by * rate[2], x[3] + by * rate[3]

    def rates(x: State, z: float) -> State:
        between = SPRING * (x[0] - x[1]) + DAMPER * (x[2] - x[3]) + force(x[0] - x[1], x[2] - x[3])
        return x[2], x[3], -between / BODY, (between - TYRE * (x[1] - z)) / WHEEL

    x, rows, h = (0.0, 0.0, 0.0, 0.0), [], DT / 8
    for z in road.tolist():
        rows.append(x[:2])
        for _ in range(8):
            k1 = rates(x, z)
            k2 = rates(after(h / 2, x, k1), z)
            k3 = rates(after(h / 2, x, k2), z)
            k4 = rates(after(h, x, k3), z)
            for weight, rate in ((1, k1), (2, k2), (2, k3), (1, k4)):
                x = after(weight * h / 6, x, rate)
    return Trajectory(t, road[:, None], np.array(rows) + 1e-4 * rng.standard_normal((3000, 2)), SPEC)


@pytest.mark.parametrize(
    ("force", "name", "parameter", "value"),
    [
        pytest.param(lambda e, v: 300.0 * abs(v), "asymmetric_damping", "c", 300.0, id="rebound and compression"),
        pytest.param(lambda e, v: 2.5e6 * e**3, "cubic_spring", "k3", 2.5e6, id="progressive spring",
                     marks=pytest.mark.slow),
        pytest.param(lambda e, v: 40.0 * np.tanh(v / 0.01), "coulomb_friction", "Fc", 40.0, id="dry bushes",
                     marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_what_acts_between_body_and_wheel_is_named_with_its_size(
    force: Callable[[float, float], float], name: str, parameter: str, value: float
) -> None:
    """With an inertia for each height it was unexplained, or a ripple and a sensor gain of 3."""
    dataset = Dataset("car", (Run(drive(force, 1)), Run(drive(force, 2), "validation")))
    report = close_loop(dataset, read_equations(NOMINAL))
    assert [(one["name"], one["at"]) for one in report.data["effects"]] == [(name, "e")]
    after = report.data["parameters"]["after"]
    assert after[f"{name}@e.{parameter}"]["value"] == pytest.approx(value, rel=0.05)
    assert after["mu"]["value"] == pytest.approx(WHEEL, rel=0.02)
    assert report.data["adequacy"] == "explained"
