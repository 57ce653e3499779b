"""Finished refits, kept one file each, so that an interrupted diagnosis continues where it stopped."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from harness.signals import Dataset

__all__ = ["Store", "fingerprint", "write_atomic"]


def write_atomic(path: Path, text: str) -> None:
    """Write a file so that a half-written one is never left under its name."""
    scratch = path.with_name(f"{path.name}.{os.getpid()}.part")
    scratch.write_text(text, encoding="utf-8")
    scratch.replace(path)


def fingerprint(dataset: Dataset, **options: Any) -> str:
    """Return a hash of the data and of everything else that decides a refit."""
    digest = hashlib.sha256()
    for run in dataset:
        digest.update(run.use.encode())
        for array in (run.trajectory.t, run.trajectory.u, run.trajectory.y):
            digest.update(np.ascontiguousarray(array).tobytes())
    noise = sorted(dataset.noise.items())
    digest.update(repr((str(dataset.spec), dataset.intersample, noise, sorted(options.items()))).encode())
    return digest.hexdigest()[:16]


class Store:
    """Records by key in ``folder/candidates``; without a folder they are kept in memory only.

    Parameters
    ----------
    folder : Path or None
        Where to keep them.
    identity : str
        Fingerprint of data and options: records of another identity are not seen.
    """

    def __init__(self, folder: Path | None, identity: str) -> None:
        self._folder = None if folder is None else folder / "candidates"
        self._identity = identity
        self._memory: dict[str, dict[str, Any]] = {}
        self.reused = 0
        if self._folder is not None:
            self._folder.mkdir(parents=True, exist_ok=True)

    def get(self, key: str) -> dict[str, Any] | None:
        """Return the record of a key, or None; a file that cannot be read counts as absent."""
        if key in self._memory:
            return self._memory[key]
        path = self._path(key)
        if path is None or not path.is_file():
            return None
        try:
            record = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        if record.get("key") != key:
            return None
        self._memory[key] = record["record"]
        self.reused += 1
        return self._memory[key]

    def put(self, key: str, record: Mapping[str, Any], *, lasting: bool = True) -> None:
        """Keep the record of a key; in memory only unless it is ``lasting``."""
        self._memory[key] = dict(record)
        path = self._path(key)
        if path is not None and lasting:
            write_atomic(path, json.dumps({"key": key, "record": self._memory[key]}))

    def _path(self, key: str) -> Path | None:
        """Return the file of a key."""
        if self._folder is None:
            return None
        return self._folder / (hashlib.sha256(f"{self._identity}/{key}".encode()).hexdigest()[:24] + ".json")
