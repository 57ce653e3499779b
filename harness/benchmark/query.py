"""Questions in SQL over the stored rows of a benchmark, finished or not; answers for pandas, polars or a file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.benchmark.store import Store
from harness.data.binary_files import optional
from harness.errors import InputError

__all__ = ["Answer", "query"]

TABLES = ("results", "timings", "regret")


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


def query(directory: str | Path, sql: str) -> Answer:
    """Ask the stored rows of a benchmark.

    Parameters
    ----------
    directory : path
        Folder that ``bench`` wrote or is writing: rows of an unfinished run are part of the answer.
    sql : str
        DuckDB's SQL over the tables ``results`` (a row for each cell), ``timings`` and ``regret``. Files on this
        machine are not within its reach.

    Returns
    -------
    Answer

    Raises
    ------
    InputError
        If the folder holds no benchmark, DuckDB refuses the query, or the extra ``query`` is not installed.
    """
    duckdb = optional("duckdb", "a query", "'sysid-harness[query]'")
    store = Store(Path(directory))
    if store.shares():
        store.merge()
    store.read_manifest()
    connection = duckdb.connect()
    try:
        for name, table in zip(TABLES, store.arrow(), strict=True):
            connection.register(name, table)
        connection.execute("set enable_external_access = false")
        found = connection.sql(sql)
        if found is None:
            raise InputError("query", expected="a SELECT", got="a statement", remedy="ask for rows", place="sql")
        return Answer(found.to_arrow_table())
    except duckdb.Error as error:
        raise InputError(
            "query",
            expected=f"SQL over {', '.join(TABLES)}",
            got=" ".join(str(error).split()),
            remedy="correct it",
            place="sql",
        ) from error
    finally:
        connection.close()
