"""Arguments and options that several commands of ``sysid`` share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from harness.terminal import completed

__all__ = [
    "AsJson",
    "DatasetName",
    "Force",
    "ModelName",
    "OptionPairs",
    "ScenarioPairs",
    "Seed",
    "Undriven",
    "Validation",
]

OptionPairs = Annotated[list[str] | None, typer.Option("--option", "-O", metavar="k=v", help="option, repeatable")]
AsJson = Annotated[bool, typer.Option("--json", help="print JSON")]
Force = Annotated[bool, typer.Option("--force", help="overwrite")]
Seed = Annotated[int, typer.Option(help="keys every random number")]
ModelName = Annotated[
    str | None,
    typer.Option(help="nominal model: NAME, FILE.fmu, FILE.urdf or FILE.py:NAME", autocompletion=completed("models")),
]
Validation = Annotated[Path | None, typer.Option(help="validation file beside a bare CSV or Parquet file")]
Undriven = Annotated[
    list[str] | None, typer.Option("--undriven", metavar="INPUT", help="input of the model that nothing drove")
]
ScenarioPairs = Annotated[
    list[str] | None, typer.Option("--scenario-option", "-S", metavar="k=v", help="scenario option, repeatable")
]
DatasetName = Annotated[str, typer.Argument(metavar="DATASET", help="dataset.toml, CSV, Parquet, or a recording")]
