"""The commands of ``sysid`` that learn models from data, look at both, and write them out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from harness import api
from harness.cli.calibration import Bounds, Copies, Free, Initial, Slopes, Ssv, Start, Starts, calibrated
from harness.cli.options import (
    AsJson,
    DatasetName,
    Force,
    Junit,
    MaxError,
    ModelName,
    OptionPairs,
    Page,
    Picture,
    Seed,
    Trust,
    Undriven,
    demands_of,
    judged,
    of_table,
)
from harness.cli.results import print_identified
from harness.cli.terminal import noted, print_json, print_paths, print_rows, print_written, say
from harness.cli.words import completed, option_pairs, whole_range
from harness.errors import InputError
from harness.frequency import is_response

if TYPE_CHECKING:
    from harness.data.recipe.chosen import ChosenSignals, Records
    from harness.models.arx_orders import ArxGrid


@of_table
def check_data(
    dataset: DatasetName,
    model: ModelName = None,
    *,
    records: Records,
    out: Page = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Find faults in records: spikes, held readings, late inputs and more. Fits leave these readings out."""
    found = api.check_data(dataset, model=model, out=out, force=force, **records)
    if as_json:
        print_json(found.to_dict())
        return
    say(str(found))
    print_paths(out)


@of_table
def identify(
    dataset: DatasetName,
    identifier: Annotated[
        str | None,
        typer.Option(
            help="id; default without a model: prediction-error, arx if there is no input, counts for categories",
            autocompletion=completed("identifiers"),
        ),
    ] = None,
    option: OptionPairs = None,
    model: ModelName = None,
    *,
    records: Records,
    free: Free = None,
    bound: Bounds = None,
    start: Start = None,
    starts: Starts = 3,
    initial: Initial = "estimated",
    slopes: Slopes = "differences",
    ssv: Ssv = None,
    copy: Copies = None,
    bounds: Annotated[
        bool, typer.Option("--bounds", help="compare errors with finite-sample bounds (linear models)")
    ] = False,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="model.json")] = None,
    seed: Seed = 0,
    max_error: MaxError = None,
    junit: Junit = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Fit one model to a data set and score it; with --free, fit parameters of an FMU or a system of FMUs."""
    demands = demands_of(None, max_error, None)
    if is_response(dataset):
        _identify_response(
            dataset, identifier, option, records,
            {"file of records": records["validation"], "a physical model": model, "--bounds": bounds or None}, out,
            as_json=as_json, force=force,
        )  # fmt: skip
        return
    if free:
        if bounds:
            raise InputError("--bounds", expected="a linear identifier", got="--free", remedy="leave one out")
        if model is None or identifier is not None:
            raise InputError(
                "--free",
                expected="--model FILE.fmu or FILE.ssp, and no --identifier",
                got="no model" if model is None else f"--identifier {identifier}",
                remedy="name the model alone",
            )
        found = calibrated(
            dataset,
            model=model,
            free=free,
            bound=bound,
            start=start,
            starts=starts,
            initial=initial,
            slopes=slopes,
            ssv=ssv,
            copy=copy,
            out=out,
            as_json=as_json,
            options=option_pairs(option, "--option"),
            seed=seed,
            force=force,
            **records,
        )
        judged("identify", demands.of_errors(Path(model).name, found.errors()), junit)
        return
    if bound or start or ssv or copy:
        raise InputError(
            "--bound, --start, --ssv and --fmu-out", expected="--free NAME", got="none", remedy="name what is free"
        )
    fitted = api.identify(
        dataset,
        identifier=identifier,
        options=option_pairs(option, "--option"),
        model=model,
        out=out,
        seed=seed,
        bounds=bounds,
        force=force,
        **records,
    )
    name = identifier or api.default_identifier(fitted.model.spec)
    if as_json:
        print_json(fitted.to_dict())
    else:
        print_identified(fitted, name)
        if fitted.bounds is not None:
            print_rows([dict(row) for row in fitted.bounds.rows])
            for text in fitted.bounds.words:
                say(text)
        print_paths(out)
    judged("identify", demands.of_errors(name, fitted.errors()), junit)


def _identify_response(
    file: str,
    identifier: str | None,
    option: list[str] | None,
    signals: Records,
    no_use: dict[str, Any],
    out: Path | None,
    *,
    as_json: bool,
    force: bool,
) -> None:
    """Fit a transfer function to the frequency response of a file, and print it."""
    for what, given in no_use.items():
        if given is not None:
            raise InputError(
                f"a frequency response and {what}", expected="the file alone", got=str(given), remedy="leave it out"
            )
    found = api.identify_response(
        file,
        identifier=identifier or "transfer-function",
        options=option_pairs(option, "--option"),
        units=signals["unit"] or {},
        sample_time=signals["sample_time"],
        out=out,
        force=force,
    )
    if as_json:
        print_json(found.to_dict())
        return
    for line in found.words():
        say(line)
    print_paths(out)


@of_table
def compare(
    files: Annotated[
        list[str],
        typer.Argument(metavar="MODEL... DATASET", help="model.json files, then the data set; or two reports"),
    ],
    model: ModelName = None,
    *,
    records: Records,
    out: Page = None,
    max_error: MaxError = None,
    junit: Junit = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Compare stored models on one data set (fit, residuals, frequency responses), or compare two reports."""
    demands = demands_of(None, max_error, None)
    from harness.comparison.reports import is_report

    if len(files) < 2:
        raise InputError(
            "what to compare",
            expected="MODEL... DATASET, or REPORT REPORT",
            got=" ".join(files),
            remedy="give a model and a data set",
        )
    if len(files) == 2 and (is_report(files[1]) or (files[0].endswith(".json") and is_report(files[0]))):
        asked = [name for name, given in (("--out", out), ("--max-error", max_error), ("--junit", junit)) if given]
        if asked:
            raise InputError(
                "options of two reports",
                expected="none but --json: what differs is printed",
                got=", ".join(asked),
                remedy="leave them out",
            )
        told = api.compare_reports(*files)
        if as_json:
            print_json(told.rows())
            return
        say(str(told))
        print_rows(told.rows())
        return
    found = api.compare(files[:-1], files[-1], model=model, out=out, force=force, note=noted, **records)
    if as_json:
        print_json(found.rows())
    else:
        print_rows(found.rows())
        print_paths(out)
    checks = [check for one in found.models for check in demands.of_errors(one.name, one.errors())]
    judged("compare", checks, junit)


