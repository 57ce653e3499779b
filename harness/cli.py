"""The ``sysid`` command: words and printing only; what it does is in :mod:`harness.api`.

Exit status: 0 done (whatever the verdict), 1 a fault of ours, 2 input that cannot be used, 130 interrupted.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from harness import __version__, api
from harness.cli_options import (
    AsJson,
    Engine,
    Force,
    ModelName,
    OptionPairs,
    Resume,
    Seed,
    Undriven,
    Validation,
    Workers,
)
from harness.cli_study import study_app
from harness.errors import HarnessError, InputError
from harness.interrupts import INTERRUPTED, Interrupts
from harness.terminal import (
    completed,
    fail,
    hidden_effect,
    jobs_bar,
    option_pairs,
    print_answer,
    print_bench,
    print_fmu,
    print_identified,
    print_json,
    print_parts,
    print_planned,
    print_rows,
    progress_bar,
    say,
    seed_range,
    text_pairs,
    wide_console,
)

__all__ = ["app", "run"]

app = typer.Typer(
    name="sysid",
    help="Co-simulation test harness for system identification that closes the loop with measured data.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

app.add_typer(study_app, name="study")


@app.command(name="list")
def list_command(
    what: Annotated[str | None, typer.Argument(help=f"{' | '.join(api.LISTED)} | ID | FILE.fmu")] = None,
    as_json: AsJson = False,
) -> None:
    """Show what is registered, or what is in an FMU."""
    if what is not None and what.endswith(".fmu"):
        description = api.describe_fmu(what)
        if as_json:
            print_json(description)
        else:
            print_fmu(description)
        return
    if what is not None and what not in api.LISTED and (part := api.describe_part(what)) is not None:
        if as_json:
            print_json(part)
            return
        say(f"{part['id']} ({part['kind'][:-1]} of {part['distribution']}): {part['text']}")
        for title, fact in part["facts"].items():
            say(f"{title}: {fact}")
        print_rows(part["options"])
        return
    parts = api.list_parts(what)
    if as_json:
        print_json(parts)
        return
    print_parts(parts)


@app.command()
def simulate(
    plant: Annotated[
        str,
        typer.Argument(
            metavar="PLANT", help="id of a plant, or FILE.fmu, .toml or .ssp", autocompletion=completed("plants")
        ),
    ],
    scenario: Annotated[
        str | None,
        typer.Option(
            "--scenario", help="id of a scenario; an FMU also runs as it is", autocompletion=completed("scenarios")
        ),
    ] = None,
    seed: Seed = 0,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="run.csv or run.parquet")] = None,
    option: OptionPairs = None,
    scenario_option: Annotated[
        list[str] | None, typer.Option("--scenario-option", "-S", metavar="k=v", help="scenario option, repeatable")
    ] = None,
    hide: Annotated[
        list[str] | None,
        typer.Option(metavar="EFFECT@PORT:k=v,...", help="hide an effect in the plant, repeatable"),
    ] = None,
    role: Annotated[
        str, typer.Option(help="estimation/0, validation/0, ...: another role, other noise")
    ] = "estimation/0",
    start: Annotated[float | None, typer.Option(help="of an FMU without a scenario: first instant [s]")] = None,
    stop: Annotated[float | None, typer.Option(help="of an FMU without a scenario: last instant [s]")] = None,
    step: Annotated[float | None, typer.Option(help="of an FMU without a scenario: sample time [s]")] = None,
    tolerance: Annotated[float | None, typer.Option(help="of an FMU without a scenario: of its solver")] = None,
    force: Force = False,
) -> None:
    """Run a scenario on a plant and record it; an FMU runs as it is where no scenario is given."""
    notes: list[str] = []
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
            force=force,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
            note=notes.append,
        )
    for text in notes:
        print(f"sysid: note: {text}", file=sys.stderr)
    say(str(trajectory))
    if out is not None:
        say(f"wrote {out}")


@app.command()
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
        str, typer.Option(help="seeds with an overlay of their trajectory: first | all | none")
    ] = "first",
    dry_run: Annotated[bool, typer.Option("--dry-run", help="say what would run, and how long it would take")] = False,
    as_json: AsJson = False,
) -> None:
    """Run a suite of plants x scenarios x identifiers x seeds and print its table."""
    folder = out if out is not None else Path("results") / Path(suite).stem
    if dry_run:
        planned = api.plan_bench(suite, out=folder, workers=workers, seeds=seed_range(seeds), shard=shard)
        for names, count in planned.cells.items():
            say(f"{count:6d}  {' x '.join(names)}")
        say(str(planned))
        return
    with jobs_bar(suite, suite) as show:
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


@app.command()
def table(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="folder of a benchmark, or of its shares")],
    form: Annotated[str | None, typer.Option("--format", help="markdown | latex | csv")] = None,
    as_json: AsJson = False,
) -> None:
    """Print a stored benchmark again, and render its report anew; puts the shares of a job array together."""
    result = api.table(directory)
    if form is not None:
        from harness.benchmark import render

        print(render(result, form), end="")
        return
    print_bench(result, as_json=as_json)


@app.command()
def query(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="folder of a benchmark or a fleet, finished or not")],
    sql: Annotated[
        str | None,
        typer.Argument(metavar="[SQL]", help="over results, timings, regret, traces; of a fleet: records, effects"),
    ] = None,
    only: Annotated[
        list[str] | None, typer.Option("--filter", metavar="COLUMN=VALUE", help="only such rows, repeatable")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="answer.csv or answer.parquet")] = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Ask the stored rows of a benchmark or a fleet a question in SQL (DuckDB), or show those with given values."""
    answer = api.query(directory, sql, filters=text_pairs(only, "--filter"))
    if out is not None:
        answer.write(out, force=force)
        say(f"wrote {out}")
    elif as_json:
        print_json(answer.records())
    else:
        print_answer(answer if sql is not None else answer.narrow())


