"""An MJCF as nominal model: the arm that MuJoCo itself computes; what it cannot hold is said; written back."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from harness import registry
from harness.errors import InputError
from harness.export import export
from harness.export.robot import repaired_mjcf
from harness.physics.arms.arm import ArmModel, load_arm
from harness.physics.arms.mechanism import arm_mechanism
from harness.physics.arms.mjcf_write import mjcf_with
from harness.physics.arms.urdf_shapes import bounding_boxes
from harness.rng import Streams
from harness.rollout import run
from harness.signals import Channel, FloatArray, PlantSpec
from identifiers.mechanics.arms.arm_model import ArmDynamics

mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install 'sysid-harness[mujoco]'")

ONE = """<mujoco model="one"><worldbody><body name="rod"><joint name="hinge" axis="0 1 0" damping="0.1"
frictionloss="0.3" armature="0.02"/><inertial pos="0.1 0 -0.4" mass="2" diaginertia="0.05 0.05 0.01"/></body>
</worldbody></mujoco>"""
# angles in degrees, defaults, a mounted base, an anchor off the frame, a reference, two joints of one body
TWO = """<mujoco model="two"><compiler autolimits="true"/><default><joint damping="0.2" armature="0.03"/></default>
<worldbody><body name="base" pos="0 0 1" euler="20 10 5"><geom size=".1"/><body name="carriage" pos=".1 .2 .3"
euler="10 20 30"><joint name="swing" pos=".1 .05 -.2" axis="1 2 3" ref="30" range="-90 90"/><joint name="slide"
type="slide" axis="0 1 1" ref=".2"/><geom type="box" size=".1 .2 .3" pos=".1 .1 .1" euler="0 30 0"/>
<body name="tool" pos=".3 0 0"><inertial pos=".1 .2 .3" mass="2" fullinertia="1 1.2 1.3 .1 .2 .3"/></body></body></body>
</worldbody><actuator><motor name="drive" joint="swing" gear="50" armature="1e-4" damping="1e-3"/>
<motor joint="slide"/></actuator></mujoco>"""


def seven() -> str:
    """Return a chain of seven joints drawn at random."""
    rng, text, end = np.random.default_rng(7), "", ""
    for k in range(7):
        numbers = [" ".join(f"{x:.4f}" for x in rng.normal(size=3) * size) for size in (0.3, 1.0, 0.05, 1.0, 0.2)]
        L = np.tril(rng.normal(size=(3, 3))) * 0.2
        second = L @ L.T
        tensor = np.trace(second) * np.eye(3) - second
        full = " ".join(f"{tensor[i, j]:.8f}" for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
        text += f"""<body name="b{k}" pos="{numbers[0]}" euler="{numbers[1]}"><joint name="j{k}" pos="{numbers[2]}"
axis="{numbers[3]}" damping="{0.1 * k}" armature="{0.01 * k}"/>
<inertial pos="{numbers[4]}" mass="{3.0 - 0.3 * k}" fullinertia="{full}"/>"""
        end += "</body>"
    return f'<mujoco model="seven"><compiler angle="radian"/><worldbody>{text}{end}</worldbody></mujoco>'


def written(folder: Path, text: str, name: str = "arm.xml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def inverse(path: Path, q: FloatArray, v: FloatArray, a: FloatArray) -> FloatArray:
    """Return the joint forces (N, n) of MuJoCo's own inverse dynamics, damping included and dry friction not."""
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    data = mujoco.MjData(model)
    found = []
    for data.qpos[:], data.qvel[:], data.qacc[:] in zip(q, v, a, strict=True):
        mujoco.mj_inverse(model, data)
        found.append(data.qfrc_inverse.copy())
    return np.array(found)


@pytest.mark.parametrize("text", [ONE, TWO, seven()], ids=["1 joint", "2 joints", "7 joints"])
def test_torque_and_regressor_agree_with_mujocos_inverse_dynamics(tmp_path: Path, text: str) -> None:
    path = written(tmp_path, text)
    arm = load_arm(path)
    q, v, a = np.random.default_rng(0).normal(size=(3, 100, arm.n)) * 2
    wanted = inverse(path, q, v, a)
    drag = arm.damping * v
    assert np.abs(arm.torques(q, v, a) + drag - wanted).max() < 1e-10 * max(np.abs(wanted).max(), 1.0)
    linear = (arm.arm.regressor(q, v, a) @ arm.arm.parameters).reshape(q.shape) + arm.motor_inertia * a + drag
    assert np.abs(linear - wanted).max() < 1e-10 * max(np.abs(wanted).max(), 1.0)


