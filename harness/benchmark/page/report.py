"""The page of a benchmark: one self-contained HTML file with the table, the plots, the failures and the versions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from harness.benchmark.page.plots import axis_plot, error_plot, rank_plot, regret_plot
from harness.benchmark.result import BenchResult
from harness.benchmark.row import Row
from harness.benchmark.summary import figure, optional_scores, pairs_in_words, places_of, rankings

TEMPLATE = Path(__file__).with_name("report.html.j2")
STYLE_SHEET = Path(__file__).with_name("page.css")


def render_html(result: BenchResult, overlays: Mapping[str, str] | None = None) -> str:
    """Return the page as text; it loads nothing from outside.

    - ``result``: what to show
    - ``overlays``: job to the picture of its trajectory, relative to the page; the only links that it has
    """
    lines = result.summary()
    links = _links(result.rows, overlays or {})
    return filled(
        TEMPLATE,
        result=result,
        places=places_of(lines),
        control=any(line.control for line in lines),
        links=links,
        more_seeds=any(len(pictures) > 1 for pictures in links.values()),
        has_bound=any(line.bound == "Cramer-Rao" for line in lines),
        several=any(line.ok > 1 for line in lines),
        figure=figure,
        more=optional_scores(lines),
        marks=pairs_in_words(lines),
        ranks=[(made, rank_plot(made)) for made in rankings(result.rows)],
        curves=axis_plot(result.rows),
        errors=error_plot(lines, result.rows),
        regrets=regret_plot(result.rows),
        failures=[(line, status, reason, count) for line in lines for status, reason, count in line.problems],
        settings=_settings(result.rows),
        statuses=_statuses(result),
    )


def filled(template: Path, **content: Any) -> str:
    """Return a page in the house's style from a template that holds ``{{ style | safe }}``."""
    import jinja2

    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    style = STYLE_SHEET.read_text(encoding="utf-8")
    return environment.from_string(template.read_text(encoding="utf-8")).render(style=style, **content)


def _links(rows: Sequence[Row], overlays: Mapping[str, str]) -> dict[tuple[str, str, str], list[tuple[int, str]]]:
    """Return seed and picture of the cells of each line that have one."""
    found: dict[tuple[str, str, str], list[tuple[int, str]]] = {}
    for row in rows:
        if row.job in overlays:
            found.setdefault((row.plant, row.scenario, row.identifier), []).append((row.seed, overlays[row.job]))
    return found


def _statuses(result: BenchResult) -> list[tuple[str, int]]:
    """Return how many rows have each status, and how many were not run."""
    counts: dict[str, int] = {}
    for row in result.rows:
        counts[row.status] = counts.get(row.status, 0) + 1
    missing = result.planned - len(result.rows)
    return sorted(counts.items(), key=lambda item: (item[0] != "ok", -item[1])) + (
        [("not run", missing)] if missing else []
    )


def _settings(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return horizon, burn-in, initial state and record lengths of each plant and scenario."""
    seen: dict[tuple[str, str], dict[str, Any]] = {}
    for row in rows:
        entry = seen.get((row.plant, row.scenario))
        if entry is None:
            sets: dict[str, Any] = {"horizons": set(), "burn_ins": set(), "initial": set()}
            entry = {"plant": row.plant, "scenario": row.scenario, "outputs": "", **sets}
            entry["samples"], entry["held_out"] = row.samples, row.held_out_samples
            seen[row.plant, row.scenario] = entry
        if not entry["outputs"] and row.outputs:
            entry["outputs"] = ", ".join(f"{n} [{u}]" for n, u in zip(row.outputs, row.units, strict=True))
            entry["samples"], entry["held_out"] = row.samples, row.held_out_samples
        if row.initial_state:
            entry["horizons"].add("whole record" if row.horizon is None else f"{row.horizon:g} s")
            entry["burn_ins"].add(row.burn_in)
            entry["initial"].add(row.initial_state)
    for entry in seen.values():
        for name in ("horizons", "burn_ins", "initial"):
            entry[name] = ", ".join(map(str, sorted(entry[name], key=lambda v: (str(type(v)), v)))) or "-"
    return list(seen.values())
