"""Measurement logs: MDF4 (automotive), MCAP (robotics) and TDMS (National Instruments), through optional packages."""

from __future__ import annotations

import gc
import json
import logging
import sys
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from harness.data.tables.binary_files import broken, no_numbers
from harness.data.tables.columns import MemoryTable
from harness.errors import InputError
from harness.extras import optional
from harness.signals import FloatArray


class MdfFile:
    """An MDF file (version 3 or 4); channels go by their name, ``time`` is the raster of the first channel.

    Channels on other rasters keep their own stamps.
    """

    def __init__(self, path: Path) -> None:
        asammdf = optional("asammdf", "MDF")
        logging.getLogger("asammdf").setLevel(logging.CRITICAL)  # the refusal says what is wrong, once
        self._channels: dict[str, Any] = {}
        self._twice: set[str] = set()
        self._left_out: dict[str, str] = {}
        try:
            with asammdf.MDF(path) as log:
                arrays = _arrays(log)
                for signal in log.iter_channels(skip_master=True):
                    kind = signal.samples.dtype.kind
                    if signal.name in arrays:
                        self._left_out[signal.name] = "an array in each row"
                    elif kind not in "biuf" or signal.samples.ndim != 1:
                        self._left_out[signal.name] = "texts" if kind in "SUO" else "no plain numbers"
                    elif len(signal.samples):
                        if signal.name in self._channels:
                            self._twice.add(signal.name)
                        self._channels.setdefault(signal.name, signal)
        except Exception as error:
            _drop_quietly(error)
            raise broken(path, "MDF", error) from error
        if not self._channels:
            raise InputError(
                "an empty log", expected="numeric channels", got="none", remedy="check the file", file=path
            )
        self._time = np.asarray(next(iter(self._channels.values())).timestamps, dtype=np.float64)
        self.titles = ["time", *(name for name in self._channels if name != "time")]
        held = [f"{name} ({what})" for name, what in self._left_out.items() if name not in self._channels]
        self.notes = [f"channels that are no columns of numbers: {', '.join(held[:8])}"] if held else []

    def values(self, title: str) -> FloatArray:
        """Return one channel (N,), or the time axis [s]."""
        if title == "time":
            return self._time.copy()
        if title in self._twice:
            raise InputError(
                f"two channels {title!r}",
                expected="channels with names of their own",
                got=f"{title} in two groups",
                remedy="rename or remove one",
                place=title,
            )
        signal = self._channels[title]
        found = np.array(signal.samples, dtype=np.float64)
        if signal.invalidation_bits is not None:
            found[np.asarray(signal.invalidation_bits, dtype=bool)] = np.nan  # the logger says so itself
        return found

    def clocks(self, titles: Sequence[str]) -> tuple[list[FloatArray], str]:
        """Return the stamps [s] of some channels, each on its own raster."""
        stamps = [self._time if title == "time" else self._channels[title].timestamps for title in titles]
        return [np.asarray(one, dtype=np.float64) for one in stamps], "the log's own"

    def select(self, text: str) -> FloatArray | None:
        """Return None, as MDF has plain channels only; refuse a channel that holds something else."""
        if text in self._left_out:
            raise InputError(
                f"the channel {text!r}",
                expected="a column of numbers",
                got=self._left_out[text],
                remedy="export it as numbers, or choose another channel",
                place=text,
            )
        return None

    def unit(self, title: str) -> str | None:
        """Return the unit that the log states."""
        if title == "time":
            return "s"
        return str(self._channels[title].unit) or None


def _arrays(log: Any) -> set[str]:
    """Return the names of channels that hold an array in each row (a CA block), which are no columns."""
    found = set()
    for group in getattr(log, "groups", ()):
        dependencies = getattr(group, "channel_dependencies", ())
        for channel, dependency in zip(getattr(group, "channels", ()), dependencies, strict=False):
            if dependency:
                found.add(channel.name)
    return found


def _drop_quietly(error: BaseException) -> None:
    """Let go of what an error holds: a reader that failed half-way may raise once more when it goes, in print only."""
    loud, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        link: BaseException | None = error
        while link is not None:
            traceback.clear_frames(link.__traceback__)
            link = link.__context__
        gc.collect()  # such readers refer to themselves
    finally:
        sys.unraisablehook = loud


def open_tdms(path: Path) -> MemoryTable | Waveforms:
    """Return the reader of a TDMS file: waveforms, where all channels state their sampling, else columns.

    A channel goes by its name, and by ``group/name`` where two groups have one. Raises InputError if the file cannot be
    read, or holds no numbers.
    """
    nptdms = optional("nptdms", "TDMS")
    try:
        channels = [one for group in nptdms.TdmsFile.read(path).groups() for one in group.channels() if len(one)]
        found = [(one.group_name, one.name, np.asarray(one[:]), dict(one.properties)) for one in channels]
    except Exception as error:
        raise broken(path, "TDMS", error) from error
    if not any(values.dtype.kind in "biuf" for _, _, values, _ in found):
        raise InputError("an empty log", expected="numeric channels", got="none", remedy="check the file", file=path)
    names = [name for _, name, _, _ in found]
    plain = [f"{group}/{name}" if names.count(name) > 1 else name for group, name, _, _ in found]
    units = [str(about.get("unit_string") or "") for *_, about in found]
    if all(about.get("wf_increment", 0.0) > 0 and values.dtype.kind in "biuf" for _, _, values, about in found):
        return Waveforms(plain, units, [values for _, _, values, _ in found], [about for *_, about in found])
    titles = [f"{name} [{unit}]" if unit else name for name, unit in zip(plain, units, strict=True)]
    return MemoryTable({title: values for title, (_, _, values, _) in zip(titles, found, strict=True)})