def test_what_acts_at_the_joints_is_read(tmp_path: Path) -> None:
    arm = load_arm(written(tmp_path, TWO))
    assert [joint.name for joint in arm.arm.moving] == ["swing", "slide"]
    assert [str(channel) for channel in arm.inputs] == ["tau1 [N m]", "tau2 [N]"]
    assert np.allclose(arm.damping, [0.2 + 50**2 * 1e-3, 0.2])
    assert np.allclose(arm.motor_inertia, [0.03 + 50**2 * 1e-4, 0.03])
    assert arm.arm.moving[0].upper == pytest.approx(np.pi / 2)
    assert not arm.idle
    assert any("gears" in note and "50 at swing" in note for note in arm.notes)
    assert any("shapes: base, carriage" in note for note in arm.notes)
    assert load_arm(written(tmp_path, ONE)).friction.tolist() == [0.3]


def test_a_locked_joint_stands_at_its_reference(tmp_path: Path) -> None:
    path = written(tmp_path, TWO)
    q, v, a = np.random.default_rng(0).normal(size=(3, 20, 1))
    reference = np.hstack([np.full((20, 1), np.radians(30)), q])
    none = np.zeros((20, 1))
    wanted = inverse(path, reference, np.hstack([none, v]), np.hstack([none, a]))[:, 1:]
    locked = load_arm(path, locked=["swing"])
    assert np.abs(locked.torques(q, v, a) + locked.damping * v - wanted).max() < 1e-10 * np.abs(wanted).max()


def test_joints_without_an_actuator_are_passive_and_rotors_are_parameters(tmp_path: Path) -> None:
    text = TWO.replace('<motor joint="slide"/>', "")
    arm = arm_mechanism(str(written(tmp_path, text)))
    assert [str(symbol) for symbol in arm.u] == ["tau1"]
    system = arm.system()
    assert {name: value for name, value in system.values().items() if name.startswith("motor")} == {
        "motor_inertia1": 0.28,
        "motor_inertia2": 0.03,
    }


@pytest.mark.parametrize(
    ("inside", "options", "words"),
    [
        ("<body><freejoint name='root'/><geom size='.1'/></body>", {}, "joint root: .* a free joint; .*weld the base"),
        ("<body><joint name='wrist' type='ball'/><geom size='.1'/></body>", {}, "joint wrist: .* a ball joint"),
        (
            "</worldbody><equality><joint joint1='hinge' polycoef='1'/></equality><worldbody>",
            {},
            r"locked = \['hinge'\]",
        ),
        ("</worldbody><equality><weld name='glue' body1='rod'/></equality><worldbody>", {}, "weld glue"),
        ("</worldbody><option gravity='0 0 -1.6'/><worldbody>", {}, r"gravity: expected 0 0 -9\.81 .* got 0 0 -1\.6"),
        ("", {"locked": ["elbow"]}, "locked joint: expected one of hinge"),
        ("", {"locked": ["hinge"]}, "a joint that moves"),
        ("<body><joint/></body>", {}, "mass and inertia of moving bodies"),
    ],
)
def test_what_is_no_arm_is_refused_by_name(
    tmp_path: Path, inside: str, options: dict[str, list[str]], words: str
) -> None:
    path = written(tmp_path, ONE.replace("</worldbody>", f"{inside}</worldbody>"))
    with pytest.raises(InputError, match=words) as caught:
        load_arm(path, **options)  # type: ignore[arg-type]
    assert len(str(caught.value).splitlines()) == 1


def test_what_an_arm_leaves_out_is_said_by_name(tmp_path: Path) -> None:
    text = ONE.replace('damping="0.1"', 'damping="0.1 0.2" stiffness="3"').replace(
        "</worldbody>",
        '<site name="wall"/></worldbody><option density="1.2"/><tendon><spatial name="cable" stiffness="9"><site '
        'site="wall"/><site site="end"/></spatial></tendon><actuator><motor name="winch" tendon="cable"/></actuator>',
    )
    text = text.replace("<inertial", '<site name="end" pos="0 0 -.4"/><inertial').replace(
        '<body name="rod">', '<body name="rod" gravcomp="1">'
    )
    notes = " | ".join(load_arm(written(tmp_path, text)).notes)
    for words in ("springs at joints", "not linear", "cable", "gravity of bodies", "a medium", "winch"):
        assert words in notes


