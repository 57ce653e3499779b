"""A trajectory to a file and back, bit for bit: CSV and Parquet with units in the titles of the columns.

What the columns are stands in the metadata of a Parquet file. A CSV file stays a plain table, and has it beside it in
``NAME.csv-metadata.json``: W3C, *Model for Tabular Data and Metadata on the Web* (2015), section 5.3, names it so.

True states go to columns of their own that start with ``truth:``; readers of measurements never look at them. What came
from outside a control loop goes to columns that start with ``reference:``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from harness.data.tables.columns import columns_of
from harness.data.tables.headers import REFERENCE, TRUTH, split_header
from harness.data.tables.table import Table
from harness.data.whole_files import whole_file, write_json
from harness.errors import InputError
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory, stated_categories
from harness.specs import channel_from_dict, channel_to_dict, spec_from_dict, spec_to_dict

_KEY = "sysid-harness/trajectory/1"
BESIDE = "-metadata.json"  # What the name of a CSV file gets in the name of the file that says what its columns are.


def write_trajectory(
    trajectory: Trajectory, path: str | Path, *, references: Mapping[str, FloatArray] | None = None
) -> Path:
    """Write a record as CSV or Parquet.

    Parameters
    ----------
    trajectory : Trajectory
    path : path
        Ends in ``.csv`` or ``.parquet``. An existing file is replaced, whole or not at all.
    references : mapping, optional
        Signals from outside the loop by title, such as ``"u [N]"``: arrays (N,).

    Returns
    -------
    Path
        The file.

    Raises
    ------
    InputError
        If the suffix is neither, or the folder is missing.

    Notes
    -----
    Numbers are written so that they read back bit for bit. The whole :class:`PlantSpec` (inputs and outputs, ranges,
    periods, kinds) goes into the metadata of a Parquet file; a CSV file is a plain table, and has it beside it in
    ``NAME.csv-metadata.json``.
    """
    path = Path(path)
    columns = {
        **columns_of(trajectory),
        **{f"{REFERENCE}{title}": np.asarray(values, dtype=float) for title, values in (references or {}).items()},
    }
    if not path.parent.is_dir():
        raise InputError(
            "the folder is missing", expected="an existing folder", got=str(path.parent), remedy="make it", file=path
        )
    suffix = path.suffix.lower()
    if suffix not in (".csv", ".parquet"):
        raise InputError(
            "output file", expected="a name that ends in .csv or .parquet", got=path.name, remedy="rename it", file=path
        )
    content = {_KEY: _spec_to_dict(trajectory.spec)}
    with whole_file(path) as scratch:
        if suffix == ".csv":
            lines = [",".join(map(_quoted, columns))]
            table = [values.tolist() for values in columns.values()]
            lines += [",".join(map(repr, row)) for row in zip(*table, strict=True)]
            scratch.write_text("\n".join(lines) + "\n", encoding="utf-8")
        else:
            import pyarrow as pa
            import pyarrow.parquet as pq

            arrow = pa.table({title: np.ascontiguousarray(values) for title, values in columns.items()})
            pq.write_table(arrow.replace_schema_metadata({_KEY: json.dumps(content[_KEY])}), scratch)
    if suffix == ".csv":
        write_json(_beside(path), {"url": path.name, "notes": [content]})
    return path


def _beside(path: Path) -> Path:
    """Return where it stands what the columns of a CSV file are."""
    return path.with_name(path.name + BESIDE)


def _quoted(title: str) -> str:
    """Return a title as a cell of a CSV file (RFC 4180)."""
    return '"' + title.replace('"', '""') + '"' if "," in title or '"' in title else title


def read_trajectory(
    path: str | Path, *, spec: PlantSpec | None = None, inputs: Sequence[str] | None = None
) -> Trajectory:
    """Read a record that :func:`write_trajectory` wrote.

    Parameters
    ----------
    path : path
        A Parquet or CSV file.
    spec : PlantSpec, optional
        What was recorded; without it, what was written with the record counts.
    inputs : sequence of str, optional
        For a table of which nothing says it, or that is played otherwise: which columns are inputs; the others are
        outputs.

    Returns
    -------
    Trajectory
        With the true states where the file holds them.

    Raises
    ------
    InputError
        If a column is missing, or nothing says which columns are inputs.
    """
    path = Path(path)
    table = Table(path)
    stored = stored_spec(path, table.titles)
    if stored is not None and inputs is not None and {channel.name for channel in stored.inputs} != set(inputs):
        stored = None
    spec = spec or stored
    truth = [title for title in table.all_titles if title.startswith(TRUTH)]
    time = table.read_time("time")[0]
    if spec is None:
        if inputs is None:
            raise InputError(
                "nothing says which columns are inputs",
                expected="spec = ... or inputs = [...]",
                got="neither",
                remedy='call read_trajectory(path, inputs=["u"])',
                file=path,
            )
        spec = _spec_from_titles(table, list(inputs), truth, time)
    u = [table.read(channel.name)[0] for channel in spec.inputs]
    y = [table.read(channel.name)[0] for channel in spec.outputs]
    x = np.column_stack([table.read_any(title) for title in truth]) if truth else None
    n = len(time)
    return Trajectory(time, np.column_stack(u) if u else np.zeros((n, 0)), np.column_stack(y), spec, x)


def stored_spec(path: str | Path, titles: Sequence[str]) -> PlantSpec | None:
    """Return what :func:`write_trajectory` said of a table with these titles; None where nothing is said of them."""
    path = Path(path)
    try:
        found = [_spec_from_dict(content) for content in _stored(path)]
    except (InputError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(
            "what the record says of its channels", expected="what sysid wrote", got=f"{type(error).__name__}: {error}",
            remedy="take a copy that is whole", file=_beside(path) if path.suffix.lower() == ".csv" else path,
        ) from error  # fmt: skip
    names = {split_header(title)[0] for title in titles}
    known = [spec for spec in found if names >= {channel.name for channel in (*spec.inputs, *spec.outputs)}]
    return known[0] if known else None  # the table may be another one by now


def _stored(path: Path) -> list[Any]:
    """Return the JSON in the metadata of a Parquet file, or beside a CSV file; nothing where there is none of ours."""
    if path.suffix.lower() == ".csv" and _beside(path).is_file():
        notes = json.loads(_beside(path).read_text(encoding="utf-8")).get("notes", [])  # other tools write it too
        return [note[_KEY] for note in notes if isinstance(note, dict) and _KEY in note]
    if path.suffix.lower() != ".parquet":
        return []
    import pyarrow.parquet as pq

    try:
        metadata = pq.read_schema(path).metadata or {}
    except Exception:
        return []  # the reader of the table words the refusal
    return [json.loads(text) for key, text in metadata.items() if key == _KEY.encode()]


def _spec_from_titles(table: Table, inputs: list[str], truth: list[str], time: FloatArray) -> PlantSpec:
    """Return the spec that the titles of a CSV file amount to."""

    def channel(title: str) -> Channel:
        name, unit = split_header(title)
        count = stated_categories(unit or "1")
        return Channel(name, unit or "1") if count is None else Channel(name, "1", 0, count - 1, kind="category")

    titles = [title for title in table.titles if split_header(title)[0] != "time" and not title.startswith(REFERENCE)]
    for name in inputs:
        if table.find(name) is None:
            raise table.missing(name)
    chosen = [title for title in titles if split_header(title)[0] in inputs]
    others = [title for title in titles if title not in chosen]
    if len(time) < 2:
        raise InputError(
            "one sample", expected="at least two rows", got=str(len(time)), remedy="give spec", file=table.path
        )
    return PlantSpec(
        tuple(map(channel, chosen)),
        tuple(map(channel, others)),
        float(f"{(time[-1] - time[0]) / (len(time) - 1):.12g}"),
        tuple(channel(title.removeprefix(TRUTH)) for title in truth),
    )


def _spec_to_dict(spec: PlantSpec) -> dict[str, Any]:
    """Return a spec with its states as JSON has it."""
    return {**spec_to_dict(spec), "states": list(map(channel_to_dict, spec.states))}


def _spec_from_dict(content: dict[str, Any]) -> PlantSpec:
    """Return the spec of its JSON form."""
    return replace(spec_from_dict(content), states=tuple(map(channel_from_dict, content["states"])))
