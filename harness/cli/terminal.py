"""What the ``sysid`` command reads from options and writes to the terminal: pairs, seeds, progress, tables."""

from __future__ import annotations

import json
import math
import os
import sys
import time
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, cast

from harness.errors import InputError, printable
from harness.supervision.interrupts import stop_if_asked

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console
    from rich.progress import Progress, TaskID

    from harness.api import Identified
    from harness.benchmark import Answer, BenchResult
    from harness.benchmark.public import PublicResult
    from harness.diagnosis.planned import Planned
    from harness.models.estimate import Estimate

__all__ = [
    "Lines",
    "completed",
    "fail",
    "hidden_effect",
    "jobs_bar",
    "noted",
    "option_pairs",
    "option_value",
    "print_answer",
    "print_bench",
    "print_fmu",
    "print_identified",
    "print_json",
    "print_parts",
    "print_paths",
    "print_planned",
    "print_public",
    "print_rows",
    "print_system",
    "print_written",
    "progress_bar",
    "say",
    "seed_range",
    "share_bar",
    "text_pairs",
    "whole_range",
    "wide_console",
]


def fail(message: str, status: int) -> int:
    """Print one line on standard error and return the exit status."""
    print(f"sysid: {printable(message)}", file=sys.stderr)
    return status


def completed(kind: str) -> Callable[[str], list[str]]:
    """Return the function that completes the id of a part in a shell (``sysid --install-completion``)."""

    def begun(incomplete: str) -> list[str]:
        from harness import registry

        return [entry.id for entry in registry.entries(kind) if entry.id.startswith(incomplete)]

    return begun


OWN = "sysid-harness"
"""The distribution whose parts go without a remark."""


def say(text: str) -> None:
    """Print a line."""
    print(printable(text))


def noted(text: str) -> None:
    """Print a note beside the answer."""
    print(f"sysid: note: {printable(text)}", file=sys.stderr)


def print_json(content: Any) -> None:
    """Print JSON; what it cannot hold (NaN, infinity) is null."""
    print(json.dumps(_plain(content), indent=1, allow_nan=False))


