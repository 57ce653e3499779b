"""The records of a study for anybody's tool: data and nominal models in one folder, the truth in another.

Names of records tell nothing. Records of the seeds ``tuning`` and ``judged`` can be made again by anyone who has this
project; with a secret number, only by who knows it. Each record is a job of :func:`harness.jobs.run_jobs`: what ends a
run loses the records at work, and one that breaks its worker is said by name.
"""

from __future__ import annotations

import csv
import hashlib
import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.data.whole_files import whole_file, write_json
from harness.errors import InputError, PlantError
from harness.fingerprint import own_code
from harness.jobs import Desk, run_jobs, shard_file
from harness.jobs.alone import alone_in
from harness.jobs.progress import Progress
from sysid_lab.folder import write_record
from sysid_lab.plan import BASES, PLANTS, Task, plan
from sysid_lab.records import SAMPLES, make_records
from sysid_lab.store import read_rows

TABLE, TRUTH = "records.csv", "truth.csv"
SETTINGS, SHARDS, LOG = "generate.json", "shards", "generate.log"
FORMAT = "sysid-lab/sysid_lab-records/1"
TIME_LIMIT = 300.0  # Seconds for one record: a hundred times what the slowest engine takes for 20 s of data.
TRUTH_COLUMNS = (
    "record",
    "study",
    "plant",
    "engine",
    "truth",
    "level",
    "noise",
    "disturbance",
    "index",
    "base",
    "sizes",
    "structure",
)
SECRET_FROM = 300_000
"""Secret bases begin here: what lies below is for tuning and for the project's own judged records."""
README = """# Records for a tool that says what a model lacks

Each folder below `records/` is one case: `estimation.csv` and `validation.csv` (20 s at 250 Hz, positions only) and a
`dataset.toml` that names columns, units and the nominal model (`sysid list pendulum`, `sysid list cart-pole`; both have
viscous friction). Something may be missing from the model, or nothing.

Answer with a CSV file, one line a record:

- `record`: its name, as in `records.csv`.
- `verdict`: `effects_found`, `nothing_missing` or `unexplained` (something is missing, and no cause is named).
- `effects`: what is missing, `EFFECT@PLACE`, several joined by ` + `; names as in `sysid list effects`, places are
  the coordinates (`theta`, `x`), the input (`u`) and the `base`.
- `ties` (may be left out): for each effect what the data cannot tell from it, joined by ` / `; a set of two effects by
  ` & `; the effects apart by `; `.
- `unseen` (may be left out): effects that the record cannot show, joined by ` + `.
- `stand_in` (may be left out): `yes` where the effects only imitate something else.

`sysid-lab score TRUTH ANSWERS.csv ...` judges; a record without a line counts as not answered. `sysid close-loop
records.csv --out RUN` and `sysid-lab answer RUN -o ANSWERS.csv` is how sysid-harness answers.
"""


@dataclass(frozen=True)
class Package:
    """What was generated.

    ``failed`` are tasks whose truth could not be simulated, with the reason; they are no part of the package.
    """

    records: Path
    truth: Path
    made: int
    failed: tuple[tuple[str, str], ...]

    def __str__(self) -> str:
        planned = self.made + len(self.failed)
        lines = [f"{self.made} of {planned} records in {self.records}, their truth in {self.truth}"]
        return "\n".join(lines + [f"left out: {key}: {reason}" for key, reason in self.failed])


def record_name(key: str) -> str:
    """Return the name of a record, which tells nothing of what is in it.

    Examples
    --------
    >>> record_name("none|pendulum|laws|none||low|0|0|0")
    'r-dc1d761f4d'
    """
    return "r-" + hashlib.sha256(key.encode()).hexdigest()[:10]


def base_of(seeds: str, secret: int | None = None) -> int:
    """Return the base of the random numbers.

    Raises
    ------
    InputError
        If the word is unknown, or the secret number belongs to somebody.
    """
    if secret is not None:
        if secret < SECRET_FROM:
            raise InputError(
                "secret number", expected=f"at least {SECRET_FROM}", got=str(secret), remedy="choose a large one"
            )
        return secret
    if seeds not in BASES:
        raise InputError("seeds", expected=" or ".join(BASES), got=repr(seeds), remedy="correct it")
    return BASES[seeds]