def simulated(arm: ArmModel) -> tuple[FloatArray, ...]:
    """Return what an arm says about a motion, and what acts at its joints."""
    q, v, a = np.random.default_rng(3).normal(size=(3, 40, arm.n))
    return arm.torques(q, v, a), arm.damping, arm.friction, arm.motor_inertia


@pytest.mark.parametrize("text", [ONE, TWO, seven()], ids=["1 joint", "2 joints", "7 joints"])
def test_an_mjcf_written_with_other_parameters_says_them_when_it_is_read_again(tmp_path: Path, text: str) -> None:
    arm = load_arm(written(tmp_path, text))
    rng = np.random.default_rng(1)
    bodies = (arm.arm.parameters.reshape(-1, 10) * rng.uniform(0.8, 1.3, (len(arm.arm.joints), 1))).ravel()
    damping, friction, rotors = arm.damping * 1.5 + 0.1, arm.friction + 0.2, arm.motor_inertia + 0.05
    again = load_arm(
        written(
            tmp_path,
            mjcf_with(arm, bodies, damping=damping, friction=friction, motor_inertia=rotors, beyond=["backlash at q1"]),
            "repaired.xml",
        )
    )
    assert "an MJCF cannot hold: backlash at q1" in (tmp_path / "repaired.xml").read_text()
    q, v, a = rng.normal(size=(3, 40, arm.n))
    wanted = arm.torques(q, v, a, parameters=bodies) + rotors * a
    assert np.abs(again.torques(q, v, a) - wanted).max() < 1e-9 * np.abs(wanted).max()
    for found, given in zip(simulated(again)[1:], (damping, friction, rotors), strict=True):
        assert np.allclose(found, given, rtol=1e-12)


def test_an_mjcf_written_unchanged_is_the_same_arm_and_a_payload_hangs_on_the_last_body(tmp_path: Path) -> None:
    """Includes are written out, so that the file stands alone."""
    written(tmp_path, '<mujoco><default><joint damping="0.7"/></default></mujoco>', "defaults.xml")
    arm = load_arm(written(tmp_path, seven().replace("<worldbody>", '<include file="defaults.xml"/><worldbody>')))
    alone = tmp_path / "alone"
    alone.mkdir()
    same = load_arm(written(alone, mjcf_with(arm)))
    assert all(np.array_equal(x, y) for x, y in zip(simulated(arm), simulated(same), strict=True))
    load = np.array([2.0, 0.2, -0.1, 0.4])
    loaded = load_arm(written(alone, mjcf_with(arm, payload=load)))
    bodies = arm.arm.parameters.reshape(-1, 10).copy()
    centre = load[1:] / load[0]
    tensor = load[0] * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    bodies[-1] += [*load, *tensor[np.triu_indices(3)]]
    q, v, a = np.random.default_rng(3).normal(size=(3, 40, arm.n))
    wanted = arm.torques(q, v, a, parameters=bodies.ravel()) + arm.motor_inertia * a
    assert np.abs(loaded.torques(q, v, a) - wanted).max() < 1e-9 * np.abs(wanted).max()


def test_what_cannot_be_found_in_the_text_or_has_no_mjcf_is_refused(tmp_path: Path) -> None:
    repeated = (
        '<replicate count="2" offset="1 0 0"><body name="b"><joint name="j"/><geom size=".1"/></body></replicate>'
    )
    arm = load_arm(written(tmp_path, f"<mujoco><worldbody>{repeated}</worldbody></mujoco>"))
    with pytest.raises(InputError, match="replicate"):
        mjcf_with(arm, damping=arm.damping + 1.0)
    with pytest.raises(InputError, match="density"):
        mjcf_with(load_arm(written(tmp_path, ONE)), np.array([-1.0, *np.zeros(9)]))
    assert re.search("armature", mjcf_with(load_arm(written(tmp_path, ONE)), motor_inertia=np.array([0.5])))


def effect(name: str, at: str, **values: float) -> dict[str, object]:
    """Return an effect as a report has it."""
    return {"name": name, "at": at, "parameters": {key: {"value": value} for key, value in values.items()}}


