"""The commands of ``sysid`` that learn models from data, look at both, and write them out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from harness import api
from harness.cli_options import (
    AsJson,
    Columns,
    DatasetName,
    Force,
    Inputs,
    ModelName,
    OptionPairs,
    Outputs,
    Runs,
    SampleTime,
    Seed,
    Undriven,
    Units,
    Validation,
    signals_of,
)
from harness.errors import InputError
from harness.terminal import completed, option_pairs, print_identified, print_json, print_rows, say, whole_range

__all__ = ["compare", "export", "identify", "order", "spectrum"]


def identify(
    dataset: DatasetName,
    identifier: Annotated[
        str | None,
        typer.Option(
            help="id of an identifier; default arx where no physical model is given",
            autocompletion=completed("identifiers"),
        ),
    ] = None,
    option: OptionPairs = None,
    model: ModelName = None,
    validation: Validation = None,
    undriven: Undriven = None,
    input: Inputs = None,
    output: Outputs = None,
    column: Columns = None,
    unit: Units = None,
    sample_time: SampleTime = None,
    run: Runs = None,
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
        **signals_of(input, output, column, unit, sample_time, run),
    )
    print_identified(fitted, identifier or api.DEFAULT_IDENTIFIER)
    if out is not None:
        say(f"wrote {out}")


def compare(
    files: Annotated[list[str], typer.Argument(metavar="MODEL... DATASET", help="model.json files, then the data set")],
    model: ModelName = None,
    validation: Validation = None,
    undriven: Undriven = None,
    input: Inputs = None,
    output: Outputs = None,
    column: Columns = None,
    unit: Units = None,
    sample_time: SampleTime = None,
    run: Runs = None,
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
        **signals_of(input, output, column, unit, sample_time, run),
    )
    if as_json:
        print_json(found.rows())
    else:
        print_rows(found.rows())
    if out is not None:
        say(f"wrote {out}")


def spectrum(
    dataset: DatasetName,
    model: ModelName = None,
    undriven: Undriven = None,
    input: Inputs = None,
    output: Outputs = None,
    column: Columns = None,
    unit: Units = None,
    sample_time: SampleTime = None,
    run: Runs = None,
    segment: Annotated[int | None, typer.Option(min=16, help="samples of a segment of Welch's method")] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="picture: .svg, .png or .pdf")] = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Show the frequency response in the data, with bands and coherence."""
    found = api.spectrum(
        dataset,
        model=model,
        undriven=undriven or (),
        segment=segment,
        out=out,
        force=force,
        **signals_of(input, output, column, unit, sample_time, run),
    )
    if as_json:
        print_json(found.rows(64))
    else:
        say(f"{found.averages:.0f} averages; deviation is one standard deviation of the magnitude")
        print_rows(found.rows())
    if out is not None:
        say(f"wrote {out}")


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


def order(
    dataset: DatasetName,
    identifier: Annotated[
        list[str] | None,
        typer.Option(
            help="one with the option order, repeatable; default arx, n4sid, ho-kalman",
            autocompletion=completed("identifiers"),
        ),
    ] = None,
    orders: Annotated[str, typer.Option(metavar="A..B", help="orders A to B, both included")] = "1..12",
    option: OptionPairs = None,
    model: ModelName = None,
    validation: Validation = None,
    undriven: Undriven = None,
    input: Inputs = None,
    output: Outputs = None,
    column: Columns = None,
    unit: Units = None,
    sample_time: SampleTime = None,
    run: Runs = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="picture: .svg, .png or .pdf")] = None,
    seed: Seed = 0,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Show which order a linear model needs: held-out errors by order, and singular values."""
    first, last = whole_range(orders, "--orders")
    found = api.order(
        dataset,
        identifiers=identifier or (),
        orders=range(first, last + 1),
        options=option_pairs(option, "--option"),
        model=model,
        validation=validation,
        undriven=undriven or (),
        out=out,
        seed=seed,
        force=force,
        **signals_of(input, output, column, unit, sample_time, run),
    )
    if as_json:
        print_json(
            {"orders": found.rows(), "singular_values": {k: v.tolist() for k, v in found.singular_values.items()}}
        )
    else:
        say(f"judged on {found.judged}")
        print_rows(found.rows())
    if out is not None:
        say(f"wrote {out}")
