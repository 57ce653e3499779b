"""How often the 95 % intervals of mechanical estimates hold the truth, over simulated records; how often none is given.

Run: python benchmarks/coverage_of_estimates.py FOLDER [--records 200] [--jobs 1] [--only WORD ...] [--table PAGE]

Every model, form and criterion, seeds from 10 000 on, in rounds of ten records, so that what is there at any time is
balanced. FOLDER keeps one line a record (``rows.jsonl``): an interrupted run goes on. ``--table`` writes the page of
what is there and runs nothing.
"""

from __future__ import annotations

import argparse
import json
import math
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from harness.errors import HarnessError
from harness.models.estimate import estimate_of
from harness.physics import load_model
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.mechanics import lumped
from identifiers.mechanics.grey_box import OutputError
from identifiers.mechanics.lumped import Lumped

NOISE_POSITION, NOISE_RATE = 1e-3, 1e-2
SAMPLES, DT = 600, 0.01
COPIES = 20
FIRST = 10_000
ROUND = 10
MODELS = {"pendulum": False, "cart-pole": True}  # Whether rates are measured.
FORMS = ("torque", "energy", "momentum")
CRITERIA = ("least-squares", "unweighted", "total", "instruments", "huber", "l1")
Task = tuple[str, str, str, int]
lumped.MEASURED = CRITERIA  # what is measured here decides which criteria give intervals elsewhere


def record(model: str, rates: bool, seed: int) -> tuple[Trajectory, dict[str, float]]:
    """Return a record of a model at its nominal values under a held random force, with sensor noise."""
    system = load_model(model)
    rng = np.random.default_rng(seed)
    size = 10.0 if model == "cart-pole" else 1.0
    u = size * np.repeat(rng.uniform(-1, 1, size=(SAMPLES // 10, 1)), 10, axis=0)
    n = len(system.coordinates)
    x = system.simulator(DT, substeps=2).states(system.vector(), 0.2 * rng.normal(size=2 * n), u)
    names = (*system.outputs, *(Channel(f"{one.name}_rate", f"{one.unit}/s") for one in system.outputs))
    keep = 2 * n if rates else n
    noise = np.repeat([NOISE_POSITION, NOISE_RATE], n)[:keep]
    spec = PlantSpec(system.inputs, names[:keep], DT)
    y = x[:, :keep] + noise * rng.normal(size=(SAMPLES, keep))
    return Trajectory(np.arange(SAMPLES) * DT, u, y, spec), system.values()


def judged(task: Task) -> dict[str, Any]:
    """Return one row: which intervals hold the truth, or why there is none."""
    model, form, criterion, seed = task
    data, truth = record(model, MODELS[model], seed)
    row: dict[str, Any] = {"model": model, "form": form, "criterion": criterion, "seed": seed}
    rng = np.random.default_rng(seed)
    try:
        if form == "output-error":
            fitted = OutputError(model=model).fit([data], rng=rng)
        else:
            fitted = Lumped(form, model, estimator=criterion, intervals=COPIES).estimated([data], rng=rng)[0]
    except HarnessError as error:
        return {**row, "refused": str(error).splitlines()[0]}
    found = estimate_of(fitted)
    assert found is not None
    given = {name: found.interval(name) for name in found.names}
    if not any(given.values()):
        return {**row, "none": found.method}
    return {**row, "held": {name: one[0] <= truth[name] <= one[1] for name, one in given.items() if one}}


def tasks(count: int, only: list[str]) -> list[Task]:
    """Return what is to be run, ten seeds of everything at a time."""
    kinds = [(model, form, criterion) for model in MODELS for form in FORMS for criterion in CRITERIA]
    # with one equation an instant there is nothing to weigh
    kinds = [one for one in kinds if one[2] != "unweighted" or (one[0] == "cart-pole" and one[1] != "energy")]
    kinds += [(model, "output-error", "-") for model in MODELS]
    kinds = [one for one in kinds if not only or all(word in one for word in only)]
    rounds = range(FIRST, FIRST + count, ROUND)
    kinds.sort(key=lambda one: one[2] == "l1")  # linear programs take longest
    return [
        (*kind, seed) for first in rounds for kind in kinds for seed in range(first, min(first + ROUND, FIRST + count))
    ]


def within(held: int, given: int) -> bool:
    """Return True unless the share lies outside 90 to 98 % by more than two standard deviations of so many records."""
    low = 0.90 * given - 2 * math.sqrt(0.90 * 0.10 * given)
    high = 0.98 * given + 2 * math.sqrt(0.98 * 0.02 * given)
    return low <= held <= high


def table(rows: list[dict[str, Any]]) -> tuple[str, str]:
    """Return the table in Markdown and as CSV."""
    lines = ["| model | form | criterion | records | with intervals | held, by parameter | |", "|" + "---|" * 7]
    plain = ["model,form,criterion,records,refused,with_intervals,parameter,held"]
    for model in MODELS:
        for form in (*FORMS, "output-error"):
            for criterion in (*CRITERIA, "-"):
                own = [one for one in rows if (one["model"], one["form"], one["criterion"]) == (model, form, criterion)]
                if not own:
                    continue
                given = [one["held"] for one in own if "held" in one]
                held = {name: sum(one[name] for one in given) for name in (given[0] if given else {})}
                refused = sum("refused" in one for one in own)
                shares = ", ".join(f"{name} {100 * n / len(given):.1f} %" for name, n in held.items()) or "-"
                outside = [name for name, n in held.items() if not within(n, len(given))]
                verdict = f"outside 90 to 98 %: {', '.join(outside)}" if outside else ""
                lines.append(f"| {model} | {form} | {criterion} | {len(own)} | {len(given)} | {shares} | {verdict} |")
                for name, n in held.items() or {"": 0}.items():
                    plain.append(f"{model},{form},{criterion},{len(own)},{refused},{len(given)},{name},{n}")
    return "\n".join(lines) + "\n", "\n".join(plain) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--records", type=int, default=200)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--table", type=Path)
    chosen = parser.parse_args()
    chosen.folder.mkdir(parents=True, exist_ok=True)
    path = chosen.folder / "rows.jsonl"
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    done = {(one["model"], one["form"], one["criterion"], one["seed"]) for one in rows}
    if chosen.table is None:
        left = [one for one in tasks(chosen.records, chosen.only) if one not in done]
        with ProcessPoolExecutor(chosen.jobs) as pool, path.open("a") as log:
            for row in pool.map(judged, left, chunksize=ROUND):
                log.write(json.dumps(row) + "\n")
                log.flush()
                rows.append(row)
    text, plain = table(rows)
    print(text)
    if chosen.table is not None:
        start, end = "<!-- table -->\n", "<!-- end of the table -->\n"
        page = chosen.table.read_text()
        first, last = page.index(start) + len(start), page.index(end)
        chosen.table.write_text(page[:first] + text + page[last:])
        chosen.table.with_suffix(".csv").write_text(plain)


if __name__ == "__main__":
    main()
