"""The commands of ``sysid`` that close the loop: on a record, on a fleet, before measuring, and on what is left."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from harness import api
from harness.cli.options import (
    AsJson,
    FailOn,
    Force,
    Junit,
    MaxError,
    MaxShare,
    ModelName,
    Resume,
    ScenarioPairs,
    Seed,
    Trust,
    Undriven,
    Validation,
    demands_of,
    judged,
    of_table,
)
from harness.cli.results import print_planned
from harness.cli.terminal import jobs_bar, noted, print_json, say, share_bar, wide_console
from harness.cli.words import completed, option_pairs
from harness.errors import InputError, printable

if TYPE_CHECKING:
    from harness.data.recipe.chosen import Records
    from harness.diagnosis import Report
    from harness.learned import LearnedResidual
    from harness.scoring.acceptance import Demands


@of_table
def close_loop(
    dataset: Annotated[
        str,
        typer.Argument(
            metavar="DATASET|RECORDING|FLEET",
            help="log, dataset.toml or recording (sysid list recordings); fleet: a folder, a quoted pattern, a table",
        ),
    ],
    out: Annotated[Path, typer.Option(help="folder for report.html and report.json; fleet: for fleet.html")],
    model: ModelName = None,
    *,
    records: Records,
    dictionary: Annotated[
        str,
        typer.Option(
            metavar="TEXT",
            help="effects: given, to try (?), or left out (!), such as 'coulomb_friction(theta); *delay*?; !cogging'",
        ),
    ] = "",
    effect: Annotated[
        list[str] | None, typer.Option(metavar="FILE.py:NAME", help="a law of your own to try as well, repeatable")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="print report.json")] = False,
    resume: Resume = False,
    force: Force = False,
    workers: Annotated[int | None, typer.Option(min=1, help="fleet: number of processes; default all cores")] = None,
    engine: Annotated[str, typer.Option(help="fleet: local, or dask://HOST:PORT")] = "local",
    time_limit: Annotated[float | None, typer.Option(help="fleet: longest time for one record [s]")] = None,
    step_limit: Annotated[
        float | None,
        typer.Option(min=0.0, help="FMU: longest time for one step [s]; default 10 or less"),
    ] = None,
    fail_on: FailOn = None,
    max_error: MaxError = None,
    max_share: MaxShare = None,
    junit: Junit = None,
) -> None:
    """Find the effect that a model lacks, add it, and report the error before and after; for one record or a fleet."""
    from harness.fleet import is_fleet

    demands = demands_of(fail_on, max_error, max_share)
    if is_fleet(dataset):
        validation, undriven = records.pop("validation"), records.pop("undriven")
        if any(records.values()):
            raise InputError(
                "columns chosen for a fleet",
                expected="records whose titles are the model's ports, or a dataset.toml for each",
                got=" ".join(f"--{name.replace('_', '-')}" for name, value in records.items() if value),
                remedy="leave it out",
            )
        if validation is not None or force:
            raise InputError(
                "option of one record",
                expected="records with their own validation files, and a new folder or --resume",
                got="--force" if force else "--validation",
                remedy="choose a new folder, or --resume to do what is missing in this one"
                if force
                else "name validation files in the column validation of a table of records",
            )
        if step_limit is not None:
            raise InputError(
                "option of one record",
                expected="the time limit of a record in a fleet",
                got="--step-limit",
                remedy="leave it out, or give --time-limit",
            )
        if dictionary or effect:
            raise InputError(
                "option of one record",
                expected="the whole dictionary for a fleet, whose records are compared with each other",
                got="--dictionary" if dictionary else "--effect",
                remedy="leave it out; a law for a fleet comes from an installed plug-in, see sysid new effect",
            )
        _close_fleet(dataset, out, model, undriven, as_json, resume, workers, engine, time_limit, demands, junit)
        return
    if engine != "local" or time_limit is not None or workers is not None:
        raise InputError(
            "option of a fleet",
            expected="many records",
            got="one, with "
            + ("--engine" if engine != "local" else "--workers" if time_limit is None else "--time-limit"),
            remedy="leave it out, or give a folder, a pattern in quotes or a table of records",
        )
    with share_bar("closing the loop", dataset) as show:
        report = api.close_loop(
            dataset,
            out=out,
            model=model,
            dictionary=dictionary,
            effects=effect or (),
            resume=resume,
            force=force,
            step_limit=step_limit,
            progress=show,
            **records,
        )
    if as_json:
        print_json(report.data)
    else:
        _print_told(report)
        say(f"report: {out / 'report.html'}")
    judged("close-loop", demands.of_report(str(report.data["dataset"]), report.data), junit)


def _close_fleet(
    source: str,
    out: Path,
    model: str | None,
    undriven: Sequence[str],
    as_json: bool,
    resume: bool,
    workers: int | None,
    engine: str,
    time_limit: float | None,
    demands: Demands,
    junit: Path | None,
) -> None:
    """Close the loop on many records and print what they have in common."""
    with jobs_bar("records", source) as show:
        result = api.close_fleet(
            source,
            out=out,
            model=model,
            undriven=undriven,
            engine=engine,
            workers=workers,
            resume=resume,
            **({} if time_limit is None else {"time_limit": time_limit}),
            progress=show,
        )
    if as_json:
        print_json(result.to_records())
    else:
        say(str(result))
        say(f"page: {result.page}")
    if result.rows and not any(row.ok for row in result.rows):
        raise InputError(
            "no record gave an answer",
            expected="at least one that can be used",
            got=f"{len(result.rows)} of {len(result.rows)} without one, the first: {result.rows[0].reason}",
            remedy=f"see the reasons in {result.page}",
        )
    judged("close-loop", result.checks(demands), junit)


def learn_residual(
    loop: Annotated[
        Path, typer.Argument(metavar="DIR", help="folder of a closed loop that left something unexplained")
    ],
    dataset: Annotated[str, typer.Argument(metavar="DATASET|RECORDING", help="the data of that loop")],
    out: Annotated[Path, typer.Option(help="folder for learned.html, learned.json and model.json")],
    validation: Validation = None,
    undriven: Undriven = None,
    coordinate: Annotated[str | None, typer.Option(help="where the force acts; default: where it helps most")] = None,
    argument: Annotated[
        list[str] | None,
        typer.Option(help="state or input that the force depends on, repeatable; default: speed, position or both"),
    ] = None,
    refit: Annotated[bool, typer.Option("--refit", help="refit the named parameters together with the force")] = False,
    seed: Seed = 0,
    as_json: AsJson = False,
    force: Force = False,
    trust: Trust = None,
) -> None:
    """Fit what a closed loop left unexplained by a force without a name (not physical, valid within its data)."""
    with share_bar("learning a residual force", str(loop)) as show:
        found = api.learn_residual(
            loop,
            dataset,
            out=out,
            validation=validation,
            undriven=undriven or (),
            coordinate=coordinate,
            arguments=argument,
            refit=refit,
            seed=seed,
            force=force,
            progress=show,
        )
    if as_json:
        print_json(found.data)
        return
    _print_told(found)
    say(f"page: {out / 'learned.html'}")


def _print_told(found: Report | LearnedResidual) -> None:
    """Print what was found, and what it warns of."""
    wide_console().print(printable(str(found)), highlight=False, markup=False, soft_wrap=True)
    for text in found.data["warnings"]:
        noted(text)


def isolability(
    model: Annotated[str, typer.Argument(metavar="PLANT_OR_MODEL", help="nominal model, or a plant made of equations")],
    scenario: Annotated[
        str, typer.Option("--scenario", help="id of a scenario", autocompletion=completed("scenarios"))
    ],
    scenario_option: ScenarioPairs = None,
    parameter: Annotated[
        list[str] | None, typer.Option("--parameter", metavar="k=v", help="value of a model parameter, repeatable")
    ] = None,
    sample_time: Annotated[float, typer.Option(help="sample time of the planned record [s]")] = 0.01,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Before you measure: show which effects an experiment can tell apart."""
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
