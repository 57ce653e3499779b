"""Whether FMUs run here as fmpy runs them: agree / differ / refused, file by file, for every FMU under a folder.

    python benchmarks/fmu_agreement.py FOLDER [--seconds 20]

Both sides take the default experiment, start values and the same steps. ``agree`` means within 1e-3 of an output's
range for model exchange (two solvers at one tolerance) and 1e-9 for co-simulation.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
from pathlib import Path
from typing import Any

import numpy as np

AGREE = {"cs": 1e-9, "me": 1e-3}


def peer(path: str, names: list[str], kind: str, start: float, stop: float, step: float, tolerance: Any) -> np.ndarray:
    """Return fmpy's table (n, ny) at the samples, in the FMU's own units."""
    import fmpy

    result = fmpy.simulate_fmu(
        path,
        fmi_type={"cs": "CoSimulation", "me": "ModelExchange"}[kind],
        start_time=start,
        stop_time=stop,
        output_interval=step,
        relative_tolerance=tolerance,
        output=names,
        validate=False,
    )
    rows = np.searchsorted(result["time"], start + step * np.arange(round((stop - start) / step) + 1) + 1e-6 * step) - 1
    columns = [np.asarray(result[name], dtype=float).reshape(len(result), -1) for name in names]
    return np.column_stack(columns)[np.unique(rows)]


def judged(path: Path, pipe: Any) -> None:
    """Send one line about one FMU and kind."""
    from harness.errors import HarnessError
    from plants.fmu.archive import read_fmu
    from plants.fmu.as_is import run_as_is
    from plants.fmu.options import default
    from plants.fmu.variables import port

    try:
        file = read_fmu(path)
    except HarnessError as error:
        pipe.send([("-", "refused", str(error))])
        return
    found = []
    for kind in file.kinds:
        try:
            ours = run_as_is(path, kind=kind, timeout=60.0)
        except HarnessError as error:
            found.append((kind, "refused", str(error)))
            continue
        record, dt = ours.trajectory, ours.trajectory.spec.sample_time
        variables = {v.name: v for v in file.description.modelVariables}
        names = list(
            dict.fromkeys(c.name.split("[")[0] if c.name not in variables else c.name for c in record.spec.outputs)
        )
        ports = [port(file, variables[name]) for name in names]
        scale = np.array([p.scale for p in ports for _ in range(p.size)])
        offset = np.array([p.offset for p in ports for _ in range(p.size)])
        stop = ours.start + (len(record) - 1) * dt
        try:
            theirs = scale * peer(str(path), names, kind, ours.start, stop, dt, default(file, "tolerance")) + offset
        except Exception as error:
            found.append((kind, "ran", f"fmpy does not run it: {' '.join(str(error).split())[:100]}"))
            continue
        n = min(len(theirs), len(record))
        spread = np.maximum(np.ptp(record.y[:n], axis=0), 1e-6 + 1e-6 * np.abs(record.y[:n]).max(axis=0))
        off = np.abs(theirs[:n] - record.y[:n]) / spread
        share = float(np.quantile(off.max(axis=1), 0.98)) if n else 0.0  # an event may fall on either side of a sample
        word = "agree" if share <= AGREE[kind] and n > 0.9 * len(record) else "differ"
        found.append((kind, word, f"{share:.1e} of the range, {n} of {len(record)} samples"))
    pipe.send(found)


def main() -> int:
    """Print the table and the counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seconds", type=float, default=20.0, help="for one file")
    arguments = parser.parse_args()
    counts: dict[str, int] = {}
    context = multiprocessing.get_context("spawn")
    for path in sorted(arguments.folder.rglob("*.fmu")):
        here, there = context.Pipe()
        process = context.Process(target=judged, args=(path, there))
        process.start()
        there.close()
        try:
            rows = here.recv() if here.poll(arguments.seconds) else [("-", "timeout", f"{arguments.seconds:g} s")]
        except EOFError:
            rows = [("-", "crashed", "the process of the comparison died (fmpy runs the FMU in it)")]
        process.kill()
        process.join()
        for kind, word, why in rows:
            counts[word] = counts.get(word, 0) + 1
            print(f"{word:8s} {kind:2s} {path.relative_to(arguments.folder)}: {why}", flush=True)
    print(", ".join(f"{word} {count}" for word, count in sorted(counts.items())))
    return 0


if __name__ == "__main__":
    sys.exit(main())
