"""Questions in SQL over tables of rows; answers for pandas, polars or a file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.data.binary_files import optional
from harness.errors import InputError

__all__ = ["Answer", "ask"]


@dataclass(frozen=True, eq=False)
class Answer:
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
        scratch = target.with_name(target.name + ".part")
        if target.suffix == ".parquet":
            from pyarrow import parquet

            parquet.write_table(self.table, scratch)
        elif target.suffix == ".csv":
            import pyarrow as pa
            from pyarrow import csv

            nested = [field.name for field in self.table.schema if pa.types.is_nested(field.type)]
            if nested:
                raise InputError(
                    "columns of a CSV",
                    expected="one value in each cell",
                    got=f"lists in {', '.join(nested)}",
                    remedy="select other columns, unnest them, or write .parquet",
                )
            csv.write_csv(self.table, scratch)
        else:
            raise InputError(
                "file for an answer", expected=".csv or .parquet", got=target.name, remedy="rename it", file=target
            )
        scratch.replace(target)


def ask(tables: Mapping[str, Any], sql: str) -> Answer:
    """Ask Arrow tables.

    Parameters
    ----------
    tables : mapping
        Name to table.
    sql : str
        DuckDB's SQL. Files on this machine are not within its reach.

    Raises
    ------
    InputError
        If DuckDB refuses the query.

    Examples
    --------
    >>> import pyarrow as pa
    >>> ask({"rows": pa.table({"size": [1.0, 3.0]})}, "select avg(size) as mean from rows").records()
    [{'mean': 2.0}]
    """
    duckdb = optional("duckdb", "a query", "'sysid-harness[query]'")

    connection = duckdb.connect()
    try:
        for name, table in tables.items():
            connection.register(name, table)
        connection.execute("set enable_external_access = false")
        found = connection.sql(sql)
        if found is None:
            raise InputError("query", expected="a SELECT", got="a statement", remedy="ask for rows", place="sql")
        return Answer(found.to_arrow_table())
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
