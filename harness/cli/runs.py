"""The commands of ``sysid`` that run plants: one of them, or a benchmark and its stored rows."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from harness import api
from harness.cli.options import AsJson, Engine, Force, OptionPairs, Resume, ScenarioPairs, Seed, Trust, Workers
from harness.cli.results import print_answer, print_bench, print_public
from harness.cli.terminal import jobs_bar, noted, print_json, print_paths, print_rows, progress_bar, say
from harness.cli.words import completed, hidden_effect, option_pairs, seed_range, text_pairs
from harness.errors import InputError, PlantError, printable


def simulate(
    plant: Annotated[
        str,
        typer.Argument(
            metavar="PLANT",
            help="id of a plant, or a file: .fmu, .toml, .ssp, .ssd, OspSystemStructure.xml",
            autocompletion=completed("plants"),
        ),
    ],
    scenario: Annotated[
        str | None,
        typer.Option(
            "--scenario", help="id of a scenario; a file also runs without one", autocompletion=completed("scenarios")
        ),
    ] = None,
    seed: Seed = 0,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="run.csv or run.parquet")] = None,
    option: OptionPairs = None,
    scenario_option: ScenarioPairs = None,
    hide: Annotated[
        list[str] | None, typer.Option(metavar="EFFECT@PORT:k=v,...", help="hide an effect in the plant, repeatable")
    ] = None,
    role: Annotated[
        str, typer.Option(help="estimation/0, validation/0, ...: each role has its own random numbers")
    ] = "estimation/0",
    start: Annotated[float | None, typer.Option(help="file without a scenario: start time [s]")] = None,
    stop: Annotated[float | None, typer.Option(help="file without a scenario: stop time [s]")] = None,
    step: Annotated[float | None, typer.Option(help="file without a scenario: sample time [s]")] = None,
    tolerance: Annotated[float | None, typer.Option(help="file without a scenario: tolerance of its solver")] = None,
    exchange: Annotated[
        str | None, typer.Option(help="coupling or system: jacobi (all step at once) | gauss-seidel (in turn)")
    ] = None,
    halve: Annotated[
        int | None, typer.Option(metavar="N", help="file without a scenario: halve the step N times")
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="with --halve: draw the changes over the step (.svg, .png, .pdf)"),
    ] = None,
    as_json: AsJson = False,
    force: Force = False,
    trust: Trust = None,
) -> None:
    """Run a scenario on a plant and record it. Without a scenario, an FMU or a system runs its own experiment."""
    notes: list[str] = []
    if picture is not None and halve is None:
        raise InputError("--picture", expected="--halve as well", got="none", remedy="--halve 4")
    if halve is not None:
        if scenario is not None or hide or scenario_option:
            raise InputError(
                "--halve",
                expected="a file without a scenario",
                got="a scenario or a hidden effect",
                remedy="leave it out",
            )
        found = api.halve(
            plant,
            times=halve,
            step=step,
            out=out,
            picture=picture,
            force=force,
            note=notes.append,
            start=start,
            stop=stop,
            tolerance=tolerance,
            exchange=exchange,
            options=option_pairs(option, "--option"),
        )
        for text in notes:
            noted(text)
        if as_json:
            print_json(found.rows())
            return
        print_rows(found.rows())
        print_paths(out, picture)
        return
    broken: list[PlantError] = []
    try:
        with progress_bar("simulating") as bar:
            task = bar.add_task(plant, total=None)
            trajectory = api.simulate(
                plant,
                scenario=scenario,
                seed=seed,
                out=out,
                options=option_pairs(option, "--option"),
                scenario_options=option_pairs(scenario_option, "--scenario-option"),
                hide=[hidden_effect(text) for text in hide or ()],
                role=role,
                start=start,
                stop=stop,
                step=step,
                tolerance=tolerance,
                exchange=exchange,
                force=force,
                progress=lambda done, total: bar.update(task, completed=done, total=total),
                note=notes.append,
                broke=broken.append,
            )
    finally:  # what was said before a run broke may be why
        for text in notes:
            noted(text)
    if as_json:
        from harness.specs import spec_to_dict

        said = {"samples": len(trajectory), "written": out and str(out), "notes": notes}
        print_json({"spec": spec_to_dict(trajectory.spec), **said})
        return
    say(str(trajectory))
    print_paths(out)
    for error in broken:  # what came before it is kept, and the exit status says that it is not the whole
        raise error


def bench(
    suite: Annotated[
        str,
        typer.Argument(
            metavar="SUITE", help="name of a suite (sysid list suites) or FILE.toml", autocompletion=completed("suites")
        ),
    ],
    out: Annotated[Path | None, typer.Option(help="folder for results; default results/SUITE")] = None,
    workers: Workers = None,
    seeds: Annotated[str | None, typer.Option(metavar="A..B", help="seeds A to B, both included")] = None,
    engine: Engine = "local",
    resume: Resume = False,
    shard: Annotated[str | None, typer.Option(metavar="i/n", help="the i-th of n shares, for job arrays")] = None,
    traces: Annotated[
        str, typer.Option(help="seeds whose trajectories are kept for the overlays: first | all | none")
    ] = "first",
    dry_run: Annotated[bool, typer.Option("--dry-run", help="list what would run, and how long it would take")] = False,
    sets: Annotated[
        str | None, typer.Option(metavar="ID[,...]", help="suite public: sets of the table; default all")
    ] = None,
    only: Annotated[str | None, typer.Option(help="suite public: one column, black | grey | peers")] = None,
    choices: Annotated[Path | None, typer.Option(metavar="FILE.toml", help="suite public: the entries")] = None,
    download: Annotated[
        bool, typer.Option("--download", help="suite public: download missing sets (extra download)")
    ] = False,
    as_json: AsJson = False,
    trust: Trust = None,
) -> None:
    """Run a suite of plants x scenarios x identifiers x seeds and print its table; public: the public table."""
    folder = out if out is not None else Path("results") / Path(suite).stem
    if suite == PUBLIC:
        apart = {"--workers": workers, "--seeds": seeds, "--shard": shard, "--dry-run": dry_run or None}
        _refused(apart, "another suite", "the public table")
        wanted = None if sets is None else [name.strip() for name in sets.split(",") if name.strip()]
        with jobs_bar(f"benchmark {suite}", suite) as show:
            public = api.bench_public(
                sets=wanted, only=only, out=folder, choices=choices, download=download, resume=resume, progress=show
            )
        print_public(public, as_json=as_json)
        return
    own = {"--sets": sets, "--only": only, "--choices": choices, "--download": download or None}
    _refused(own, "the suite public", suite)
    if dry_run:
        planned = api.plan_bench(suite, out=folder, workers=workers, seeds=seed_range(seeds), shard=shard)
        if as_json:
            cells = [{"names": list(names), "jobs": count} for names, count in planned.cells.items()]
            print_json({"cells": cells, "summary": str(planned)})
            return
        for names, count in planned.cells.items():
            say(f"{count:6d}  {' x '.join(names)}")
        say(str(planned))
        return
    with jobs_bar(f"benchmark {suite}", suite) as show:
        result = api.bench(
            suite,
            out=folder,
            workers=workers,
            seeds=seed_range(seeds),
            engine=engine,
            resume=resume,
            shard=shard,
            traces=traces,
            progress=show,
        )
    print_bench(result, as_json=as_json)


PUBLIC = "public"
"""The suite that is a table of its own: :mod:`harness.benchmark.public`."""


def _refused(options: Mapping[str, object], needed: str, suite: str) -> None:
    """Refuse options that mean nothing to a suite."""
    given = [name for name, value in options.items() if value is not None]
    if given:
        raise InputError(", ".join(given), expected=needed, got=suite, remedy="leave it out")


def table(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="folder of a benchmark, or of its shares")],
    form: Annotated[str | None, typer.Option("--format", help="markdown | latex | csv")] = None,
    as_json: AsJson = False,
) -> None:
    """Print the table of a stored benchmark and write its report anew; merges the shares of a job array."""
    if (public := api.stored_public(directory)) is not None:
        print_public(public, as_json=as_json)
        return
    result = api.table(directory)
    if form is not None:
        from harness.benchmark import render

        print(printable(render(result, form)), end="")
        return
    print_bench(result, as_json=as_json)


def query(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="folder of a benchmark or a fleet, finished or not")],
    sql: Annotated[
        str | None,
        typer.Argument(metavar="SQL", help="query on results, timings, regret, traces; fleet: records, effects"),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option("--filter", metavar="COLUMN=VALUE", help="keep only rows with this value, repeatable"),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="answer.csv or answer.parquet")] = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Query the stored rows of a benchmark or a fleet in SQL (DuckDB), or show those with given values."""
    answer = api.query(directory, sql, filters=text_pairs(only, "--filter"))
    if out is not None:
        answer.write(out, force=force)
        print_paths(out)
    elif as_json:
        print_json(answer.records())
    else:
        print_answer(answer if sql is not None else answer.narrow())
