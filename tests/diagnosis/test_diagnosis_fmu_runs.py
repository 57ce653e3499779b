"""How few runs of an FMU a search takes: what is known of one run is not asked of another."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from fmu_files import redescribed

from harness.blackbox.effects import surround
from harness.blackbox.reader import fmu_system
from harness.blackbox.runner import Runner
from harness.blackbox.simulator import FmuSimulator, Loan
from harness.data import load_dataset
from harness.diagnosis.fmu.form import _convolution
from harness.diagnosis.fmu.passes import FreePass, StateRun
from harness.effects import builtin
from harness.effects.effect import Placed
from harness.errors import InputError
from harness.physics.compiled.kalman_pass import PassNoise
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory
from plants.mockups import mockup

DT, N = 0.02, 400
PENDULUM = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"),), DT)
SPRING = PlantSpec((Channel("u", "N"),), (Channel("q", "m"),), DT)
T: FloatArray = np.asarray(DT * np.arange(N), dtype=np.float64)
U = (0.3 * np.sin(2.1 * T) + 0.2 * np.sin(5.3 * T))[:, None]


def counted(name: str) -> tuple[FmuSimulator, list[int]]:
    """Return a simulator of a mock-up and the list that grows with every run of its FMU."""
    system = fmu_system(mockup(name), PENDULUM)
    runner, steps = Runner(system, DT), []
    add = runner.meter.add

    def seen(count: int, seconds: float) -> None:
        steps.append(count)
        add(count, seconds)

    runner.meter.add = seen  # type: ignore[assignment,method-assign]
    return FmuSimulator(system, runner), steps


def test_an_effect_on_a_sensor_does_not_run_the_fmu_again() -> None:
    simulator, runs = counted("pendulum")
    system, x0 = simulator.system, np.array([0.2, 0.0])
    plain = simulator.run(system.vector(), x0, U)[1]
    assert len(runs) == 1
    for limit in (0.1, 0.15):
        made = surround(system, [Placed(builtin()["sensor_saturation"], "theta", {"limit": limit})])
        clipped = FmuSimulator(made, simulator.runner).run(made.vector(), x0, U)[1]
        assert np.abs(clipped - np.clip(plain, -limit, limit)).max() < 0.02 * limit
    assert len(runs) == 1, "what the sensor tells is made of the same run"
    for width in (0.05, 0.1):
        made = surround(system, [Placed(builtin()["dead_zone"], "u", {"width": width})])
        FmuSimulator(made, simulator.runner).run(made.vector(), x0, U)
    assert len(runs) == 3, "what drives it is another run each"


def test_a_start_that_moves_only_last_digits_of_the_solver_moves_nothing() -> None:
    """An angle of which only the speed is measured: a fit went 2e7 rad along what the solver rounds."""

    class Rounding(FmuSimulator):
        def run(self, p, x0, u, t0=0.0, extra=None):  # type: ignore[no-untyped-def]
            speed = x0[1] + np.cumsum(u, axis=0)
            asked.append(x0.copy())
            return np.repeat(x0[None], len(u), axis=0), speed * (1 + 1e-11 * np.sin(1e4 * x0[0]))

    asked: list[FloatArray] = []
    simulator = Rounding((some := counted("pendulum")[0]).system, some.runner)
    p, x0 = simulator.system.vector(), np.array([[0.2, 0.1]])
    for _ in range(2):
        with simulator.deriving(simulator.state_columns):
            _, _, found = simulator.windows(p[None], x0, U[None], None, T[:1])
        assert found is not None
        assert not found[0][..., simulator.np].any()
        assert found[0][..., simulator.np + 1] == pytest.approx(1.0, abs=1e-6)
        simulator.forget()
    assert len(asked) == 3 + 1, "the run is remembered, and this start not asked for again"


def test_first_steps_borrow_the_derivatives_of_a_run_like_theirs() -> None:
    simulator, runs = counted("pendulum")
    system, x0 = simulator.system, np.array([[0.2, 0.0]])
    p, every = system.vector(), range(system.np + system.nx)

    def slopes(values: FloatArray, lent: list[Loan] | None = None) -> tuple[FloatArray, int]:
        before = len(runs)
        with simulator.deriving(every, lent):
            found = simulator.windows(values[None], x0, U[None], None, T[:1])[2]
        assert found is not None
        return found[0], len(runs) - before

    loans: list[Loan] = []
    own, cost = slopes(p, loans)
    lent, borrowed = slopes(p * 1.02, loans)
    assert borrowed == 1 < cost, "only the run itself"
    assert np.abs(lent - own).max() == 0.0
    simulator.forget()
    exact, again = slopes(p * 1.02)
    assert again >= cost - 1, "what is finished takes its own"
    assert 0.0 < np.abs(exact - lent).max() < 0.2 * np.abs(exact).max()
    assert slopes(p * 2.0, loans)[1] >= cost - 1, "elsewhere nothing is borrowed"


@pytest.mark.parametrize(("name", "spec", "alike"), [("mass_spring", SPRING, True), ("pendulum", PENDULUM, False)])
def test_pushes_are_convolved_with_one_response_where_that_is_what_they_do(
    name: str, spec: PlantSpec, alike: bool
) -> None:
    system = fmu_system(mockup(name), spec)
    passes = FreePass(FmuSimulator(system, Runner(system, DT)))
    record = Trajectory(T, 5 * U, np.zeros((N, system.ny)), spec)
    x0 = np.zeros(system.nx)
    noise = PassNoise(np.ones(system.ny), np.zeros(0), np.zeros(0), np.zeros(0))
    run = passes(record, system.vector(), x0, noise, keep=True)
    assert isinstance(run, StateRun)
    still = run.pushed(np.zeros_like(U))
    found = _convolution(run, still, record.u, 1e-3)
    assert (found is not None) == alike
    if found is not None:
        push = 1e-3 * np.cos(9.0 * T)[:, None]
        told = run.pushed(push) - still
        assert np.abs(found(push[..., None])[..., 0] - told).max() < 0.01 * np.abs(told).max()


def test_variables_without_a_unit_take_that_of_the_data(tmp_path: Path) -> None:
    """Most FMUs written by hand declare none; their numbers are taken as the data's, and that is said."""
    units = r' (displayUnit="[^"]*"|unit="(N m|rad|rad/s)")'
    path = redescribed(tmp_path / "unitless.fmu", lambda text: re.sub(units, "", text))
    system = fmu_system(path, PENDULUM)
    assert [str(one) for one in (*system.inputs, *system.outputs)] == ["u [N m]", "theta [rad]"]
    assert [(one.name, one.force_unit, one.rate) for one in system.coordinates] == [("theta", "N m", "der(theta)")]
    assert system.notes == ("the FMU declares no units of u [N m], theta [rad]: its numbers are taken as the data's",)
    plain = fmu_system(path, PlantSpec((Channel("u", "1"),), (Channel("theta", "1"),), DT))
    assert [one.unit for one in (*plain.inputs, *plain.outputs)] == ["1", "1"]
    assert (plain.coordinates, plain.notes) == ((), ())
    assert fmu_system(mockup("pendulum"), PENDULUM).notes == ()
    data = tmp_path / "log.csv"
    lines = [f"{t:.2f},{u:.6f},{57.3 * y:.6f}" for t, u, y in zip(T, U[:, 0], 0.1 * np.sin(3 * T), strict=True)]
    data.write_text("time [s],u [N m],theta [deg]\n" + "\n".join(lines))
    read = load_dataset(data, model=str(path)).dataset
    assert [str(one) for one in (*read.spec.inputs, *read.spec.outputs)] == ["u [N m]", "theta [rad]"]
    assert np.abs(read.runs[0].trajectory.y).max() == pytest.approx(0.1, rel=0.01)
    with pytest.raises(InputError, match="unit does not fit"):  # what declares one still has to be given it
        load_dataset(data, model=str(mockup("pendulum")), unit={"theta": "m"})


def test_a_rough_fit_takes_one_run_for_each_parameter() -> None:
    found, taken = [], []
    for rough in (False, True):
        simulator, runs = counted("pendulum")
        simulator.one_sided = rough
        p, x0 = simulator.system.vector(), np.array([0.2, 0.0])
        slopes = simulator.windows(p[None], x0[None], U[None], None, np.zeros(1))[2]
        assert slopes is not None
        free = [k for k, parameter in enumerate(simulator.system.parameters) if not parameter.fixed]
        found.append(slopes[0][..., free])
        taken.append(len(runs))
        if rough:
            assert len(runs) == 1 + len(free) + len(x0)
    assert taken[1] < taken[0]
    assert np.abs(found[1] - found[0]).max() < 0.02 * np.abs(found[0]).max()
