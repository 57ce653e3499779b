"""The table of a benchmark for papers and spreadsheets: Markdown, LaTeX, CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Mapping, Sequence

from harness.benchmark.result import BenchResult
from harness.benchmark.summary import (
    CONTROL,
    OPTIONAL,
    Quartiles,
    Summary,
    figure,
    optional_scores,
    pairs_in_words,
)
from harness.errors import refuse_unknown

HEAD = (
    "plant",
    "scenario",
    "identifier",
    "ok/run",
    "equation error",
    "simulation error",
    "best possible",
    "bound",
    "over best",
    "regret",
)
FIT = "fit"  # Title of the column behind those of scores that not every model has.


def render(result: BenchResult, form: str) -> str:
    """Return the table as text.

    Parameters
    ----------
    result : BenchResult
    form : {"markdown", "latex", "csv"}
        CSV has one column for every figure; the others have ``median [quartiles]``, bold for the best of a plant and
        scenario and for lines that tie with it (:func:`harness.benchmark.statistics.standings`).

    Raises
    ------
    InputError
        If there is no such form.
    """
    refuse_unknown("format of a table", form, FORMATS, remedy="choose one")
    return FORMATS[form](result)


def _markdown(result: BenchResult) -> str:
    lines = result.summary()
    control, more = _asked(lines), optional_scores(lines)
    head = (*HEAD, *more.values(), FIT, *CONTROL * control)
    rows = markdown_rows(head, (_cells(line, more, "**{}**", markdown_text, control) for line in lines))
    return "\n".join(rows) + "\n"


def markdown_rows(head: Sequence[str], cells: Iterable[Iterable[str]]) -> list[str]:
    """Return the lines of a table in Markdown.

    Examples
    --------
    >>> markdown_rows(["a", "b"], [["1", "2"]])
    ['| a | b |', '|---|---|', '| 1 | 2 |']
    """
    return ["| " + " | ".join(head) + " |", "|" + "---|" * len(head), *("| " + " | ".join(row) + " |" for row in cells)]


def _latex(result: BenchResult) -> str:
    lines = result.summary()
    control, more = _asked(lines), optional_scores(lines)
    head = (*HEAD, *more.values(), FIT, *CONTROL * control)
    columns = f"lllrlllllll{'l' * len(more)}{'llll' * control}"
    words = (
        f"Suite {result.suite}: median [quartiles] over seeds of the NRMSE on held-out records. {pairs_in_words(lines)}"
    )
    rows: list[str] = []
    place = None
    for line in lines:
        if place not in (None, (line.plant, line.scenario)):
            rows.append(r"\addlinespace")
        place = (line.plant, line.scenario)
        rows.append(" & ".join(_cells(line, more, r"\textbf{{{}}}", latex_text, control)) + r" \\")
    return latex_lines(caption(words, result.versions), columns, head, rows)


def latex_lines(title: str, columns: str, head: Sequence[str], rows: Sequence[str]) -> str:
    """Return a table in LaTeX: its caption, the kinds of its columns, their titles, and lines that are set already.

    Examples
    --------
    >>> latex_lines("", "l", ["title"], ["x"]).count("tabular")
    2
    """
    titles = " & ".join(map(latex_text, head)) + r" \\"
    begin = [r"\begin{table}", title, rf"\begin{{tabular}}{{{columns}}}", r"\toprule", titles, r"\midrule"]
    return "\n".join([*begin, *rows, r"\bottomrule", r"\end{tabular}", r"\end{table}", ""])


CITATION = "sysid-harness (BSD-3-Clause); how to cite it stands in its CITATION.cff"


def caption(words: str, versions: Mapping[str, str]) -> str:
    """Return the caption of a table in LaTeX: what it shows, the versions that it rests on, and how to cite.

    Examples
    --------
    >>> caption("All of it.", {"numpy": "2.0"}).endswith("stands in its CITATION.cff. Versions: numpy 2.0.}")
    True
    """
    known = ", ".join(f"{name} {version}" for name, version in versions.items() if version != "not installed")
    return rf"\caption{{{latex_text(f'{words} Made by {CITATION}. Versions: {known}.')}}}"


def _csv(result: BenchResult) -> str:
    lines = result.summary()
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    scores = ["equation_error", "simulation_error", "noise_floor", "best_possible", "over_best", "least_equation_error"]
    scores += ["regret", "fit_seconds", "memory_mib"]
    control = _asked(lines)
    scores += [*OPTIONAL, *["control_score", "predictive_cost", "control_regret"] * control]
    writer.writerow(
        ["plant", "scenario", "identifier", "ok", "run", "best_or_tied"]
        + [f"{name}_{part}" for name in scores for part in ("median", "low", "high")]
        + ["bound", "problems", *["control"] * control]
    )
    for line in lines:
        found: list[Quartiles | None] = [getattr(line, name) for name in scores]
        figures = [("", "", "") if q is None else (repr(q.median), repr(q.low), repr(q.high)) for q in found]
        problems = "; ".join(f"{count} {status}: {reason}" for status, reason, count in line.problems)
        writer.writerow(
            [line.plant, line.scenario, line.identifier, line.ok, line.run, int(line.leading)]
            + [text for texts in figures for text in texts]
            + [line.bound, problems, *[line.control] * control]
        )
    return stream.getvalue()


FORMATS: dict[str, Callable[[BenchResult], str]] = {"markdown": _markdown, "latex": _latex, "csv": _csv}
"""Name to what makes the text."""


def _asked(lines: Sequence[Summary]) -> bool:
    """Return True if the columns of control were asked for."""
    return any(line.control for line in lines)


def _cells(line: Summary, more: Mapping[str, str], bold: str, quote: Callable[[str], str], control: bool) -> list[str]:
    """Return the cells of a line; a line without scores says why instead."""
    simulation = _score(line.simulation_error) or (line.problems[0][0] if not line.ok and line.problems else "")
    texts = [
        line.plant,
        line.scenario,
        line.identifier,
        f"{line.ok}/{line.run}",
        _score(line.equation_error),
        simulation,
        figure(line.best_possible.median) if line.best_possible else "",
        line.bound,
        figure(line.over_best.median) if line.over_best else "",
        _score(line.regret),
        *(_score(getattr(line, name)) for name in more),
        f"{figure(line.fit_seconds.median, 2)} s" if line.fit_seconds and line.ok else "",
    ]
    if control:
        texts += [_score(line.control_score), _score(line.predictive_cost), _score(line.control_regret), line.control]
    cells = [quote(text) for text in texts]
    if line.leading:
        place = HEAD.index("simulation error")
        cells[place] = bold.format(cells[place])
    return cells


def _score(score: Quartiles | None) -> str:
    """Return median [quartiles]."""
    return "" if score is None else str(score)


def markdown_text(text: str) -> str:
    """Return a text that ends no cell of Markdown."""
    return text.replace("|", "\\|")


def latex_text(text: str) -> str:
    """Return a text that LaTeX sets as it is."""
    special = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    return "".join(special.get(sign, "\\" + sign if sign in "&%_#${}" else sign) for sign in text)
