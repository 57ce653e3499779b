"""Files that unpack to far more than they are, or whose numbers lie elsewhere."""

from __future__ import annotations

import gzip
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from harness.data import load_dataset
from harness.data.tables.table import open_table
from harness.errors import InputError
from harness.fleet.records import FleetRecord
from harness.fleet.work import RecordJob


def test_a_small_file_that_unpacks_to_much_is_refused(tmp_path: Path) -> None:
    packed = tmp_path / "run.csv.gz"
    packed.write_bytes(gzip.compress(b"time [s],u [N m],theta [rad]\n" + b"0," * (40 << 20)))
    book = tmp_path / "run.xlsx"
    with zipfile.ZipFile(book, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("xl/worksheets/sheet1.xml", bytes(60 << 20))
    for path in (packed, book):
        with pytest.raises(InputError, match="MiB unpacked"):
            load_dataset(path, model="pendulum")


def test_numbers_of_another_file_are_not_read(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    (tmp_path / "secret").write_bytes(np.arange(8.0).tobytes())
    with h5py.File(tmp_path / "outside.h5", "w") as file:
        file.create_dataset("x", shape=(8,), dtype="f8", external=[(str(tmp_path / "secret"), 0, 64)])
    with h5py.File(tmp_path / "inner.h5", "w") as file:
        file["x"] = np.arange(8.0)
    with h5py.File(tmp_path / "virtual.h5", "w") as file:
        layout = h5py.VirtualLayout(shape=(8,), dtype="f8")
        layout[:] = h5py.VirtualSource(str(tmp_path / "inner.h5"), "x", shape=(8,))
        file.create_virtual_dataset("x", layout)
    for name in ("outside.h5", "virtual.h5"):
        with pytest.raises(InputError, match="numbers in another file"):
            open_table(tmp_path / name, {})
    open_table(tmp_path / "inner.h5", {})


def test_a_fleet_notices_the_files_that_a_data_set_names(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text("a")
    (tmp_path / "mine.py").write_text("a")
    (tmp_path / "d.toml").write_text(
        'name = "d"\n[nominal]\nmodel = "mine.py:swing"\n[signals.u]\nrole = "input"\n'
        '[signals.y]\nrole = "output"\n[[runs]]\nfile = "run.csv"\n'
    )
    seen = set()
    for changed in ("", "run.csv", "mine.py", "d.toml"):
        if changed:
            (tmp_path / changed).write_text((tmp_path / changed).read_text() + "\n#")
        seen.add(RecordJob(FleetRecord("d", tmp_path / "d.toml"), tmp_path, None, (), 1.0).job)
    assert len(seen) == 4


def test_a_closed_reader_is_no_fault(tmp_path: Path) -> None:
    sysid = f"{sys.executable} -m harness list"
    for line in (f"{sysid} >&-", f"{sysid} <&-", f"set -o pipefail; {sysid} | head -c 1 >/dev/null"):
        done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=False, cwd=tmp_path)
        assert (done.returncode, done.stderr) == (0, ""), line


def test_a_parquet_file_that_states_more_than_memory_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Equal values pack without any limit: what counts is how many the file says that it holds."""
    import pyarrow as pa
    from pyarrow import parquet

    from harness.data.tables import packing

    path = tmp_path / "run.parquet"
    n = 200_000
    parquet.write_table(pa.table({"time [s]": [0.0] * n, "u [N m]": [0.0] * n, "theta [rad]": [0.0] * n}), path)
    assert path.stat().st_size < 20_000
    monkeypatch.setattr(packing, "LARGEST", 4 << 20)
    with pytest.raises(InputError, match="at most 4 MiB unpacked, got 4 MiB"):
        load_dataset(path, model="pendulum")


@pytest.mark.parametrize("text", ["{", "[]", "null", "{}", '{"inputs": 3}', "[" * 100_000])
def test_a_record_whose_description_is_damaged(tmp_path: Path, text: str) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    from harness.data import trajectories

    table = pa.table({"time [s]": [0.0, 1.0], "u [1]": [0.0, 1.0]}).replace_schema_metadata({trajectories._KEY: text})
    parquet.write_table(table, tmp_path / "run.parquet")
    with pytest.raises(InputError, match="what the record says of its channels"):
        trajectories.stored_spec(tmp_path / "run.parquet", ["u [1]"])
