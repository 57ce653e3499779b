"""Tables that are in memory already: pandas, polars, xarray, numpy, dictionaries, and records of ours."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from harness.data.tables.columns import MemoryTable, columns_of
from harness.data.tables.headers import split_header
from harness.errors import InputError
from harness.signals import Trajectory


def in_memory(data: Any) -> MemoryTable | None:
    """Return the table of data in memory; None for a path.

    Raises InputError if its columns have no names.

    - ``data`` DataFrame, Dataset of xarray, structured array, mapping of arrays, or Trajectory

    Examples
    --------
    >>> table = in_memory({"time": np.arange(3), "u [Nm]": np.zeros(3)})
    >>> table.titles, table.values("time").tolist()
    (['time', 'u [Nm]'], [0.0, 1.0, 2.0])
    """
    if isinstance(data, str | Path):
        return None
    if isinstance(data, Trajectory):
        return MemoryTable(columns_of(data))
    if isinstance(data, Mapping) and not hasattr(data, "data_vars"):
        return MemoryTable(data)
    if isinstance(data, np.ndarray) and data.dtype.names:
        return MemoryTable({name: data[name] for name in data.dtype.names})
    kind = type(data).__module__.partition(".")[0]
    if kind == "pandas" and hasattr(data, "columns"):
        return MemoryTable({**_index(data), **{str(name): data[name].to_numpy() for name in data.columns}})
    if kind == "polars" and hasattr(data, "columns"):
        return MemoryTable({name: data[name].to_numpy() for name in data.columns})
    if kind == "xarray" and hasattr(data, "data_vars"):
        return MemoryTable(
            {_titled(name, data[name]): data[name].to_numpy() for name in (*data.coords, *data.data_vars)}
        )
    raise InputError(
        "data",
        expected="a file, or a table with named columns (DataFrame, xarray.Dataset, mapping of arrays, Trajectory)",
        got=f"{type(data).__module__}.{type(data).__qualname__}",
        remedy='give names: {"time [s]": t, "u [N m]": u, "theta [rad]": theta}',
    )


def input_and_output(u: Any, y: Any) -> tuple[dict[str, Any], list[str], list[str]]:
    """Return one table of an input and an output that came apart, and the names of both.

    Raises InputError if the lengths differ, an array has more than two dimensions or complex numbers, or both sides use
    one name.

    - ``u, y`` array (N,) or (N, k), list, or a Series or DataFrame of pandas or polars: arrays are called ``u`` and
      ``y``, several columns ``u1``, ``u2``, ...; a Series or a DataFrame keeps its names (with units: ``"torque [N
      m]"``), and an index of times that both share is the clock

    Examples
    --------
    >>> table, inputs, outputs = input_and_output(np.zeros((4, 2)), [1.0, 2.0, 3.0, 4.0])
    >>> inputs, outputs
    (['u1', 'u2'], ['y'])
    """
    (left, first), (right, second) = _columns(u, "u"), _columns(y, "y")
    lengths = {len(values) for values in (*left.values(), *right.values())}
    if len(lengths) > 1:
        raise InputError(
            "input and output of different length",
            expected="as many rows in each",
            got=" and ".join(f"{len(next(iter(side.values())))}" for side in (left, right)),
            remedy="cut both to the same instants",
        )
    if shared := sorted(set(left) & set(right)):
        raise InputError(
            "one name for an input and an output",
            expected="names that differ",
            got=", ".join(shared),
            remedy="rename the column of one",
        )
    time = {} if first is None or second is None or not np.array_equal(first[1], second[1]) else {first[0]: first[1]}
    return {**time, **left, **right}, list(left), list(right)


def _columns(data: Any, letter: str) -> tuple[dict[str, Any], tuple[str, Any] | None]:
    """Return the columns of one side by name, and its index where it is one of times."""
    kind = type(data).__module__.partition(".")[0]
    if kind in ("pandas", "polars"):
        frame = data.to_frame() if hasattr(data, "to_frame") else data
        index = _index(frame) if kind == "pandas" else {}
        names = [letter if name in (None, "", 0) else str(name) for name in frame.columns]
        found = {name: frame[old].to_numpy() for name, old in zip(names, frame.columns, strict=True)}
        return found, next(iter(index.items()), None)
    array = np.asarray(data)
    if array.ndim not in (1, 2) or not array.size or array.dtype.kind not in "biuf":
        raise InputError(
            f"the {'input' if letter == 'u' else 'output'} {letter}",
            expected="real numbers, shape (N,) or (N, channels), or a Series or DataFrame",
            got=f"{type(data).__name__} of shape {array.shape}, {array.dtype}",
            remedy=f"give one row for each instant, such as {letter}.reshape(-1, 1)",
        )
    block = array.reshape(len(array), -1)
    names = [letter] if block.shape[1] == 1 else [f"{letter}{k + 1}" for k in range(block.shape[1])]
    return {name: block[:, k] for k, name in enumerate(names)}, None


def _index(frame: Any) -> dict[str, Any]:
    """Return the index of a pandas frame as the time column, where it is one."""
    index = frame.index
    if index.dtype.kind in "mM":
        return {str(index.name or "time [s]"): index.to_numpy()}
    return {} if index.name is None else {str(index.name): index.to_numpy()}


def _titled(name: Any, variable: Any) -> str:
    """Return the title of a variable of xarray, its unit from the attributes."""
    unit = variable.attrs.get("units", variable.attrs.get("unit"))
    return str(name) if unit is None or split_header(str(name))[1] is not None else f"{name} [{unit}]"
