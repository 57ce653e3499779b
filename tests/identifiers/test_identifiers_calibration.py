"""Joint offsets and link lengths from readings and marker: at the Cramer-Rao bound, with what cannot be told."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from harness.errors import FitError, InputError
from harness.models.estimate import estimate_of
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.mechanics.arms.calibration import JointCalibration, MarkerModel
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


def places_by_bullet(urdf, q):
    """Return where Bullet's own kinematics has the marker (N, 3) at postures (N, 7)."""
    import pybullet as bullet

    client, places = bullet.connect(bullet.DIRECT), []
    try:
        body = bullet.loadURDF(urdf, useFixedBase=True, physicsClientId=client)
        for posture in q:
            for joint, angle in enumerate(posture):
                bullet.resetJointState(body, joint, angle, physicsClientId=client)
            state = bullet.getLinkState(body, 6, computeForwardKinematics=True, physicsClientId=client)
            places.append(bullet.multiplyTransforms(state[4], state[5], MARKER, (0, 0, 0, 1))[0])
    finally:
        bullet.disconnect(client)
    return np.array(places)


def test_exact_pairs_give_the_exact_offsets(plant):
    model = JointCalibration(marker=MARKER).fit([pairs(plant, np.random.default_rng(1), noise=0.0)], rng=RNG)
    for name, true in HIDDEN.items():
        assert model.parameters[name] == pytest.approx(true, abs=1e-10)
    assert estimate_of(model).rank.full


@pytest.mark.parametrize("reading_noise", [pytest.param(0.0, marks=pytest.mark.slow), 1e-3])
def test_offsets_reach_the_cramer_rao_bound_and_intervals_cover(plant, reading_noise):
    # Bound: inverse of sum J' S^-1 J at the truth, S the covariance of a pair; over 40 records.
    rng = np.random.default_rng(2)
    identifier = JointCalibration(marker=MARKER, reading_noise=reading_noise)
    true, ratios, held = np.array(list(HIDDEN.values())), [], 0
    for _ in range(40):
        record = pairs(plant, rng, reading_noise=reading_noise)
        estimate = estimate_of(identifier.fit([record], rng=rng))
        _, slope, turned = plant._arm.jacobians(record.u, plant._parameters)
        spread = 1e-6 * np.eye(3) + reading_noise**2 * turned @ turned.transpose(0, 2, 1)
        J = slope[:, :, :7]
        bound = np.sqrt(np.diag(np.linalg.inv(np.sum(J.transpose(0, 2, 1) @ np.linalg.solve(spread, J), axis=0))))
        ratios.append((estimate.values - true) / bound)
        held += sum(low <= value <= high for (low, high), value in zip(estimate.intervals, true, strict=True))
    assert np.sqrt(np.mean(np.square(ratios))) <= 1.2
    assert 0.90 <= held / (40 * 7) <= 0.99


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
    pytest.importorskip("pybullet")
    import pybullet_data

    rng, offsets = np.random.default_rng(5), np.array([0.02, -0.01, 0.015, -0.03, 0.01, 0.02, -0.02])
    q = rng.uniform(-1.5, 1.5, size=(60, 7))
    p = places_by_bullet(f"{pybullet_data.getDataPath()}/kuka_iiwa/model.urdf", q)
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


CAMERA = {"camera_x": 1.2, "camera_y": -0.4, "camera_z": 0.8, "camera_rx": 0.3, "camera_ry": -1.4, "camera_rz": 2.1}


def test_a_camera_that_stands_anywhere_and_a_marker_stuck_on_by_hand_are_found():
    seen = {"marker_x": 0.06, "marker_y": 0.01, "marker_z": 0.09}
    plant = MarkedArmPlant(marker=MARKER, hidden=HIDDEN | CAMERA | seen)
    record, fresh = (pairs(plant, np.random.default_rng(seed), noise=2e-4) for seed in (8, 9))
    model = JointCalibration(marker=MARKER, camera=True, free_marker=True).fit([record], rng=RNG)
    estimate = estimate_of(model)
    assert estimate.rank.rank == 14  # 7 offsets, marker, camera; the first joint and the camera turn alike, the last
    np.testing.assert_allclose(model.output(np.zeros((100, 0)), fresh.u), fresh.y, atol=1.5e-3)
    for name in ("offset2", "offset3", "offset4", "offset5", "offset6", "marker_z", "camera_x"):
        interval = estimate.interval(name)
        if interval is not None:
            true = (HIDDEN | CAMERA | seen)[name]
            assert interval[0] - 2e-4 < true < interval[1] + 2e-4, name
    assert estimate.interval("offset3") is not None
    assert estimate.interval("offset1") is None


