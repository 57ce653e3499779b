"""A full disk and a second run on one folder are states of the run: no row is made of them."""

from __future__ import annotations

import errno
import shutil
from pathlib import Path
from typing import Any

import pytest

from harness.benchmark import bench
from harness.benchmark.store import Store
from harness.errors import InputError
from harness.jobs import room
from harness.jobs.alone import alone_in
from harness.jobs.batch import write_shard


def write_suite(folder: Path, mark: Path) -> Path:
    """Write a suite whose third identifier meets a full disk as long as a file is there."""
    parts = ['{id = "test-fit"}', '{id = "test-fit", label = "b"}',
             f'{{id = "test-fit", label = "meets it", options = {{fail = "full-disk {mark}"}}}}',
             '{id = "test-fit", label = "c"}']  # fmt: skip
    path = folder / "disk.toml"
    path.write_text(
        'name = "disk"\nseeds = [0]\n[[groups]]\nplants = [{id = "test-lag"}]\n'
        f'scenarios = [{{id = "prbs", options = {{samples = 60}}}}]\nidentifiers = [{", ".join(parts)}]\n'
    )
    return path


@pytest.mark.filterwarnings("ignore")
def test_resumed_with_room_it_ends_with_the_same_table(plugins: Path, tmp_path: Path) -> None:
    mark, out = tmp_path / "full", tmp_path / "out"
    suite = write_suite(tmp_path, mark)
    mark.touch()
    with pytest.raises(InputError, match=r"takes nothing more.*no space left on device.*--resume"):
        bench(suite, out=out, workers=1)
    kept = Store(out).rows()
    assert sorted(row.identifier for row in kept.values()) == ["b", "test-fit"]  # what was done before stays
    assert {row.status for row in kept.values()} == {"ok"}
    mark.unlink()
    bench(suite, out=out, workers=1, resume=True)
    bench(suite, out=tmp_path / "whole", workers=1)
    assert (out / "results.parquet").read_bytes() == (tmp_path / "whole" / "results.parquet").read_bytes()


def test_nothing_is_stored_on_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage: Any = shutil.disk_usage(tmp_path)
    write_shard(tmp_path, "a", b"{}")
    monkeypatch.setattr(room.shutil, "disk_usage", lambda folder: usage._replace(free=1000))
    with pytest.raises(OSError, match="No space left") as caught:
        write_shard(tmp_path, "b", b"{}")
    assert caught.value.errno == errno.ENOSPC
    with pytest.raises(OSError, match="No space left"):
        room.raise_if_full(ValueError("what a library says of a full disk"))
    monkeypatch.setattr(room.shutil, "disk_usage", lambda folder: usage._replace(total=0, free=0))  # it tells no sizes
    write_shard(tmp_path, "c", b"{}")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.json", "c.json"]


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS])
def test_a_refused_write_is_seen_through_what_it_led_to(number: int) -> None:
    def led() -> None:
        try:
            try:
                raise OSError(number, "refused", "file")
            except OSError:
                raise KeyError("a") from None  # the reason is hidden from a reader, not from us
        except KeyError as error:
            raise RuntimeError("b") from error

    with pytest.raises(RuntimeError) as caught:
        led()
    found = room.full_disk(caught.value)
    assert found is not None
    assert found.errno == number
    assert room.full_disk(OSError(errno.ENOENT, "missing")) is None


def test_a_second_run_on_a_folder_is_refused_and_harms_nothing(tmp_path: Path, plugins: Path) -> None:
    from harness.diagnosis import close_loop_file
    from harness.fleet import close_fleet

    out = tmp_path / "out"
    records = tmp_path / "runs"
    records.mkdir()
    for name in "ab":
        (records / f"{name}.csv").write_text(
            "time [s],u [N m],theta [rad]\n" + "".join(f"{k / 100},{k % 7},{(k % 5) / 10}\n" for k in range(60))
        )
    with alone_in(out):
        for call in (
            lambda: bench(write_suite(tmp_path, tmp_path / "no"), out=out, workers=1, resume=True),
            lambda: close_fleet(records, out=out, model="pendulum", workers=1, resume=True),
            lambda: close_loop_file(records / "a.csv", out=out, model="pendulum", force=True),
        ):
            with pytest.raises(InputError, match="another run writes into the folder"):
                call()
        assert list(out.iterdir()) == []
    with alone_in(out):
        pass  # it is free again
