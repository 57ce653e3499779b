"""Bags of ROS 1 and ROS 2: fields by their path, joints by their names, topics with clocks of their own on one grid."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness import api
from harness.data import load_dataset
from harness.data.recipe.contents import contents_of
from harness.errors import InputError

pytest.importorskip("rosbags", reason="rosbags is not installed: pip install 'sysid-harness[data]'")
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

N, DT = 400, 0.01
START = 1_700_000_000_000_000_000
ANGLE = 0.3 * np.sin(2.0 * DT * np.arange(N))
COMMAND_STEP = 0.05

URDF = """<robot name="two"><link name="base"/>
<link name="upper"><inertial><origin xyz="0 0 0.2"/><mass value="1"/><inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="fore"><inertial><origin xyz="0 0 0.2"/><mass value="1"/><inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="9" velocity="9"/></joint>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="fore"/><origin xyz="0 0 0.4"/><axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="9" velocity="9"/></joint></robot>
"""  # noqa: E501


def messages(store: Any, one: bool) -> list[tuple[str, str, int, Any]]:
    """Return topic, type, time and message: joints at 100 Hz in changing order, commands at 20 Hz, a wrench."""
    kinds = store.types

    def header(at: int) -> Any:
        stamp = kinds["builtin_interfaces/msg/Time"](sec=at // 10**9, nanosec=at % 10**9)
        return kinds["std_msgs/msg/Header"](**({"seq": 0} if one else {}), stamp=stamp, frame_id="")

    vector = kinds["geometry_msgs/msg/Vector3"]
    out = []
    for k in range(N):
        at = START + round(k * DT * 1e9)
        names, values = ["shoulder", "elbow"], np.array([ANGLE[k], -ANGLE[k]])
        if k % 3 == 0:  # drivers list joints in any order
            names, values = names[::-1], values[::-1].copy()
        state = kinds["sensor_msgs/msg/JointState"](header(at), names, values, 2 * values, 3 * values)
        out.append(("/joint_states", "sensor_msgs/msg/JointState", at + 2_000_000, state))
        if k % 5 == 0:
            layout = kinds["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
            command = kinds["std_msgs/msg/Float64MultiArray"](layout, np.array([float(k), -float(k)]))
            out.append(("/command", "std_msgs/msg/Float64MultiArray", at, command))
        if k % 2 == 0:
            wrench = kinds["geometry_msgs/msg/Wrench"](vector(1.0 * k, 0.0, 0.0), vector(0.0, 0.0, 0.5))
            stamped = kinds["geometry_msgs/msg/WrenchStamped"](header(at), wrench)
            out.append(("/wrench", "geometry_msgs/msg/WrenchStamped", at + 1_000_000, stamped))
    return sorted(out, key=lambda entry: entry[2])


def written(
    folder: Path, kind: str, messages: Callable[[Any, bool], list[tuple[str, str, int, Any]]] = messages
) -> Path:
    """Write a bag of one kind."""
    if kind == "ros1":
        store = get_typestore(Stores.ROS1_NOETIC)
        path = folder / "run.bag"
        with Writer1(path) as bag:
            links: dict[str, Any] = {}
            for topic, name, at, message in messages(store, True):
                links.setdefault(topic, None)
                links[topic] = links[topic] or bag.add_connection(topic, name, typestore=store)
                bag.write(links[topic], at, store.serialize_ros1(message, name))
        return path
    store = get_typestore(Stores.ROS2_HUMBLE)
    plugin = StoragePlugin.MCAP if kind.startswith("mcap") else StoragePlugin.SQLITE3
    with Writer2(folder / "bag", version=9, storage_plugin=plugin) as bag2:
        links = {}
        for topic, name, at, message in messages(store, False):
            links.setdefault(topic, None)
            links[topic] = links[topic] or bag2.add_connection(topic, name, typestore=store)
            bag2.write(links[topic], at, store.serialize_cdr(message, name))
    if kind.endswith("folder"):
        return folder / "bag"
    return next(one for one in (folder / "bag").iterdir() if one.suffix in (".mcap", ".db3"))


def described(path: Path, *, resample: str = "", extra: str = "") -> Path:
    text = f"""name = "rig"