@app.command()
def identify(
    dataset: Annotated[str, typer.Argument(metavar="DATASET", help="dataset.toml, CSV, Parquet, or a recording")],
    identifier: Annotated[str, typer.Option(help="id of an identifier", autocompletion=completed("identifiers"))],
    option: OptionPairs = None,
    model: ModelName = None,
    validation: Validation = None,
    undriven: Undriven = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="model.json")] = None,
    seed: Seed = 0,
    force: Force = False,
) -> None:
    """Fit one model to a data set and score it."""
    fitted = api.identify(
        dataset,
        identifier=identifier,
        options=option_pairs(option, "--option"),
        model=model,
        validation=validation,
        undriven=undriven or (),
        out=out,
        seed=seed,
        force=force,
    )
    print_identified(fitted, identifier)
    if out is not None:
        say(f"wrote {out}")


@app.command()
def compare(
    files: Annotated[list[str], typer.Argument(metavar="MODEL... DATASET", help="model.json files, then the data set")],
    model: ModelName = None,
    validation: Validation = None,
    undriven: Undriven = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="page.html")] = None,
    trust: Annotated[bool, typer.Option("--trust", help="run the Python file that a model.json names")] = False,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Put stored models side by side on one data set: fit, residuals, frequency responses."""
    if len(files) < 2:
        raise InputError(
            "what to compare", expected="MODEL... DATASET", got=" ".join(files), remedy="give a model and a data set"
        )
    found = api.compare(
        files[:-1],
        files[-1],
        model=model,
        validation=validation,
        undriven=undriven or (),
        out=out,
        trust=trust,
        force=force,
    )
    if as_json:
        print_json(found.rows())
    else:
        print_rows(found.rows())
    if out is not None:
        say(f"wrote {out}")


@app.command()
def spectrum(
    dataset: Annotated[str, typer.Argument(metavar="DATASET", help="dataset.toml, CSV, Parquet, or a recording")],
    model: ModelName = None,
    undriven: Undriven = None,
    segment: Annotated[int | None, typer.Option(min=16, help="samples of a segment of Welch's method")] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="picture: .svg, .png or .pdf")] = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Show the frequency response in the data, with bands and coherence."""
    found = api.spectrum(dataset, model=model, undriven=undriven or (), segment=segment, out=out, force=force)
    if as_json:
        print_json(found.rows(64))
    else:
        say(f"{found.averages:.0f} averages; deviation is one standard deviation of the magnitude")
        print_rows(found.rows())
    if out is not None:
        say(f"wrote {out}")


