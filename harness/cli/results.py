"""What commands found, printed for a person: parts, tables, fitted models, FMUs, systems."""

from __future__ import annotations

import math
import sys
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from harness.api import Identified
    from harness.benchmark import BenchResult, QueryResult
    from harness.benchmark.public import PublicResult
    from harness.diagnosis.planned import Planned
    from harness.models.estimate import Estimate
    from harness.physics.definition.parameters import FarOff
from harness.cli.terminal import print_json, print_table, say, wide_console
from harness.units import behind

OWN = "sysid-harness"
"""The distribution whose parts go without a remark."""
NARROW = 70
"""Columns below which a list puts what a part is under its name."""


def print_parts(parts: Mapping[str, Sequence[Mapping[str, str]]]) -> None:
    """Print ids and what is behind them, kind by kind."""
    from rich.padding import Padding
    from rich.table import Table

    console = wide_console()
    for kind, rows in parts.items():
        lines = [
            (
                row["id"],
                (f"(needs {row['needs']}, which is not installed) " if row["needs"] else "")
                + row["summary"]
                + ("" if (own := row["distribution"]) == OWN else f" (from {own})"),
            )
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


def print_answer(answer: QueryResult) -> None:
    """Print the answer to a query as a table."""
    rows = [[f"{v:.6g}" if isinstance(v, float) else v for v in one.values()] for one in answer.records()]
    print_table(answer.columns, rows)


def print_planned(found: Planned) -> None:
    """Print the isolability matrix (percent), from what size each is visible, what looks alike, what is invisible."""
    width = max(map(len, found.effects), default=0)
    needed = width + 4 + 4 * len(found.effects)
    if sys.stdout.isatty() and wide_console().width < needed:
        say(f"(the matrix of all pairs needs {needed} columns: widen the terminal, or --json; {found.noise})")
    else:
        say(f"how much of the row's effect the column's effect can mimic, in percent ({found.noise})")
        say(" " * (width + 4) + "".join(f"{k + 1:>4}" for k in range(len(found.effects))))
        for k, (name, row) in enumerate(zip(found.effects, found.cosines, strict=True)):
            say(f"{k + 1:>3} {name:<{width}}" + "".join(f"{100 * value:>4.0f}" for value in row))
    for name, size in found.smallest.items():
        say(f"visible from about {size['parameter']} = {size['value']:.3g}{behind(size['unit'])}: {name}")
    for one, other, cosine in found.alike:
        say(f"cannot be told apart: {one} and {other} ({cosine:.3f})")
    for hidden in found.hidden:
        say(f"not visible: {hidden['name']}@{hidden['at']}: {hidden['reason']}")
    if found.untested:
        say(f"not tested (no first-order test sees them): {', '.join(found.untested)}")


def print_identified(fitted: Identified, identifier: str) -> None:
    """Print the scores of a model, output by output."""
    from harness.models.determined import bands_of, gaps_words
    from harness.models.estimate import estimate_of

    say_far(fitted.far_from_declared)
    say(f"{identifier}: NRMSE (rms)")
    lines: list[tuple[str, ...]] = []
    for use, one_step in fitted.equation_error.items():
        for run, (one, free) in enumerate(zip(one_step, fitted.simulation_error[use], strict=True)):
            for column, channel in enumerate(fitted.model.spec.outputs):
                scores = [f"{s.nrmse[column]:.4g} ({fitted.in_own_unit(s.rms[column], channel)})" for s in (one, free)]
                lines.append((use, str(run), channel.name, *scores, free.initial_state))
    print_table(("use", "run", "output", "equation error", "simulation error", "initial state"), lines)
    for use, scores_of_use in fitted.probability.items():
        for run, score in enumerate(scores_of_use):
            say(f"{use} {run}, one step ahead: {score}")
    if torques := fitted.torque_rows():
        say("torques along the measured motion, filtered as in the fit")
        print_table(("use", "run", "torque", "rms", "NRMSE"), torques)
    if said := fitted.units_said():
        say(f"  {said}")
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
    for text in (*getattr(fitted.model, "equations", ()), *getattr(fitted.model, "findings", ())):
        say(f"  {text}")
    elsewhere = {"estimate", "warning", "determined", "equations", *({"condition"} if estimate is not None else ())}
    _print_notes(getattr(fitted.model, "notes", None) or {}, elsewhere)
    _print_order(fitted.model)
    if gaps := gaps_words(bands_of(fitted.model), fitted.model.spec.sample_time):
        say(f"  {gaps}")
    for warning in fitted.warnings:
        say(f"warning: {warning}")


def say_far(far: Sequence[FarOff]) -> None:
    """Say first which parameters lie far from what was declared, if any do."""
    from harness.physics.definition.parameters import said_far

    if far:
        say(f"warning: {said_far(far)}")


def _print_parameters(model: Any, named: Mapping[str, float], estimate: Estimate | None) -> None:
    """Print parameters with what is known of their uncertainty."""
    loose = estimate.rank.undetermined if estimate is not None and estimate.rank is not None else ()
    for name, value in named.items():
        deviation = getattr(model, "deviations", {}).get(name)
        interval = estimate.interval(name) if estimate is not None and name in estimate.names else None
        text = f"  {name} = {value:.6g}" + (f" +- {deviation:.2g}" if deviation else "")
        text += behind(_unit_of(model, estimate, name))
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
        f"{name} = {value:.6g}{behind(unit)}"
        for name, unit, value in zip(found["names"], found["units"], found["values"], strict=True)
        if name not in named and value is not None
    ]
    if rows:
        say(f"  lumped: {', '.join(rows)}")


