"""The verdict of a diagnosis in one line."""

from __future__ import annotations

from typing import Any

__all__ = ["summary"]


def summary(data: dict[str, Any]) -> str:
    """Return the verdict in one line.

    Parameters
    ----------
    data : dict
        Content of ``report.json``.
    """
    before = data["errors"]["before"]["simulation_error"]["validation"]
    after = data["errors"]["after"]["simulation_error"]["validation"]
    change = ", ".join(
        f"{name} {_short(before[name]['rms'])} -> {_short(after[name]['rms'])} {before[name]['unit']}"
        for name in before
    )
    if data["verdict"] == "effects_found":
        names = " and ".join(f"{one['name'].replace('_', ' ')} at {one['at']}" for one in data["effects"])
        tied = sum(len(one) > 1 for one in data["tie_sets"])
        more = " (tied with others, see below)" if tied else ""
        if data["stand_in"]["flagged"] and data["adequacy"] == "mostly_explained":
            return (
                f"{data['model']} lacks {names}{more}, or laws much like it: {data['stand_in']['reasons'][0]}; "
                f"validation simulation error {change}; {_word(data['adequacy'])}"
            )
        if data["stand_in"]["flagged"]:
            verb = "stands" if len(data["effects"]) == 1 else "stand"
            return (
                f"{names}{more} {verb} in for what {data['model']} lacks, which the dictionary does not have "
                f"({data['stand_in']['reasons'][0]}); validation simulation error {change}; {_word(data['adequacy'])}"
            )
        return f"{data['model']} lacks {names}{more}; validation simulation error {change}; {_word(data['adequacy'])}"
    if data["verdict"] == "nothing_missing":
        rest = "; what is left is an unpredictable disturbance" if data["disturbance"] else ""
        return f"nothing is missing in {data['model']}: validation simulation error {change.split(' -> ')[0]}{rest}"
    return f"something is missing in {data['model']}, and no effect of the dictionary explains it ({change})"


def _word(adequacy: str) -> str:
    """Return an adequacy grade in words."""
    return {
        "explained": "the residual is explained",
        "mostly_explained": "the residual is mostly explained",
        "proxy_or_incomplete": "the answer is a proxy or incomplete",
    }[adequacy]


def _short(value: float | None) -> str:
    """Return a number in few digits."""
    return "unknown" if value is None else f"{value:.3g}"
