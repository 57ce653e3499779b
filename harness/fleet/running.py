"""The call ``close_fleet``: the closed loop on many records as jobs, their rows, tables and page."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from harness.data.whole_files import write_text
from harness.errors import UNREADABLE, InputError
from harness.fleet.changes import Change, Odd, changes, odd_machines
from harness.fleet.page import fleet_page, written
from harness.fleet.records import find_records
from harness.fleet.row import FleetRow
from harness.fleet.store import FleetStore, read_shard
from harness.fleet.trends import New, Trend, new_effects, series_of, trends
from harness.fleet.work import RecordJob
from harness.jobs import make_engine, run_jobs, shard_file
from harness.jobs.alone import alone_in
from harness.jobs.progress import Progress
from harness.scoring.acceptance import Demand, Demands
from harness.units import behind

TIME_LIMIT = 1800.0
"""Seconds for one record: ten times what the slowest model of the project takes for 20 s of data (an FMU, 180 s)."""


@dataclass(frozen=True, eq=False)
class FleetResult:
    """What the closed loop said of a fleet.

    Parameters
    ----------
    folder : Path
        With ``records.parquet``, ``effects.parquet``, ``fleet.html`` and a report for each record.
    rows : tuple of Row
        In the order of the records.
    planned : int
        Records that were asked for.
    """

    folder: Path
    rows: tuple[FleetRow, ...]
    planned: int

    @property
    def page(self) -> Path:
        """The page to read."""
        return FleetStore(self.folder).page

    @property
    def new(self) -> list[New]:
        """Where effects begin."""
        return new_effects(self.rows)

    @property
    def changes(self) -> list[Change]:
        """Where sizes change between dates, whatever the shape, with their test."""
        return changes(self.rows)

    @property
    def odd(self) -> list[Odd]:
        """Machines that are not as the others."""
        return odd_machines(self.rows)

    @property
    def trends(self) -> list[Trend]:
        """How sizes change with the date."""
        return trends(series_of(self.rows))

    def checks(self, demands: Demands) -> list[Demand]:
        """Return the checks of each record, passed or not; a record without an answer passes none.

        Parameters
        ----------
        demands : harness.scoring.acceptance.Demands

        Raises
        ------
        InputError
            If the report of a record is not there any more, or damaged.
        """
        found: list[Demand] = []
        if not demands.anything:
            return found
        reports = FleetStore(self.folder).reports
        for row in self.rows:
            if row.ok:
                found += demands.of_report(row.record, _report(reports / row.record / "report.json"))
            else:
                found.append(Demand(row.record, "answer", False, f"{row.status}: {row.reason}", broken=True))
        return found

    def to_records(self) -> list[dict[str, Any]]:
        """Return the rows as plain dictionaries, ready for JSON."""
        return [msgspec.to_builtins(row) for row in self.rows]

    def __str__(self) -> str:
        counts = Counter(row.verdict.replace("_", " ") if row.ok else row.status for row in self.rows)
        lines = [
            f"{len(self.rows)} of {self.planned} records: " + ", ".join(f"{n} {w}" for w, n in counts.most_common())
        ]
        found = Counter(effect.name for row in self.rows for effect in row.effects)
        lines += [f"{name}: in {count} records" for name, count in found.most_common()]
        for one in self.new:
            where = f"{one.machine}, " if one.machine else ""
            what = f"another law, after {', '.join(one.before)}" if one.before else "new"
            lines.append(f"{what}: {one.effect.name} in {one.row.record} ({where}{one.row.day}), {written(one.effect)}")
        lines += [f"new: {change}" for change in self.changes]
        lines += [str(odd) for odd in self.odd]
        for trend in self.trends:
            if trend.word != "no trend":
                name, unit = f"{trend.series.effect} {trend.series.parameter}", behind(trend.series.unit)
                where = f" on {trend.machine}" if trend.machine else ""
                lines.append(
                    f"{trend.word}: {name}{where} by {trend.slope:.3g} [{trend.low:.3g}, {trend.high:.3g}]{unit} a day"
                )
        return "\n".join(lines)


def close_fleet(
    source: str | Path,
    *,
    out: str | Path,
    model: str | None = None,
    undriven: Sequence[str] = (),
    engine: str = "local",
    workers: int | None = None,
    time_limit: float = TIME_LIMIT,
    resume: bool = False,
    progress: Callable[[int, int, str], None] | None = None,
) -> FleetResult:
    """Close the loop on every record of a fleet; a record that breaks is a row with its reason.

    Parameters
    ----------
    source : path or str
        A folder of records, a pattern (``"runs/*.csv"``), or a CSV table with the column ``file`` and perhaps
        ``machine``, ``date`` (ISO 8601) and ``validation``.
    out : path
        Folder for ``records.parquet``, ``effects.parquet``, ``fleet.html``, ``fleet.log`` and the reports. Workers of
        a cluster must reach it, and the records, under the same paths.
    model : str, optional
        Nominal model, where the records do not name one; see :func:`harness.api.close_loop`.
    undriven : sequence of str
        Inputs of the model that nothing drove.
    engine : str
        ``"local"`` or ``"dask://HOST:PORT"``.
    workers : int, optional
        Processes of the local engine, a record each; by default one for each core.
    time_limit : float
        Seconds after which a record is given up.
    resume : bool
        Keep the rows of the folder and do the others; records whose files changed are done again.
    progress : callable, optional
        Called as ``progress(rows_done, rows, what)``.

    Raises
    ------
    InputError
        If there are no records, or the folder or an option cannot be used.
    """
    if not time_limit > 0:
        raise InputError("time limit", expected="seconds above 0", got=str(time_limit), remedy="raise it")
    records = find_records(source)
    made = make_engine(engine, workers)
    store = FleetStore(Path(out).absolute())
    batches = [RecordJob(record, store.reports, _absolute(model), tuple(undriven), time_limit) for record in records]
    settings = {"model": model, "undriven": list(undriven)}
    with alone_in(store.folder):
        found = store.open([batch.job for batch in batches], settings, resume=resume)
        todo = [batch for batch in batches if batch.job not in found]
        counted = Progress(store.log, len(batches), len(found), progress)

        def moved(title: str, jobs: Sequence[str]) -> None:
            rows = [read_shard(shard_file(store.shards, job)) for job in jobs]
            counted(title, [(row.status, _logged(row)) for row in rows])

        if progress is not None:
            progress(len(found), len(batches), "")
        try:
            run_jobs(todo, store.shards, engine=made, moved=moved)
        except BaseException:
            with suppress(OSError, InputError):  # what ended the run is what is said
                store.consolidate(finished=False)
            raise
        return _shown(store, store.consolidate(finished=True))


def fleet_table(directory: str | Path) -> FleetResult:
    """Read a fleet back, finished or not, and render its page anew.

    Raises
    ------
    InputError
        If the folder holds no fleet.
    """
    store = FleetStore(Path(directory))
    store.manifest()
    return _shown(store, store.in_order())


def _report(path: Path) -> dict[str, Any]:
    """Return the report of a record, for what is demanded of it."""
    try:
        data: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        str(data["verdict"]), dict(data["errors"]["after"])  # what every demand asks for
    except (*UNREADABLE, KeyError, TypeError) as error:
        raise InputError(
            "the report of a record",
            expected="report.json as sysid close-loop wrote it",
            got=f"{type(error).__name__}: {error}"[:120],
            remedy="take a copy of the folder that is whole, or run the fleet anew into a new folder",
            file=path,
        ) from error
    return data


def _shown(store: FleetStore, rows: Sequence[FleetRow]) -> FleetResult:
    """Write the page."""
    content = store.manifest()
    page = fleet_page(
        rows, planned=len(content["jobs"]), model=content["settings"]["model"] or "models of the records",
        reports=store.reports.name,
    )  # fmt: skip
    write_text(store.page, page)
    return FleetResult(store.folder, tuple(rows), len(content["jobs"]))


def _absolute(model: str | None) -> str | None:
    """Return a model whose file is found from any folder."""
    if model is None:
        return None
    name, colon, rest = model.partition(":") if ".py:" in model else (model, "", "")
    return f"{Path(name).absolute()}{colon}{rest}" if Path(name).is_file() else model


def _logged(row: FleetRow) -> str:
    """Return what the log says of a row."""
    answer = " + ".join(effect.name for effect in row.effects) or row.verdict or row.reason
    return f"{row.record} {row.seconds:.1f} s: {answer}"
