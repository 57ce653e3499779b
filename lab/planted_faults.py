"""Whether the tests notice when the diagnosis is wrong: plants small faults, one at a time, and runs the tests.

    python lab/planted_faults.py [--out FILE] [--only WORDS] [--room ROOM ...] [--limit N]

Works in a temporary copy of the tree. A fault is noticed if a test fails; it is stale if its text is gone, and then no
merit of the tests. Each result is written as it comes (``--out``, JSON lines), and a second run does what is left: a
fault is tried again when its source file or its tests have changed. Aim: 90 %.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
LIST = Path(__file__).with_suffix(".toml")
TREE = ("harness", "plants", "identifiers", "scenarios", "tests", "examples", "docs", "pyproject.toml")
AIM = 0.9
LIMIT = 900.0  # Seconds for the tests of one fault.


@dataclass(frozen=True)
class Fault:
    """A replacement of text that stands once in a file, and the tests that ought to notice."""

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]
    room: str = field(default="", repr=False)

    def identity(self) -> str:
        """Return what decides the result: the fault, its file and its tests as they are."""
        digest = hashlib.sha256(repr(self).encode())
        for path in (self.file, *(one.partition("::")[0] for one in self.tests)):
            digest.update((ROOT / path).read_bytes() if (ROOT / path).is_file() else b"")
        return digest.hexdigest()[:16]


def read_faults() -> list[Fault]:
    """Return the faults of the list."""
    data = tomllib.loads(LIST.read_text(encoding="utf-8"))
    rooms = data["rooms"]
    return [
        Fault(
            one["name"], one["file"], one["old"], one["new"],
            tuple(one.get("tests") or rooms[one["room"]]), one.get("room", ""),
        )
        for one in data["fault"]
    ]  # fmt: skip


def copied(folder: Path) -> None:
    """Copy the tree, compiled once; what changes later is noticed by its content."""
    for name in TREE:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy2(source, folder / name)
    packages = [str(folder / name) for name in TREE[:4]]
    command = [sys.executable, "-m", "compileall", "-q", "--invalidation-mode", "checked-hash", *packages]
    subprocess.run(command, check=True)


def run_tests(folder: Path, tests: Sequence[str], *, most: int = 1) -> tuple[int | None, str]:
    """Return the exit code of pytest (None: it took too long) and its last line; it ends at so many failures."""
    environment = dict(os.environ, PYTHONPATH=str(folder), OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    command = [sys.executable, "-m", "pytest", *tests, f"--maxfail={most}", "-q", "-n", "0", "-p", "no:cacheprovider"]
    command += ["-m", "not slow", "--no-header", "--tb", "no"]
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, timeout=LIMIT, check=False
        )
    except subprocess.TimeoutExpired:
        return None, f"more than {LIMIT:g} s"
    failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return done.returncode, (failed or done.stdout.splitlines() or ["no output"])[-1]


def tried(fault: Fault, folder: Path) -> dict[str, Any]:
    """Plant a fault, run its tests, and take it out again."""
    path = folder / fault.file
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    if text.count(fault.old) != 1:
        return {"result": "stale", "by": f"its text stands {text.count(fault.old)} times in {fault.file}"}
    path.write_text(text.replace(fault.old, fault.new), encoding="utf-8")
    began = time.monotonic()
    try:
        for test in fault.tests:
            code, line = run_tests(folder, [test])
            if code == 1:
                return {"result": "noticed", "by": line, "seconds": round(time.monotonic() - began, 1)}
            if code != 0:
                return {"result": "broken", "by": f"pytest ended with {code}: {line}"}
    finally:
        path.write_text(text, encoding="utf-8")
    return {"result": "unnoticed", "by": "", "seconds": round(time.monotonic() - began, 1)}


def planted(faults: Sequence[Fault], identities: Mapping[Fault, str]) -> Iterator[dict[str, Any]]:
    """Yield the result of one fault after the other, planted in a copy of the tree; nothing is copied for none."""
    if not faults:
        return
    with tempfile.TemporaryDirectory(prefix="planted-faults-") as scratch:
        folder = Path(scratch)
        copied(folder)
        sound: dict[str, bool] = {}
        for number, fault in enumerate(faults, start=1):
            for test in fault.tests:  # what fails anyhow notices nothing
                if test not in sound:
                    code, line = run_tests(folder, [test])
                    sound[test] = code == 0
                    if code != 0:
                        print(f"{test} fails without a fault: {line}", flush=True)
            if all(sound[test] for test in fault.tests):
                row = tried(fault, folder)
            else:
                row = {"result": "broken", "by": "its tests fail without a fault"}
            print(f"{number} of {len(faults)}: {fault.name}: {row['result']} {row['by']}", flush=True)
            yield {"identity": identities[fault], "name": fault.name, "file": fault.file, **row}


def known_results(path: Path) -> dict[str, dict[str, Any]]:
    """Return the results of runs before, by identity."""
    if not path.is_file():
        return {}
    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    return {row["identity"]: row for row in rows}


def main(arguments: Sequence[str] | None = None) -> int:
    """Plant the faults and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path(tempfile.gettempdir()) / "planted_faults.jsonl")
    parser.add_argument("--only", default="", help="faults whose name or file holds this")
    parser.add_argument("--room", nargs="+", default=[], help="faults of these rooms: groups of tests, see the list")
    parser.add_argument("--limit", type=int, default=None, help="at most so many new ones")
    chosen = parser.parse_args(arguments)
    faults = [one for one in read_faults() if chosen.only in one.name or chosen.only in one.file]
    if chosen.room:
        faults = [one for one in faults if one.room in chosen.room]
    identities = {one: one.identity() for one in faults}  # as the copy will be, whatever is edited meanwhile
    known = known_results(chosen.out)
    left = [one for one in faults if identities[one] not in known][: chosen.limit]
    for row in planted(left, identities):
        known[row["identity"]] = row
        with chosen.out.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
    rows = [known[identities[one]] for one in faults if identities[one] in known]
    print("\n| fault | file | result | by |\n|---|---|---|---|")
    for row in rows:
        by = row["by"].removeprefix("FAILED ").partition(" - ")[0].rpartition("/")[2]
        print(f"| {row['name']} | {row['file'].removeprefix('harness/')} | {row['result']} | {by} |")
    noticed = sum(row["result"] == "noticed" for row in rows)
    met = noticed >= AIM * len(faults)
    others = {word: sum(row["result"] == word for row in rows) for word in ("unnoticed", "stale", "broken")}
    rest = ", ".join([*(f"{count} {word}" for word, count in others.items()), f"{len(faults) - len(rows)} not tried"])
    print(f"\nnoticed {noticed} of {len(faults)} ({rest}); aim {AIM:.0%}: {'met' if met else 'missed'}")
    return 0 if met or chosen.only or chosen.room or chosen.limit else 1


if __name__ == "__main__":
    sys.exit(main())