def _plain(content: Any) -> Any:
    """Return content as JSON can hold it."""
    if isinstance(content, Mapping):
        return {str(key): _plain(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_plain(value) for value in content]
    if hasattr(content, "tolist"):  # arrays and numbers of numpy
        return _plain(content.tolist())
    return None if isinstance(content, float) and not math.isfinite(content) else content


def print_written(paths: Sequence[Any], *, as_json: bool) -> None:
    """Print which files were written."""
    if as_json:
        print_json({"written": [str(path) for path in paths]})
        return
    print_paths(*paths)


def print_paths(*paths: Path | None) -> None:
    """Print which files were written, of those that were asked for."""
    for path in paths:
        if path is not None:
            say(f"wrote {path}")


def wide_console() -> Console:
    """Return a console that folds nothing when its output is a file or a pipe."""
    from rich.console import Console

    width = None if sys.stdout.isatty() else max(120, int(os.environ.get("COLUMNS", "0") or 0))
    return Console(width=width, markup=False, highlight=False, emoji=False)  # "u [N m]" is text, no style


NARROW = 70
"""Columns below which a list puts what a part is under its name."""


def print_parts(parts: Mapping[str, Sequence[Mapping[str, str]]]) -> None:
    """Print ids and what is behind them, kind by kind."""
    from rich.padding import Padding
    from rich.table import Table

    console = wide_console()
    for kind, rows in parts.items():
        lines = [
            (row["id"], row["summary"] + ("" if (own := row["distribution"]) == OWN else f" (from {own})"))
            for row in rows
        ]
        console.print(kind)
        if console.width < NARROW:
            for name, text in lines:
                console.print(f"  {name}", overflow="fold")
                console.print(Padding(text, (0, 0, 0, 4)))
            continue
        shown = Table(box=None, padding=(0, 2, 0, 0), show_header=False)
        shown.add_column(no_wrap=True)
        shown.add_column(overflow="fold")
        for name, text in lines:
            shown.add_row(f"  {name}", text)
        console.print(shown)


PROGRESS = "SYSID_HARNESS_PROGRESS"
"""Environment variable with the seconds between two lines of progress, for a program that reads them."""


class Lines:
    """Progress where standard error is no terminal: one line every few seconds."""

    def __init__(self, title: str) -> None:
        self.title = title
        given = os.environ.get(PROGRESS, "")
        self.every = float(given) if given.replace(".", "", 1).isdecimal() else 5.0
        self.next = time.monotonic() + self.every

    def add_task(self, description: str, total: float | None = None) -> TaskID:
        """Return the only task there is."""
        return cast("TaskID", 0)

    def update(
        self, task: TaskID, *, completed: float = 0.0, total: float | None = None, description: str | None = None
    ) -> None:
        """Print a line if the last one is some seconds old."""
        stop_if_asked()
        if time.monotonic() < self.next:
            return
        self.next = time.monotonic() + self.every
        share = f"{100 * completed:.0f} %" if total is None else f"{completed:.0f} of {total:.0f}"
        print(f"{self.title}: {share}{f', {description}' if description else ''}", file=sys.stderr, flush=True)


@contextmanager
def jobs_bar(title: str, name: str) -> Iterator[Callable[[int, int, str], None]]:
    """Show how many of many jobs are done; yields what is called as ``show(done, total, what)``."""
    with progress_bar(f"benchmark {title}") as bar:
        task = bar.add_task(name, total=None)

        def show(done: int, total: int, what: str) -> None:
            bar.update(task, completed=done, total=total, description=what)

        yield show


@contextmanager
def share_bar(title: str, name: str) -> Iterator[Callable[[float, str], None]]:
    """Show how much of one thing is done; yields what is called as ``show(share, what)``."""
    with progress_bar(title) as bar:
        task = bar.add_task(name, total=None)

        def show(share: float, what: str) -> None:
            bar.update(task, completed=share, total=1.0, description=what)

        yield show


@contextmanager
def progress_bar(title: str) -> Iterator[Progress | Lines]:
    """Show on standard error how far something long has come: a bar on a terminal, else a line now and then."""
    if not sys.stderr.isatty():
        yield Lines(title)
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    class Bar(Progress):
        def update(self, *arguments: Any, **options: Any) -> None:
            stop_if_asked()
            super().update(*arguments, **options)

    with Bar(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn() if title.startswith("benchmark") else TextColumn("{task.percentage:>3.0f}%"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
    ) as bar:
        yield bar


def option_value(text: str) -> Any:
    """Read an option's value as TOML (3, 0.5, true, [1, 2]); anything else is text."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def text_pairs(texts: Sequence[str] | None, flag: str) -> dict[str, str]:
    """Read ``k=v`` pairs as they stand."""
    pairs = [text.partition("=") for text in texts or ()]
    for key, equals, value in pairs:
        if not (key and equals):
            raise InputError(
                "pair", expected="NAME=VALUE", got=repr(key + equals + value), remedy="correct it", place=flag
            )
    return {key.strip(): value.strip() for key, _, value in pairs}


def option_pairs(texts: Sequence[str] | None, flag: str) -> dict[str, Any]:
    """Read ``k=v`` pairs; ``k.NAME=v`` is an entry of the table ``k``, and NAME may hold dots itself."""
    result: dict[str, Any] = {}
    for text in texts or ():
        key, equals, value = text.partition("=")
        if not equals or not key:
            raise InputError("option", expected="k=v", got=repr(text), remedy=f"write {flag} name=value", place=flag)
        head, dot, name = key.strip().partition(".")
        head = head.replace("-", "_")
        table = result.setdefault(head, {}) if dot else None
        if dot and not (name and isinstance(table, dict)):
            raise InputError("option", expected=f"{head}.NAME=v", got=repr(text), remedy="correct it", place=flag)
        if table is None:
            result[head] = option_value(value.strip())
        else:
            table[name] = option_value(value.strip())
    return result


def hidden_effect(text: str) -> tuple[str, str, dict[str, float]]:
    """Read ``effect@port:k=v,k=v``."""
    head, _, tail = text.partition(":")
    name, at, port = head.partition("@")
    if not (name and at and port):
        raise InputError(
            "hidden effect",
            expected="EFFECT@PORT:k=v,...",
            got=repr(text),
            remedy="write e.g. --hide coulomb_friction@theta:Fc=0.05",
            place="--hide",
        )
    pairs = option_pairs([part for part in tail.split(",") if part], "--hide")
    for key, value in pairs.items():
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError(
                "hidden effect", expected=f"a number for {key}", got=repr(value), remedy="correct it", place="--hide"
            )
    return name, port, {key: float(value) for key, value in pairs.items()}


UNFOLDED = 10_000
"""Columns of a file or a pipe, which a benchmark's table need not fit."""


def print_bench(result: BenchResult, *, as_json: bool) -> None:
    """Print a benchmark's table, and where its files are."""
    from harness.benchmark import rich_table

    if as_json:
        print_json(result.to_records())
        return
    console = wide_console()
    if not sys.stdout.isatty():
        console.width = UNFOLDED
    console.print(rich_table(result))
    if result.folder is not None:
        if result.report is None:
            say(f"one share of a job array: 'sysid table {result.folder.parent}' puts the shares together")
        else:
            say(f"report: {result.report}")
        say(f"results: {result.folder / 'results.parquet'}")


def print_public(result: PublicResult, *, as_json: bool) -> None:
    """Print the public table, and where its files are."""
    from harness.benchmark.public import records, rich_public

    if as_json:
        print_json(records(result))
        return
    console = wide_console()
    if not sys.stdout.isatty():
        console.width = UNFOLDED
    console.print(rich_public(result))
    say(f"report: {result.folder / 'public.html'}")
    say(f"results: {result.folder / 'public.csv'}, public.md, public.tex, public.json")


TEXT = 24
"""Columns that the last column of a table needs to be folded into; with fewer, rows are printed as lists."""


def print_table(titles: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Print a table whose last column may fold; where the terminal is too narrow for it, each row as a list.

    No number is ever cut or broken.
    """
    from rich.padding import Padding
    from rich.table import Table
    from rich.text import Text

    console = wide_console()
    cells = [[_cell(value) for value in row] for row in rows]
    if not titles:
        return
    widths = [max(map(len, column)) for column in zip(titles, *cells, strict=True)]
    if sum(widths[:-1]) + 2 * len(widths[:-1]) + min(widths[-1], TEXT) <= console.width:
        shown = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False)
        for place, title in enumerate(titles):
            shown.add_column(Text(printable(title)), overflow="fold", no_wrap=place < len(titles) - 1)
        for row in cells:
            shown.add_row(*map(Text, row))
        console.print(shown)
        return
    for row in cells:
        console.print(Text(f"{titles[0]}: {row[0]}"))
        for title, cell in zip(titles[1:], row[1:], strict=True):
            if cell:
                console.print(Padding(Text(f"{title}: {cell}"), (0, 0, 0, 2)))


def _cell(value: object) -> str:
    """Return a value as the text of a cell."""
    if value is None or isinstance(value, bool):
        return {None: "", True: "yes", False: "no"}[value]
    return f"{value:.4g}" if isinstance(value, float) else printable(str(value))


def print_answer(answer: Answer) -> None:
    """Print the answer to a query as a table."""
    rows = [[f"{v:.6g}" if isinstance(v, float) else v for v in one.values()] for one in answer.records()]
    print_table(answer.columns, rows)


def print_planned(found: Planned) -> None:
    """Print the isolability matrix (hundredths), from what size each is seen, what looks alike, what is invisible."""
    width = max(map(len, found.effects), default=0)
    needed = width + 4 + 4 * len(found.effects)
    if sys.stdout.isatty() and wide_console().width < needed:
        say(f"(the matrix of all pairs needs {needed} columns: widen the terminal, or --json; {found.noise})")
    else:
        say(f"share of the row's effect that the column's can mimic, in hundredths ({found.noise})")
        say(" " * (width + 4) + "".join(f"{k + 1:>4}" for k in range(len(found.effects))))
        for k, (name, row) in enumerate(zip(found.effects, found.cosines, strict=True)):
            say(f"{k + 1:>3} {name:<{width}}" + "".join(f"{100 * value:>4.0f}" for value in row))
    for name, size in found.smallest.items():
        unit = "" if size["unit"] == "1" else f" {size['unit']}"
        say(f"seen from about {size['value']:.3g}{unit} of {size['parameter']}: {name}")
    for one, other, cosine in found.alike:
        say(f"cannot be told apart: {one} and {other} ({cosine:.3f})")
    for hidden in found.hidden:
        say(f"not visible: {hidden['name']}@{hidden['at']}: {hidden['reason']}")
    if found.untested:
        say(f"not tested (no first-order test sees them): {', '.join(found.untested)}")


def print_rows(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print rows of one shape as a table."""
    print_table([name.replace("_", " ") for name in (rows[0] if rows else ())], [list(row.values()) for row in rows])


def print_identified(fitted: Identified, identifier: str) -> None:
    """Print the scores of a model, output by output."""
    from harness.models.determined import bands_of, gaps_words
    from harness.models.estimate import estimate_of

    say(f"{identifier}: NRMSE (rms)")
    lines: list[tuple[str, ...]] = []
    for use, one_step in fitted.equation_error.items():
        for run, (one, free) in enumerate(zip(one_step, fitted.simulation_error[use], strict=True)):
            for column, channel in enumerate(fitted.model.spec.outputs):
                scores = [f"{s.nrmse[column]:.4g} ({s.rms[column]:.3g} {channel.unit})" for s in (one, free)]
                lines.append((use, str(run), channel.name, *scores, free.initial_state))
    print_table(("use", "run", "output", "equation error", "simulation error", "initial state"), lines)
    for use, scores_of_use in fitted.probability.items():
        for run, score in enumerate(scores_of_use):
            say(f"{use} {run}, one step ahead: {score}")
    estimate = estimate_of(fitted.model)
    named = getattr(fitted.model, "parameters", {})
    _print_parameters(fitted.model, named, estimate)
    if estimate is not None and not named:
        _print_estimate(estimate)
    elif estimate is not None:
        _print_method(estimate)
    _print_lumps(fitted.model, named)
    if estimate is not None and estimate.rank is not None:
        condition = f", condition number {estimate.condition:.3g}" if math.isfinite(estimate.condition) else ""
        say(f"  {estimate.rank}{condition}")
    for equation in getattr(fitted.model, "equations", ()):
        say(f"  {equation}")
    _print_order(fitted.model, conditioned=estimate is not None)
    if gaps := gaps_words(bands_of(fitted.model), fitted.model.spec.sample_time):
        say(f"  {gaps}")
    bands = (getattr(fitted.model, "notes", None) or {}).get("bands")
    if isinstance(bands, str):  # how far ahead learned models vouch for their bands
        say(f"  {bands}")
    for warning in fitted.warnings:
        say(f"warning: {warning}")


def _print_parameters(model: Any, named: Mapping[str, float], estimate: Estimate | None) -> None:
    """Print parameters with what is known of their uncertainty."""
    loose = estimate.rank.undetermined if estimate is not None and estimate.rank is not None else ()
    for name, value in named.items():
        deviation = getattr(model, "deviations", {}).get(name)
        interval = estimate.interval(name) if estimate is not None and name in estimate.names else None
        text = f"  {name} = {value:.6g}" + (f" +- {deviation:.2g}" if deviation else "")
        unit = _unit_of(model, estimate, name)
        text += "" if unit == "1" else f" {unit}"
        text += f" [{interval[0]:.6g}, {interval[1]:.6g}]" if interval else ""
        say(text + (" (not determined alone)" if name in loose else ""))


def _unit_of(model: Any, estimate: Estimate | None, name: str) -> str:
    """Return the unit of a parameter as its estimate or its system declares it; ``1`` where nothing does."""
    if estimate is not None and name in estimate.names:
        return estimate.units[estimate.names.index(name)]
    declared = model.system().parameters if hasattr(model, "system") else ()
    return next((one.unit for one in declared if one.name == name), "1")


def _print_lumps(model: Any, named: Mapping[str, float]) -> None:
    """Print the lumped parameters that a mechanical fit stands on, but for those that are parameters themselves."""
    found = (getattr(model, "notes", None) or {}).get("lumped")
    if not isinstance(found, Mapping):
        return
    rows = [
        f"{name} = {value:.6g}" + ("" if unit == "1" else f" {unit}")
        for name, unit, value in zip(found["names"], found["units"], found["values"], strict=True)
        if name not in named and value is not None
    ]
    if rows:
        say(f"  lumped: {', '.join(rows)}")


VALUES = 8
"""Singular values that are printed: enough to see where they fall to the noise."""

ROUNDED = 1e-9
"""A mode at 1 (a constant, an integrator) comes out so far beyond it by rounding."""

COEFFICIENTS = 40
"""Coefficients beyond which only their number is printed: a table of lags tells nobody anything, the file has all."""


def _print_estimate(estimate: Estimate) -> None:
    """Print coefficients with their intervals, or how many there are, and how the intervals came about."""
    if len(estimate.names) <= COEFFICIENTS:
        for name, unit, value in zip(estimate.names, estimate.units, estimate.values, strict=True):
            interval = estimate.interval(name)
            text = f"  {name} = {value:.6g}" + ("" if unit == "1" else f" {unit}")
            say(text + (f" [{interval[0]:.6g}, {interval[1]:.6g}]" if interval else ""))
    else:
        say(f"  {len(estimate.names)} coefficients (--out writes them)")
    _print_method(estimate)


def _print_method(estimate: Estimate) -> None:
    """Print how intervals came about, or why there are none, and whether the search ended."""
    level = f"{100 * estimate.level:g} % intervals: " if estimate.intervals is not None else ""
    if estimate.method:
        say(f"  {level}{estimate.method}")
    if not estimate.converged:
        say(f"warning: not converged{f': {estimate.message}' if estimate.message else ''}")


def _print_order(model: Any, *, conditioned: bool) -> None:
    """Print states, spectral radius, and what decided on the order; a model that grows is told whatever its scores."""
    from harness.models.lqr import spectral_radius

    notes = getattr(model, "notes", None) or {}
    if not conditioned and isinstance(notes.get("condition"), float):
        say(f"  condition number of the regressors {notes['condition']:.3g}")
    for key in ("hankel_singular_values", "singular_values"):
        if isinstance(notes.get(key), list):
            level = f"; noise alone up to {notes['hankel_noise']:.3g}" if "hankel_noise" in notes else ""
            values = ", ".join(f"{value:.3g}" for value in notes[key][:VALUES])
            say(f"  {key.replace('_', ' ').capitalize()} {values}{level}")
    a = getattr(model, "a_matrix", None)
    if a is None or not len(a):
        return
    radius = spectral_radius(a)
    grows = " (unstable: free runs grow without bound)" if radius > 1.0 + ROUNDED else ""
    say(f"  {len(a)} state{'s' if len(a) > 1 else ''}, spectral radius {radius:.4g}{grows}")


def print_fmu(content: dict[str, Any]) -> None:
    """Print what is in an FMU."""
    say(
        f"{content['model']} (FMI {content['fmi']}, {content['tool'] or 'tool not told'}): "
        f"{content['description'] or ''}"
    )
    say(f"platforms: {', '.join(content['platforms']) or 'none'}")
    for kind, abilities in content["kinds"].items():
        can = [name for name, has in abilities.items() if has is True] if isinstance(abilities, dict) else abilities
        say(f"{kind}: {', '.join(map(str, can)) or 'no optional abilities'}")
    titles = ("name", "causality", "variability", "type", "unit", "start", "description")
    print_table(titles, [[row[title] for title in titles] for row in content["variables"]])
    for problem in content["problems"]:
        say(f"warning: {problem}")


def print_system(content: dict[str, Any]) -> None:
    """Print what is in a system of FMUs."""
    experiment = content["experiment"]
    known = [f"{name} {value:g} s" for name, value in experiment.items() if value is not None]
    say(f"{content['name']}: {', '.join(known) or 'no experiment of its own'}")
    parts = [[c["name"], c["fmu"], c["fmi"], c["tool"] or "", ", ".join(c["platforms"])] for c in content["components"]]
    print_table(("component", "fmu", "fmi", "tool", "platforms"), parts)
    wires = [[wire["from"], wire["to"], wire["change"]] for wire in content["connections"]]
    values = [[f"{c['name']}.{name}", str(v)] for c in content["components"] for name, v in c["values"].items()]
    for titles, rows in ((("from", "to", "change"), wires), (("value", "in SI"), values)):
        if rows:
            print_table(titles, rows)
    inputs = [f"{one['name']} [{one['si_unit']}]" for one in content["inputs"]]
    outputs = [str(one["name"]) for one in content["outputs"]]
    say(f"inputs: {', '.join(inputs) or 'none'}")
    say(f"outputs: {', '.join(outputs) or 'none'}")
    for note in content["notes"]:
        say(f"note: {note}")


def seed_range(text: str | None) -> tuple[int, int] | None:
    """Read ``A..B``; None where nothing is asked for."""
    if text is None:
        return None
    first, last = whole_range(text, "--seeds")
    if ".." not in text and first:
        print(f"seed {first} alone; --seeds 0..{first - 1} are {first} seeds", file=sys.stderr)
    return first, last


def whole_range(text: str, flag: str) -> tuple[int, int]:
    """Read ``A..B``, or one number.

    Raises
    ------
    InputError
        If it is no range of whole numbers from 0 on.
    """
    first, dots, last = text.partition("..")
    try:
        pair = (int(first), int(last if dots else first))
    except ValueError:
        pair = (1, 0)
    if pair[0] > pair[1] or pair[0] < 0:
        raise InputError(
            flag[2:], expected="A..B with 0 <= A <= B", got=repr(text), remedy=f"write e.g. {flag} 1..4", place=flag
        )
    return pair
