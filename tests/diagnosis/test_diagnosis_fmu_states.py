"""States of an FMU as nominal model: those it declares, those only its start values betray, and none at all."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from harness import registry
from harness.blackbox.reader import fmu_system
from harness.diagnosis import diagnose
from harness.diagnosis.fmu.kind import BlackBox
from harness.diagnosis.forms.predictive import whitened
from harness.effects import builtin
from harness.effects.effect import Placed
from harness.export import export
from harness.fmi.build import compiler
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory
from plants.mockups import mockup

DT, N, NOISE = 0.02, 500, 1e-3
TRUE = {"J": 0.06, "b": 0.04, "mgl": 1.1}
SPEC = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"),), DT)

pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler: install gcc")


def recorded(x0: dict[str, float], coulomb: float = 0.0) -> Dataset:
    """Return records of the pendulum mockup, only its angle measured."""
    runs = []
    for seed, use in enumerate(("estimation", "validation")):
        rng = np.random.default_rng(seed)
        t = np.arange(N) * DT
        u = sum(0.2 * np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in (0.13, 0.31, 0.53, 0.92))[:, None]
        options = {"sample_time": DT, "outputs": ["theta"], "parameters": {**TRUE, "Fc": coulomb}}
        with registry.create("plants", "fmu", path=mockup("pendulum"), **options) as plant:
            y = [plant.reset(rng=rng, x0=x0), *(plant.step(one) for one in u[:-1])]
        noisy = np.array(y) + rng.normal(0, NOISE, (N, 1))
        runs.append(Run(Trajectory(t, u, noisy, SPEC), use, use))  # type: ignore[arg-type]
    return Dataset("mockup", tuple(runs), noise={"theta": NOISE})


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return our own pendulum as an FMU: its description names no state."""
    path = tmp_path_factory.mktemp("exported") / "pendulum.fmu"
    export("pendulum", out=path, fmi="2")
    return path


def test_start_values_betray_the_states_of_an_exported_model(exported: Path) -> None:
    system = fmu_system(exported, SPEC)
    assert [one.name for one in system.inner_states] == ["state.theta", "state.theta_rate"]
    assert system.shown == {"theta": "state.theta"}
    (joint,) = system.coordinates
    assert (joint.name, joint.position, joint.rate) == ("theta", "state.theta", "state.theta_rate")


def test_declared_states_are_kept_as_they_are() -> None:
    system = fmu_system(mockup("pendulum"), SPEC)
    assert [one.name for one in system.inner_states] == ["theta", "omega"]
    assert not system.shown


def test_an_exported_model_is_calibrated_from_a_moving_start(exported: Path) -> None:
    data = recorded({"theta": 0.4, "omega": 0.3})
    found = diagnose(data, fmu_system(exported, SPEC), kind=BlackBox(), dictionary=[builtin()["coulomb_friction"]])
    assert found.verdict == "nothing_missing"
    for name, value in TRUE.items():
        assert found.final.values[name] == pytest.approx(value, rel=0.03)
    np.testing.assert_allclose(found.final.detail.points["estimation"].x0[0], [0.4, 0.3], atol=0.02)


def test_an_fmu_without_settable_states_is_diagnosed_from_rest(exported: Path) -> None:
    system = replace(fmu_system(exported, SPEC), inner_states=(), shown={})
    found = diagnose(recorded({}, 0.05), system, kind=BlackBox(), dictionary=[builtin()["coulomb_friction"]])
    assert [str(one.placed) for one in found.outcome.accepted] == ["coulomb_friction@theta"]
    assert found.final.values["coulomb_friction@theta.Fc"] == pytest.approx(0.05, rel=0.2)


def test_a_direction_around_an_fmu_is_what_a_little_of_the_effect_does(exported: Path) -> None:
    """Sign and size: forces that are left over are drawn as what the FMU lacks, not as what it has too much of."""
    data, placed = recorded({}), Placed(builtin()["quadratic_drag"], "theta")
    system = fmu_system(exported, SPEC)
    form = BlackBox().form(system, data)
    fit = form.fit((), [system.values()], None)
    assert fit is not None
    (column,) = form.columns(fit, [placed])
    point, little = fit.detail.points["estimation"], 1e-4
    with_it = form.composed([placed])
    values = with_it.vector({**fit.values, placed.main(): little})
    record, (before,) = data.estimation[0], form.paths(fit, "estimation")[0]
    after = form.passes(with_it, 1)(record, values, point.x0[0], point.noise)
    assert after is not None
    moved = whitened((after.e - before.e)[..., None] / little, before.s[..., None])
    got, expected = column.estimation[:, 0], np.ravel(moved)
    assert got @ expected / np.sqrt((got @ got) * (expected @ expected)) > 0.99
    assert got @ got == pytest.approx(expected @ expected, rel=0.05)
