"""The public table for a terminal, and as CSV, Markdown, LaTeX and a page."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.benchmark.page.exports import caption, latex_lines, latex_text, markdown_rows, markdown_text
from harness.benchmark.page.report import filled
from harness.benchmark.public.published import Published, best_published, known_figures, published
from harness.benchmark.public.result import PublicCell, PublicResult
from harness.benchmark.public.rules import Rule
from harness.benchmark.summary import figure
from harness.data.whole_files import whole_file

if TYPE_CHECKING:
    from rich.console import RenderableType

TEMPLATE = Path(__file__).with_name("public.html.j2")
MARKS = "* made under another window or another start than the rule's; ? not known which"
TITLES = ("set", "figure", "unit", "n", "best published", "black box", "grey box")


def records(result: PublicResult) -> list[dict[str, Any]]:
    """Return one record for each figure of each column of ours, with the best published beside it."""
    found: list[dict[str, Any]] = []
    for rule, test, number in _lines(result):
        best = best_published(rule.id, test)
        for cell in result.by_set[rule.id].values():
            found.append(
                {
                    "set": rule.id,
                    "test": test,
                    "unit": rule.unit,
                    "window": rule.window,
                    "column": cell.column,
                    "status": cell.status,
                    "figure": _at(cell.figures, number),
                    "whole_record": _at(cell.whole_record, number),
                    "model": cell.model,
                    "validation": cell.validation,
                    "best_published": None if best is None else best[0],
                    "best_published_by": None if best is None else best[1].method,
                    "best_published_rule": None if best is None else best[1].rule,
                    "origin": cell.origin,
                    "seconds": cell.seconds,
                    "reason": cell.reason,
                }
            )
    return found


def csv_table(result: PublicResult) -> str:
    """Return :func:`records` as CSV."""
    rows = records(result)
    stream = io.StringIO()
    writer = csv.DictWriter(stream, list(rows[0]) if rows else ["set"], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()


def markdown_table(result: PublicResult) -> str:
    """Return the table, what was fitted, and the sets without data, as Markdown."""
    peers = _peers(result)
    titles = [*TITLES, *peers, "start from the whole record: black", "grey"]
    rows = []
    for rule, test, number in _lines(result, run=True):
        own = result.by_set[rule.id]
        cells = [*_shown(rule, test, number, own, "**{}**"), *(_value(own.get(peer), number) for peer in peers)]
        cells += [_value(own.get(column), number, whole=True) for column in ("black", "grey")]
        rows.append(map(markdown_text, cells))
    lines = [*markdown_rows(titles, rows), "", MARKS + ".", ""]
    lines += [f"- {rule.title}, {cell.column}: {_said(cell)}" for rule, cell in _cells(result)]
    lines += ["", "The best published figures, and who compared them with their source:", ""]
    lines += [f"- {rule.title}: {text}" for rule in result.rules for text in _best(rule)]
    lines += ["", "Sets without data here:", ""]
    lines += [
        f"- {rule.title} (n = {rule.window}, {rule.rules_of}): {_reason(rule, result)}" for rule in _missing(result)
    ]
    return "\n".join(lines) + "\n"


def latex_table(result: PublicResult) -> str:
    """Return the table for a paper, with a caption that names rules, versions and how to cite."""
    peers = _peers(result)
    titles = [*TITLES, *peers]
    body = []
    for rule, test, number in _lines(result, run=True):
        own = result.by_set[rule.id]
        cells = _shown(rule, test, number, own, "{}")
        texts = [latex_text(cell) for cell in (*cells, *(_value(own.get(peer), number) for peer in peers))]
        for place in (5, 6):
            if _leads(rule, test, number, own, ("black", "grey")[place - 5]):
                texts[place] = rf"\textbf{{{texts[place]}}}"
        body.append(" & ".join(texts) + r" \\")
    words = (
        "Free runs over the test records of public benchmarks: root mean square error behind the first n outputs, "
        "which the model may see. Bold: at or below the best published figure. " + MARKS + "."
    )
    return latex_lines(caption(words, result.versions), f"lllr{'l' * (len(titles) - 4)}", titles, body)


def page(result: PublicResult) -> str:
    """Return the table as one self-contained page."""
    peers = _peers(result)
    groups = []
    for rule in result.rules:
        own = result.by_set[rule.id]
        lines = [
            {
                "test": test,
                "published": known_figures(rule.id, test),
                "values": [_value(own.get(column), number) for column in ("black", "grey", *peers)],
                "leads": [_leads(rule, test, number, own, column) for column in ("black", "grey", *peers)],
                "whole": [_value(own.get(column), number, whole=True) for column in ("black", "grey")],
            }
            for number, test in enumerate(rule.tests)
        ]
        run = any(cell.status == "ok" for cell in own.values())
        said = [(cell, _said(cell)) for cell in own.values() if cell.status != "missing"]
        sources = [cited(one) for one in published()[rule.id]]
        groups.append(
            {"rule": rule, "lines": lines, "run": run, "said": said, "cited": sources, "reason": _reason(rule, result)}
        )
    return filled(TEMPLATE, result=result, groups=groups, peers=peers, figure=figure, marks=MARKS)


def write_tables(result: PublicResult) -> None:
    """Write ``public.csv``, ``public.md``, ``public.tex`` and ``public.html`` into the result's folder."""
    made = {"csv": csv_table, "md": markdown_table, "tex": latex_table, "html": page}
    for suffix, make in made.items():
        with whole_file(result.folder / f"public.{suffix}") as scratch:
            scratch.write_text(make(result), encoding="utf-8")


