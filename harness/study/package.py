"""The records of a study for anybody's tool: data and nominal models in one folder, the truth in another.

Names of records tell nothing. Records of the seeds ``tuning`` and ``judged`` can be made again by anyone who has this
project; with a secret number, only by who knows it.
"""

from __future__ import annotations

import csv
import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from harness.data.whole_files import whole_file
from harness.errors import InputError, PlantError
from harness.study.folder import write_record
from harness.study.plan import BASES, PLANTS, plan
from harness.study.records import SAMPLES, make_records
from harness.study.store import read_rows

__all__ = ["TRUTH_COLUMNS", "Package", "base_of", "generate", "record_name"]

TABLE, TRUTH = "records.csv", "truth.csv"
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
)
SECRET_FROM = 200_000
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

`sysid study score TRUTH ANSWERS.csv ...` judges; a record without a line counts as not answered. `sysid close-loop
records.csv --out RUN` and `sysid study answer RUN -o ANSWERS.csv` is how sysid-harness answers.
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
        lines = [f"{self.made} records in {self.records}, their truth in {self.truth}"]
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
    progress: Callable[[int, int, str], None] | None = None,
) -> Package:
    """Write the records of a study for others, the truth apart.

    Parameters
    ----------
    out : path
        Folder for ``records.csv``, ``README.md`` and ``records/NAME``; what is there is written again, and is the same.
    truth : path
        Folder for ``truth.csv``, not within ``out``.
    seeds : {"judged", "tuning"}
    secret : int, optional
        Instead of them: a number that only the judge knows.
    records : int, optional
        Only the first so many of the plan, which is ordered so that any first part is balanced.
    plants, cells, alarms, samples
        See :func:`harness.study.study`.
    like : path, optional
        ``rows.csv`` of a study: only the records that it has rows of.
    progress : callable, optional
        Called as ``progress(done, planned, what)``.

    Raises
    ------
    InputError
        If an option cannot be used, or the truth would lie among the records.
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
    (folder / "records").mkdir(parents=True, exist_ok=True)
    apart.mkdir(parents=True, exist_ok=True)
    rows, failed = [], []
    for number, task in enumerate(tasks):
        if progress is not None:
            progress(number, len(tasks), task.plant)
        try:
            made = make_records(task, samples=samples)
        except PlantError as error:
            failed.append((task.key, " ".join(str(error).split())))
            continue
        name = record_name(task.key)
        write_record(folder / "records" / name, name, task, made)
        sizes = {f"{hidden.name}@{hidden.at}": hidden.named or hidden.truth for hidden in made.hidden}
        columns = task.columns() | {"record": name, "sizes": json.dumps(made.parameters | sizes)}
        rows.append([str(columns[column]) for column in TRUTH_COLUMNS])
    _write_csv(apart / TRUTH, TRUTH_COLUMNS, rows)
    places = sorted((f"records/{row[0]}/dataset.toml", row[TRUTH_COLUMNS.index("plant")]) for row in rows)
    _write_csv(folder / TABLE, ("file", "machine"), places)
    (folder / "README.md").write_text(README, encoding="utf-8")
    return Package(folder, apart / TRUTH, len(rows), tuple(failed))


def _write_csv(path: Path, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Write a table whole or not at all."""
    with whole_file(path) as scratch, scratch.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)
