"""Channels and records in the units in which they were recorded (``Dataset.recorded``): what a person is shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from harness.signals import Channel, FloatArray, Trajectory
from harness.units.conversion import told


def own_unit(channel: Channel, recorded: Mapping[str, str]) -> str:
    """Return the unit in which a channel is shown: the one in which it was recorded, else its own.

    Examples
    --------
    >>> own_unit(Channel("T", "K"), {"T": "degC"}), own_unit(Channel("T", "K"), {})
    ('degC', 'K')
    """
    return told(0.0, channel.unit, recorded.get(channel.name, channel.unit))[1]


def own_values(values: FloatArray, channels: Sequence[Channel], recorded: Mapping[str, str]) -> FloatArray:
    """Return readings (N, n) of channels, in SI units, in the units in which they were recorded.

    Examples
    --------
    >>> own_values(np.array([[293.15, 0.5]]), (Channel("T", "K"), Channel("h", "m")), {"T": "degC", "h": "cm"}).tolist()
    [[20.0, 50.0]]
    """
    made = np.array(values, dtype=float)
    for column, channel in enumerate(channels):
        made[:, column] = told(made[:, column], channel.unit, recorded.get(channel.name, channel.unit), reading=True)[0]
    return made


def own_record(record: Trajectory, recorded: Mapping[str, str]) -> Trajectory:
    """Return a record in the units in which it was recorded, to be drawn: ranges and periods of channels are left out.

    Examples
    --------
    >>> from harness.signals import PlantSpec
    >>> spec = PlantSpec((), (Channel("T", "K"),), 60.0)
    >>> record = Trajectory(60.0 * np.arange(2), np.zeros((2, 0)), np.array([[293.15], [295.15]]), spec)
    >>> print(own_record(record, {"T": "degC"}), own_record(record, {"T": "degC"}).y[:, 0].tolist())
    2 samples over 60 s: no input -> T [degC] every 60 s [20.0, 22.0]
    """
    inputs, outputs = (
        tuple(Channel(channel.name, own_unit(channel, recorded)) for channel in channels)
        for channels in (record.spec.inputs, record.spec.outputs)
    )
    return replace(
        record.measured(),
        u=own_values(record.u, record.spec.inputs, recorded),
        y=own_values(record.y, record.spec.outputs, recorded),
        spec=replace(record.spec, inputs=inputs, outputs=outputs, states=()),
    )
