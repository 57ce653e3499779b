"""What a probe found about each FMU of a benchmark, kept beside its scores in ``probes.json``."""

from __future__ import annotations

import inspect
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from harness import registry
from harness.benchmark.parts import Task
from harness.benchmark.row import one_line
from harness.data.whole_files import write_text
from harness.errors import HarnessError
from harness.jobs.stored import reading
from harness.supervision.workers import worker_pool

LIMIT = 120.0  # s for one plant


def probe_plants(tasks: Sequence[Task], file: Path) -> None:
    """Probe every plant that can be probed and is not in the file yet; no plant is made in this process.

    Parameters
    ----------
    tasks : sequence of Task
        Their plants are probed once each.
    file : Path
        JSON: plant name to ``options`` and ``result`` (None and a ``reason`` if the probe itself broke). Left alone, or
        not made, where no plant can be probed.
    """
    known: dict[str, dict[str, Any]] = {}
    if file.is_file():
        with reading(file, "delete it: the FMUs are probed again"):
            known = msgspec.json.decode(file.read_bytes(), type=dict[str, dict[str, Any]])
    parts = {task.plant.name: task.plant for task in tasks}
    new = {
        name: part
        for name, part in parts.items()
        if _probeable(part.id) and known.get(name, {}).get("options") != _plain(part.options)
    }
    if not new:
        return
    with worker_pool(1) as pool:
        waiting = {name: pool.schedule(_probe, args=[p.id, p.options], timeout=LIMIT) for name, p in new.items()}
        for name, future in waiting.items():
            entry: dict[str, Any] = {"plant": new[name].id, "options": _plain(new[name].options), "result": None}
            try:
                entry["result"] = future.result()
            except Exception as error:  # whatever an FMU does to its process is a finding
                entry["reason"] = one_line(error) if isinstance(error, HarnessError) else type(error).__name__
            known[name] = entry
    write_text(file, json.dumps(known, indent=1) + "\n")


def _probeable(plant: str) -> bool:
    """Return True if what makes the plant says that it makes one with a ``probe_tool``."""
    try:
        factory = registry.load("plants", plant)
        made = factory if inspect.isclass(factory) else inspect.signature(factory, eval_str=True).return_annotation
    except (HarnessError, NameError, TypeError, ValueError):
        return False  # the rows of this plant will tell what is wrong with it
    return getattr(made, "probe_tool", None) is not None


def _probe(plant: str, options: dict[str, Any]) -> dict[str, Any]:
    """Make a plant, and probe it with the options that it was really made with."""
    with registry.create("plants", plant, **options) as made:
        found: dict[str, Any] = registry.load("tools", made.probe_tool)(**made.options).to_dict()
    return found


def _plain(options: dict[str, Any]) -> Any:
    """Return options as they read back from JSON."""
    return json.loads(json.dumps(options, default=str))