def test_every_axis_of_an_arm_is_told_as_far_as_a_point_can_tell():
    """Four numbers an axis and three of the point (Mooring, Roth & Driels 1991): 31 of 45 for seven joints."""
    rng = np.random.default_rng(10)
    off = {f"{word}{k}_{way}": float(rng.normal(scale=2e-3)) for word in ("tilt", "shift") for k in range(1, 8)
           for way in "ab"}  # fmt: skip
    plant = MarkedArmPlant(marker=MARKER, hidden=HIDDEN | off)
    record, fresh = pairs(plant, rng, count=120, noise=1e-4), pairs(plant, rng, noise=0.0)
    bare = JointCalibration(marker=MARKER).fit([record], rng=RNG)
    model = JointCalibration(marker=MARKER, axes=True, free_marker=True).fit([record], rng=RNG)
    assert estimate_of(model).rank.rank == 31
    error, before = (
        np.sqrt(np.mean((one.output(np.zeros((100, 0)), fresh.u) - fresh.y) ** 2)) for one in (model, bare)
    )
    assert error < 1.5e-4
    assert before > 1e-3


def test_axes_that_bullet_turned_are_found_through_bullets_own_kinematics(tmp_path):
    """The arm that is measured is another file: its fourth axis is tilted by 5 mrad and lies 2 mm off."""
    pytest.importorskip("pybullet")
    import pybullet_data

    source = Path(pybullet_data.getDataPath()) / "kuka_iiwa" / "model.urdf"
    tree = ElementTree.parse(source)
    (origin,) = (j.find("origin") for j in tree.iter("joint") if j.get("name") == "lbr_iiwa_joint_4")
    assert origin is not None
    places, turns = ([float(x) for x in origin.get(key, "").split()] for key in ("xyz", "rpy"))
    origin.set("xyz", f"{places[0] + 0.002} {places[1]} {places[2]}")
    origin.set("rpy", f"{turns[0]} {turns[1] + 0.005} {turns[2]}")
    for mesh in [(link, part) for link in tree.iter("link") for part in link if part.tag in ("visual", "collision")]:
        mesh[0].remove(mesh[1])
    tree.write(tmp_path / "bent.urdf")
    rng = np.random.default_rng(11)
    q = rng.uniform(-1.6, 1.6, size=(160, 7))
    p = places_by_bullet(str(tmp_path / "bent.urdf"), q)
    spec = MarkedArmPlant(marker=MARKER).spec
    record = Trajectory(np.arange(100) * 0.1, q[:100], np.array(p[:100]) + 1e-4 * rng.normal(size=(100, 3)), spec)
    model = JointCalibration(marker=MARKER, axes=True).fit([record], rng=rng)
    left = np.array(p[100:]) - model.output(np.zeros((60, 0)), q[100:])
    bare = np.array(p[100:]) - MarkedArmPlant(marker=MARKER).rollout(q[100:])
    assert np.sqrt(np.mean(left**2)) < 1.5e-4
    assert np.sqrt(np.mean(bare**2)) > 1e-3


def test_postures_that_are_chosen_tell_more_than_random_ones_and_as_much_as_they_promise():
    from harness import api

    rng = np.random.default_rng(12)
    found = api.analyse("calibration-poses", "iiwa", options={"postures": 15, "marker": MARKER, "above": 0.2})
    assert len(found.rows) == 15
    assert all(row["marker z [m]"] >= 0.2 for row in found.rows)
    details = found.details
    assert np.all(details["deviations"] <= 1.05 * details["random"])
    plant = MarkedArmPlant(marker=MARKER, hidden=HIDDEN)
    q, errors = np.array(details["postures"]), []
    for _ in range(60):
        p = plant.rollout(q) + 1e-3 * rng.normal(size=(15, 3))
        model = JointCalibration(marker=MARKER).fit([Trajectory(np.arange(15) * 0.1, q, p, plant.spec)], rng=rng)
        errors.append([model.parameters[name] - HIDDEN[name] for name in HIDDEN])
    spread = np.sqrt(np.mean(np.square(errors), axis=0))
    np.testing.assert_allclose(spread, details["deviations"], rtol=0.35)


