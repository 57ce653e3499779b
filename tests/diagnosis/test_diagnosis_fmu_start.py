"""Before the loop around an FMU: where its fit starts, at which rate, step and tolerance it runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from harness import registry
from harness.blackbox.accuracy import settled
from harness.blackbox.reader import fmu_system
from harness.blackbox.runner import Runner
from harness.blackbox.simulator import FmuSimulator
from harness.blackbox.system import FmuSystem
from harness.diagnosis.fmu.kind import BlackBox
from harness.diagnosis.fmu.prepare import FmuWindows, measured_states, nominal_fmu, rough_values
from harness.signals import Dataset, FloatArray, PlantSpec, Run, Trajectory
from plants.mockups import mockup

TRUE = {"J": 0.06, "b": 0.04, "mgl": 1.1}


def records(dt: float, n: int, noise: float = 1e-3, **parameters: float) -> Dataset:
    """Return records of the pendulum FMU, its angle measured."""
    runs = []
    for seed, use in enumerate(("estimation", "validation")):
        rng = np.random.default_rng(seed)
        t = np.arange(n) * dt
        u = sum(0.25 * np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in (0.13, 0.31, 0.53, 0.92))[:, None]
        given = {**TRUE, **parameters}
        with registry.create("plants", "fmu", path=mockup("pendulum"), sample_time=dt, outputs=["theta"],
                             parameters=given) as plant:  # fmt: skip
            y = np.vstack([plant.reset(rng=rng, x0={"theta": 0.4}), plant.rollout(u[:-1])])
            spec = PlantSpec(plant.spec.inputs, plant.spec.outputs, dt)
        runs.append(Run(Trajectory(t, u, y + rng.normal(0, noise, y.shape), spec), use))  # type: ignore[arg-type]
    return Dataset("pendulum", tuple(runs), noise={"theta": noise})


@pytest.fixture(scope="module")
def slow() -> Dataset:
    """Return ten seconds at 100 Hz."""
    return records(0.01, 1000)


@pytest.mark.parametrize("off", [5.0, 0.2, 20.0])
def test_the_fit_starts_near_the_truth_from_an_inertia_far_off(slow: Dataset, off: float) -> None:
    system = nominal_fmu(mockup("pendulum"), slow, {"J": 0.05 * off, "b": 0.02, "mgl": 1.0})
    found = rough_values(system, slow, Runner(system, 0.01))
    assert found is not None
    assert {name: found[name] for name in TRUE} == pytest.approx(TRUE, rel=0.03)


def test_windows_are_differentiated_where_a_step_needs_it_and_nowhere_else(slow: Dataset) -> None:
    system = nominal_fmu(mockup("pendulum"), slow, TRUE)
    simulator = FmuSimulator(system, Runner(system, 0.01))
    windows = FmuWindows(simulator, [slow.estimation[0]], 2.0, np.array([1e-3]))  # type: ignore[arg-type]
    p = system.vector()
    x0 = windows.starts_from([measured_states(system, simulator, slow.estimation[0], p)[0]])
    plain, whole = windows.evaluate(p, x0), windows.trial(p, x0)
    assert plain.cost == whole.cost
    assert not plain.gram.any()
    k, h = system.parameter_names.index("mgl"), 1e-5
    moved = p.copy()
    moved[k] += h
    slope = (windows.evaluate(moved, x0).cost - plain.cost) / h
    assert whole.gradient[:, k].sum() == pytest.approx(-slope, rel=0.02)
    pruned = windows.trial(p, x0, budget=0.5 * plain.cost)
    assert np.isinf(pruned.cost)
    assert not pruned.gram.any()


class _Solver:
    """A stand-in for a simulator whose error grows with the square of the step and with the tolerance."""

    error = 0.0

    def __init__(self, system: FmuSystem, runner: Runner) -> None:
        self.step, self.tolerance = system.step or 0.01, system.tolerance or 1e-4

    def run(self, p: object, x0: object, u: FloatArray, t0: float) -> tuple[None, FloatArray]:
        off = self.error * (self.step / 0.01) ** 2 + 10 * self.tolerance
        return None, np.full((len(u), 1), off)


@pytest.mark.parametrize(
    ("error", "noise", "step", "tolerance"),
    [(0.0, 1.0, None, None), (0.0, 1e-3, None, 1e-6), (1e-2, 1e-3, 0.00125, 1e-10), (1.0, 1e-9, 0.01 / 16, 1e-12)],
    ids=["its own", "tolerance", "step", "never"],
)
def test_an_fmu_is_run_as_finely_as_the_noise_asks(
    slow: Dataset, monkeypatch: pytest.MonkeyPatch, error: float, noise: float, step: float, tolerance: float
) -> None:
    monkeypatch.setattr("harness.blackbox.accuracy.FmuSimulator", _Solver)
    monkeypatch.setattr(_Solver, "error", error)
    system = fmu_system(mockup("pendulum"), slow.spec)
    found = settled(system, slow.estimation[0], np.array([noise]), np.zeros(2), None)
    assert found.step == step
    assert found.tolerance == pytest.approx(tolerance)
    assert bool(found.notes) == (found is not system)
    assert not found.notes or ("solver is part of" in found.notes[-1]) == (noise == 1e-9)


def test_settings_reach_the_plant_and_the_fingerprint(slow: Dataset) -> None:
    system = fmu_system(mockup("pendulum"), slow.spec)
    made = replace(system, step=0.003, tolerance=1e-6, notes=("odd",))
    plant = Runner(made, 0.01).plant
    assert (plant.substeps, plant.tolerance) == (4, 1e-6)
    assert made.fingerprint != system.fingerprint
    assert BlackBox().prepared(slow, made)[0].warnings[-1] == "odd"
