"""Records that are in memory already as a data set that was read, and what is odd about a data set."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from harness.data.recipe.loaded import LoadedDataset, Nominal
from harness.data.recipe.ports import Ports, located_model, ports_of
from harness.signals import Dataset, Run, Trajectory


def are_records(data: Any) -> bool:
    """Return True for several records of ours."""
    return isinstance(data, list | tuple) and bool(data) and all(isinstance(one, Trajectory) for one in data)


def examined_data(data: Dataset, *names: Sequence[str]) -> Dataset:
    """Return a data set that knows what is odd about it, in its warnings too; runs by these names."""
    from harness.data.oddities import examined, lines  # SciPy's statistics take a second to load

    data = examined(data)
    return replace(data, warnings=(*data.warnings, *lines(data.oddities or (), *names)))


def of_records(data: Any, model: str | None) -> LoadedDataset:
    """Return records that are in memory already as a data set that was read."""
    if isinstance(data, LoadedDataset):
        return data
    if not isinstance(data, Dataset):
        data = Dataset("data", tuple(Run(one, "estimation", str(k)) for k, one in enumerate(data)))
    if data.oddities is None:
        data = examined_data(data)
    known = None if model is None else ports_of(located_model(model, Path.cwd()), {})
    names = {channel.name: (channel.name, 0) for channel in data.spec.outputs}
    ports = [] if known is None else [channel.name for channel in known.outputs]
    for port in ports:
        for derivative in (1, 2):
            name = Ports.channel_name(port, derivative)
            if name in names and name not in ports:
                names[name] = (port, derivative)
    nominal = None if model is None else Nominal(located_model(model, Path.cwd()))
    return LoadedDataset(data, nominal, tuple(names.values()), tuple({} for _ in data.runs), Path("(data)"))