class Waveforms:
    """Channels that state start and step of their sampling; ``time`` is the clock of the first.

    - ``values`` sequence of array (N,)
    - ``sampling``: ``wf_increment`` [s], and perhaps ``wf_start_offset`` [s] and ``wf_start_time`` (National
      Instruments, *TDMS File Format Internal Structure*, properties of waveforms)
    """

    def __init__(
        self,
        names: Sequence[str],
        units: Sequence[str],
        values: Sequence[Any],
        sampling: Sequence[Mapping[str, Any]],
    ) -> None:
        self._columns = {name: np.asarray(one, dtype=np.float64) for name, one in zip(names, values, strict=True)}
        self._units = dict(zip(names, units, strict=True))
        begins = [np.datetime64(one.get("wf_start_time") or 0, "us") for one in sampling]
        self._clocks = {
            name: (begin - begins[0]) / np.timedelta64(1, "s")
            + float(one.get("wf_start_offset", 0.0))
            + float(one["wf_increment"]) * np.arange(len(self._columns[name]))
            for name, begin, one in zip(names, begins, sampling, strict=True)
        }
        self._clocks["time"] = next(iter(self._clocks.values()))
        self.titles = ["time", *(name for name in names if name != "time")]

    def values(self, title: str) -> FloatArray:
        """Return one channel (N,), or the time axis [s]."""
        return (self._clocks if title == "time" else self._columns)[title].copy()

    def clocks(self, titles: Sequence[str]) -> tuple[list[FloatArray], str]:
        """Return the stamps [s] of some channels."""
        return [self._clocks[title].copy() for title in titles], "the log's own"

    def unit(self, title: str) -> str | None:
        """Return the unit that the log states."""
        return "s" if title == "time" else self._units[title] or None


class McapFile:
    """An MCAP log with JSON messages; a value goes by ``/topic.field.field``.

    ``time`` is the log time [s] of the first topic since its first message; every topic keeps stamps of its own.
    """

    paths = True

    def __init__(self, path: Path) -> None:
        reader_module = optional("mcap.reader", "MCAP")
        columns: dict[str, list[float]] = {}
        taken: dict[str, list[int]] = {}
        stamps: dict[str, list[int]] = {}
        foreign: dict[str, str] = {}
        try:
            with path.open("rb") as stream:
                for _, channel, message in reader_module.make_reader(stream).iter_messages():
                    if channel.message_encoding != "json":
                        foreign[channel.topic] = channel.message_encoding or "unknown"
                        continue
                    stamps.setdefault(channel.topic, []).append(message.log_time)
                    for name, value in _numbers(channel.topic, json.loads(message.data)):
                        columns.setdefault(name, []).append(value)
                        taken.setdefault(name, []).append(message.log_time)
        except Exception as error:
            raise broken(path, "MCAP", error) from error
        if not columns:
            raise no_numbers(
                path, {topic: f"messages in {encoding}" for topic, encoding in sorted(foreign.items())}, set(stamps)
            )
        self._foreign = foreign
        self._columns = {name: np.array(values) for name, values in columns.items()}
        first = np.array(next(iter(stamps.values())), dtype=np.int64)
        self._clocks = {name: (np.array(at, dtype=np.int64) - first[0]) * 1e-9 for name, at in taken.items()}
        self._clocks["time"] = (first - first[0]) * 1e-9
        self._columns = {"time": (first - first[0]) * 1e-9, **self._columns}
        self.titles = list(self._columns)

    def values(self, title: str) -> FloatArray:
        """Return one field (N,) at the stamps of its topic, or the log time [s] of the first one."""
        return self._columns[title].copy()

    def clocks(self, titles: Sequence[str]) -> tuple[list[FloatArray], str]:
        """Return the log times [s] of some fields, from the first message of the first topic."""
        return [self._clocks[title].copy() for title in titles], "the times at which messages were recorded"

    def select(self, text: str) -> FloatArray | None:
        """Return None, as a field goes by its full name; refuse what lies in messages that are not JSON."""
        for topic, encoding in self._foreign.items():
            if text == topic or text.startswith(f"{topic}."):
                raise InputError(
                    f"topic {topic!r} cannot be read",
                    expected="JSON messages",
                    got=f"{encoding} messages",
                    remedy="convert the log to JSON messages or to CSV",
                    place=text,
                )
        return None

    def unit(self, title: str) -> str | None:
        """Return None: JSON messages state no units."""
        return "s" if title == "time" else None


def _numbers(prefix: str, content: Any) -> list[tuple[str, float]]:
    """Return every number of a message with its path."""
    if isinstance(content, bool | int | float):
        return [(prefix, float(content))]
    items: list[tuple[str, Any]] = []
    if isinstance(content, dict):
        items = [(f"{prefix}.{key}", value) for key, value in content.items()]
    elif isinstance(content, list):
        items = [(f"{prefix}[{number}]", value) for number, value in enumerate(content)]
    return [pair for name, value in items for pair in _numbers(name, value)]