@pytest.mark.parametrize("criterion", ["D", "A", "E"])
def test_each_criterion_betters_what_it_is_about(criterion):
    from harness import api

    found = api.analyse("calibration-poses", "iiwa", options={"postures": 10, "among": 100, "criterion": criterion})
    assert any("observability index O1" in text for text in found.words)
    assert found.plot().axes[0].get_xlabel() == "standard deviation [mrad or mm]"
    if criterion == "A":
        assert np.sum(found.details["deviations"] ** 2) < np.sum(found.details["random"] ** 2)


def test_too_few_postures_for_what_is_asked_are_refused():
    from harness import api

    with pytest.raises(InputError, match=r"at least 11: 31 directions can be told"):
        api.analyse("calibration-poses", "iiwa", options={"postures": 8, "axes": True, "free_marker": True})
    with pytest.raises(InputError, match="an arm read from a URDF"):
        api.analyse("calibration-poses", "pendulum")
    with pytest.raises(InputError, match="height that the marker keeps"):
        api.analyse("calibration-poses", "iiwa", options={"above": 5.0})


def test_a_record_that_the_plant_wrote_is_calibrated_as_it_is(tmp_path):
    from harness import api

    api.simulate("marked-arm", scenario="steps", options={"hidden": {"offset4": 0.01}}, out=tmp_path / "pairs.csv",
                 scenario_options={"duration": 10.0, "amplitude": 1.2, "dwell": 0.1, "noise": 5e-4})  # fmt: skip
    found = api.identify(tmp_path / "pairs.csv", identifier="joint-calibration")
    low, high = found.estimate.interval("offset4")
    assert low < 0.01 < high
    assert sorted(found.model.parameters) == [f"offset{k}" for k in range(1, 8)]


def hand_eye(eye, pose, rng, *, count=30, noise=5e-4, turn_noise=2e-3, spans=(0.4, 0.4, 0.4, 1.0, 0.6, 0.6)):
    """Return a record of a hand and a camera, made without the project's kinematics, and the two poses behind it."""
    q = rng.uniform(-1, 1, size=(count, 6)) * spans
    hand = Rotation.from_euler("ZYX", q[:, 3:])
    carried, standing = Rotation.random(random_state=rng), Rotation.random(random_state=rng)
    at, there = rng.normal(scale=0.2, size=3), rng.normal(size=3)
    end, turn = q[:, :3] + hand.apply(at), hand * carried  # of marker or camera, in the frame of the base
    if eye == "room":  # the base stands in the frame of the camera
        p, seen = there + standing.apply(end), standing * turn
    else:  # the target stands in the frame of the base
        p, seen = turn.inv().apply(there - end), turn.inv() * standing
    p = p + noise * rng.normal(size=p.shape)
    axes = (Rotation.from_rotvec(turn_noise * rng.normal(size=(count, 3))) * seen).as_matrix()
    y = np.hstack([p, axes[:, :, 0], axes[:, :, 1]]) if pose else p
    words = ("marker", "camera") if eye == "room" else ("camera", "target")
    poses = [np.hstack([at, carried.as_rotvec()]), np.hstack([there, standing.as_rotvec()])]
    names = [f"{word}_{turn}{axis}" for word in words for turn in ("", "r") for axis in "xyz"]
    true = dict(zip(names, np.concatenate(poses).tolist(), strict=True))
    spec = MarkedArmPlant(model="hand", eye=eye, pose=pose).spec
    return Trajectory(np.arange(count) * 0.1, q, y, spec), true


CASES = [("room", True), *(pytest.param(*case, marks=pytest.mark.slow) for case in (("hand", True), ("room", False))),
         ("hand", False)]  # fmt: skip


