"""A plug-in that harms its process hurts its own row only, and leaves nothing running."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from harness.benchmark import bench

ENDS = {
    "descriptors": ("crashed", "closed"),
    "standard-lines": ("ok", ""),
    "surroundings": ("ok", ""),
    "fork": ("ok", ""),
    "fork-back": ("ok", ""),
    "daemon": ("ok", ""),
    "exit-well": ("crashed", "exit status 0"),
    "interrupt": ("crashed", "raised KeyboardInterrupt"),
    "untold": ("crashed", "raised Untold"),
}


def _running(mark: str) -> list[str]:
    """Return the living processes that carry a mark in their environment."""
    found = []
    for one in Path("/proc").glob("[0-9]*"):
        try:
            state = (one / "stat").read_text().rpartition(")")[2].split()[0]
            if b"resource_tracker" in (one / "cmdline").read_bytes():
                continue  # of this process, for as long as it lives
            if mark in (one / "environ").read_bytes().decode(errors="replace") and state != "Z":
                found.append(one.name)
        except OSError:
            continue
    return [name for name in found if int(name) != os.getpid()]


@pytest.mark.filterwarnings("ignore")
def test_harm_is_the_row_of_who_did_it(plugins: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mark = f"SYSID_TEST_MARK_{os.getpid()}_{time.monotonic_ns()}"
    monkeypatch.setenv(mark, "1")
    parts = ['{id = "test-fit", label = "sound"}']
    for how in ENDS:
        parts.append(f'{{id = "test-fit", label = "{how}", options = {{fail = "{how}"}}}}')
        parts.append(f'{{id = "test-fit", label = "after {how}"}}')
    suite = tmp_path / "hostile.toml"
    suite.write_text(
        'name = "hostile"\nseeds = [0]\ntime_limit = 60.0\n[[groups]]\nplants = [{id = "test-lag"}]\n'
        f'scenarios = [{{id = "prbs", options = {{samples = 60}}}}]\nidentifiers = [{", ".join(parts)}]\n'
    )
    rows = {row.identifier: row for row in bench(suite, workers=1).rows}
    for how, (status, words) in ENDS.items():
        assert rows[how].status == status, (how, rows[how].reason)
        assert words in (rows[how].reason or ""), how
        assert rows[f"after {how}"].status == "ok", (how, rows[f"after {how}"].reason)
    deadline = time.monotonic() + 10
    while left := _running(mark):
        assert time.monotonic() < deadline, left
        time.sleep(0.1)