@app.command(name="close-loop")
def close_loop(
    dataset: Annotated[
        str,
        typer.Argument(
            metavar="DATASET|RECORDING|FLEET",
            help="see sysid list recordings; many: a folder, a pattern in quotes, a CSV table with the column file",
        ),
    ],
    out: Annotated[Path, typer.Option(help="folder for report.html and report.json; of a fleet, for fleet.html")],
    model: ModelName = None,
    validation: Validation = None,
    undriven: Undriven = None,
    as_json: Annotated[bool, typer.Option("--json", help="print report.json")] = False,
    resume: Resume = False,
    force: Force = False,
    workers: Annotated[int | None, typer.Option(min=1, help="of a fleet: processes; default all cores")] = None,
    engine: Annotated[str, typer.Option(help="of a fleet: local, or dask://HOST:PORT")] = "local",
    time_limit: Annotated[float | None, typer.Option(help="of a fleet: seconds for one record")] = None,
) -> None:
    """Find the effect that a model lacks, add it, report the error before and after; of one record or of a fleet."""
    from harness.fleet import is_fleet

    if is_fleet(dataset):
        if validation is not None or force:
            raise InputError(
                "option of one record",
                expected="records with their own validation files, and a new folder or --resume",
                got="--force" if force else "--validation",
                remedy="name validation files in the column validation of a table of records",
            )
        _close_fleet(dataset, out, model, undriven, as_json, resume, workers, engine, time_limit)
        return
    if engine != "local" or time_limit is not None or workers is not None:
        raise InputError(
            "option of a fleet",
            expected="many records",
            got="one, with "
            + ("--engine" if engine != "local" else "--workers" if time_limit is None else "--time-limit"),
            remedy="leave it out, or give a folder, a pattern in quotes or a table of records",
        )
    with progress_bar("closing the loop") as bar:
        task = bar.add_task(dataset, total=1.0)

        def show(fraction: float, what: str) -> None:
            bar.update(task, completed=fraction, description=what)

        report = api.close_loop(
            dataset,
            out=out,
            model=model,
            validation=validation,
            undriven=undriven or (),
            resume=resume,
            force=force,
            progress=show,
        )
    if as_json:
        print_json(report.data)
        return
    wide_console().print(str(report), highlight=False, markup=False, soft_wrap=True)
    for text in report.data["warnings"]:
        print(f"sysid: note: {text}", file=sys.stderr)
    say(f"report: {out / 'report.html'}")


def _close_fleet(
    source: str,
    out: Path,
    model: str | None,
    undriven: list[str] | None,
    as_json: bool,
    resume: bool,
    workers: int | None,
    engine: str,
    time_limit: float | None,
) -> None:
    """Close the loop on many records and print what they have in common."""
    with jobs_bar("of records", source) as show:
        result = api.close_fleet(
            source,
            out=out,
            model=model,
            undriven=undriven or (),
            engine=engine,
            workers=workers,
            time_limit=time_limit,
            resume=resume,
            progress=show,
        )
    if as_json:
        print_json(result.to_records())
        return
    say(str(result))
    say(f"page: {result.page}")