@pytest.mark.parametrize(("eye", "pose"), CASES)
def test_hand_and_eye_are_found_wherever_they_are_and_their_intervals_cover(eye, pose):
    held, scatter = [], []
    for seed in range(15):
        record, true = hand_eye(eye, pose, np.random.default_rng(seed))
        model = JointCalibration(model="hand", eye=eye, pose=pose).fit([record], rng=RNG)
        estimate = estimate_of(model)
        assert estimate.rank.full
        for name, (low, high) in zip(estimate.names, estimate.intervals, strict=True):
            held.append(low <= true[name] <= high)
            scatter.append((estimate.value(name) - true[name]) / estimate.deviation(name))
    assert 0.88 <= np.mean(held) <= 0.99
    assert 0.8 <= np.sqrt(np.mean(np.square(scatter))) <= 1.25
    again = MarkerModel.from_dict(model.to_dict())
    x = again.initial_state(record)
    np.testing.assert_array_equal(again.output(x, record.u[3]), model.output(x, record.u[3]))
    assert np.std(model.output(np.zeros((len(record), 0)), record.u) - record.y) < 3e-3


@pytest.mark.parametrize(
    ("spans", "rank", "open_axes"),
    [((0.4, 0.4, 0.4, 1.0, 0, 0), 11, "z"), ((0.4, 0.4, 0.4, 0, 0, 0), 9, "xyz")],
)
def test_turns_about_one_axis_leave_the_place_along_it_open(spans, rank, open_axes):
    record, _ = hand_eye("hand", True, np.random.default_rng(0), spans=spans)
    estimate = estimate_of(JointCalibration(model="hand", eye="hand", pose=True).fit([record], rng=RNG))
    assert estimate.rank.rank == rank
    assert set(estimate.rank.undetermined) == {f"{word}_{axis}" for word in ("camera", "target") for axis in open_axes}


def test_poses_tell_four_numbers_an_axis_and_six_at_each_end_and_the_urdf_that_comes_out_says_the_same(tmp_path):
    """4 n + 6 (Mooring, Roth & Driels 1991), here for seven joints; and the file is that arm."""
    from harness.physics.arms.marked_arm import marked_arm

    rng = np.random.default_rng(13)
    off = {f"{word}{k}_{way}": float(rng.normal(scale=2e-3)) for word in ("tilt", "shift") for k in range(1, 8)
           for way in "ab"}  # fmt: skip
    plant = MarkedArmPlant(marker=MARKER, hidden=HIDDEN | off, pose=True)
    low, high = (np.array([getattr(c, end) for c in plant.spec.inputs]) for end in ("minimum", "maximum"))
    q = rng.uniform(low, high, size=(60, 7))
    record = Trajectory(np.arange(40) * 0.1, q[:40], plant.rollout(q[:40]), plant.spec)
    model = JointCalibration(marker=MARKER, axes=True, pose=True).fit([record], rng=rng)
    assert estimate_of(model).rank.rank == 34
    np.testing.assert_allclose(model.output(np.zeros((60, 0)), q), plant.rollout(q), atol=1e-8)
    (tmp_path / "found.urdf").write_text(model.to_urdf())
    arm = marked_arm(str(tmp_path / "found.urdf"), MARKER, pose=True)
    ends = {name: value for name, value in model.parameters.items() if name.startswith(("marker", "camera"))}
    np.testing.assert_allclose(arm.places(q, arm.vector(ends)), plant.rollout(q), atol=1e-8)
    hand = JointCalibration(model="hand", pose=True).fit([hand_eye("room", True, rng)[0]], rng=rng)
    with pytest.raises(InputError, match="read from a URDF"):
        hand.to_urdf()


def test_a_camera_that_sees_orientations_needs_fewer_postures_and_wrong_wishes_are_refused():
    from harness import api

    with pytest.raises(InputError, match=r"at least 6: 34 directions can be told, 6 numbers"):
        api.analyse("calibration-poses", "iiwa", options={"postures": 5, "axes": True, "pose": True})
    found = api.analyse("calibration-poses", "iiwa", options={"postures": 8, "axes": True, "pose": True})
    assert np.all(found.details["deviations"] <= 1.5 * found.details["random"])
    record, _ = hand_eye("room", True, np.random.default_rng(0))
    with pytest.raises(InputError, match="neither lengths nor axes"):
        JointCalibration(model="hand", pose=True, axes=True).fit([record], rng=RNG)
    with pytest.raises(InputError, match="room or hand"):
        JointCalibration(model="hand", eye="foot").fit([record], rng=RNG)
