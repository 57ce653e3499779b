"""The tables of a study as Markdown: what was right, tied, wrong or missed, misses included."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence

import numpy as np

from harness.study.statistics import clopper_pearson, upper_bound

__all__ = ["WORDS", "counts", "summary"]

Row = dict[str, str]
WORDS = ("right", "tied", "wrong", "flagged", "missed")

LEGEND = """Each row of a table counts pairs of records (estimation and validation, 20 s at 250 Hz, positions only).
*right*: the accepted set is the truth, effect and place. *tied*: the truth is in the tie set; or it is exactly the
same on this plant as what was accepted (gravity tilt, encoder offset and eccentric load on one joint; asymmetric
Coulomb friction, and Coulomb friction with a bias); or nothing was accepted, and the report says that the truth cannot
be told from the nominal parameters (input gain: a common scale of all of them; an offset of a position without
reference). *wrong*: another set was accepted. *flagged*: the report says that something is missing, and names no cause:
no effect accepted, or those accepted called a stand-in. *missed*: nothing said.
Truths: `laws` (hand-written C, steps of 0.2 ms, friction with a true standstill, sharp corners), `bullet` (PyBullet's
joint friction and damping), `pymunk` (Chipmunk's constraints; `balanced`: upright under LQR), `fmu` (hand-written C
behind FMI). Sizes: nominal is 6 to 10 % of the rms torque, quarter a fourth; noise: low 1e-4, high 1e-3 (rad, m);
disturbance: unknown coloured torque of 2 % of the rms torque. Both models have viscous friction: it is not hidden."""


def summary(rows: Iterable[Row], *, seeds: str, planned: int, keys: Collection[str]) -> str:
    """Return the text of ``study.md``.

    Parameters
    ----------
    rows : iterable of dict
        Of ``rows.csv``.
    seeds : str
        ``tuning`` or ``judged``, for the title.
    planned : int
        Tasks of the plan.
    keys : collection of str
        Their keys; other rows of the file are left out.
    """
    known = [row for row in rows if row["key"] in keys]
    good = [row for row in known if row["status"] == "ok"]
    parts = [
        "# What the closed loop finds on simulated truths",
        f"Made by `sysid study` on {seeds} seeds: {len(known)} of {planned} planned records done"
        f"{'' if len(known) == planned else ' (the order is balanced, so the part done is a fair sample)'}.",
        LEGEND,
    ]
    single = [row for row in good if row["study"] == "confusion"]
    hidden = [row for row in single if row["truth"]]
    if hidden:
        parts += ["## One effect", _figures(hidden)]
        for title, column in (
            ("plant", "plant"), ("size", "level"), ("noise", "noise"), ("disturbance", "disturbance"),
            ("truth by", "engine"),
        ):  # fmt: skip
            parts.append(_table(title, hidden, lambda row, column=column: row[column]))  # type: ignore[misc]
        parts.append(_table("size, noise, disturbance", hidden, _cell))
        parts.append(_table("effect", hidden, lambda row: f"{row['plant']}: {row['truth']}"))
    two = [row for row in good if row["study"] == "two"]
    if two:
        parts += ["## Two effects at once", _figures(two), _table("effects", two, lambda row: row["truth"])]
    outside = [row for row in good if row["study"] == "outside"]
    if outside:
        parts += ["## Laws that the dictionary does not have", _outside(outside)]
    nothing = [row for row in good if not row["truth"] and row["study"] in ("none", "confusion")]
    if nothing:
        parts += ["## Nothing missing: false alarms", _alarms(nothing)]
    covered = [row for row in good if row["intervals"] not in ("", "0")]
    if covered:
        parts += ["## Coverage of the 95 % intervals", _coverage(covered)]
    timed = [row for row in good if row["cpu_s"]]
    if timed:
        parts += ["## Cost", _cost(timed)]
    if single or two:
        parts += ["## Every answer that was not right or tied", _misses([*hidden, *two, *nothing])]
    failed = [row for row in known if row["status"] != "ok"]
    if failed:
        lines = [f"- `{row['key']}`: {row['status']}: {row['reason']}" for row in failed]
        parts += ["## Records without an answer", "\n".join(lines)]
    return "\n\n".join(parts) + "\n"


def counts(rows: Iterable[Row]) -> dict[str, int]:
    """Return how many rows have each outcome.

    Examples
    --------
    >>> counts([{"outcome": "right"}, {"outcome": "right"}, {"outcome": "missed"}])
    {'right': 2, 'tied': 0, 'wrong': 0, 'flagged': 0, 'missed': 1}
    """
    found = [row["outcome"] for row in rows]
    return {word: found.count(word) for word in WORDS}


def _table(title: str, rows: Sequence[Row], group: Callable[[Row], str]) -> str:
    """Return a table of outcomes by group."""
    lines = [f"| {title} | records | {' | '.join(WORDS)} | right or tied |", "|---" * (len(WORDS) + 3) + "|"]
    for name in sorted({group(row) for row in rows}):
        here = [row for row in rows if group(row) == name]
        lines.append(_line(name, here))
    if len(lines) > 3:
        lines.append(_line("all", rows))
    return "\n".join(lines)


def _line(name: str, rows: Sequence[Row]) -> str:
    found = counts(rows)
    share = 100 * (found["right"] + found["tied"]) / len(rows)
    return f"| {name} | {len(rows)} | {' | '.join(str(found[word]) for word in WORDS)} | {share:.0f} % |"


def _cell(row: Row) -> str:
    return f"{row['level']}, {row['noise']}, {100 * float(row['disturbance']):g} %"


def _figures(rows: Sequence[Row]) -> str:
    """Return the figures to reach, and what was reached."""
    lines = ["| figure | to reach | reached |", "|---|---|---|"]
    for level, goal in (("nominal", "95 %"), ("quarter", "90 %")):
        here = [row for row in rows if row["level"] == level]
        if here:
            found = counts(here)
            lines.append(
                f"| right or tied, {level} size | {goal} | {_share(found['right'] + found['tied'], len(here))} |"
            )
            lines.append(f"| right alone, {level} size | | {_share(found['right'], len(here))} |")
    doubted = sum(row["outcome"] in ("right", "tied") and bool(row["stand_in"]) for row in rows)
    if doubted:
        lines.append(f"| right or tied, but called a stand-in | none | {_share(doubted, len(rows))} |")
    ratios = _numbers(rows, "ratio")
    if ratios.size:
        good = int((ratios <= 1.1).sum())
        lines.append(f"| validation error within 1.1 of the oracle's | 90 % | {_share(good, ratios.size)} |")
    for noise, factor in (("high", 10), ("low", 100)):
        here = [row for row in rows if row["noise"] == noise and row["oracle_improvement"] and row["improvement"]]
        able = [row for row in here if float(row["oracle_improvement"]) >= factor]
        reached = "the oracle's never"
        if able:
            reached = _share(sum(float(row["improvement"]) >= factor / 1.1 for row in able), len(able))
        if here:
            lines.append(f"| error falls {factor}x (less 10 %) if the oracle's does, {noise} noise | all | {reached} |")
    return "\n".join(lines)


def _share(found: int, of: int) -> str:
    """Return a share with its interval."""
    low, high = clopper_pearson(found, of)
    return f"{found} of {of} ({100 * found / of:.1f} %, 95 % interval {100 * low:.0f} to {100 * high:.0f} %)"


def _numbers(rows: Iterable[Row], column: str) -> np.ndarray:
    """Return the known numbers of a column."""
    return np.array([float(row[column]) for row in rows if row[column]])


def _outside(rows: Sequence[Row]) -> str:
    """Return how laws outside the dictionary were answered: a confident name is the only fault."""
    words = ("unexplained", "stand-in", "confident", "nothing_missing")
    lines = ["| law | records | flagged: unexplained | flagged: a stand-in | confident name | missed |"]
    lines.append("|---" * 6 + "|")
    for name in [*sorted({row["truth"] for row in rows}), "all"]:
        said = [_said(row) for row in rows if name in (row["truth"], "all")]
        lines.append(f"| {name} | {len(said)} | {' | '.join(str(said.count(word)) for word in words)} |")
    named = [row for row in rows if _said(row) == "confident"]
    lines += [
        "",
        *(f"- `{row['key']}`: named {row['accepted']}, {row['residual_over_floor']} x floor" for row in named),
    ]
    return "\n".join(lines).rstrip()


def _said(row: Row) -> str:
    """Return how a report answered: its verdict, and for named effects whether it called them a stand-in."""
    if row["verdict"] != "effects_found":
        return row["verdict"]
    return "stand-in" if row["stand_in"] else "confident"


def _alarms(rows: Sequence[Row]) -> str:
    """Return the count of false alarms by class with the exact upper bound."""
    lines = [
        "A false alarm is any accepted effect. The bound is the one-sided 95 % Clopper-Pearson bound.",
        "",
        "| class | records | false alarms | rate below | no effect, but said something is left |",
        "|---|---|---|---|---|",
    ]
    classes = {
        "white sensor noise alone": [row for row in rows if float(row["disturbance"]) == 0],
        "with 2 % coloured torque": [row for row in rows if float(row["disturbance"]) > 0],
    }
    for name in sorted({f"{row['plant']}, truth by {row['engine']}" for row in rows}):
        classes[name] = [row for row in rows if f"{row['plant']}, truth by {row['engine']}" == name]
    for name, here in classes.items():
        if here:
            alarms = sum(row["verdict"] == "effects_found" for row in here)
            left = sum(row["verdict"] == "unexplained" for row in here)
            bound = 100 * upper_bound(alarms, len(here))
            lines.append(f"| {name} | {len(here)} | {alarms} | {bound:.2f} % | {left} |")
    return "\n".join(lines)


def _coverage(rows: Sequence[Row]) -> str:
    """Return how many intervals hold the truth: in records that were answered right."""
    lines = [
        "Intervals of nominal and effect parameters, in records that were answered right; 90 to 98 % is the aim. "
        "The interval of the share takes parameters as independent.",
        "",
        "| class | records | intervals | hold the truth |",
        "|---|---|---|---|",
    ]
    classes: dict[str, Callable[[Row], bool]] = {
        "all": lambda row: True,
        "nothing missing, white": lambda row: not row["truth"] and float(row["disturbance"]) == 0,
        "nothing missing, coloured": lambda row: not row["truth"] and float(row["disturbance"]) > 0,
        "an effect, white": lambda row: bool(row["truth"]) and float(row["disturbance"]) == 0,
        "an effect, coloured": lambda row: bool(row["truth"]) and float(row["disturbance"]) > 0,
    }
    for engine in sorted({row["engine"] for row in rows}):
        classes[f"truth by {engine}"] = lambda row, engine=engine: row["engine"] == engine  # type: ignore[misc]
    for name, inside in classes.items():
        here = [row for row in rows if inside(row)]
        if here:
            total = sum(int(row["intervals"]) for row in here)
            lines.append(f"| {name} | {len(here)} | {total} | {_share(sum(int(r['covered']) for r in here), total)} |")
    return "\n".join(lines)


def _cost(rows: Sequence[Row]) -> str:
    """Return seconds for a record of 20 s."""
    lines = [
        "Seconds for a 20 s record. The rows of the studies run one to a core; those of the cost study run alone, with "
        "two worker processes (to reach: 15 s for a compiled model, 180 s for an FMU).",
        "",
        "| what | records | CPU median | CPU 90 % | wall median | wall largest |",
        "|---|---|---|---|---|---|",
    ]
    groups = {
        "nothing missing": [row for row in rows if row["study"] != "cost" and not row["truth"]],
        "one effect": [row for row in rows if row["study"] == "confusion" and row["truth"]],
        "two effects": [row for row in rows if row["study"] == "two"],
        "outside the dictionary": [row for row in rows if row["study"] == "outside"],
    }
    for plant in sorted({row["plant"] for row in rows}):
        groups[f"all, {plant}"] = [row for row in rows if row["plant"] == plant and row["study"] != "cost"]
    for row in rows:
        if row["study"] == "cost":
            kind = "FMU" if row["model"] == "fmu" else "compiled model"
            answer = row["accepted"] or row["verdict"]
            groups[f"alone: {kind}, {row['plant']}, {row['truth'] or 'nothing missing'} (answer: {answer})"] = [row]
    for name, here in groups.items():
        if here:
            cpu, wall = _numbers(here, "cpu_s"), _numbers(here, "wall_s")
            figures = (np.median(cpu), np.quantile(cpu, 0.9), np.median(wall), wall.max())
            lines.append(f"| {name} | {len(here)} | {' | '.join(f'{value:.1f}' for value in figures)} |")
    return "\n".join(lines)


def _misses(rows: Sequence[Row]) -> str:
    """Return every record that was not answered right or tied."""
    lines = ["| truth | record | answer | | error over oracle's |", "|---|---|---|---|---|"]
    for row in sorted(rows, key=lambda one: (one["plant"], one["truth"], one["key"])):
        if row["outcome"] not in ("right", "tied"):
            where = f"{row['plant']}, {row['engine']}, {_cell(row)}"
            answer = row["accepted"] or row["verdict"]
            how = f"{row['outcome']}{': ' if row['how'] else ''}{row['how']}"
            lines.append(f"| {row['truth'] or 'nothing'} | {where} | {answer} | {how} | {row['ratio']} |")
    return "\n".join(lines) if len(lines) > 2 else "None."
