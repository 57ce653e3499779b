"""Designed references keep the limits and condition the parameters better than random ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness import registry
from harness.errors import InputError
from harness.physics.arms.formats.urdf import load_urdf
from scenarios.design import (
    JointLimits,
    condition_number,
    design_reference,
    deviation_of,
    identifiable_columns,
    volume_of,
)

pybullet_data = pytest.importorskip("pybullet_data", reason="comes with pybullet, for CPython 3.10 and 3.11 only")


def two_inertias(q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return the regressor of two pendulums and a column that repeats another."""
    columns = [a[:, 0], np.sin(q[:, 0]), v[:, 0], a[:, 1], np.sin(q[:, 1]), 2 * a[:, 1]]
    return np.column_stack(columns)


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000), rate=st.floats(0.2, 5.0), low=st.floats(-2.0, -0.1), high=st.floats(0.1, 3.0))
def test_limits_are_kept_at_all_times(seed: int, rate: float, low: float, high: float) -> None:
    limits = JointLimits(np.full(2, low), np.full(2, high), np.array([rate, 2 * rate]))
    made = design_reference(two_inertias, limits, steps=60, starts=3, rng=np.random.default_rng(seed))
    q, v, _ = made.reference.at(np.linspace(0, 2 * made.reference.period, 2003))
    assert (q >= limits.low).all()
    assert (q <= limits.high).all()
    assert (np.abs(v) <= limits.rate).all()
    assert made.condition <= made.start


def test_derivatives_belong_to_the_position() -> None:
    limits = JointLimits(-np.ones(2), np.ones(2), np.ones(2))
    made = design_reference(two_inertias, limits, steps=5, starts=2, rng=np.random.default_rng(0)).reference
    t, h = np.linspace(0, 10, 50), 1e-5
    (q, v, a), (ahead, *_), (behind, *_) = made.at(t), made.at(t + h), made.at(t - h)
    np.testing.assert_allclose((ahead - behind) / (2 * h), v, atol=1e-7)
    np.testing.assert_allclose((ahead - 2 * q + behind) / h**2, a, atol=1e-3)


def test_identifiable_columns_and_condition() -> None:
    rng = np.random.default_rng(0)
    W = two_inertias(*rng.standard_normal((3, 50, 2)))
    assert identifiable_columns(W).size == 5
    assert condition_number(W * [1, 1, 1, 1, 1, 5]) > 1e6
    assert condition_number(np.diag([1.0, 100.0]), scaled=False) == pytest.approx(100)


@pytest.mark.slow
def test_iiwa_is_conditioned_well_under_its_limits() -> None:
    arm = load_urdf(Path(pybullet_data.getDataPath()) / "kuka_iiwa/model.urdf")
    limits = JointLimits(
        np.array([joint.lower for joint in arm.moving]),
        np.array([joint.upper for joint in arm.moving]),
        np.full(7, 1.5),
    )
    made = design_reference(arm.regressor, limits, steps=150, starts=10, rng=np.random.default_rng(0))
    W = arm.regressor(*made.reference.at(np.arange(100) * 0.1))
    assert identifiable_columns(W).size == 43
    assert made.condition < min(0.8 * made.start, 25)


def test_bad_limits_are_refused() -> None:
    with pytest.raises(InputError, match="limits of the joints"):
        JointLimits(np.zeros(2), np.array([1.0, np.inf]), np.ones(2))


@pytest.mark.slow
def test_the_iiwa_tracks_its_designed_reference_within_all_limits() -> None:
    """Row 17: condition number <= 25 under limits of position, rate, torque and height; then an ordinary scenario."""
    from harness import registry
    from harness.physics.arms.kinematics import joint_places
    from harness.rng import Streams
    from harness.rollout import run
    from scenarios.arm_models import arm_of
    from scenarios.designed import ArmDesigned

    scenario = ArmDesigned(lowest=0.1, duration=12.0)
    with registry.create("plants", "iiwa-bullet", sample_time=0.008, substeps=8) as plant:
        made = scenario.design(plant.spec, rng=Streams("p", "s", 0)("estimation/0/excitation"))
        record = run(plant, scenario, streams=Streams("p", "s", 0), role="estimation/0")
        spec = plant.spec
    assert made.condition <= 25
    q, u = record.y[:, :7], record.u
    arm = arm_of(None, spec)
    assert (np.abs(u) <= [channel.maximum for channel in spec.inputs]).all()
    assert joint_places(arm, q)[0][:, 1:, 2].min() > 0.09
    late = record.t > 1.5
    wanted = made.reference.at(record.t)[0]
    assert np.abs(q - wanted)[late].max() < 0.05
    assert q[0] == pytest.approx(wanted[0], abs=1e-6)


def test_a_chosen_parameter_is_designed_for() -> None:
    limits = JointLimits(-np.ones(2), np.ones(2), np.ones(2))

    def second(W: np.ndarray) -> float:
        return deviation_of(np.delete(W, 5, axis=1), 1)

    kwargs = {"steps": 200, "starts": 5}
    whole = design_reference(two_inertias, limits, rng=np.random.default_rng(0), **kwargs).reference
    chosen = design_reference(two_inertias, limits, criterion=second, rng=np.random.default_rng(0), **kwargs)
    t = np.arange(100) * 0.1
    assert second(two_inertias(*chosen.reference.at(t))) < second(two_inertias(*whole.at(t)))


def test_limits_that_cannot_be_kept_are_said() -> None:
    limits = JointLimits(-np.ones(2), np.ones(2), np.ones(2))
    with pytest.raises(InputError, match="within the limits"):
        design_reference(
            two_inertias, limits, steps=3, starts=2, violation=lambda q, v, a: 1.0, rng=np.random.default_rng(0)
        )


def test_the_volume_of_one_parameter_is_its_deviation_and_no_unit_reorders() -> None:
    W = np.random.default_rng(0).normal(size=(50, 4))
    assert volume_of(W, [2]) == pytest.approx(deviation_of(W, 2))
    covariance = np.linalg.inv(W.T @ W)[1:3, 1:3]
    assert volume_of(W, [1, 2]) == pytest.approx(np.sqrt(np.linalg.det(covariance)))
    assert volume_of(W * [1.0, 10.0, 0.1, 5.0], [1, 2]) == pytest.approx(volume_of(W, [1, 2]))
    assert volume_of(np.column_stack([W, W[:, 0]]), [0]) == np.inf


def test_a_pair_of_parameters_is_told_apart_by_the_scenario() -> None:
    with registry.create("plants", "iiwa-bullet") as plant:
        spec = plant.spec
    short = {"duration": 10.0, "steps": 150, "starts": 5}
    pair = registry.create("scenarios", "arm-designed", parameters=("damping1", "friction1"), **short)
    found = pair.design(spec, rng=np.random.default_rng(0))
    assert found.condition < 0.9 * found.start
    for name, words in (("spring1", "option parameters"), ("m1", "tell from all others")):
        with pytest.raises(InputError, match=words):
            registry.create("scenarios", "arm-designed", parameters=(name,), **short).design(
                spec, rng=np.random.default_rng(0)
            )
