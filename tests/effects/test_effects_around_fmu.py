"""An FMU with effects around it goes from one process to another: a loop on an FMU runs in a child."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from harness.blackbox.effects import surround
from harness.blackbox.reader import fmu_system
from harness.blackbox.runner import Runner
from harness.blackbox.simulator import FmuSimulator
from harness.effects import builtin
from harness.effects.effect import Placed
from harness.signals import Channel, PlantSpec
from plants.mockups import mockup

SPEC = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"),), 0.01)


@pytest.mark.parametrize(
    ("name", "at", "values"),
    [("coulomb_friction", "theta", {"Fc": 0.2, "w": 0.05}), ("actuator_lag", "u", {"tau": 0.1})],
)
def test_it_simulates_the_same_after_the_journey(name: str, at: str, values: dict[str, float]) -> None:
    nominal = fmu_system(mockup("pendulum"), SPEC)
    system = surround(nominal, [Placed(builtin()[name], at, values)])
    there = pickle.loads(pickle.dumps(system))
    assert there.effects == system.effects
    assert there.fingerprint == system.fingerprint
    u = np.sin(np.arange(60) * 0.1)[:, None]
    runs = []
    for one in (system, there, pickle.loads(pickle.dumps(nominal))):
        simulator = FmuSimulator(one, Runner(one, SPEC.sample_time))
        runs.append(simulator.run(one.vector(), np.zeros(one.nx), u)[1])
    assert np.array_equal(runs[0], runs[1])
    assert np.abs(runs[0] - runs[2]).max() > 1e-3


@pytest.mark.parametrize(
    ("first", "values", "start"),
    [("drifting_gain", {}, 3.0), ("actuator_lag", {"tau": 0.1}, 2.0)],
    ids=["time", "a hidden state"],
)
def test_a_hidden_state_starts_where_what_stands_before_it_does(
    first: str, values: dict[str, float], start: float
) -> None:
    """A gain drifts by a few hundredths within a record, and a lag begins at its input."""
    effects = builtin()
    system = surround(
        fmu_system(mockup("pendulum"), SPEC),
        [Placed(effects[first], "u", values), Placed(effects["rate_limit"], "u", {})],
    )
    simulator = FmuSimulator(system, Runner(system, SPEC.sample_time))
    found = simulator.hidden_start(np.zeros(system.nx), np.array([start]), system.vector())
    np.testing.assert_allclose(found, start, rtol=0.03)


def test_a_delayed_input_may_have_been_another_before_the_record() -> None:
    """What goes in is delayed by two samples and a half: as if the FMU itself had got 0 for so long, then 3."""
    nominal = fmu_system(mockup("pendulum"), SPEC)
    system = surround(nominal, [Placed(builtin()["input_delay"], "u", {"tau": 0.025})])
    assert [(state.name, state.unit) for state in system.hidden] == [("input_delay@u.before", "N m")]
    late = FmuSimulator(system, Runner(system, SPEC.sample_time))
    p, x0, u = system.vector(), np.array([0.3, 0.0, -3.0]), np.full((40, 1), 3.0)
    assert late.hidden_start(x0, u[0], p).tolist() == [0.0], "nothing is known of it: it was the first value"
    seen, by_delay = late.sampled.inputs(u[None], p[None], True)
    arrived = np.concatenate([[0.0, 0.0, 1.5], np.full(37, 3.0)])[:, None]
    plain = FmuSimulator(nominal, Runner(nominal, SPEC.sample_time)).run(nominal.vector(), x0[:2], arrived)[1]
    np.testing.assert_allclose(late.run(p, x0, seen[0])[1], plain, atol=1e-9)

    def moved(k: int, h: float) -> np.ndarray:
        q = np.concatenate([p, x0])
        q[k] += h
        return late.run(
            q[: system.np], q[system.np :], late.sampled.inputs(u[None], q[None, : system.np], False)[0][0]
        )[1]

    assert by_delay is not None
    slopes = late.windows(p[None], x0[None], seen, by_delay, np.zeros(1))[2]
    assert slopes is not None
    for k in (system.np - 1, system.np + 2):
        expected = (moved(k, 1e-3) - moved(k, -1e-3)) / 2e-3
        assert np.abs(expected).max() > 1e-4
        np.testing.assert_allclose(slopes[0][..., k], expected, atol=0.02 * np.abs(expected).max())