@of_table
def spectrum(
    dataset: DatasetName,
    model: ModelName = None,
    undriven: Undriven = None,
    *,
    signals: ChosenSignals,
    segment: Annotated[
        int | None, typer.Option(min=16, help="use Welch's method, with segments of this many samples")
    ] = None,
    out: Picture = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Show the frequency response of the data, with bands and coherence."""
    found = api.spectrum(
        dataset, model=model, undriven=undriven or (), segment=segment, out=out, force=force, note=noted, **signals
    )
    if as_json:
        print_json(found.rows(64))
    else:
        counted = "averages" if found.method == "Welch" else "lines each"
        say(f"{found.method}, {found.averages:.0f} {counted}; deviation is one standard deviation of the magnitude")
        say(f"magnitudes: {found.gains()}")
        if dark := found.unexcited():
            say(dark)
        titles = {"frequency": "frequency [Hz]", "phase": "phase [deg]"}
        print_rows([{titles.get(name, name): value for name, value in row.items()} for row in found.rows()])
        print_paths(out)


def export(
    source: Annotated[str, typer.Argument(metavar="DIR_OR_MODEL", help="folder of a closed loop, or a model.json")],
    out: Annotated[
        Path,
        typer.Option("--out", "-o", help="model.fmu; for a repaired FMU model.ssp; for an arm arm.urdf or arm.xml"),
    ],
    fmi: Annotated[str, typer.Option(help="2, 3 or both (then model.fmu is FMI 2.0, model-fmi3.fmu FMI 3.0)")] = "both",
    as_json: AsJson = False,
    force: Force = False,
    trust: Trust = None,
) -> None:
    """Write a model as a co-simulation FMU with its C source."""
    print_written(api.export(source, out=out, fmi=fmi, force=force), as_json=as_json)


def _span(text: str | None, flag: str) -> range:
    """Return the orders that an option asks for."""
    if text is None:
        raise InputError(flag[2:], expected="both --na and --nb", got=f"no {flag}", remedy=f"write e.g. {flag} 1..4")
    first, last = whole_range(text, flag)
    return range(first, last + 1)


def _print_grid(found: ArxGrid, *, as_json: bool) -> None:
    """Print what the criteria prefer of a grid of ARX orders."""
    rows = found.rows_of()
    if as_json:
        print_json({"orders": rows, "rows": found.rows, "rows_held_out": found.held_rows})
        return
    say(f"{found.losses[..., 0].size} ARX models on {found.rows} rows, judged on {found.held_rows} others")
    print_rows(rows)


@of_table
def order(
    dataset: DatasetName,
    identifier: Annotated[
        list[str] | None,
        typer.Option(
            help="identifier with the option order, repeatable; default arx, n4sid, ho-kalman",
            autocompletion=completed("identifiers"),
        ),
    ] = None,
    orders: Annotated[str, typer.Option(metavar="A..B", help="orders A to B, both included")] = "1..12",
    na: Annotated[
        str | None, typer.Option(metavar="A..B", help="grid of ARX models: number of past outputs; needs --nb")
    ] = None,
    nb: Annotated[
        str | None, typer.Option(metavar="A..B", help="grid of ARX models: coefficients of each input")
    ] = None,
    nk: Annotated[str, typer.Option(metavar="A..B", help="grid of ARX models: delays")] = "1",
    option: OptionPairs = None,
    model: ModelName = None,
    *,
    records: Records,
    out: Picture = None,
    seed: Seed = 0,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Show which order a linear model needs: held-out errors by order, and singular values.

    With --na and --nb the ARX models of all these orders and delays, from one factorisation of the data.
    """
    if na is not None or nb is not None:
        _print_grid(
            api.arx_orders(
                dataset,
                *(_span(text, flag) for text, flag in ((na, "--na"), (nb, "--nb"), (nk, "--nk"))),
                model=model,
                out=out,
                force=force,
                note=noted,
                **records,
            ),
            as_json=as_json,
        )
        print_paths(None if as_json else out)
        return
    first, last = whole_range(orders, "--orders")
    found = api.order(
        dataset,
        identifiers=identifier or (),
        orders=range(first, last + 1),
        options=option_pairs(option, "--option"),
        model=model,
        out=out,
        seed=seed,
        force=force,
        note=noted,
        **records,
    )
    if as_json:
        print_json(
            {"orders": found.rows(), "singular_values": {k: v.tolist() for k, v in found.singular_values.items()}}
        )
    else:
        say(f"judged on {found.judged}")
        print_rows(found.printed())
        print_paths(out)
