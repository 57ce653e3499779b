"""The commands of ``sysid`` that look into a structure, a process or a model: modes, analyses, equations."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from harness import api
from harness.cli.options import (
    AsJson,
    DatasetName,
    Force,
    ModelName,
    OptionPairs,
    Picture,
    Seed,
    Trust,
    Undriven,
    of_table,
)
from harness.cli.terminal import noted, print_json, print_paths, print_rows, progress_bar, say
from harness.cli.words import completed, option_pairs, whole_range

if TYPE_CHECKING:
    from harness.data.recipe.chosen import ChosenSignals


@of_table
def modes(
    dataset: DatasetName,
    identifier: Annotated[
        str | None,
        typer.Option(
            help="n4sid, ho-kalman, dmdc or another with an order; default ssi, a subspace fit with covariance",
            autocompletion=completed("identifiers"),
        ),
    ] = None,
    order: Annotated[
        str | None,
        typer.Option(metavar="A..B", help="orders, two states for each mode; default 2..40, as far as the data allow"),
    ] = None,
    frequency: Annotated[
        float | None,
        typer.Option(help="a mode is stable if its frequency changes by less than this share; default 0.01"),
    ] = None,
    damping: Annotated[
        float | None, typer.Option(help="the same for damping; default 0.1, or its standard deviation")
    ] = None,
    mac: Annotated[float | None, typer.Option(help="the same for shapes: smallest MAC; default 0.95")] = None,
    window: Annotated[int | None, typer.Option(help="samples of past and of future in the subspace fit")] = None,
    option: OptionPairs = None,
    model: ModelName = None,
    undriven: Undriven = None,
    *,
    signals: ChosenSignals,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="folder for the page and the pictures")] = None,
    seed: Seed = 0,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Show frequencies, damping and shapes of a structure with 95 % intervals, and what the data leave open."""
    from harness.modal import Criteria

    first, last = whole_range(order, "--order") if order is not None else (0, 0)
    asked: dict[str, Any] = {"frequency": frequency, "damping": damping, "mac": mac}
    with progress_bar("modes") as bar:
        task = bar.add_task("modes", total=None)
        found = api.modes(
            dataset,
            identifier=identifier,
            orders=None if order is None else range(first, last + 1, 2),
            criteria=Criteria(**{name: value for name, value in asked.items() if value is not None}),
            window=window,
            options=option_pairs(option, "--option"),
            model=model,
            undriven=undriven or (),
            out=out,
            seed=seed,
            force=force,
            note=noted,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
            **signals,
        )
    if as_json:
        print_json(found.to_dict())
        return
    print_rows(found.rows())
    if not found.modes:
        say("no mode is determined by these data")
    for text in found.words():
        say(text)
    print_paths(out)


@of_table
def analyse(
    name: Annotated[
        str, typer.Argument(metavar="ANALYSIS", help="id (sysid list analyses)", autocompletion=completed("analyses"))
    ],
    subject: Annotated[
        str,
        typer.Argument(metavar="SUBJECT", help="subject: a plant, model.json, a model or URDF, or a data set"),
    ],
    option: OptionPairs = None,
    subject_option: Annotated[
        list[str] | None,
        typer.Option("--subject-option", "-P", metavar="k=v", help="option of the plant or model, repeatable"),
    ] = None,
    *,
    signals: ChosenSignals,
    out: Picture = None,
    seed: Seed = 0,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Analyse a finite process, a mechanism, a plant or records with a registered analysis."""
    found = api.analyse(
        name,
        subject,
        options=option_pairs(option, "--option"),
        subject_options=option_pairs(subject_option, "--subject-option"),
        out=out,
        seed=seed,
        force=force,
        **signals,
    )
    if as_json:
        print_json(found.to_dict())
        return
    print_rows([dict(row) for row in found.rows])
    for text in found.words:
        say(text)
    print_paths(out)


class PrintedForm(StrEnum):
    """What the equations are printed as."""

    text = "text"
    latex = "latex"
    python = "python"
    c = "c"


def equations(
    model: Annotated[
        str, typer.Argument(metavar="MODEL", help="name, URDF, MJCF, model.json, or folder of a closed loop")
    ],
    form: Annotated[PrintedForm, typer.Option("--as", help="text, latex, python or c")] = PrintedForm.text,
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
