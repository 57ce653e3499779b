"""The pass of the Kalman filter without a compiler is the compiled one."""

from __future__ import annotations

import numpy as np
import pytest

from harness.effects import builtin
from harness.effects.compose import compose
from harness.effects.effect import Placed
from harness.fmi.build import compiler
from harness.physics import load_model
from harness.physics.compiled.kalman_pass import KalmanPass, PassNoise
from harness.physics.compiled.latent import with_latent_forces
from harness.signals import PlantSpec, Trajectory

needs_compiler = pytest.mark.skipif(compiler() is None, reason="no C compiler: install gcc")
DT = 0.01


def record(model: str, intersample: str, holes: bool) -> tuple[object, Trajectory, np.ndarray, np.ndarray]:
    name, _, effect = model.partition("+")
    system = load_model(name)
    if effect:
        system = compose(system, [Placed(builtin()[effect], "theta")])
    rng = np.random.default_rng(1)
    u = 0.3 * rng.normal(size=(40, system.nu))
    x0 = np.zeros(system.nx)
    x0[0] = 0.2
    p = np.array([parameter.value for parameter in system.parameters])
    y = system.simulator(DT, intersample=intersample, backend="casadi").rollout(p, x0, u)
    y = y + 1e-3 * rng.normal(size=y.shape)
    spec = PlantSpec(system.inputs, system.outputs, DT)
    missing = np.zeros(y.shape, dtype=bool)
    missing[5:20:3] = holes  # readings that are not there, as decimated sensors have
    made = Trajectory(DT * np.arange(40, dtype=np.float64), u, y, spec, missing=missing)
    return system, made, p, x0


@needs_compiler
@pytest.mark.parametrize(
    ("model", "intersample", "holes"),
    [
        ("pendulum", "zoh", True),
        ("two-tanks", "smooth", False),
        ("drive", "foh", True),
        ("pendulum+coulomb_friction", "zoh", False),
        ("pendulum+coulomb_friction", "smooth", True),
    ],
)
@pytest.mark.parametrize("force", [1.0, 0.0])  # without one a run is free, and its covariance is left out
def test_both_ways_are_the_same_to_rounding(model: str, intersample: str, holes: bool, force: float) -> None:
    system, data, p, x0 = record(model, intersample, holes)
    disturbed = with_latent_forces(system)  # type: ignore[arg-type]
    found = []
    for compiled in (True, False):
        run = KalmanPass(disturbed, DT, intersample=intersample, compiled=compiled)  # type: ignore[arg-type]
        noise = PassNoise(
            np.full(run.ny, 0.01), np.full(run.nl, 0.2 * force), np.full(run.nl, 0.3), np.full(run.nl, 0.05 * force)
        )
        columns = np.arange(run.parameter_count + run.start_size)
        passed = run(data, p, x0, noise, columns=columns, keep=True, by_noise=True)
        assert passed is not None
        lean = run(data, p, x0, noise)
        assert lean is not None
        assert lean.nll == pytest.approx(passed.nll, rel=1e-12)
        found.append(passed)
    one, two = found
    for name in ("e", "s", "j", "e_noise", "s_noise"):
        theirs, ours = getattr(one, name), getattr(two, name)
        assert np.array_equal(np.isnan(theirs), np.isnan(ours)), name
        assert np.allclose(ours, theirs, rtol=1e-9, atol=1e-9 * np.nanmax(np.abs(theirs)), equal_nan=True), name
    for name in ("x_before", "p_before", "x_after", "p_after", "transition", "gain", "row"):
        assert np.allclose(getattr(two.path, name), getattr(one.path, name), rtol=1e-9, atol=1e-11), name


def test_a_state_that_diverges_is_no_pass() -> None:
    system, data, p, _ = record("pendulum", "zoh", False)
    run = KalmanPass(with_latent_forces(system), DT, compiled=False)  # type: ignore[arg-type]
    noise = PassNoise(np.full(run.ny, 0.01), np.full(run.nl, 0.2), np.full(run.nl, 0.3), np.zeros(run.nl))
    assert run(data, p * [1e-30, 1.0, 1.0], np.array([0.2, 0.0]), noise) is None
