"""The verdict of a diagnosis in one line."""

from __future__ import annotations

from typing import Any

from harness.diagnosis.confirm import FAR

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
        rest = (_left(data) if data["adequacy"] == "explained" else "") or _word(data["adequacy"])
        return f"{data['model']} lacks {names}{more}; validation simulation error {change}; {rest}"
    if data["verdict"] == "nothing_missing":
        left = _left(data) or ("what is left is an unpredictable disturbance" if data["disturbance"] else "")
        rest = f"; {left}" if left else ""
        return f"nothing is missing in {data['model']}: validation simulation error {change.split(' -> ')[0]}{rest}"
    return f"something is missing in {data['model']}, and no effect of the dictionary explains it ({change})"


def _left(data: dict[str, Any]) -> str:
    """Say what is far above the noise although nothing predicts it; empty if nothing is."""
    ratios = [one["ratio_to_noise"] for one in data["disturbance"].values() if not one["predictable"]]
    known = [ratio for ratio in ratios if ratio is not None and ratio > FAR]
    if not known:
        return ""
    return (
        f"what is left, {max(known):.3g} times the noise, cannot be predicted: a disturbance, or what no test here sees"
    )


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
