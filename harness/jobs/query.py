"""Questions in SQL over tables of rows; answers for pandas, polars or a file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.data.whole_files import whole_file
from harness.errors import InputError
from harness.extras import optional


@dataclass(frozen=True, eq=False)
class QueryResult:
    """What a query found.

    Parameters
    ----------
    table : pyarrow.Table
        Its columns; ``pyarrow`` readers (pandas, polars, DuckDB) take it without a copy.
    """

    table: Any

    @property
    def columns(self) -> list[str]:
        """Names of the columns."""
        return list(self.table.column_names)

    def __len__(self) -> int:
        return int(self.table.num_rows)

    def narrow(self) -> QueryResult:
        """Return the answer without columns of lists and those without any value, for a reader."""
        import pyarrow as pa

        kept = [
            name
            for name in self.columns
            if not pa.types.is_nested(self.table.schema.field(name).type)
            and any(value not in (None, "") for value in self.table.column(name).unique().to_pylist())
        ]
        return QueryResult(self.table.select(kept))

    def records(self) -> list[dict[str, Any]]:
        """Return the rows as dictionaries."""
        return list(self.table.to_pylist())

    def pandas(self) -> Any:
        """Return a pandas data frame (needs pandas)."""
        return self.table.to_pandas()

    def polars(self) -> Any:
        """Return a polars data frame (needs polars)."""
        import polars

        return polars.from_arrow(self.table)

    def write(self, path: str | Path, *, force: bool = False) -> None:
        """Write a CSV or Parquet file.

        Raises
        ------
        InputError
            If the name ends otherwise, the file exists and ``force`` is not given, or a column cannot be in a CSV.
        """
        target = Path(path)
        if target.exists() and not force:
            raise InputError(
                "file exists",
                expected="a new file",
                got="an old one",
                remedy="choose another or give --force",
                file=target,
            )
        if target.suffix not in (".csv", ".parquet"):
            raise InputError(
                "file for an answer", expected=".csv or .parquet", got=target.name, remedy="rename it", file=target
            )
        import pyarrow as pa
        from pyarrow import csv, parquet

        nested = [field.name for field in self.table.schema if pa.types.is_nested(field.type)]
        if nested and target.suffix == ".csv":
            raise InputError(
                "columns of a CSV",
                expected="one value in each cell",
                got=f"lists in {', '.join(nested)}",
                remedy="select other columns, unnest them, or write .parquet",
            )
        with whole_file(target) as scratch:
            (csv.write_csv if target.suffix == ".csv" else parquet.write_table)(self.table, scratch)


def filtered(tables: Mapping[str, Any], filters: Mapping[str, Any]) -> dict[str, Any]:
    """Return the rows of Arrow tables in which columns have given values; a table without the column keeps all.

    Raises InputError if no table has a column, or a text is no value of it.

    - ``tables``: name to table
    - ``filters``: column to value, or to its text

    Examples
    --------
    >>> import pyarrow as pa
    >>> rows = pa.table({"seed": [0, 1, 1], "status": ["ok", "ok", "unfit"]})
    >>> filtered({"rows": rows}, {"status": "ok", "seed": "1"})["rows"].to_pylist()
    [{'seed': 1, 'status': 'ok'}]
    """
    import pyarrow as pa
    from pyarrow import compute

    chosen = dict(tables)
    for column, value in filters.items():
        known = {name: table for name, table in chosen.items() if column in table.column_names}
        if not known:
            columns = dict.fromkeys(name for table in tables.values() for name in table.column_names)
            raise InputError(
                "no such column",
                expected=f"a column: {', '.join(columns)}",
                got=repr(column),
                remedy="correct it",
                place="filter",
            )
        for name, table in known.items():
            kind = table.schema.field(column).type
            try:
                wanted = pa.scalar(value).cast(kind)
            except pa.ArrowException as error:  # no such value of this type, or pyarrow has no such cast
                raise InputError(
                    f"filter {column}", expected=f"a value of type {kind}", got=repr(value), remedy="correct it",
                    place="filter",
                ) from error  # fmt: skip
            chosen[name] = table.filter(compute.equal(table.column(column), wanted))
    return chosen


def ask(tables: Mapping[str, Any], sql: str | None = None, filters: Mapping[str, Any] | None = None) -> QueryResult:
    """Ask Arrow tables.

    Raises InputError if a filter or the query cannot be used, or DuckDB is not installed.

    - ``tables``: name to table
    - ``sql``: duckDB's SQL. Files on this machine are not within its reach. Without it the answer is the first table.
    - ``filters``: column to value; see :func:`filtered`

    Examples
    --------
    >>> import pyarrow as pa
    >>> ask({"rows": pa.table({"size": [1.0, 3.0]})}, "select avg(size) as mean from rows").records()
    [{'mean': 2.0}]
    """
    tables = filtered(tables, filters or {})
    if sql is None:
        return QueryResult(next(iter(tables.values())))
    duckdb = optional("duckdb", "a query", "'sysid-harness[query]'")

    connection = duckdb.connect()
    try:
        for name, table in tables.items():
            connection.register(name, table)
        connection.execute("set enable_external_access = false")
        found = connection.sql(sql)
        if found is None:
            raise InputError("query", expected="a SELECT", got="a statement", remedy="ask for rows", place="sql")
        return QueryResult(found.to_arrow_table())
    except duckdb.Error as error:
        raise InputError(
            "query",
            expected=f"SQL over {', '.join(tables)}",
            got=" ".join(str(error).split()),
            remedy="correct it",
            place="sql",
        ) from error
    finally:
        connection.close()