@dataclass(frozen=True)
class RecordFiles:
    """The files of one record as a batch of one job; see :class:`harness.jobs.JobBatch`.

    Its row is that of ``truth.csv``, or ``{"failed": REASON}``.

    Parameters
    ----------
    task : Task
    folder : Path
        Of all records.
    samples : int
        Of one run.
    """

    task: Task
    folder: Path
    samples: int

    @property
    def name(self) -> str:
        """Name of the record."""
        return record_name(self.task.key)

    @property
    def title(self) -> str:
        """What the progress calls it."""
        return self.task.plant

    @property
    def jobs(self) -> tuple[str, ...]:
        """The one job."""
        return (self.name.removeprefix("r-"),)

    @property
    def time_limit(self) -> float:
        """Seconds for the record."""
        return TIME_LIMIT

    def only(self, jobs: Sequence[str]) -> RecordFiles:
        """Return the batch: it has one job only."""
        return self

    def lost(self, job: str, status: str, reason: str, *, shared: bool) -> bytes:
        """Return the row of a record that broke its worker."""
        return _failed(f"the simulation {reason}" if status == "timeout" else reason)

    def work(self, desk: Desk) -> None:
        """Simulate the record and write its files, then its row."""
        (job,) = self.jobs
        with desk.job(job):
            try:
                made = make_records(self.task, samples=self.samples)
            except PlantError as error:
                desk.put(job, _failed(" ".join(str(error).split())))
                return
            write_record(self.folder / self.name, self.name, self.task, made)
            sizes = {f"{hidden.name}@{hidden.at}": hidden.named or hidden.truth for hidden in made.hidden}
            columns = self.task.columns() | {"record": self.name, "sizes": json.dumps(made.parameters | sizes)}
            desk.put(job, json.dumps({column: str(columns[column]) for column in TRUTH_COLUMNS}).encode())


def generate(
    out: str | Path,
    *,
    truth: str | Path,
    seeds: str = "judged",
    secret: int | None = None,
    records: int | None = None,
    plants: Sequence[str] = PLANTS,
    cells: int = 4,
    alarms: int = 400,
    samples: int = SAMPLES,
    like: str | Path | None = None,
    workers: int | None = None,
    resume: bool = False,
    force: bool = False,
    progress: Callable[[int, int, str], None] | None = None,
) -> Package:
    """Write the records of a study for others, the truth apart.

    Parameters
    ----------
    out : path
        Folder for ``records.csv``, ``README.md`` and ``records/NAME``.
    truth : path
        Folder for ``truth.csv``, not within ``out``; also for the rows of a run that is not finished, and a log.
    seeds : {"judged", "tuning"}
    secret : int, optional
        Instead of them: a number that only the judge knows.
    records : int, optional
        Only the first so many of the plan, which is ordered so that any first part is balanced.
    plants, cells, alarms, samples
        See :func:`sysid_lab.study`.
    like : path, optional
        ``rows.csv`` of a study: only the records that it has rows of.
    workers : int, optional
        Processes; by default one for each core. The records are the same for any number.
    resume : bool
        Keep the records that are there and make the others.
    force : bool
        Make all anew.
    progress : callable, optional
        Called as ``progress(done, planned, what)``.

    Raises
    ------
    InputError
        If an option cannot be used, the truth would lie among the records, or the folder of the truth holds records and
        neither ``resume`` nor ``force`` is given.
    """
    folder, apart = Path(out).resolve(), Path(truth).resolve()
    if apart == folder or folder in apart.parents:
        raise InputError("folder of the truth", expected=f"one outside {folder}", got=str(apart), remedy="choose it")
    base = base_of(seeds, secret)
    tasks = [task for task in plan("all", base=base, plants=plants, cells=cells, alarms=alarms) if task.study != "cost"]
    if like is not None:
        wanted = read_rows(Path(like))
        tasks = [task for task in tasks if task.key in wanted]
    tasks = tasks[:records]
    if not tasks:
        raise InputError("records of a study", expected="at least one", got="none", remedy="ask for more")
    batches = [RecordFiles(task, folder / "records", samples) for task in tasks]
    settings = {"format": FORMAT, "code": own_code(), "base": base, "samples": samples}
    with alone_in(apart), alone_in(folder):
        found = _opened(apart, settings, batches, resume=resume, force=force)
        (folder / "records").mkdir(parents=True, exist_ok=True)
        shards = apart / SHARDS
        counted = Progress(apart / LOG, len(batches), len(found), progress)
        keys = {batch.jobs[0]: batch.task.key for batch in batches}

        def moved(title: str, jobs: Sequence[str]) -> None:
            rows = {job: _row(shards, job) for job in jobs}
            counted(title, [(_status(row), f"{keys[job]}{_why(row)}") for job, row in rows.items()])

        if progress is not None:
            progress(len(found), len(batches), "")
        run_jobs([batch for batch in batches if batch.name not in found], shards, workers=workers, moved=moved)
        rows = {batch.name: found.get(batch.name) or _row(shards, batch.jobs[0]) for batch in batches}
        failed = tuple((b.task.key, rows[b.name]["failed"]) for b in batches if "failed" in rows[b.name])
        written = [row for row in rows.values() if "failed" not in row]
        _write_csv(apart / TRUTH, TRUTH_COLUMNS, [[row[column] for column in TRUTH_COLUMNS] for row in written])
        places = sorted((f"records/{row['record']}/dataset.toml", row["plant"]) for row in written)
        _write_csv(folder / TABLE, ("file", "machine"), places)
        (folder / "README.md").write_text(README, encoding="utf-8")
        shutil.rmtree(shards, ignore_errors=True)
        return Package(folder, apart / TRUTH, len(written), failed)


