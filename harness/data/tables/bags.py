"""Bags of robots: ROS 1 and ROS 2 (db3, MCAP with CDR), read through ``rosbags``; a value goes by ``/topic.field``."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from harness.data.tables.binary_files import broken, no_numbers
from harness.extras import optional
from harness.signals import FloatArray

REP_103 = {
    ("geometry_msgs/msg/Wrench", "force"): "N",
    ("geometry_msgs/msg/Wrench", "torque"): "N m",
    ("geometry_msgs/msg/Twist", "linear"): "m/s",
    ("geometry_msgs/msg/Twist", "angular"): "rad/s",
    ("sensor_msgs/msg/Imu", "angular_velocity"): "rad/s",
    ("sensor_msgs/msg/Imu", "linear_acceleration"): "m/s^2",
}
"""Units that the definition of a message states (REP 103); a joint's position is rad or m, which it does not say."""

LONGEST_LIST = 64
"""Numbers of one list that become columns: joints and actuators, but no images and no clouds of points."""


def is_bag_folder(path: Path) -> bool:
    """Return True for the folder of a ROS 2 bag."""
    return path.is_dir() and (path / "metadata.yaml").is_file()


class BagFile:
    """A bag: every number of every message is a column, with the stamps of its own topic.

    Lists of joints (``JointState``) go by the joint's name, whatever its place in a message:
    ``/joint_states.position[elbow]``; other lists by their index: ``/command.data[0]``.

    - ``path``: ``.bag``, ``.db3``, ``.mcap``, or the folder of a ROS 2 bag
    """

    paths = True

    def __init__(self, path: Path) -> None:
        columns: dict[str, list[float]] = {}
        stamps: dict[str, list[tuple[int, int]]] = {}
        self._units: dict[str, str] = {}
        unread: dict[str, str] = {}
        readable: set[str] = set()
        try:
            for topic, kind, logged, message in _messages(path):
                readable.add(kind)
                if isinstance(message, Exception):
                    unread[topic] = kind
                    continue
                at = (logged, _header(message))
                for name, value, unit in _numbers(topic, message):
                    columns.setdefault(name, []).append(value)
                    stamps.setdefault(name, []).append(at)
                    if unit is not None:
                        self._units.setdefault(name, unit)
        except Exception as error:  # the library raises whatever a damaged bag makes it meet
            raise broken(path, "ROS bag", error) from error
        if not columns:
            raise no_numbers(path, unread, {f"messages of {kind}" for kind in readable})
        self.notes = [
            f"topic {topic} is left out: the bag does not hold the definition of {kind}, or it cannot be read"
            for topic, kind in unread.items()
        ]
        self._columns = {name: np.array(values) for name, values in columns.items()}
        self._stamps = {name: np.array(pairs, dtype=np.int64) for name, pairs in stamps.items()}
        self._origin = min(int(pairs[0, 0]) for pairs in self._stamps.values())
        self.titles = list(self._columns)

    def values(self, title: str) -> FloatArray:
        """Return one field (N,), at the stamps of its own topic."""
        return self._columns[title].copy()

    def clocks(self, titles: Sequence[str]) -> tuple[list[FloatArray], str]:
        """Return the stamps [s] of some columns, and which they are.

        The stamps of the headers are when something was measured, and count where every topic that is used has them;
        the time at which messages were recorded, with the delay of their way, counts for all otherwise: clocks are not
        mixed.
        """
        tables = [self._stamps[title] for title in titles]
        headed = all((table[:, 1] > 0).all() and (np.diff(table[:, 1]) > 0).all() for table in tables)
        # headers of a clock that began elsewhere have no origin in common with the log
        origin = min(int(table[0, 1]) for table in tables) if headed else self._origin
        return [np.asarray((table[:, int(headed)] - origin) * 1e-9, dtype=np.float64) for table in tables], (
            "the stamps of the headers" if headed else "the times at which messages were recorded"
        )

    def unit(self, title: str) -> str | None:
        """Return the unit that the definition of the message states."""
        return self._units.get(title)


def _files(path: Path) -> list[Path]:
    """Return what a bag is read from: itself, or the files of a folder that were renamed since its metadata.

    As many files as the metadata name, none under the name that it had, are these: ``ros2 bag reindex`` takes them so.
    """
    if not is_bag_folder(path):
        return [path]
    yaml = optional("ruamel.yaml", "a bag")
    # the reader words what is wrong with the metadata
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError, yaml.error.YAMLError):
        said = yaml.YAML(typ="safe").load((path / "metadata.yaml").read_text(encoding="utf-8"))
        named = [PurePath(one).name for one in said["rosbag2_bagfile_information"]["relative_file_paths"]]
        there = sorted(one for one in path.iterdir() if one.suffix in (".mcap", ".db3"))
        if len(there) == len(named) and not {one.name for one in there} & set(named):
            return there
    return [path]