def rich_public(result: PublicResult) -> RenderableType:
    """Return the table for a terminal; what has no figure stands below it with its reason."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    peers = _peers(result)
    made = Table(box=SIMPLE_HEAD, header_style="bold", padding=(0, 1), collapse_padding=True, pad_edge=False)
    for title in (*TITLES, *peers, "whole: black", "grey"):
        made.add_column(title, justify="right" if title == "n" else "left")
    last = ""
    for rule, test, number in _lines(result, run=True):
        own = result.by_set[rule.id]
        cells = [Text(text) for text in _shown(rule, test, number, own, "{}")]
        for place, column in ((5, "black"), (6, "grey")):
            if _leads(rule, test, number, own, column):
                cells[place].stylize("bold green")
        if rule.id == last:
            cells[0] = Text("")
        last = rule.id
        more = [_value(own.get(peer), number) for peer in peers]
        more += [_value(own.get(column), number, whole=True) for column in ("black", "grey")]
        made.add_row(*cells, *map(Text, more))
    notes = [Text(f"{rule.id}, {cell.column}: {_said(cell)}", style="dim") for rule, cell in _cells(result)]
    notes += [Text(f"{rule.id}: {_reason(rule, result)}", style="dim") for rule in _missing(result)]
    return Group(
        Text("free runs over the test records; n: outputs that the model may see, the error counts behind them; "
             "green: at or below the best published"),
        made,
        Text(MARKS, style="dim"),
        *notes,
        Text(str(result)),
    )  # fmt: skip


def _lines(result: PublicResult, *, run: bool = False) -> Iterator[tuple[Rule, str, int]]:
    """Yield the figures of the table; of the sets that were run only, where asked."""
    for rule in result.rules:
        if run and not any(cell.status in ("ok", "unfit", "failed") for cell in result.by_set[rule.id].values()):
            continue
        for number, test in enumerate(rule.tests):
            yield rule, test, number


def _cells(result: PublicResult) -> list[tuple[Rule, PublicCell]]:
    """Return the cells of sets whose data are there."""
    rules = {rule.id: rule for rule in result.rules}
    return [(rules[cell.set], cell) for cell in result.cells if cell.status not in ("missing", "not entered")]


def _missing(result: PublicResult) -> list[Rule]:
    """Return the sets of which nothing was run."""
    run = {rule.id for rule, _, _ in _lines(result, run=True)}
    return [rule for rule in result.rules if rule.id not in run]


def _reason(rule: Rule, result: PublicResult) -> str:
    """Return why nothing of a set was run."""
    reasons = [cell.reason for cell in result.by_set[rule.id].values() if cell.reason]
    return reasons[0] if reasons else rule.where


def _peers(result: PublicResult) -> list[str]:
    """Return the columns of other packages."""
    return sorted({cell.column for cell in result.cells} - {"black", "grey"})


def _shown(rule: Rule, test: str, number: int, own: dict[str, PublicCell], bold: str) -> list[str]:
    """Return the cells under :data:`TITLES`."""
    best = best_published(rule.id, test)
    beside = "-" if best is None else f"{figure(best[0])}{best[1].mark} ({best[1].method})"
    cells = [rule.title, test, rule.unit, str(rule.window), beside]
    for column in ("black", "grey"):
        text = _value(own.get(column), number)
        cells.append(bold.format(text) if _leads(rule, test, number, own, column) else text)
    return cells


def _best(rule: Rule) -> list[str]:
    """Return the best published figures of a set with their sources, a line for each method."""
    best = [(test, found) for test in rule.tests if (found := best_published(rule.id, test)) is not None]
    return [
        f"{', '.join(f'{test} {figure(value)}{one.mark}' for test, (value, mine) in best if mine is one)}: {cited(one)}"
        for one in published()[rule.id]
        if any(mine is one for _, (_, mine) in best)
    ]


def cited(one: Published) -> str:
    """Return whose a published figure is, how often it was read, and its source."""
    note = f"; {one.note}" if one.note else ""
    return f"{one.method} ({one.year}), {one.read}: {one.source}{note}"


def _value(cell: PublicCell | None, number: int, *, whole: bool = False) -> str:
    """Return a figure, or the status of a cell without one."""
    if cell is None:
        return ""
    values = cell.whole_record if whole else cell.figures
    value = _at(values, number)
    if value is not None:
        return figure(value)
    if cell.status == "ok":
        return "diverged" if values else ""
    return "" if whole or cell.status == "missing" else cell.status


def _leads(rule: Rule, test: str, number: int, own: dict[str, PublicCell], column: str) -> bool:
    """Return True if a figure of ours is at or below the best published."""
    best: tuple[float, Published] | None = best_published(rule.id, test)
    value = _at(own[column].figures, number) if column in own else None
    return best is not None and value is not None and value <= best[0]


def _at(values: list[float | None], number: int) -> float | None:
    """Return a value, or None where there are none."""
    return values[number] if number < len(values) else None


def _said(cell: PublicCell) -> str:
    """Return what a cell rests on, or why it has no figure."""
    if cell.status != "ok":
        return f"{cell.status}: {cell.reason}"
    validated = "" if cell.validation is None else f", {figure(cell.validation)} on the validation part"
    return f"{cell.model}{validated}; {figure(cell.seconds, 2)} s; code {cell.code or 'not kept'}; {cell.origin}"
