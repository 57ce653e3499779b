"""Options that several commands share, so that one word means the same everywhere."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from harness.terminal import completed
from harness.trust import trusting

__all__ = ["AsJson", "DatasetName", "Engine", "Force", "ModelName", "OptionPairs", "Resume", "ScenarioPairs", "Seed",
           "Trust", "Undriven", "Validation", "Workers"]  # fmt: skip


def _trust(context: typer.Context, files: list[str] | None) -> list[str] | None:
    """Trust files until the command ends."""
    if files and not context.resilient_parsing:
        context.with_resource(trusting(*files))
    return files


OptionPairs = Annotated[list[str] | None, typer.Option("--option", "-O", metavar="k=v", help="option, repeatable")]
AsJson = Annotated[bool, typer.Option("--json", help="print JSON")]
Force = Annotated[bool, typer.Option("--force", help="overwrite")]
Resume = Annotated[bool, typer.Option("--resume", help="continue what was interrupted")]
Seed = Annotated[int, typer.Option(help="keys every random number")]
ModelName = Annotated[
    str | None,
    typer.Option(help="nominal model: NAME, FILE.fmu, FILE.urdf or FILE.py:NAME", autocompletion=completed("models")),
]
Validation = Annotated[Path | None, typer.Option(help="validation file beside a bare CSV or Parquet file")]
Undriven = Annotated[
    list[str] | None, typer.Option("--undriven", metavar="INPUT", help="input of the model that nothing drove")
]
Trust = Annotated[
    list[str] | None,
    typer.Option(
        "--trust",
        metavar="FILE",
        callback=_trust,
        help="code that a file may name: FILE.py or FILE.fmu, or FILE that names it, repeatable",
    ),
]
Workers = Annotated[int | None, typer.Option(min=1, help="processes; default all cores")]
Engine = Annotated[str, typer.Option(help="local, or dask://HOST:PORT")]
ScenarioPairs = Annotated[
    list[str] | None, typer.Option("--scenario-option", "-S", metavar="k=v", help="scenario option, repeatable")
]
DatasetName = Annotated[str, typer.Argument(metavar="DATASET", help="dataset.toml, CSV, Parquet, or a recording")]
