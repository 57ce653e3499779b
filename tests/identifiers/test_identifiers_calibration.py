"""Joint offsets and link lengths from readings and marker: at the Cramer-Rao bound, with what cannot be told."""

import numpy as np
import pytest

from harness.errors import FitError, InputError
from harness.models.estimate import estimate_of
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.mechanics.calibration import JointCalibration, MarkerModel
from plants.bullet.marked_arm import MarkedArmPlant

pytest.importorskip("pybullet_data")

MARKER = (0.05, 0.0, 0.1)
RNG = np.random.default_rng(0)
HIDDEN = {f"offset{k}": float(v) for k, v in zip(range(1, 8), RNG.normal(scale=0.02, size=7), strict=True)}


@pytest.fixture(scope="module")
def plant():
    return MarkedArmPlant(marker=MARKER, hidden=HIDDEN)


def pairs(plant, rng, *, count=100, noise=1e-3, reading_noise=0.0):
    low, high = (np.array([getattr(c, end) for c in plant.spec.inputs]) for end in ("minimum", "maximum"))
    q = rng.uniform(low, high, size=(count, len(low)))
    p = plant.rollout(q) + noise * rng.normal(size=(count, 3))
    return Trajectory(np.arange(count) * 0.1, q + reading_noise * rng.normal(size=q.shape), p, plant.spec)


def test_exact_pairs_give_the_exact_offsets(plant):
    model = JointCalibration(marker=MARKER).fit([pairs(plant, np.random.default_rng(1), noise=0.0)], rng=RNG)
    for name, true in HIDDEN.items():
        assert model.parameters[name] == pytest.approx(true, abs=1e-10)
    assert estimate_of(model).rank.full


@pytest.mark.parametrize("reading_noise", [0.0, 1e-3])
def test_offsets_reach_the_cramer_rao_bound_and_intervals_cover(plant, reading_noise):
    # Bound: inverse of sum J' S^-1 J at the truth, S the covariance of a pair; over 200 records.
    rng = np.random.default_rng(2)
    identifier = JointCalibration(marker=MARKER, reading_noise=reading_noise)
    true, ratios, held = np.array(list(HIDDEN.values())), [], 0
    for _ in range(200):
        record = pairs(plant, rng, reading_noise=reading_noise)
        estimate = estimate_of(identifier.fit([record], rng=rng))
        _, slope, turned = plant._arm.jacobians(record.u, plant._parameters)
        spread = 1e-6 * np.eye(3) + reading_noise**2 * turned @ turned.transpose(0, 2, 1)
        J = slope[:, :, :7]
        bound = np.sqrt(np.diag(np.linalg.inv(np.sum(J.transpose(0, 2, 1) @ np.linalg.solve(spread, J), axis=0))))
        ratios.append((estimate.values - true) / bound)
        held += sum(low <= value <= high for (low, high), value in zip(estimate.intervals, true, strict=True))
    assert np.sqrt(np.mean(np.square(ratios))) <= 1.2
    assert 0.90 <= held / (200 * 7) <= 0.98


def test_lengths_that_lie_on_one_line_are_told_in_sum_only():
    plant = MarkedArmPlant(marker=MARKER, hidden=HIDDEN | {"length5": 0.1845 + 0.004, "length_marker": 0.1148})
    record = pairs(plant, np.random.default_rng(3), noise=1e-4)
    model = JointCalibration(marker=MARKER, lengths=True).fit([record], rng=RNG)
    estimate = estimate_of(model)
    assert estimate.rank.rank == 12
    assert {"length5", "length6"} <= set(estimate.rank.undetermined)
    assert "length5 and length6 only in proportion" in str(estimate.rank)
    assert model.parameters["length5"] + model.parameters["length6"] == pytest.approx(0.4 + 0.004, abs=2e-4)
    assert model.parameters["length_marker"] == pytest.approx(0.1148, abs=2e-4)
    assert estimate.interval("length5") is None
    low, high = estimate.interval("length_marker")
    assert low < 0.1148 < high


def test_a_marker_on_the_last_axis_says_nothing_of_the_last_offset():
    plant = MarkedArmPlant(marker=(0.0, 0.0, 0.1), hidden=HIDDEN)
    record = pairs(plant, np.random.default_rng(4))
    model = JointCalibration(marker=(0.0, 0.0, 0.1)).fit([record], rng=RNG)
    assert estimate_of(model).rank.undetermined == ("offset7",)
    assert abs(model.parameters["offset7"]) < 1e-12


def test_offsets_of_bullet_are_found_through_bullets_own_kinematics():
    # The marker is seen by Bullet; the encoders are off by what is to be found.
    bullet = pytest.importorskip("pybullet")
    import pybullet_data

    client = bullet.connect(bullet.DIRECT)
    try:
        body = bullet.loadURDF(
            f"{pybullet_data.getDataPath()}/kuka_iiwa/model.urdf", useFixedBase=True, physicsClientId=client
        )
        rng, offsets = np.random.default_rng(5), np.array([0.02, -0.01, 0.015, -0.03, 0.01, 0.02, -0.02])
        q, p = rng.uniform(-1.5, 1.5, size=(60, 7)), []
        for posture in q:
            for joint, angle in enumerate(posture):
                bullet.resetJointState(body, joint, angle, physicsClientId=client)
            state = bullet.getLinkState(body, 6, computeForwardKinematics=True, physicsClientId=client)
            p.append(bullet.multiplyTransforms(state[4], state[5], MARKER, (0, 0, 0, 1))[0])
    finally:
        bullet.disconnect(client)
    spec = MarkedArmPlant(marker=MARKER).spec
    noisy = np.array(p) + 2e-4 * rng.normal(size=(60, 3))
    record = Trajectory(np.arange(60) * 0.1, q - offsets, noisy, spec)
    model = JointCalibration(marker=MARKER).fit([record], rng=rng)
    estimate = estimate_of(model)
    for k, true in enumerate(offsets):
        assert abs(model.parameters[f"offset{k + 1}"] - true) < 4 * estimate.deviation(f"offset{k + 1}")
        assert estimate.deviation(f"offset{k + 1}") < 2e-3


def test_a_model_comes_back_from_its_description_and_has_no_state(plant):
    record = pairs(plant, np.random.default_rng(6))
    model = JointCalibration(marker=MARKER).fit([record], rng=RNG)
    again = MarkerModel.from_dict(model.to_dict())
    x = again.initial_state(record)
    np.testing.assert_array_equal(again.output(x, record.u[3]), model.output(x, record.u[3]))
    assert x.shape == (0,)


def test_wrong_signals_and_options_are_refused(plant):
    record = pairs(plant, np.random.default_rng(7), count=5)
    other = PlantSpec(tuple(Channel(f"a{k}", "rad") for k in range(7)), plant.spec.outputs, 0.1, feedthrough=True)
    with pytest.raises(FitError, match="language"):
        JointCalibration(marker=MARKER).fit([Trajectory(record.t, record.u, record.y, other)], rng=RNG)
    with pytest.raises(FitError, match="too few pairs"):
        JointCalibration(marker=MARKER).fit([record[:2]], rng=RNG)
    with pytest.raises(InputError, match="joint-calibration"):
        JointCalibration(marker=MARKER, fixed=["elbow"]).fit([record], rng=RNG)