def _messages(path: Path) -> Iterator[tuple[str, str, int, Any]]:
    """Yield topic, type, time of recording [ns] and content of every message.

    The content is an exception where a type is not known, or its definition in the bag cannot be read (events of
    services): a topic that cannot be read does not take the others with it.
    """
    highlevel = optional("rosbags.highlevel", "a bag")
    typesys = optional("rosbags.typesys", "a bag")
    usual = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    bag = highlevel.AnyReader(_files(path), default_typestore=usual)
    for part in bag.readers:
        with part:
            stores = {connection.id: _types(connection, typesys, usual) for connection in part.connections}
            for connection, logged, raw in part.messages():
                store = stores[connection.id]
                message: Any = store
                if not isinstance(store, Exception):
                    read = store.deserialize_cdr if bag.is2 else store.deserialize_ros1
                    try:
                        message = read(raw, connection.msgtype)
                    except Exception as error:  # a type whose definition the bag does not hold
                        message = error
                yield connection.topic, connection.msgtype, int(logged), message


def _types(connection: Any, typesys: Any, usual: Any) -> Any:
    """Return the types that the messages of a connection are made of, or what is wrong with their definition."""
    definition = connection.msgdef
    if definition.format.name == "NONE":
        return usual
    try:
        store = typesys.get_typestore(typesys.Stores.EMPTY)
        if definition.format.name == "MSG":
            store.register(typesys.get_types_from_msg(definition.data, connection.msgtype))
        else:
            rule = "=" * 80 + "\n"
            texts = [part.partition("\n")[2] for part in definition.data.split(rule) if part.startswith("IDL: ")]
            for text in texts or [definition.data]:
                store.register(typesys.get_types_from_idl(text))
    except Exception as error:  # the library raises whatever a definition makes it meet
        return error
    return store


def _fields(message: Any) -> Iterator[str]:
    """Yield the names of what a message holds, without constants of its type and the filler of an empty one."""
    for field in dataclasses.fields(message):
        constant = field.name.isupper() and hasattr(type(message), field.name)
        if not constant and field.name not in ("header", "__msgtype__", "layout", _FILLER):
            yield field.name


_FILLER = "structure_needs_at_least_one_member"


def _header(message: Any) -> int:
    """Return the stamp of a message's header [ns]; 0 where it has none."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return 0 if stamp is None else int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _numbers(topic: str, message: Any) -> Iterator[tuple[str, float, str | None]]:
    """Yield name, value and unit of every number of a message; of a joint's lists by the joint's name."""
    joints = list(message.name) if message.__msgtype__ == "sensor_msgs/msg/JointState" else None
    for field in _fields(message):
        value = getattr(message, field)
        if joints is None:
            yield from _inside(f"{topic}.{field}", value, REP_103.get((message.__msgtype__, field)))
        elif field != "name":
            for joint, number in zip(joints, value, strict=False):
                yield f"{topic}.{field}[{joint}]", float(number), None


def _inside(path: str, value: Any, unit: str | None) -> Iterator[tuple[str, float, str | None]]:
    """Yield the numbers inside a value."""
    if isinstance(value, bool | int | float | np.number):
        yield path, float(value), unit
    elif isinstance(value, np.ndarray | list | tuple):
        if len(value) <= LONGEST_LIST:
            for number, one in enumerate(value):
                yield from _inside(f"{path}[{number}]", one, unit)
    elif dataclasses.is_dataclass(value):
        kind = getattr(value, "__msgtype__", "")
        for field in _fields(value):
            yield from _inside(f"{path}.{field}", getattr(value, field), REP_103.get((kind, field), unit))


def holds_json(path: Path) -> bool:
    """Return True for an MCAP log all of whose messages are JSON: no bag of ROS."""
    reader = optional("mcap.reader", "MCAP")
    with contextlib.suppress(Exception), path.open("rb") as stream:  # the reader words what is wrong with the file
        summary = reader.make_reader(stream).get_summary()
        kinds = {channel.message_encoding for channel in summary.channels.values()} if summary is not None else {"json"}
        return "cdr" not in kinds and "ros1" not in kinds
    return True
