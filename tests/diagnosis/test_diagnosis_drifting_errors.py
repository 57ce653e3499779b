"""Free runs of slow plants under a force that nobody measured: an error that drifts is no effect."""

from __future__ import annotations

import numpy as np
import pytest

from harness.diagnosis.algorithm import diagnose
from harness.physics import Ode, Parameter
from harness.signals import Dataset, FloatArray, PlantSpec, Run, Trajectory

pytestmark = pytest.mark.slow  # whole loops

DT, N, HEAT, LOSS = 2.0, 2000, 2300.0, 0.45


def oven() -> Ode:
    ode = Ode("oven", x="T", u="P", p="C R", units={"T": "K", "P": "W"}, process="T",
              parameters={"C": 2000.0, "R": 0.5})  # fmt: skip
    (temperature,), (power,), (heat, loss) = ode.x, ode.u, ode.p
    ode.rhs, ode.outputs = [(power - temperature / loss) / heat], {"T": temperature}
    return ode


def record(seed: int, *, draught: float = 0.0, leak: float = 0.0, door: float = 0.0, sun: float = 0.0) -> Trajectory:
    """Return an oven under steps of its heater, exact between samples.

    A draught takes power, and comes and goes; from a third of the record on a door stays open; the sun heats by turns.
    """
    rng = np.random.default_rng(seed)
    power = np.repeat(rng.choice([0.0, 400.0], N // 100), 100)
    lost: FloatArray = np.zeros(N)
    memory = np.exp(-DT / 100.0)
    for k in range(1, N):
        lost[k] = memory * lost[k - 1] + draught * np.sqrt(1 - memory**2) * rng.standard_normal()
    lost[N // 3 :] -= door
    lost += sun * np.sin(0.012 * DT * np.arange(N) + rng.uniform(0, 6))
    rate = 1.0 / (LOSS * HEAT) + leak
    decay, temperatures, now = np.exp(-DT * rate), [], 5.0
    for k in range(N):
        temperatures.append(now)
        now = decay * now + (1 - decay) * (power[k] + lost[k]) / (HEAT * rate)
    system = oven().system()
    y = np.array(temperatures)[:, None] + 0.02 * rng.standard_normal((N, 1))
    return Trajectory(np.arange(N) * DT, power[:, None], y, PlantSpec(system.inputs, system.outputs, DT))


@pytest.mark.parametrize("seed", [1, 3, 5])
@pytest.mark.parametrize("draught", [4.0, 10.0])
def test_a_draught_that_comes_and_goes_is_no_law(seed: int, draught: float) -> None:
    """A slow sine, a bent scale or a gain that drifts follows it: named with confidence before errors had a memory."""
    runs = Run(record(10 * seed, draught=draught)), Run(record(10 * seed + 1, draught=draught), "validation")
    found = diagnose(Dataset("oven", runs), oven().system())
    assert not found.outcome.accepted or found.grade == "proxy_or_incomplete"


def test_what_is_really_missing_is_still_found() -> None:
    """Steps of the heater whose power is 20 W less than it says."""
    runs = Run(record(70, draught=1.0)), Run(record(71, draught=1.0), "validation")
    short = tuple(
        Run(Trajectory(run.trajectory.t, run.trajectory.u + 20.0, run.trajectory.y, run.trajectory.spec), run.use)
        for run in runs
    )
    known = {"C": Parameter("C", "J/K", HEAT, fixed=True), "R": Parameter("R", "K/W", LOSS, fixed=True)}
    found = diagnose(Dataset("oven", short), oven().system().with_parameters(known))
    names = {str(member[0]) for accepted in found.outcome.accepted for member in accepted.tie}
    assert "force_bias@P" in names


@pytest.mark.parametrize("seed", [80, 90])
@pytest.mark.parametrize(
    ("cause", "law"), [({"door": 25.0}, "force_step@T"), ({"sun": 15.0}, "periodic_disturbance@T")]
)
def test_a_flow_that_nobody_measured_has_a_law(seed: int, cause: dict[str, float], law: str) -> None:
    """A flow that ends for good was a gain that drifts, "explained"; a sine was "nothing missing"."""
    runs = Run(record(seed, **cause), "estimation"), Run(record(seed + 1, **cause), "validation")
    found = diagnose(Dataset("oven", runs), oven().system())
    (accepted,) = found.outcome.accepted
    assert law in {str(member[0]) for member in accepted.tie} | {str(accepted.placed)}
    assert found.grade == "explained"
    row = next(row for row in found.outcome.rounds[0].candidates if row.name == law)  # of a tie, that of the flow
    assert row.fit is not None
    (size,) = (abs(row.fit.values[name]) for name in [row.added[0].main()] if name)
    assert size * row.fit.values["C"] == pytest.approx(next(iter(cause.values())), rel=0.05)
