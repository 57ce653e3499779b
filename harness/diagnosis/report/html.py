"""What the pages share: the environment of the templates, and the rows of the before/after table."""

from __future__ import annotations

import re
from typing import Any

from harness.diagnosis.policy import POLICY
from harness.diagnosis.report.words import as_recorded, change_text, digits, shown


def environment() -> Any:
    """Return the jinja2 environment of the pages."""
    import jinja2

    made = jinja2.Environment(
        loader=jinja2.PackageLoader("harness.diagnosis.report", "templates"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    made.filters.update(
        number=_number,
        percent=_percent,
        words=_words,
        p=_probability,
        change=change_text,
        shown=shown,
        arrows=_arrows,
        as_recorded=as_recorded,
        sentence=_sentence,
    )
    return made


def error_rows(data: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of the before/after table: use, output, figures."""
    rows = []
    for use in ("estimation", "validation", "test"):
        for kind, label in (("equation_error", "equation error"), ("simulation_error", "simulation error")):
            before, after = data["errors"]["before"][kind].get(use, {}), data["errors"]["after"][kind].get(use, {})
            horizon = ""
            if kind == "simulation_error":
                error = data["errors"]["before"][kind]
                horizon = "whole record" if error["whole_record"] else f"{error['horizon_s']:g} s windows"
            for name in before:
                rows.append(_error_row(data, use, label, horizon, name, before[name], after.get(name)))
        begun = [data["errors"][key]["simulation_error"].get("from_measured_state", {}) for key in ("before", "after")]
        for name, figures in begun[0].get(use, {}).items():
            text = f"{data['errors']['before']['simulation_error']['horizon_s']:g} s windows from the measured state"
            rows.append(_error_row(data, use, "simulation error", text, name, figures, begun[1].get(use, {}).get(name)))
        others = data["errors"]["before"]["simulation_error"]["other_horizons"]
        later = data["errors"]["after"]["simulation_error"]["other_horizons"]
        for old, new in zip(others, later, strict=True):
            for name in old.get(use, {}):
                text = f"{old['horizon_s']:g} s windows"
                rows.append(_error_row(data, use, "simulation error", text, name, old[use][name], new[use].get(name)))
    return rows


def _error_row(
    data: dict[str, Any],
    use: str,
    label: str,
    horizon: str,
    name: str,
    before: dict[str, Any],
    after: dict[str, Any] | None,
) -> dict[str, Any]:
    """Return one row of the table, with the factor gained."""
    before = as_recorded(before, name, data)
    after = None if after is None else as_recorded(after, name, data)
    a, b = before["rms"], None if after is None else after["rms"]
    factor = a / b if a is not None and b else None
    return {
        "use": use,
        "kind": label,
        "horizon": horizon,
        "output": name,
        "unit": before["unit"],
        "before": a,
        "after": b,
        "nrmse_before": before["nrmse"],
        "nrmse_after": None if after is None else after["nrmse"],
        "factor": factor,
        "changed": factor is None or not 1 / POLICY.changed < factor < POLICY.changed,
    }


def _sentence(text: str) -> str:
    """Return a text as a sentence; the name of a file at its beginning stays as it is."""
    named = re.search(r"[.\[]\w", text.partition(" ")[0])
    return f"{text[:1] if named else text[:1].upper()}{text[1:]}{'' if text.endswith(('.', '?', '!')) else '.'}"


def _arrows(text: str) -> str:
    """Return a text with arrows that no line breaks at, nor before a per cent sign."""
    arrow = "\N{NO-BREAK SPACE}\N{RIGHTWARDS ARROW}\N{NO-BREAK SPACE}"
    return text.replace(" -> ", arrow).replace(" %", "\N{NO-BREAK SPACE}%")


def _number(value: float | None) -> str:
    """Return a number in four digits, a dash where it is unknown."""
    if value is None:
        return "–"  # noqa: RUF001
    return digits(value)


def _percent(value: float | None) -> str:
    """Return a share in percent."""
    return "–" if value is None else f"{digits(100 * value, 3)} %"  # noqa: RUF001


def _words(value: str) -> str:
    """Return a name with spaces."""
    return value.replace("_", " ")


def _probability(value: float | None) -> str:
    """Return a p-value."""
    if value is None:
        return "–"  # noqa: RUF001
    return "< 0.001" if value < 0.001 else f"{value:.3f}"
