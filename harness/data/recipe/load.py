"""load_dataset: from a dataset.toml, or one bare CSV or Parquet file, to records in SI units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Unpack

import msgspec

from harness.data.recipe.bare import describe_bare
from harness.data.recipe.chosen import Chosen, ChosenSignals
from harness.data.recipe.description import read_description
from harness.data.recipe.in_memory import are_records, of_records
from harness.data.recipe.loaded import LoadedDataset
from harness.data.recipe.ports import ANY_PORTS, Ports
from harness.data.recipe.reading import DATA_FOLDER, Reader
from harness.data.tables.bags import is_bag_folder
from harness.data.tables.memory import in_memory
from harness.data.tables.table import BARE, FORMATS, Table, suffix_of, unknown_format
from harness.errors import InputError
from harness.signals import Channel, Dataset, PlantSpec, Trajectory

__all__ = ["DATA_FOLDER", "load_dataset", "load_record"]


def load_dataset(
    path: Any,
    *,
    model: str | None = None,
    validation: Any = None,
    ports: tuple[Sequence[Channel], Sequence[Channel]] | None = None,
    undriven: Sequence[str] = (),
    **signals: Unpack[ChosenSignals],
) -> LoadedDataset:
    """Read a data set, check it, and convert it to SI units.

    Parameters
    ----------
    path : path or table
        ``dataset.toml``; one CSV, Parquet, Feather or Excel file whose columns carry the names of the model's ports; or
        such a table in memory: a DataFrame of pandas or polars, an xarray Dataset, a mapping of arrays, a
        :class:`Trajectory` or several, a :class:`Dataset`. Units stand in the titles: ``u [N m]``.
    model : str, optional
        Nominal model, in place of the one that the file names; a bare file needs it.
    validation : path or table, optional
        Validation data beside a bare file or table; without them the last third validates.
    ports : (inputs, outputs), optional
        Channels of the model, for a caller that knows it already.
    undriven : sequence of str, optional
        Inputs of the model that nothing drove (0 in all records), beside those that the file declares.
    **signals : Signals
        What is said of the columns of a table without a ``dataset.toml``: ``input`` and ``output`` name its signals
        where no model does, ``column={"theta": "Winkel"}`` says where one stands, ``unit={"theta": "deg"}`` its unit
        (a column without any holds plain numbers where no model asks for a unit), ``sample_time`` [s] where there is
        no time column, ``gaps="split"`` makes a record of every piece between holes, ``run`` names further records with
        the same columns: files, or ``("validation", file)``.

    Returns
    -------
    LoadedDataset
        What was noticed stands in ``dataset.warnings``.

    Raises
    ------
    InputError
        If a file, column, unit, time axis or value cannot be used. The message names file, place and remedy.
    """
    chosen = Chosen.of(signals)
    if isinstance(path, LoadedDataset | Dataset) or are_records(path):
        if chosen.anything or validation is not None:
            raise InputError(
                "columns of records",
                expected="records as they are: their channels have names and units",
                got=f"{type(path).__name__} with {', '.join(signals) or 'validation'}",
                remedy="leave it out, or give a table",
            )
        return of_records(path, model)
    if isinstance(path, Trajectory) and model in (None, ANY_PORTS) and ports is None and not chosen.anything:
        ports = (path.spec.inputs, path.spec.outputs)
    return _load(path, model, validation, ports, undriven, chosen)


def load_record(data: Any, spec: PlantSpec) -> Trajectory:
    """Return one table, or the one run of a data set, as a record in the language of a model.

    Raises InputError if the data cannot be used, or are several records.

    - ``data``: as for :func:`load_dataset`; the columns carry the names of the model's channels
    - ``spec``: the model's inputs, outputs and sample time
    """
    found = _load(data, None, None, (spec.inputs, spec.outputs), (), Chosen(whole=True)).dataset
    if len(found.runs) != 1:
        raise InputError(
            "several records",
            expected="one",
            got=f"{len(found.runs)} runs of {found.name}",
            remedy="take one: load_dataset(...).dataset.runs[0].trajectory",
        )
    return found.runs[0].trajectory


def _load(
    path: Any,
    model: str | None,
    validation: Any,
    ports: tuple[Sequence[Channel], Sequence[Channel]] | None,
    undriven: Sequence[str],
    chosen: Chosen,
) -> LoadedDataset:
    """Read a file or a table: see :func:`load_dataset`."""
    tables: dict[Path, Table] = {}
    path = _path_or_name(path, "data", tables)
    chosen = replace(
        chosen,
        runs=tuple((use, _path_or_name(one, f"data {k + 2}", tables)) for k, (use, one) in enumerate(chosen.runs)),
    )
    validation = None if validation is None else _path_or_name(validation, "validation data", tables)
    suffix = suffix_of(path)
    described = suffix in FORMATS or is_bag_folder(path)
    notes: list[str] = []
    at = None if ports is None else Ports(tuple(ports[0]), tuple(ports[1]))
    if suffix in BARE or path in tables or (described and chosen.anything):
        description, known = describe_bare(
            path, model=model, validation=validation, ports=ports, notes=notes, tables=tables, chosen=chosen
        )
        at = None if known is None else Ports(known.inputs, known.outputs, untold=known.untold)
    elif described and path.exists():
        raise InputError(
            "a file that needs a description",
            expected="a dataset.toml, or --input and --output (or --column) that name its columns",
            got=repr(suffix),
            remedy=f"name them, or write a dataset.toml (sysid new dataset {path.name} drafts one)",
            file=path,
        )
    else:
        if suffix != ".toml" and path.is_file():
            raise unknown_format(path)
        if validation is not None:
            raise InputError(
                "a validation file beside a dataset.toml", expected='its own [[runs]] with use = "validation"',
                got=str(validation), remedy="add the run to the dataset.toml", file=path,
            )  # fmt: skip
        if replace(chosen, whole=False).anything:
            raise InputError(
                "columns chosen beside a dataset.toml",
                expected="the dataset.toml alone, which says it itself",
                got="input, output, column, unit, sample_time, gaps, sheet or run",
                remedy="leave them out, or give the table itself",
                file=path,
            )
        description = read_description(path)
    description = msgspec.structs.replace(description, undriven=tuple({*description.undriven, *undriven}))
    try:
        reader = Reader(path, description, notes, tables, model=model, ports=at)
        return reader.load(fitted=not chosen.whole)
    except InputError as error:
        raise error.located(file=path) from error


def _path_or_name(data: Any, name: str, tables: dict[Path, Table]) -> Path:
    """Return the path of a file, or a name for a table in memory, which is kept under it."""
    found = in_memory(data)
    if found is None:
        return Path(data)
    path = Path(f"({name})")
    tables[path] = Table(path, found)
    return path
