"""Channels and records in the units in which they were recorded (``Dataset.recorded``): what a person is shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from harness.signals import Channel, FloatArray, PlantSpec, Trajectory
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
    return replace(
        record.measured(),
        u=own_values(record.u, record.spec.inputs, recorded),
        y=own_values(record.y, record.spec.outputs, recorded),
        spec=own_gains(record.spec, recorded)[0],
    )


def own_gains(spec: PlantSpec, recorded: Mapping[str, str]) -> tuple[PlantSpec, FloatArray]:
    """Return a plant's ports in the units in which they were recorded, and what gains (ny, nu) in SI are times there.

    Examples
    --------
    >>> from harness.signals import PlantSpec
    >>> spec = PlantSpec((Channel("u", "V"),), (Channel("T", "K"), Channel("h", "m")), 1.0)
    >>> own, times = own_gains(spec, {"u": "mV", "T": "degC"})
    >>> str(own.outputs[0]), times.round(6).tolist()
    ('T [degC]', [[0.001], [0.001]])
    """
    inputs, outputs = (
        tuple(Channel(channel.name, own_unit(channel, recorded)) for channel in channels)
        for channels in (spec.inputs, spec.outputs)
    )
    sizes = [
        np.diff(own_values(np.repeat([[0.0], [1.0]], len(channels), axis=1), channels, recorded), axis=0)[0]
        for channels in (spec.inputs, spec.outputs)
    ]
    return replace(spec, inputs=inputs, outputs=outputs, states=()), sizes[1][:, None] / sizes[0][None, :]
