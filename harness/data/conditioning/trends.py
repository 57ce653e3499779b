"""Trends and bands: what is taken from every signal alike before a linear model is fitted."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from harness.data.sections import FilterSection
from harness.errors import InputError
from harness.signals import Channel, FloatArray, Trajectory

Trend = Literal["none", "constant", "linear"]


def conditioned(record: Trajectory, trend: Trend, band: FilterSection | None) -> Trajectory:
    """Return a record without its trend, inside a band; limits and periods of its channels no longer hold.

    Raises InputError if a channel counts or switches, or the band does not fit the sample time.
    """
    if trend == "none" and band is None:
        return record
    for channel in (*record.spec.inputs, *record.spec.outputs):
        if channel.kind != "real":
            raise InputError(
                f"channel {channel.name!r}",
                expected="a real signal where detrend or [filter] is declared",
                got=channel.kind,
                remedy="leave the channel out, or detrend and [filter]",
            )
    tables = [without_trend(table, trend) for table in (record.u, record.y)]
    if band is not None:
        tables = [filtered(table, band, record.spec.sample_time) for table in tables]
    plain = [tuple(Channel(c.name, c.unit) for c in group) for group in (record.spec.inputs, record.spec.outputs)]
    spec = replace(record.spec, inputs=plain[0], outputs=plain[1], states=())
    return Trajectory(record.t, tables[0], tables[1], spec, missing=record.missing)


def without_trend(values: FloatArray, trend: Trend) -> FloatArray:
    """Return columns (N, n) without their mean or straight line.

    Examples
    --------
    >>> import numpy as np
    >>> without_trend(np.array([[1.0], [2.0], [3.0]]), "constant").ravel().tolist()
    [-1.0, 0.0, 1.0]
    """
    if trend == "none" or values.size == 0:
        return values
    from scipy.signal import detrend

    result: FloatArray = detrend(values, axis=0, type=trend)
    return result


def filtered(values: FloatArray, band: FilterSection, sample_time: float) -> FloatArray:
    """Return columns (N, n) inside a band, forward in time from the steady state of the first row.

    Raises InputError if an edge is not below half the sampling frequency, or the edges are out of order.

    Examples
    --------
    >>> import numpy as np
    >>> filtered(np.ones((3, 1)), FilterSection(high=1.0), 0.1).ravel().round(12).tolist()
    [1.0, 1.0, 1.0]
    """
    from scipy.signal import butter, sosfilt, sosfilt_zi

    nyquist = 0.5 / sample_time
    edges = [edge for edge in (band.low, band.high) if edge is not None]
    if not edges or edges != sorted(set(edges)) or not all(0.0 < edge < nyquist for edge in edges):
        raise InputError(
            "[filter]",
            expected=f"low, high or both, in Hz, low below high, below half the sampling frequency ({nyquist:g} Hz)",
            got=f"low = {band.low}, high = {band.high}",
            remedy="correct the edges",
            place="filter",
        )
    kind: Literal["bandpass", "highpass", "lowpass"] = "highpass" if band.high is None else "lowpass"
    kind = "bandpass" if len(edges) == 2 else kind
    sections = butter(band.order, edges if len(edges) == 2 else edges[0], kind, fs=1.0 / sample_time, output="sos")
    start = sosfilt_zi(sections)[:, :, None] * values[:1]
    result: FloatArray = sosfilt(sections, values, axis=0, zi=start)[0]
    return result
