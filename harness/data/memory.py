"""Tables that are in memory already: pandas, polars, xarray, numpy, dictionaries, and records of ours."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from harness.data.columns import MemoryTable
from harness.data.headers import split_header
from harness.data.trajectories import columns_of
from harness.errors import InputError
from harness.signals import Trajectory

__all__ = ["in_memory"]


def in_memory(data: Any) -> MemoryTable | None:
    """Return the table of data in memory; None for a path.

    Parameters
    ----------
    data : DataFrame, Dataset of xarray, structured array, mapping of arrays, or Trajectory

    Raises
    ------
    InputError
        If its columns have no names.

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
