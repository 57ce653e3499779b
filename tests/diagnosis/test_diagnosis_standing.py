"""Dry friction of a motor that stands between its moves: what holds it there is as steep as where it turns."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from harness import api
from harness.signals import FloatArray

MOTOR = """input  u [1]
state  th [rad], w [rad/s]
motion th: w, J
J = 1e-4 kg m^2 fixed
k = 0.5 N m >= 0
b = 1e-3 N m s/rad >= 0
th' = w
w' = (k*u - b*w) / J
output th
"""


def record(seed: int, number: int, *, rows: int = 400, step: float = 0.01, inside: int = 50) -> FloatArray:
    """Return rows of time, command and angle, read by an encoder whose stamps jitter by 0.1 ms while it turns."""
    rng = np.random.default_rng([seed, number])
    level = 0.3 * rng.uniform(-1.0, 1.0, 40)
    level[::3] = 0.0
    u = np.repeat(level, rng.integers(40, 120, 40))[:rows]
    angles, speeds, th, w = np.zeros(rows), np.zeros(rows), 0.0, 0.0
    for k in range(rows):
        angles[k], speeds[k] = th, w
        for _ in range(inside):
            free = 4000.0 * u[k] - 6.0 * w
            if w == 0.0:
                pull = 0.0 if abs(free) <= 300.0 else free - np.sign(free) * 300.0
            else:
                pull = free - np.sign(w) * 300.0
            new = w + step / inside * pull
            if new * w < 0.0:
                new = 0.0
            th, w = th + step / inside * 0.5 * (w + new), new
    read = angles + speeds * 1e-4 * rng.standard_normal(rows)
    count = 2.0 * np.pi / 2000.0
    return np.column_stack([np.arange(rows) * step, u, np.round(read / count) * count])


@pytest.mark.parametrize("seed", [3, pytest.param(2, marks=pytest.mark.slow), pytest.param(5, marks=pytest.mark.slow)])
def test_dry_friction_of_a_motor_that_stands_is_fitted(seed: int, tmp_path: Path) -> None:
    (tmp_path / "motor.eqs").write_text(MOTOR, encoding="utf-8")
    for number, use in enumerate(("estimation", "validation")):
        rows = record(seed, number)
        np.savetxt(tmp_path / f"{use}.csv", rows, delimiter=",", header="time [s],u [1],th [rad]", comments="")
    report = api.close_loop(
        tmp_path / "estimation.csv", validation=tmp_path / "validation.csv", model=str(tmp_path / "motor.eqs"),
        dictionary="coulomb_friction(th); !*", out=tmp_path / "out",
    )  # fmt: skip
    (friction,) = report.data["effects"]
    assert friction["name"] == "coulomb_friction"
    level = friction["parameters"]["Fc"]
    assert level["value"] == pytest.approx(0.03, rel=0.05)
