"""The records of a task as a folder that any tool reads."""

from __future__ import annotations

from pathlib import Path

from harness.data.trajectories import write_trajectory
from harness.data.whole_files import write_text
from sysid_lab.plan import Task
from sysid_lab.records import Records


def write_record(folder: Path, name: str, task: Task, made: Records) -> None:
    """Write the runs of a record and what describes them."""
    folder.mkdir(exist_ok=True)
    spec = made.dataset.spec
    lines = [f'name = "{name}"', "", "[nominal]", f'model = "{task.plant}"']
    for role, channels in (("input", spec.inputs), ("output", spec.outputs)):
        for channel in channels:
            lines += ["", f"[signals.{channel.name}]", f'role = "{role}"', f'unit = "{channel.unit}"']
    for run in made.dataset:
        write_trajectory(run.trajectory.measured(), folder / f"{run.use}.csv")
        lines += ["", "[[runs]]", f'file = "{run.use}.csv"', f'use = "{run.use}"']
    write_text(folder / "dataset.toml", "\n".join(lines) + "\n")
