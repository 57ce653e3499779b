"""``sysid check``: a plug-in held to its contract, an FMU vetted, a run held against a reference."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from harness import api
from harness.cli.options import AsJson, Force, Junit, OptionPairs, judged
from harness.cli.terminal import noted, print_json, print_paths, print_rows, say, share_bar
from harness.cli.words import option_pairs, text_pairs
from harness.errors import InputError
from harness.trust import names_fmu

CALL = 10.0
"""Longest time for one call of an FMU [s], where none is given."""


def check(
    name: Annotated[
        str, typer.Argument(metavar="NAME_OR_FILE", help="id of a plug-in, FILE.py:NAME, FILE.fmu, or a run FILE.csv")
    ],
    reference: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="FMU or run: table that it must agree with, time in the first column"),
    ] = None,
    tube: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=WIDTH[@TIME]",
            help="half width around the reference: 0.01, 0.5% of the range, 0.01+0.5%, and @0.02 s in time; "
            "* is every other channel (default 0.2%), repeatable",
        ),
    ] = None,
    inputs: Annotated[Path | None, typer.Option(metavar="FILE", help="with --reference: a table of inputs")] = None,
    start: Annotated[float | None, typer.Option(help="with --reference: first instant of the run [s]")] = None,
    stop: Annotated[float | None, typer.Option(help="with --reference: last instant of the run [s]")] = None,
    step: Annotated[float | None, typer.Option(help="with --reference: step of the run [s]")] = None,
    option: OptionPairs = None,
    limit: Annotated[
        float | None,
        typer.Option(help="longest time for one call of an FMU (10) or one check of a plug-in (300) [s]", min=0.0),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="FMU or run: page.html")] = None,
    junit: Junit = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Check a plug-in against its contract, vet an FMU, or compare a run with a reference; status 1 on failure."""
    if reference is not None:
        with share_bar("checking", name):
            agreed = api.agreement(
                name,
                reference,
                tubes=text_pairs(tube, "--tube"),
                inputs=inputs,
                options=option_pairs(option, "--option"),
                start=start,
                stop=stop,
                step=step,
                limit=CALL if limit is None else limit,
                out=out,
                force=force,
            )
        for text in agreed.notes:
            noted(text)
        if as_json:
            print_json(agreed.to_dict())
        else:
            print_rows(agreed.rows())
            print_paths(out)
        judged("check", agreed.checks(), junit)
        return
    asked = {"--tube": tube, "--inputs": inputs, "--start": start, "--stop": stop, "--step": step}
    if any(value is not None for value in asked.values()):
        raise InputError(
            ", ".join(flag for flag, value in asked.items() if value is not None),
            expected="--reference FILE beside it",
            got="none",
            remedy="name the reference",
        )
    if names_fmu(name):
        with share_bar("checking", name) as show:
            vetted = api.vet(
                name,
                options=option_pairs(option, "--option"),
                limit=CALL if limit is None else limit,
                out=out,
                force=force,
                progress=show,
            )
        if as_json:
            print_json(vetted.to_dict())
        else:
            say(str(vetted))
            print_paths(out)
        judged("check", vetted.checks(), junit)
        return
    if option or out is not None:
        raise InputError(
            "--option and --out", expected="an FMU, or a run with --reference", got=name, remedy="leave them out"
        )
    results = api.check(name, limit=limit)
    if as_json:
        print_json([{"name": r.name, "passed": r.passed, "reason": r.reason} for r in results])
    else:
        for result in results:
            say(f"{'pass' if result.passed else 'FAIL'}  {result.name}{': ' + result.reason if result.reason else ''}")
    from harness.scoring.acceptance import Demand

    judged("check", [Demand(name, result.name, result.passed, result.reason or "") for result in results], junit)
