"""What a worker does with a record: close the loop on it, keep its report, write its row."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, cast

from harness import registry
from harness.data.recipe.description import read_description
from harness.data.recipe.ports import located_model
from harness.errors import HarnessError
from harness.fingerprint import fingerprint, own_code
from harness.fleet.records import FleetRecord
from harness.fleet.row import blank, encoded, fill
from harness.jobs import Desk
from harness.jobs.batch import described
from harness.jobs.room import raise_if_full


@dataclass(frozen=True)
class RecordJob:
    """One record as a batch of one job; see :class:`harness.jobs.JobBatch`.

    Parameters
    ----------
    record : FleetRecord
    reports : Path
        Folder of the reports, which every worker can reach; the record's own is below it.
    model : str, optional
    undriven : tuple of str
    time_limit : float
        Seconds.
    """

    record: FleetRecord
    reports: Path
    model: str | None
    undriven: tuple[str, ...]
    time_limit: float

    @property
    def title(self) -> str:
        """What the progress calls it."""
        return self.record.name

    @cached_property
    def job(self) -> str:
        """A hash of the data, of the files that they and the model name, and of all else that decides the answer."""
        files = [path for path in self._files() if path.is_file()]
        return fingerprint(own_code(), self.record.name, self.model, self.undriven, files)[:20]

    def _files(self) -> list[Path]:
        """Return the files that decide the answer: the record's, those that a data set names, and that of the model."""
        found = [path for path in (self.record.file, self.record.validation) if path is not None]
        model, folder = self.model, Path.cwd()
        if self.record.file.suffix == ".toml":
            try:
                read = read_description(self.record.file)
            except HarnessError:
                return found  # the row will say so
            found += [self.record.file.parent / file for run in read.runs for file in run.files]
            if model is None and read.nominal is not None:
                model, folder = read.nominal.model, self.record.file.parent
        if model is None:
            return found
        file, python, _ = located_model(model, folder).partition(".py:")
        return [*found, Path(file + python.rstrip(":"))]

    @property
    def jobs(self) -> tuple[str, ...]:
        """The one job."""
        return (self.job,)

    def only(self, jobs: Sequence[str]) -> RecordJob:
        """Return the batch: it has one job only."""
        return self

    def lost(self, job: str, status: str, reason: str, *, shared: bool) -> bytes:
        """Return the row of a record that broke its worker."""
        text = f"the diagnosis {reason}" if status == "timeout" else reason
        return encoded(blank(self.record, job, status=status, reason=text))

    def work(self, desk: Desk) -> None:
        """Close the loop on the record."""
        from harness import diagnosis
        from harness.data import load_dataset

        job = self.job
        row = blank(self.record, job)
        started = time.perf_counter()
        with desk.job(job):
            try:
                loaded: Any = load_dataset(
                    registry.dataset_path(self.record.file),
                    model=self.model,
                    validation=self.record.validation,
                    undriven=self.undriven,
                )
                report = diagnosis.close_loop_file(cast(Any, loaded), out=self.reports / self.record.name, resume=True)
                fill(row, report.data)
            except HarnessError as error:
                raise_if_full(error)
                row.status, row.reason = error.status, " ".join(str(error).split())[:400]
            except BaseException as error:  # a fault on one record is a row, and the others go on
                raise_if_full(error)
                row.status, row.reason = "crashed", " ".join(described(error).split())[:400]
        row.seconds = time.perf_counter() - started
        desk.put(job, encoded(row))
