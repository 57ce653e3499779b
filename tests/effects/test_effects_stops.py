"""Where a travel ends: steps that pass a stop are fine enough, and the loop tells a wall from stops at both sides."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.diagnosis.algorithm import diagnose
from harness.effects import Placed, builtin, compose
from harness.physics.compiled.simulator import Simulator
from harness.physics.symbolic.typed import read_equations
from harness.signals import Channel, Dataset, FloatArray, PlantSpec, Run, Trajectory

GIMBAL = read_equations(
    "input u [N m]\nstate q [rad], w [rad/s]\nmotion q: w, J\nJ = 0.03 kg m^2 >= 0\nb = 0.1 N m s/rad >= 0\n"
    "k = 3 N m/rad >= 0\nq' = w\nw' = (u - b*w - k*q)/J\noutput q\n",
    "gimbal.eqs",
).system()
DT = 0.005


def driven(seed: int, samples: int) -> FloatArray:
    """Return a torque (N,) of four lines that swings the gimbal by some 0.6 rad."""
    rng, t = np.random.default_rng(seed), DT * np.arange(samples)
    lines = zip(rng.uniform(0.3, 3.0, 4), rng.uniform(0.0, 2.0 * np.pi, 4), strict=True)
    return 0.55 * sum((np.sin(2.0 * np.pi * f * t + phase) for f, phase in lines), np.zeros(samples))


def swung(u: FloatArray, stop: Callable[[float, float], float]) -> FloatArray:
    """Return the angle of the true gimbal (N,), in steps of a fortieth of a sample (semi-implicit Euler, refined)."""
    parts, q, w, out = 40, 0.0, 0.0, np.empty(len(u))
    h = DT / parts
    for k, torque in enumerate(u):
        out[k] = q
        for _ in range(parts):
            a = (torque - 0.12 * w - 2.0 * q + stop(q, w)) / 0.02
            middle, speed = q + 0.5 * h * w, w + 0.5 * h * a
            a = (torque - 0.12 * speed - 2.0 * middle + stop(middle, speed)) / 0.02
            q, w = q + h * speed, w + h * a
    return out


@settings(max_examples=12, deadline=None)
@given(
    name=st.sampled_from(["end_stop", "one_sided_stop"]), where=st.floats(0.2, 0.5), k=st.floats(15.0, 150.0),
    d=st.floats(0.0, 0.2), seed=st.integers(0, 1000),
)  # fmt: skip
def test_steps_that_pass_a_stop_are_fine_enough(name: str, where: float, k: float, d: float, seed: int) -> None:
    """A damper that takes hold within a step of 5 ms was seen to a thousandth of a radian or two."""
    system = compose(GIMBAL, [Placed(builtin()[name], "q", {"stop": where, "k": k, "d": d})])
    system = system.with_parameters({"J": 0.02, "b": 0.12, "k": 2.0})
    u = driven(seed, 800)[:, None]
    runs = [Simulator(system, DT, substeps=n).rollout(system.vector(), np.zeros(system.nx), u)[:, 0] for n in (1, 40)]
    assert np.sqrt(np.mean((runs[0] - runs[1]) ** 2)) < 4e-4
    assert np.ptp(runs[1]) > 0.3


def test_a_wall_at_one_side_is_found_where_the_travel_ends() -> None:
    """A quadratic spring, a wave and an error of the sensor stood in for it."""
    rng = np.random.default_rng(5)
    spec = PlantSpec((Channel("u", "N m"),), (Channel("q", "rad"),), DT)
    runs = []
    for seed, use in ((1, "estimation"), (2, "validation")):
        u = driven(seed, 1200)
        q = swung(u, lambda q, w: -60.0 * (q + 0.35) - 0.05 * w if q < -0.35 else 0.0)
        y = (q + 1e-3 * rng.standard_normal(len(q)))[:, None]
        runs.append(Run(Trajectory(DT * np.arange(len(u)), u[:, None], y, spec), use))
    found = diagnose(Dataset("gimbal", tuple(runs)), GIMBAL)
    assert [str(one.placed) for one in found.outcome.accepted] == ["one_sided_stop@q"]
    assert found.final.values["one_sided_stop@q.stop"] == pytest.approx(-0.35, abs=2e-3)
    assert found.final.values["one_sided_stop@q.k"] == pytest.approx(60.0, rel=0.03)
    assert found.grade == "explained"
