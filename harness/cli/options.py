"""Options that several commands share, so that one word means the same everywhere."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from harness.cli.terminal import fail
from harness.cli.words import completed, text_pairs
from harness.trust import trusting

if TYPE_CHECKING:
    from harness.scoring.acceptance import Demand, Demands


def _trust(context: typer.Context, files: list[str] | None) -> list[str] | None:
    """Trust files until the command ends."""
    if files and not context.resilient_parsing:
        context.with_resource(trusting(*files))
    return files


OptionPairs = Annotated[list[str] | None, typer.Option("--option", "-O", metavar="k=v", help="option, repeatable")]
AsJson = Annotated[bool, typer.Option("--json", help="print JSON")]
Force = Annotated[bool, typer.Option("--force", help="overwrite")]
Resume = Annotated[bool, typer.Option("--resume", help="continue what was interrupted")]
Seed = Annotated[int, typer.Option(min=0, help="seed of every random number")]
ModelName = Annotated[
    str | None,
    typer.Option(
        help="nominal model: NAME, FILE.fmu, FILE.urdf, FILE.xml (MJCF), FILE.eqs (equations as text) or FILE.py:NAME",
        autocompletion=completed("models"),
    ),
]
Picture = Annotated[Path | None, typer.Option("--out", "-o", help="picture: .svg, .png or .pdf")]
Page = Annotated[Path | None, typer.Option("--out", "-o", help="page.html")]
Validation = Annotated[Path | None, typer.Option(help="file to validate on, if DATASET is a bare CSV or Parquet file")]
Undriven = Annotated[
    list[str] | None,
    typer.Option("--undriven", metavar="INPUT", help="input of the model that nothing drove, repeatable"),
]
Trust = Annotated[
    list[str] | None,
    typer.Option(
        "--trust",
        metavar="FILE",
        callback=_trust,
        help="allow code that a file names: the code (FILE.py, FILE.fmu), the file or a folder, repeatable",
    ),
]
Workers = Annotated[int | None, typer.Option(min=1, help="number of processes; default all cores")]
Engine = Annotated[str, typer.Option(help="local, or dask://HOST:PORT")]
ScenarioPairs = Annotated[
    list[str] | None, typer.Option("--scenario-option", "-S", metavar="k=v", help="scenario option, repeatable")
]
DatasetName = Annotated[str, typer.Argument(metavar="DATASET", help="dataset.toml, CSV, Parquet, or a recording")]
Inputs = Annotated[
    list[str] | None,
    typer.Option("--input", metavar="NAME", help="table: column of an input, repeatable; none if there is no input"),
]
Outputs = Annotated[
    list[str] | None, typer.Option("--output", metavar="NAME", help="table: column of an output, repeatable")
]
Columns = Annotated[
    list[str] | None,
    typer.Option(
        "--column", metavar="NAME=TITLE", help="table: title of the column of a signal or of time, repeatable"
    ),
]
Units = Annotated[
    list[str] | None,
    typer.Option("--unit", metavar="NAME=UNIT", help="table: unit of a signal or of time, repeatable"),
]
SampleTime = Annotated[
    float | None,
    typer.Option(
        "--sample-time", help="table without a time column, with rough stamps or with several clocks: sample time [s]"
    ),
]
Gaps = Annotated[
    str | None, typer.Option("--gaps", help="table with gaps: split makes a record of every piece between them")
]
Sheet = Annotated[
    str | None, typer.Option("--sheet", metavar="NAME", help="Excel workbook: sheet to read; default the first")
]
FailOn = Annotated[
    str | None,
    typer.Option("--fail-on", metavar="VERDICT[,...]", help="verdicts that give exit status 1, such as unexplained"),
]
MaxError = Annotated[
    list[str] | None,
    typer.Option(
        "--max-error",
        metavar="OUTPUT=VALUE",
        help="largest rms simulation error allowed on validation data, such as theta=2mrad, repeatable; else status 1",
    ),
]
MaxShare = Annotated[
    float | None,
    typer.Option("--max-share", help="largest unexplained share of the motion allowed, 0 to 1; else status 1"),
]
Junit = Annotated[Path | None, typer.Option("--junit", metavar="FILE", help="write the checks as JUnit XML")]
Runs = Annotated[
    list[str] | None,
    typer.Option(
        "--run", metavar="[USE=]FILE", help="table: a further record, repeatable; USE is estimation, validation or test"
    ),
]


def demands_of(fail_on: str | None, max_error: list[str] | None, max_share: float | None) -> Demands:
    """Return the demands on a result that the options state."""
    from harness.scoring.acceptance import Demands

    words = [word.strip().replace("-", "_").replace(" ", "_") for word in (fail_on or "").split(",")]
    return Demands(tuple(word for word in words if word), text_pairs(max_error, "--max-error"), max_share)


def judged(suite: str, checks: Sequence[Demand], junit: Path | None) -> None:
    """Write checks where asked, say on standard error what fails, and leave with status 1 if something does."""
    if junit is not None:
        from harness.scoring.acceptance import write_junit

        write_junit(junit, suite, checks)
    failed = [check for check in checks if not check.passed]
    for check in failed:
        fail(f"{check.subject} fails {check.name}: {check.text}", 1)
    if failed:
        raise typer.Exit(1)


TABLE = {
    "input": Inputs,
    "output": Outputs,
    "column": Columns,
    "unit": Units,
    "sample_time": SampleTime,
    "gaps": Gaps,
    "sheet": Sheet,
    "run": Runs,
}
"""Options that say which columns of a table are which signals, by name."""
BESIDE = {"validation": Validation, "undriven": Undriven}
"""What else is said of records."""


def of_table(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of :data:`TABLE` where it takes ``signals``, of :data:`BESIDE` too for ``records``.

    It receives what they say as that argument. ``--trust`` is the last of its options.
    """
    hints = get_type_hints(command, localns={"ChosenSignals": dict, "Records": dict}, include_extras=True)
    parameters: list[inspect.Parameter] = []
    for parameter in inspect.signature(command).parameters.values():
        if parameter.name not in ("signals", "records"):
            parameters.append(parameter.replace(annotation=hints[parameter.name]))
            continue
        taken, options = parameter.name, TABLE if parameter.name == "signals" else BESIDE | TABLE
        parameters += [
            inspect.Parameter(name, parameter.kind, default=None, annotation=hint) for name, hint in options.items()
        ]
    parameters.append(inspect.Parameter("trust", inspect.Parameter.KEYWORD_ONLY, default=None, annotation=Trust))

    @functools.wraps(command)
    def called(**given: Any) -> None:
        said = {name: given.pop(name) for name in options}
        said |= {name: text_pairs(said[name], f"--{name}") for name in ("column", "unit")}
        said |= {name: said[name] or None for name in ("input", "output", "run")}
        if "undriven" in said:
            said["undriven"] = said["undriven"] or ()
        del given["trust"]  # what it does is done once it is read
        command(**given, **{taken: said})

    called.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    vars(called)["__signature__"] = inspect.Signature(parameters)
    return called
