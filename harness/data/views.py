"""Records as pandas, polars and xarray have them; results of fmpy and python-control as records."""

from __future__ import annotations

from typing import Any

import numpy as np

from harness.data.tables.columns import columns_of
from harness.errors import InputError, refuse_unknown
from harness.extras import optional
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory


def to_pandas(trajectory: Trajectory) -> Any:
    """Return a record as a pandas ``DataFrame`` over time [s]; columns are titled ``name [unit]``.

    Raises
    ------
    InputError
        If pandas is not installed.
    """
    pandas = optional("pandas", "a pandas view", "pandas")
    columns = columns_of(trajectory)
    index = pandas.Index(columns.pop("time [s]"), name="time [s]")
    return pandas.DataFrame(columns, index=index)


def to_polars(trajectory: Trajectory) -> Any:
    """Return a record as a polars ``DataFrame`` with a column ``time [s]``.

    Raises
    ------
    InputError
        If polars is not installed.
    """
    return optional("polars", "a polars view", "polars").DataFrame(columns_of(trajectory))


def to_xarray(trajectory: Trajectory) -> Any:
    """Return a record as an xarray ``Dataset`` over ``time``, units in the attributes of the variables.

    Raises
    ------
    InputError
        If xarray is not installed.
    """
    xarray = optional("xarray", "an xarray view", "xarray")
    variables = {}
    spec = trajectory.spec
    for role, channels, values in (("input", spec.inputs, trajectory.u), ("output", spec.outputs, trajectory.y)):
        for i, channel in enumerate(channels):
            variables[channel.name] = ("time", values[:, i], {"units": channel.unit, "role": role})
    time = ("time", trajectory.t, {"units": "s"})
    return xarray.Dataset(variables, coords={"time": time}, attrs={"sample_time": spec.sample_time})


def from_control(response: Any, *, units: dict[str, str] | None = None) -> Trajectory:
    """Return the record of a python-control ``TimeResponseData`` (its simulated states become the truth).

    Parameters
    ----------
    response : control.TimeResponseData
        One trace, sampled uniformly.
    units : dict, optional
        Unit by signal name; ``"1"`` without.

    Raises
    ------
    InputError
        If the response has several traces, or its time is not uniform.
    """
    if getattr(response, "ntraces", 0) > 1:
        raise InputError(
            "a response with several traces",
            expected="one trace",
            got=str(response.ntraces),
            remedy="take one: response.trace...",
        )
    t = np.asarray(response.time, dtype=np.float64)

    def block(values: Any) -> FloatArray:
        if values is None:
            return np.zeros((len(t), 0))
        array = np.asarray(values, dtype=np.float64)
        return np.ascontiguousarray(array.reshape(-1, len(t)).T)

    u, y, x = block(response.inputs), block(response.outputs), block(response.states)
    spec = PlantSpec(
        _channels(response.input_labels, u, "u", units),
        _channels(response.output_labels, y, "y", units),
        _steps(t),
        _channels(response.state_labels, x, "x", units),
        feedthrough=True,
    )
    return Trajectory(t, u, y, spec, x if x.shape[1] else None)


def from_fmpy(result: Any, *, inputs: tuple[str, ...] = (), units: dict[str, str] | None = None) -> Trajectory:
    """Return the record of the structured array that ``fmpy.simulate_fmu`` returns.

    Parameters
    ----------
    result : structured array
        With a column ``time``.
    inputs : tuple of str
        Columns that are inputs. Caution: fmpy records in row k the input that was applied *before* t[k]; they are
        moved up by one row here, so that u[k] is what was held from t[k] on (the last row repeats).
    units : dict, optional
        Unit by column; ``"1"`` without.

    Raises
    ------
    InputError
        If a column is missing or the time is not uniform (an event adds a row).
    """
    names = list(result.dtype.names or ())
    for name in ("time", *inputs):
        refuse_unknown("a missing column", name, names, remedy="correct it")
    t = np.asarray(result["time"], dtype=np.float64)
    outputs = [name for name in names if name not in ("time", *inputs)]
    u = np.zeros((len(t), len(inputs)))
    for i, name in enumerate(inputs):
        u[:-1, i], u[-1, i] = result[name][1:], result[name][-1]
    y = np.column_stack([np.asarray(result[name], dtype=np.float64) for name in outputs])
    spec = PlantSpec(_channels(inputs, u, "u", units), _channels(outputs, y, "y", units), _steps(t))
    return Trajectory(t, u, y, spec)


def _channels(labels: Any, values: FloatArray, letter: str, units: dict[str, str] | None) -> tuple[Channel, ...]:
    """Return channels with these labels, or with counted names where there are none."""
    names = list(labels) if labels is not None and len(labels) else [f"{letter}[{i}]" for i in range(values.shape[1])]
    return tuple(Channel(str(name), (units or {}).get(str(name), "1")) for name in names)


def _steps(t: FloatArray) -> float:
    """Return the sample time of a time axis."""
    if len(t) < 2:
        raise InputError("one sample", expected="at least two instants", got=str(len(t)), remedy="simulate longer")
    return float(f"{(t[-1] - t[0]) / (len(t) - 1):.12g}")
