"""The command that prints the equations of a model."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from harness import api
from harness.cli.options import AsJson, Force, OptionPairs, Trust
from harness.cli.terminal import option_pairs, print_json, say

__all__ = ["equations"]


class Form(StrEnum):
    """What the equations are printed as."""

    text = "text"
    latex = "latex"
    python = "python"
    c = "c"


def equations(
    model: Annotated[str, typer.Argument(metavar="MODEL", help="name, URDF, MJCF, model.json, folder of close-loop")],
    form: Annotated[Form, typer.Option("--as", help="text, latex, python or c")] = Form.text,
    option: OptionPairs = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="file to write")] = None,
    as_json: AsJson = False,
    force: Force = False,
    trust: Trust = None,
) -> None:
    """Print the equations of a model: motion, energy, lumped parameters, regressor, as text, LaTeX, Python or C."""
    text = api.equations(model, form=form.value, out=out, force=force, **option_pairs(option, "--option"))
    if as_json:
        print_json({"model": model, "as": form.value, "text": text, "wrote": None if out is None else str(out)})
        return
    say(text.rstrip() if out is None else f"wrote {out}")
