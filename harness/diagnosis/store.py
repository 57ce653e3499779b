"""Finished refits, kept one file each, so that an interrupted diagnosis continues where it stopped."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from harness.fingerprint import fingerprint
from harness.signals import Dataset


def write_atomic(path: Path, text: str) -> None:
    """Write a file so that a half-written one is never left under its name."""
    scratch = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        scratch.write_text(text, encoding="utf-8")
        scratch.replace(path)
    except OSError:
        with suppress(OSError):
            scratch.unlink(missing_ok=True)
        raise


def data_fingerprint(dataset: Dataset) -> str:
    """Return a hash of the data: of all runs and what is missing in them, units, noise, resolution and the hold."""
    runs = [(run.use, run.trajectory.t, run.trajectory.u, run.trajectory.readings) for run in dataset]
    known = dict(dataset.noise), dict(dataset.resolution)
    return fingerprint(runs, str(dataset.spec), dataset.intersample, *known)


class CandidateStore:
    """Records by key in ``folder/candidates``.

    - ``folder``: where to keep them
    - ``identity``: fingerprint of data and options: records of another identity are not seen
    """

    def __init__(self, folder: Path, identity: str) -> None:
        self._folder = folder / "candidates"
        self._identity = identity
        self._folder.mkdir(parents=True, exist_ok=True)

    def get(self, key: str) -> dict[str, Any] | None:
        """Return the record of a key, or None; a file that cannot be read or was changed counts as absent."""
        try:
            kept = json.loads(self._path(key).read_text(encoding="utf-8"))
            record: dict[str, Any] = kept["record"]
            return record if kept["key"] == key and kept["sum"] == _sum(record) else None
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            return None

    def put(self, key: str, record: Mapping[str, Any]) -> None:
        """Keep the record of a key."""
        write_atomic(self._path(key), json.dumps({"key": key, "sum": _sum(record), "record": dict(record)}))

    def _path(self, key: str) -> Path:
        """Return the file of a key."""
        return self._folder / f"{fingerprint(self._identity, key)}.json"


def _sum(record: Mapping[str, Any]) -> str:
    """Return a checksum of a record, the same for the record as it reads back."""
    return fingerprint(json.dumps(dict(record), sort_keys=True))
