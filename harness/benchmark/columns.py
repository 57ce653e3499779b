"""Rows as columns: which Parquet file holds which fields, their types and units, and rows back from the files."""

from __future__ import annotations

import gc
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from harness.benchmark.row import Row, sound
from harness.data.whole_files import whole_file
from harness.jobs.stored import read_columns, reading

FORMAT = "sysid-harness/bench/1"
UNITS = {
    **{
        name: "1"
        for name in (
            "equation_error",
            "simulation_error",
            "noise_floor",
            "coverage",
            "control_score",
            "predictive_cost",
        )
    },
    "regret_over_theory": "1",
    **{name: "1" for name in ("least_equation_error", "least_simulation_error")},
    "control_regret": "samples of the optimal cost",
    **{name: "nats" for name in ("log_score", "log_regret", "average_log_regret")},
    "memory_mib": "MiB",
    **{
        name: "see the column units, one for each output"
        for name in ("equation_rms", "simulation_rms", "trace_measured", "trace_residual")
    },
    **{name: "s" for name in ("horizon", "data_seconds", "fit_seconds", "score_seconds", "trace_t")},
    **{name: "samples" for name in ("burn_in", "samples", "held_out_samples", "curve_steps")},
}
"""Units of the columns, kept in the schema of the Parquet files."""
TIMINGS = ("data_seconds", "fit_seconds", "score_seconds", "memory_mib")
CURVES = ("curve_steps", "curve_regret", "curve_theory")
TRACES = ("trace_t", "trace_measured", "trace_residual")
KEYS = ("plant", "scenario", "identifier", "seed")


def columns_of_files() -> tuple[tuple[str, ...], ...]:
    """Return the columns of results, timings, curves and traces."""
    apart = {*TIMINGS, *CURVES, *TRACES, "job"}
    scores = [name for name in Row.__struct_fields__ if name not in apart]
    return (*scores, "job"), *(("job", *KEYS, *own) for own in (TIMINGS, CURVES, TRACES))


def rows_of(paths: Sequence[Path]) -> dict[str, Row]:
    """Return the rows whose columns lie in these Parquet files, by job; columns of other versions are left out.

    Raises InputError if a file is damaged.
    """
    found: dict[str, Row] = {}
    with _no_collection():
        for path in paths:
            table = read_columns(path)
            with reading(path):
                columns = _known_columns(table)
                jobs = columns.get("job", [])
                if "status" in columns:
                    values = zip(*columns.values(), strict=True)
                    rows = (Row(**dict(zip(columns, row, strict=True))) for row in values)
                    found.update(zip(jobs, rows, strict=True))
                    continue
                for name in columns.keys() - {"job", *KEYS}:
                    for job, value in zip(jobs, columns[name], strict=True):
                        if job in found:
                            setattr(found[job], name, value)
        for row in found.values():
            with reading(paths[0]):
                sound(row)
    return found


def _known_columns(table: Any) -> dict[str, list[Any]]:
    """Return the columns of a table that rows have and that hold anything, as the types that rows have.

    Raises ValueError if a value is missing that every row has.
    """
    columns = {}
    for name in set(Row.__struct_fields__) & set(table.column_names):
        column = table.column(name).cast(_arrow_type(name))
        if _all_default(column):
            continue
        if column.null_count and "None" not in str(Row.__annotations__[name]).rpartition("]")[2]:
            raise ValueError(f"no {name} in {column.null_count} rows")
        columns[name] = plain_values(column)
    return columns


@contextmanager
def _no_collection() -> Iterator[None]:
    """Keep the collector of cycles from looking at a million new values again and again; rows have no cycles."""
    before = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if before:
            gc.enable()


def _all_default(column: Any) -> bool:
    """Return True if a column holds nothing: only nulls, or only lists without an item."""
    import pyarrow as pa

    if pa.types.is_list(column.type):
        return not column.null_count and not any(len(chunk.flatten()) for chunk in column.chunks)
    return bool(column.null_count == len(column))


def plain_values(column: Any) -> list[Any]:
    """Return an Arrow column as a list, tuples for its lists, None for what is null.

    Arrow's own ``to_pylist`` makes an object of every value first, and takes ten times as long.

    Examples
    --------
    >>> import pyarrow as pa
    >>> plain_values(pa.array([[1.0, None], [], None]))
    [(1.0, None), (), None]
    """
    import pyarrow as pa

    array = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    if isinstance(array, pa.ChunkedArray):  # a column without chunks, or with more than one can hold
        array = pa.concat_arrays(array.chunks) if array.num_chunks else pa.array([], type=array.type)
    missing = np.flatnonzero(array.is_null().to_numpy(zero_copy_only=False)) if array.null_count else ()
    values: list[Any]
    if pa.types.is_list(array.type):
        ends = array.offsets.to_numpy()
        inner = plain_values(array.values)
        values = [tuple(inner[first:last]) for first, last in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)]
    elif array.null_count and pa.types.is_integer(array.type):
        values = array.fill_null(0).to_numpy().tolist()
    else:
        values = array.to_numpy(zero_copy_only=False).tolist()
    for k in missing:
        values[k] = None
    return values


def arrow_table(names: Sequence[str], rows: Sequence[Row]) -> Any:
    """Return some fields of rows as an Arrow table; units go into the schema."""
    import pyarrow as pa

    fields = [
        pa.field(name, _arrow_type(name), metadata={"unit": UNITS[name]} if name in UNITS else None) for name in names
    ]
    columns = [pa.array([getattr(row, field.name) for row in rows], type=field.type) for field in fields]
    return pa.Table.from_arrays(columns, schema=pa.schema(fields, metadata={"format": FORMAT}))


def write_rows(path: Path, names: Sequence[str], rows: Sequence[Row]) -> None:
    """Write some fields of rows to a Parquet file, whole or not at all."""
    from pyarrow import parquet

    with whole_file(path) as scratch:
        parquet.write_table(arrow_table(names, rows), scratch, compression="zstd", write_page_checksum=True)


def _arrow_type(name: str) -> Any:
    """Return the column type of a field of Row."""
    import pyarrow as pa

    def type_of(hint: str) -> Any:
        if hint.startswith("tuple["):
            return pa.list_(type_of(hint.removeprefix("tuple[").removesuffix(", ...]")))
        for word, made in (("str", pa.string()), ("bool", pa.bool_()), ("int", pa.int64())):
            if hint.startswith(word):
                return made
        return pa.float64()

    return type_of(str(Row.__annotations__[name]))
