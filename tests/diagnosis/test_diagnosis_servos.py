"""A servo that lifts a weight: dry friction of its gear, by an integrator that sticks and slips, at published sizes.

The plant is no code of the project: a motor behind a resistance under a position controller of 1 kHz, friction that
stops the arm within a step where it can (as physics engines do), an encoder of 4096 counts, a reading every 5 ms. Sizes
are those that were published for two Dynamixel servos (Duclusaud et al. 2024, arXiv:2410.08650, models M1, M3 and M4).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from harness.diagnosis import close_loop
from harness.physics.symbolic.ode import Ode
from harness.physics.symbolic.typed import read_equations
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory

DT, FINE, COUNT = 5e-3, 1e-4, 2 * math.pi / 4096
SPEC = PlantSpec((Channel("v", "V"),), (Channel("theta", "rad"),), DT)


@dataclass(frozen=True)
class Servo:
    """A servo with an arm and a weight; ``load`` and ``slow`` are shares of the torque in the gear."""

    kt: float
    resistance: float
    inertia: float
    weight: float
    stiffness: float
    supply: float
    viscous: float
    level: float
    load: float = 0.0
    slow: float = 0.0
    speed: float = 1.0
    power: float = 1.0

    def run(self, goal: Callable[[float], float], phase: float) -> Trajectory:
        """Return 6 s behind a position controller."""
        q = w = volts = 0.0
        rows: list[tuple[float, float]] = []
        for k in range(round(6.0 / FINE)):
            reading = COUNT * round(q / COUNT + phase)
            if k % round(1e-3 / FINE) == 0:
                volts = min(max(self.stiffness * (goal(k * FINE) - reading), -self.supply), self.supply)
            if k % round(DT / FINE) == 0:
                rows.append((volts, reading))
            motor = self.kt / self.resistance * (volts - self.kt * w)
            pull = -self.weight * math.sin(q)
            near = math.exp(-((abs(w) / self.speed) ** self.power))
            most = self.level + (self.load + self.slow * near) * abs(pull - motor) + self.viscous * abs(w)
            stop = self.inertia / FINE * w + motor + pull  # what would halt the arm within this step
            w += (motor + pull - math.copysign(min(abs(stop), most), stop)) / self.inertia * FINE
            q += w * FINE
        u, y = np.array(rows).T
        return Trajectory(np.arange(len(u)) * DT, u[:, None], y[:, None], SPEC)

    def data(self) -> Dataset:
        """Return an estimation and a validation record, as a bench would make them."""
        chirp = self.run(lambda t: math.sin(t * t), 0.2)
        sines = self.run(lambda t: math.pi / 2 * math.sin(t) + 0.5 * math.sin(5 * t) * math.sin(2 * t), -0.3)
        return Dataset("servo", (Run(chirp), Run(sines, "validation")))

    def nominal(self) -> Ode:
        """Return what an engineer writes: a motor, an arm of known weight, no dry friction."""
        return read_equations(f"""
            input  v [V]
            state  theta [rad], w [rad/s]
            motion theta: w, J
            J = {1.2 * self.inertia:.3g} kg m^2    >= 0
            c = {0.9 * self.kt**2 / self.resistance:.3g} N m s/rad >= 0
            k = {1.1 * self.kt / self.resistance:.3g} N m/V >= 0
            theta' = w
            w' = (k*v - c*w - {self.weight:.6g}*sin(theta))/J
            output theta
        """)


SMALL = Servo(kt=0.38, resistance=3.38, inertia=3.3e-3, weight=0.108, stiffness=4.3, supply=7.5, viscous=4.4e-3,
              level=8.9e-3, load=0.12)  # fmt: skip
LARGE = Servo(kt=1.66, resistance=3.16, inertia=0.0347, weight=1.5, stiffness=19.0, supply=14.4, viscous=0.015,
              level=0.085, slow=0.23, speed=1.5, power=1.33)  # fmt: skip


@pytest.mark.slow
def test_friction_that_grows_with_the_torque_in_a_gear_is_named_with_its_sizes() -> None:
    """It was called a friction that depends on the angle, with an error fifteen times as large."""
    report = close_loop(SMALL.data(), SMALL.nominal())
    assert "gear_friction" in [one["name"] for one in report.data["effects"]]
    after = report.data["parameters"]["after"]
    assert after["gear_friction@theta.mu"]["value"] == pytest.approx(SMALL.load, rel=0.05)
    assert after["gear_friction@theta.Fc"]["value"] == pytest.approx(SMALL.level, rel=0.05)
    assert after["J"]["value"] == pytest.approx(SMALL.inertia, rel=0.05)
    assert report.data["explained_share"] > 0.9999
    assert any("v moves between readings" in words for words in report.data["warnings"]), "five controls a reading"


@pytest.mark.slow
def test_one_that_is_higher_near_standstill_is_named_and_followed() -> None:
    report = close_loop(LARGE.data(), LARGE.nominal())
    assert "gear_stribeck_friction" in [one["name"] for one in report.data["effects"]]
    before, after = (
        report.data["errors"][when]["simulation_error"]["validation"]["theta"]["rms"] for when in ("before", "after")
    )
    assert after < before / 5


@pytest.mark.slow
@pytest.mark.parametrize("servo", [SMALL, LARGE], ids=["small", "large"])
def test_dry_friction_of_one_level_is_not_called_a_gears(servo: Servo) -> None:
    plain = replace(servo, level=servo.level + 0.1 * servo.weight, load=0.0, slow=0.0)
    report = close_loop(plain.data(), plain.nominal())
    named = [one["name"] for one in report.data["effects"]]
    assert "coulomb_friction" in named
    assert not [name for name in named if name.startswith("gear")]
    level = report.data["parameters"]["after"]["coulomb_friction@theta.Fc"]["value"]
    assert level == pytest.approx(plain.level, rel=0.05)
    assert report.data["adequacy"] == "explained"