VALUES, SHORT = 8, 40
"""Values of a note that are printed, enough to see where singular values fall to the noise; letters of a short one."""
ROUNDED = 1e-9
"""A mode at 1 (a constant, an integrator) comes out so far beyond it by rounding."""
COEFFICIENTS = 40
"""Coefficients beyond which only their number is printed: a table of lags tells nobody anything, the file has all."""


def _print_estimate(estimate: Estimate) -> None:
    """Print coefficients with their intervals, or how many there are, and how the intervals came about."""
    if len(estimate.names) <= COEFFICIENTS:
        for name, unit, value in zip(estimate.names, estimate.units, estimate.values, strict=True):
            interval = estimate.interval(name)
            text = f"  {name} = {value:.6g}{behind(unit)}"
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


def _print_notes(notes: Mapping[str, Any], elsewhere: Collection[str]) -> None:
    """Print what a fit notes: every number and word, and the first of a list or table of them; the file has all."""
    words, lines = [], []
    for name, value in notes.items():
        title = name.replace("_", " ")
        if name in elsewhere or value is None:
            continue
        parts = value.values() if isinstance(value, Mapping) else value if isinstance(value, list | tuple) else [value]
        flat = [_plain(one) for one in parts]
        if not flat or not all(flat):
            continue  # a table of tables
        if isinstance(value, Mapping):
            flat = [f"{key} {one}".replace("_", " ") for key, one in zip(value, flat, strict=True)]
        text = ", ".join(flat[:VALUES]) + f" and {len(flat) - VALUES} more" * (len(flat) > VALUES)
        if len(flat) == 1 and len(text) <= SHORT:
            words.append(f"{title} {text}")
        else:
            lines.append(text if isinstance(value, str) else f"{title}: {text}")
    for line in ([", ".join(words)] if words else []) + lines:
        say(f"  {line[:1].upper() + line[1:]}")


def _plain(value: Any) -> str:
    """Return a number or a word as text; nothing for anything else."""
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, int | np.integer | str):
        return str(value)
    return f"{value:.3g}" if isinstance(value, float | np.floating) else ""


def _print_order(model: Any) -> None:
    """Print states and spectral radius; a model that grows is told whatever its scores."""
    from harness.models.lqr import spectral_radius

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