@app.command()
def isolability(
    model: Annotated[str, typer.Argument(metavar="PLANT_OR_MODEL", help="nominal model, or a plant made of equations")],
    scenario: Annotated[
        str, typer.Option("--scenario", help="id of a scenario", autocompletion=completed("scenarios"))
    ],
    scenario_option: Annotated[
        list[str] | None, typer.Option("--scenario-option", "-S", metavar="k=v", help="scenario option, repeatable")
    ] = None,
    parameter: Annotated[
        list[str] | None, typer.Option("--parameter", metavar="k=v", help="value of a model parameter, repeatable")
    ] = None,
    sample_time: Annotated[float, typer.Option(help="of the planned record [s]")] = 0.01,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Say before measuring which effects an experiment could tell apart."""
    found = api.isolability(
        model,
        scenario=scenario,
        scenario_options=option_pairs(scenario_option, "--scenario-option"),
        parameters=option_pairs(parameter, "--parameter"),
        sample_time=sample_time,
        seed=seed,
    )
    if as_json:
        print_json(found.to_dict())
    else:
        print_planned(found)


@app.command()
def export(
    source: Annotated[str, typer.Argument(metavar="DIR_OR_MODEL", help="folder of close-loop, or a model")],
    out: Annotated[Path, typer.Option("--out", "-o", help="model.fmu; model.ssp for a repaired FMU")],
    fmi: Annotated[str, typer.Option(help="2, 3 or both (then model.fmu is FMI 2.0, model-fmi3.fmu FMI 3.0)")] = "both",
    force: Force = False,
    trust: Annotated[bool, typer.Option("--trust", help="run the Python file that model.json names")] = False,
) -> None:
    """Write a model as a co-simulation FMU, with its C source."""
    for path in api.export(source, out=out, fmi=fmi, force=force, trust=trust):
        say(f"wrote {path}")


@app.command()
def check(
    name: Annotated[str, typer.Argument(metavar="NAME_OR_FILE", help="id of a plug-in, or FILE.py:NAME")],
    as_json: AsJson = False,
) -> None:
    """Hold a plug-in to its contract; exit 2 if it breaks it."""
    results = api.check(name)
    if as_json:
        print_json([{"name": r.name, "passed": r.passed, "reason": r.reason} for r in results])
    else:
        for result in results:
            say(f"{'pass' if result.passed else 'FAIL'}  {result.name}{': ' + result.reason if result.reason else ''}")
    failed = [result.name for result in results if not result.passed]
    if failed:
        raise InputError(
            f"{name} breaks its contract",
            expected=f"{len(results)} checks passed",
            got=f"{len(failed)} failed ({', '.join(failed)})",
            remedy="see the reasons above",
        )


@app.command()
def new(
    kind: Annotated[str, typer.Argument(metavar="KIND", help="identifier | plant | scenario | effect | model")],
    name: Annotated[str, typer.Argument(metavar="NAME", help="its id, such as soft-friction")],
    folder: Annotated[Path, typer.Option(help="where sysid-NAME/ is made")] = Path("."),
) -> None:
    """Begin a plug-in: a distribution of its own that works and passes its checks."""
    from harness.scaffold import new as begin

    for path in begin(kind, name, folder=folder):
        say(f"wrote {path}")
    say(f"now: cd {folder / f'sysid-{name}'} && pip install -e . && sysid check {name}")


@app.callback(invoke_without_command=True)
def _root(version: Annotated[bool, typer.Option("--version", help="print the version")] = False) -> None:
    """Co-simulation test harness for system identification that closes the loop with measured data."""
    if version:
        say(f"sysid-harness {__version__}")
        raise typer.Exit()


def run(arguments: Sequence[str] | None, interrupts: Interrupts) -> int:
    """Run the command line and return the exit status; every failure is one line on standard error."""
    from typer.main import get_command

    try:
        code = get_command(app).main(
            args=None if arguments is None else list(arguments), prog_name="sysid", standalone_mode=False
        )
        if code == INTERRUPTED:  # the library turns Ctrl-C into a status
            raise KeyboardInterrupt
        sys.stdout.flush()
        return code if isinstance(code, int) else 0
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (KeyboardInterrupt, typer.Abort):
        return _interrupted()
    except Exception as error:
        return _interrupted() if interrupts.seen else _failed(error)


def _interrupted() -> int:
    """Say that Ctrl-C was heard."""
    return fail("interrupted; what was finished is kept, --resume continues", INTERRUPTED)


def _failed(error: Exception) -> int:
    """Say what went wrong, and whose it is."""
    if isinstance(error, OSError):
        from harness.data.whole_files import refused_by_system

        error = refused_by_system(error) or error
    debug = bool(os.environ.get("SYSID_HARNESS_DEBUG"))
    if debug and isinstance(error.__cause__, TypeError | ValueError | AttributeError | LookupError):
        raise error
    if isinstance(error, HarnessError):
        return fail(" ".join(str(error).split()), 2)
    if hasattr(error, "format_message") and hasattr(error, "exit_code"):
        return fail(f"{error.format_message()}; remedy: sysid --help", 2)
    if debug:
        raise error
    return fail(
        f"a fault in sysid-harness: {type(error).__name__}: {' '.join(str(error).split())}; "
        "remedy: set SYSID_HARNESS_DEBUG=1 for the traceback and report it",
        1,
    )