def test_what_a_loop_found_is_in_the_repaired_mjcf_and_what_has_no_place_there_is_said(tmp_path: Path) -> None:
    arm = load_arm(written(tmp_path, TWO))
    found = [
        effect("coulomb_friction", "q1", Fc=0.4, w=0.001),
        effect("viscous_friction", "q2", b=-0.05),
        effect("rotor_inertia", "q1", J=0.02),
        effect("payload", "flange", m=0.5, mx=0.1, mz=-0.05),
        effect("link_inertia", "link of slide", I=0.7),
        effect("cogging", "q1", c=0.1),
    ]
    text = repaired_mjcf(arm, found)
    again = load_arm(written(tmp_path, text, "repaired.xml"))
    assert np.allclose(again.friction, [0.4, 0.0])
    assert np.allclose(again.damping, arm.damping + np.array([0.0, -0.05]))
    assert np.allclose(again.motor_inertia, arm.motor_inertia + np.array([0.02, 0.0]))
    assert "cannot hold: cogging at q1;" in text
    names = [joint.name for joint in again.arm.joints]
    assert np.allclose(again.arm.joints[names.index("slide")].inertia, 0.7 * np.eye(3))
    load = again.arm.joints[names.index("payload")]
    assert load.mass == 0.5
    assert np.allclose(load.mass * load.offset, [0.1, 0.0, -0.05])


def test_an_identified_arm_is_exported_as_the_file_that_it_was_read_from(tmp_path: Path) -> None:
    path = written(tmp_path, ONE)
    arm = load_arm(path)
    content = {
        "kind": "arm",
        "model": str(path),
        "inertial": (1.1 * arm.arm.parameters).tolist(),
        "damping": [0.2],
        "friction": [0.5],
        "motor_inertia": [0.07],
    }
    stored = written(tmp_path, json.dumps(content), "model.json")
    again = load_arm(export(stored, out=tmp_path / "found.xml")[0])
    assert np.allclose(again.arm.parameters, 1.1 * arm.arm.parameters)
    assert [*again.damping, *again.friction, *again.motor_inertia] == pytest.approx([0.2, 0.5, 0.07])
    names = ("inertial", "damping", "friction", "motor_inertia")
    bodies, damping, friction, rotors = (np.array(content[name]) for name in names)
    spec = PlantSpec((), (Channel("q"),), 0.01)
    model = ArmDynamics(spec, str(path), bodies, damping, friction, rotors)
    assert model.to_mjcf() == (tmp_path / "found.xml").read_text()
    with pytest.raises(InputError, match=r"\.xml or \.mjcf.*--out found\.xml"):
        export(stored, out=tmp_path / "found.urdf")


def test_bodies_have_the_boxes_of_their_shapes(tmp_path: Path) -> None:
    boxes = bounding_boxes(load_arm(written(tmp_path, TWO)))
    assert boxes[1] is None  # the slide carries the body, the swing before it nothing
    (_, low_high), carriage, tool = boxes[0], boxes[2], boxes[3]
    assert low_high == pytest.approx([0.1] * 3)
    assert tool is None
    turn = np.radians(30)
    half = 0.1 * np.cos(turn) + 0.3 * np.sin(turn), 0.2, 0.1 * np.sin(turn) + 0.3 * np.cos(turn)
    assert carriage is not None
    assert carriage[0] == pytest.approx(0.1 - np.array(half))
    assert carriage[1] == pytest.approx(0.1 + np.array(half))


def test_computed_torque_by_the_mjcf_follows_its_reference_with_its_rotors(tmp_path: Path) -> None:
    """The bodies alone leave out the rotors, 2.5 kg m^2 behind the gear."""
    path = written(tmp_path, TWO.replace('armature="1e-4"', 'armature="1e-3"'))
    arm = load_arm(path)
    plant_options = {"forces": ["swing", "slide"], "actuators": [], "sample_time": 0.002, "joint_damping": 0.0}

    def error(**choices: object) -> float:
        scenario = registry.create("scenarios", "arm-computed-torque", duration=3.0, noise=0.0, **choices)
        streams = Streams("mjcf", "track", 0)
        with registry.create("plants", "mjcf", model=str(path), **plant_options) as plant:
            planned = scenario.prepare(plant.spec, streams=streams, role="estimation/0")
            data = run(plant, scenario, streams=streams, role="estimation/0")
        wanted = np.stack(list(planned.controller.references.values()), axis=1)
        return float(np.abs(data.y[:, :2] - data.y[0, :2] - wanted[: len(data.y)]).max())

    assert error(urdf=str(path)) < min(2e-3, error(inverse_dynamics=arm.arm.inverse_dynamics) / 3)
