"""``sysid identify --free``: the parameters of an FMU or a system of FMUs, fitted to data."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from harness import api
from harness.cli.results import say_far
from harness.cli.terminal import noted, print_json, print_paths, print_rows, say, share_bar
from harness.cli.words import text_pairs
from harness.errors import InputError

if TYPE_CHECKING:
    from harness.calibration import Calibration

Free = Annotated[
    list[str] | None,
    typer.Option(
        "--free",
        metavar="NAME,...",
        help="parameters to fit of --model FILE.fmu or FILE.ssp (in a system COMPONENT.NAME), repeatable",
    ),
]
Bounds = Annotated[
    list[str] | None,
    typer.Option("--bound", metavar="NAME=LOW:HIGH", help="with --free: bounds of a parameter in SI, repeatable"),
]
Start = Annotated[
    list[str] | None, typer.Option("--start", metavar="NAME=VALUE", help="with --free: start value in SI, repeatable")
]
Starts = Annotated[
    int, typer.Option(min=1, help="with --free: number of starts of the search; the first from the declared values")
]
Initial = Annotated[
    str, typer.Option(help="with --free: initial states of each record: estimated, or file for those of the file")
]
Slopes = Annotated[
    str, typer.Option(help="with --free: gradients from differences of runs, or own for the FMU's where both agree")
]
Ssv = Annotated[Path | None, typer.Option(metavar="FILE", help="with --free: write the values as an SSV")]
Copies = Annotated[
    Path | None,
    typer.Option(
        "--fmu-out",
        "--ssp-out",
        metavar="FILE",
        help="with --free: write a copy of the model with the fitted start values",
    ),
]


def calibrated(
    dataset: str,
    *,
    free: list[str],
    bound: list[str] | None,
    start: list[str] | None,
    out: Path | None,
    ssv: Path | None,
    copy: Path | None,
    as_json: bool,
    **asked: Any,
) -> Calibration:
    """Fit, and print what was found."""
    names = [name.strip() for text in free for name in _names(text)]
    with share_bar("calibrating", "reading") as show:
        found = api.calibrate(
            dataset,
            free=[name for name in names if name],
            bounds={name: _bound(name, text) for name, text in text_pairs(bound, "--bound").items()},
            start={name: _number(name, text, "--start") for name, text in text_pairs(start, "--start").items()},
            out=out,
            ssv=ssv,
            model_out=copy,
            progress=show,
            **asked,
        )
    for text in found.notes:
        noted(text)
    if as_json:
        print_json(found.to_dict())
        return found
    say_far(found.far_from_declared)
    print_rows(found.parameter_rows())
    print_rows(found.error_rows())
    for text in found.remarks():
        say(text)
    print_paths(out, ssv, copy)
    return found


def _names(text: str) -> list[str]:
    """Return names that commas separate; a comma in brackets belongs to a name."""
    found, depth = [""], 0
    for letter in text:
        depth += (letter in "[(") - (letter in ")]")
        if letter == "," and depth == 0:
            found.append("")
        else:
            found[-1] += letter
    return found


def _number(name: str, text: str, flag: str) -> float:
    """Read a number."""
    try:
        return float(text)
    except ValueError:
        raise InputError(
            f"{flag[2:]} of {name}", expected="a number in SI", got=repr(text), remedy=f"{flag} {name}=1.5", place=flag
        ) from None


def _bound(name: str, text: str) -> tuple[float, float]:
    """Read ``LOW:HIGH``; an empty side is open."""
    low, colon, high = text.partition(":")
    pair = (
        _number(name, low, "--bound") if low.strip() else float("-inf"),
        _number(name, high, "--bound") if high.strip() else float("inf"),
    )
    if not colon or not pair[0] < pair[1]:
        raise InputError(
            f"bound of {name}",
            expected="LOW:HIGH with LOW below HIGH",
            got=repr(text),
            remedy=f"--bound {name}=0.1:10",
            place="--bound",
        )
    return pair
