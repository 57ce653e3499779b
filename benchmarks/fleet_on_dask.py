"""The loop over a fleet on two local dask workers: four machines, one whose friction grows, one where it begins.

Run ``OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/fleet_on_dask.py [RECORDS] [FOLDER]``. Records are one
joint in PyBullet with Bullet's own joint friction (20 s at 50 Hz, noise 1 mrad), so the truth is somebody else's. Each
run continues what FOLDER has. Checked here: every record is one row, the friction of machine A grows, and machine C's
is named in a record from the one on that has it.
"""

from __future__ import annotations

import csv
import sys
import tempfile
import time
from datetime import date, timedelta
from pathlib import Path

from harness import api
from harness.fleet import close_fleet, query

MACHINES = {
    "A": lambda share: 0.05 + 0.10 * share,
    "B": lambda share: 0.10,
    "C": lambda share: 0.0 if share < 0.5 else 0.08,
    "D": lambda share: 0.0,
}
"""Joint friction [N m] against the share of the time that has gone by."""


def make_records(folder: Path, each: int) -> Path:
    """Simulate the records that are not there yet; return their table."""
    folder.mkdir(parents=True, exist_ok=True)
    table = folder / "fleet.csv"
    with table.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["file", "machine", "date"])
        for number in range(each):
            for place, (machine, friction) in enumerate(MACHINES.items()):
                name = f"{machine}-{number:03d}.csv"
                if not (folder / name).exists():
                    api.simulate(
                        "arm-bullet",
                        scenario="multisine",
                        seed=10_000 + 4 * number + place,
                        out=folder / name,
                        options={"joint_friction": friction(number / each), "sample_time": 0.02, "substeps": 160},
                        scenario_options={"noise": 0.001},
                    )
                writer.writerow([name, machine, (date(2026, 1, 5) + timedelta(days=7 * number)).isoformat()])
    return table


def main(records: int, folder: Path) -> None:
    import distributed

    each = records // len(MACHINES)
    table = make_records(folder / "records", each)
    started = time.perf_counter()
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None, worker_dashboard_address=None
    ) as made:
        result = close_fleet(
            table,
            out=folder / "fleet",
            model="pendulum",
            engine=f"dask://{made.scheduler_address.removeprefix('tcp://')}",
            resume=True,
            progress=lambda done, total, what: print(f"{done} of {total}  {what}", flush=True),
        )
    seconds = time.perf_counter() - started
    print(result)
    print(f"{len(result.rows)} records in {seconds:.0f} s on two workers, of which this run did what was missing")
    answer = query(
        folder / "fleet",
        "select machine, count(*) as records, count(effect) as effects, min(size) as least, max(size) as largest "
        "from records left join effects using (record, machine) group by machine order by machine",
    )
    for row in answer.records():
        print(row)
    assert len(result.rows) == result.planned == 4 * each
    assert all(row.ok for row in result.rows)
    grows = {(trend.machine, trend.series.effect): trend.word for trend in result.trends}
    assert grows["A", "coulomb_friction@theta"] == "grows", grows
    first = next(new for new in result.new if new.machine == "C")
    assert first.row.record >= f"C-{(each + 1) // 2:03d}", first


if __name__ == "__main__":
    place = Path(sys.argv[2]) if len(sys.argv) > 2 else Path(tempfile.mkdtemp(prefix="fleet-"))
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 40, place)