[signals.command]
role = "input"
column = "/command.data[0]"
unit = "N m"
[signals.elbow]
role = "output"
column = "/joint_states.position[elbow]"
unit = "rad"
{extra}
{resample}
[[runs]]
file = "{path.relative_to(path.parents[1] if path.parent.name == "bag" else path.parent)}"
"""
    target = (path.parents[1] if path.parent.name == "bag" else path.parent) / "dataset.toml"
    target.write_text(text)
    return target


@pytest.mark.parametrize("kind", ["ros1", "db3", "db3 folder", "mcap", "mcap folder"])
def test_every_kind_of_bag_is_read_and_joints_go_by_their_names(kind: str, tmp_path: Path) -> None:
    path = written(tmp_path, kind)
    found = {channel.column: channel for channel in contents_of(path).channels}
    assert found["/joint_states.position[elbow]"].every == pytest.approx(DT)
    assert found["/command.data[1]"].every == pytest.approx(COMMAND_STEP)
    assert found["/wrench.wrench.force.x"].unit == "N"
    assert found["/wrench.wrench.torque.z"].unit == "N m"
    with pytest.raises(InputError, match=r"clocks of their own.*\[resample\] sample_time = 0.05"):
        load_dataset(described(path))
    data = load_dataset(described(path, resample="[resample]\nsample_time = 0.01")).dataset
    record = data.estimation[0]
    begin = 2e-3  # recorded 2 ms late; the command has no header, so that the log's times count
    wanted = -0.3 * np.sin(2.0 * (record.t - begin))
    assert record.y[:, 0] == pytest.approx(wanted, abs=1e-4)
    assert set(np.round(record.u[2:7, 0], 6)) <= {0.0, 1.0, 4.0, 5.0}  # held, and shared where it changes inside a step
    area = np.sum(record.u[:-1, 0]) * DT
    times = np.arange(0, N, 5) * DT
    truth = np.interp(
        record.t[-1], np.append(times, N * DT), np.append(0, np.cumsum(np.arange(0, N, 5) * COMMAND_STEP))
    )
    assert area == pytest.approx(truth, rel=1e-3)
    said = " ".join(data.warnings)
    assert "times at which messages were recorded" in said
    assert "command held from the stamps on, elbow interpolated (linear)" in said


def test_headers_count_where_all_have_them_and_one_topic_needs_no_grid(tmp_path: Path) -> None:
    path = written(tmp_path, "mcap")
    effort = '[signals.effort]\nrole = "input"\ncolumn = "/joint_states.effort[elbow]"\nunit = "N m"'
    text = described(path, extra=effort).read_text()
    start, end = text.index("[signals.command]"), text.index("[signals.elbow]")
    (tmp_path / "one.toml").write_text(text[:start] + text[end:])
    data = load_dataset(tmp_path / "one.toml").dataset
    assert data.spec.sample_time == pytest.approx(DT)
    assert data.estimation[0].y[:, 0] == pytest.approx(-ANGLE)
    assert data.estimation[0].u[:, 0] == pytest.approx(-3 * ANGLE)
    assert any("stamps of the headers" in note for note in data.warnings)


@pytest.mark.parametrize("prefix", ["", "left_"])
def test_a_draft_knows_the_joints_of_the_urdf(prefix: str, tmp_path: Path) -> None:
    path = written(tmp_path, "mcap")
    (tmp_path / "two.urdf").write_text(URDF.replace('<joint name="', f'<joint name="{prefix}'))
    out = api.new_dataset([path], model=str(tmp_path / "two.urdf"), out=tmp_path / "dataset.toml")
    text = out.read_text()
    assert all(line in text for line in ('port = "q2"', 'port = "tau2"', "derivative = 1"))
    assert "\n[resample]" not in text  # one topic, one clock
    assert text.count('unit = "rad"') == text.count('unit = "rad/s"') == text.count('unit = "?"') == 2
    with pytest.raises(InputError, match=r"\?"):  # an effort may be a current: it is asked
        load_dataset(out)
    out.write_text(text.replace('unit = "?"', 'unit = "N m"'))
    data = load_dataset(out).dataset
    assert [channel.name for channel in data.spec.outputs][:2] == ["q1", "q2"]
    assert np.concatenate([run.trajectory.y[:, 1] for run in data]) == pytest.approx(-ANGLE)


def test_joints_that_differ_by_more_than_a_prefix_are_asked(tmp_path: Path) -> None:
    path = written(tmp_path, "mcap")
    (tmp_path / "two.urdf").write_text(URDF.replace('"shoulder"', '"hip"').replace('"elbow"', '"knee"'))
    out = api.new_dataset([path], model=str(tmp_path / "two.urdf"), out=tmp_path / "dataset.toml")
    assert not re.search(r"^port = ", out.read_text(), re.MULTILINE)


def test_a_broken_bag_is_refused_in_one_line(tmp_path: Path) -> None:
    for name in ("a.bag", "a.db3", "a.mcap"):
        (tmp_path / name).write_bytes(b"no bag at all, but long enough to be looked at by a reader")
        with pytest.raises(InputError, match=r"not an? (ROS bag|MCAP) file"):
            contents_of(tmp_path / name)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "no message at all; remedy: record again"),
        ("hello", "only messages of std_msgs/msg/String; remedy: record the topics that hold"),
    ],
)
@pytest.mark.parametrize("kind", ["ros1", "db3", "mcap"])
def test_a_bag_without_numbers_says_why(kind: str, text: str | None, said: str, tmp_path: Path) -> None:
    monkey = [] if text is None else [("/chatter", "std_msgs/msg/String", START, text)]
    with pytest.raises(InputError, match=re.escape(said)):
        contents_of(
            written(
                tmp_path,
                kind,
                lambda store, one: [(topic, name, at, store.types[name](data)) for topic, name, at, data in monkey],
            )
        )


@pytest.mark.parametrize("kind", ["db3 folder", "mcap folder"])
def test_a_bag_whose_file_was_renamed_is_read_and_one_that_lacks_a_file_is_not(kind: str, tmp_path: Path) -> None:
    folder = written(tmp_path, kind)
    file = next(one for one in folder.iterdir() if one.suffix in (".db3", ".mcap"))
    wanted = [channel.column for channel in contents_of(folder).channels]
    renamed = file.rename(folder / f"run{file.suffix}")
    assert [channel.column for channel in contents_of(folder).channels] == wanted
    renamed.unlink()
    with pytest.raises(InputError, match="not a ROS bag file"):
        contents_of(folder)


def test_a_topic_whose_definition_cannot_be_read_does_not_take_the_others_with_it(tmp_path: Path) -> None:
    """As recorders write events of services beside topics; and constants of a type are no data."""
    writer_of = pytest.importorskip("mcap.writer", reason="mcap is not installed")
    store = get_typestore(Stores.ROS2_HUMBLE)
    path = tmp_path / "mixed.mcap"
    with path.open("wb") as stream:
        writer = writer_of.Writer(stream)
        writer.start(profile="ros2")
        service = writer.register_schema("pkg/srv/Sum_Event", "ros2msg", b"int64 a\n---\nint64 sum\n")
        battery = writer.register_schema("pkg/msg/Level", "ros2msg", b"byte LOW=1\nbyte HIGH=2\nfloat64 volt\n")
        asked = writer.register_channel("/sum/_service_event", "cdr", service)
        told = writer.register_channel("/battery", "cdr", battery)
        for k in range(50):
            raw = store.serialize_cdr(store.types["std_msgs/msg/Float64"](12.0 + k), "std_msgs/msg/Float64")
            writer.add_message(told, START + k * 10**7, bytes(raw), START + k * 10**7)
            writer.add_message(asked, START + k * 10**7, b"\x00\x01\x00\x00", START + k * 10**7)
        writer.finish()
    found = contents_of(path)
    assert [channel.column for channel in found.channels] == ["/battery.volt"]
    assert any("/sum/_service_event is left out" in fact for fact in api.describe_file(path)["facts"])