def _opened(
    apart: Path, settings: dict[str, Any], batches: Sequence[RecordFiles], *, resume: bool, force: bool
) -> dict[str, dict[str, str]]:
    """Make the folder of the truth ready; return the rows of the records that are there, by record."""
    manifest, shards = apart / SETTINGS, apart / SHARDS
    if force:
        shutil.rmtree(shards, ignore_errors=True)
    elif manifest.exists() or (apart / TRUTH).exists():
        if not resume:
            raise InputError(
                "the folder holds the truth of records",
                expected="a new folder",
                got="one with records",
                remedy="--resume continues it, --force begins anew",
                file=apart,
            )
        old = json.loads(manifest.read_text(encoding="utf-8")) if manifest.exists() else None
        if old != settings:
            raise InputError(
                "the folder holds the truth of other records",
                expected="the seeds, samples and code that it was begun with",
                got="others",
                remedy="choose other folders, or begin anew with --force",
                file=apart,
            )
    shards.mkdir(parents=True, exist_ok=True)
    write_json(manifest, settings)
    if force:
        return {}
    known: dict[str, dict[str, str]] = {}
    if (apart / TRUTH).exists():
        with (apart / TRUTH).open(newline="", encoding="utf-8") as file:
            known = {row["record"]: row for row in csv.DictReader(file)}
    for batch in batches:
        if shard_file(shards, batch.jobs[0]).exists():
            known[batch.name] = _row(shards, batch.jobs[0])
    return {
        batch.name: known[batch.name]
        for batch in batches
        if "failed" not in known.get(batch.name, {"failed": ""})
        and (batch.folder / batch.name / "dataset.toml").is_file()
    }


def _row(shards: Path, job: str) -> dict[str, str]:
    """Return the row of a record that has run."""
    row: dict[str, str] = json.loads(shard_file(shards, job).read_bytes())
    return row


def _failed(reason: str) -> bytes:
    """Return the row of a record that could not be made."""
    return json.dumps({"failed": reason[:400]}).encode()


def _status(row: dict[str, str]) -> str:
    return "failed" if "failed" in row else "ok"


def _why(row: dict[str, str]) -> str:
    return f": {row['failed']}" if "failed" in row else ""


def _write_csv(path: Path, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Write a table whole or not at all."""
    with whole_file(path) as scratch, scratch.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)
