"""The tables of a study as Markdown: what was right, tied, wrong or missed, misses included."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence

import numpy as np

from sysid_lab.pages.headline import figures, share
from sysid_lab.pages.statistics import upper_bound
from sysid_lab.truths.disturbances import STRUCTURES

Row = dict[str, str]
WORDS = ("right", "tied", "wrong", "flagged", "missed")

LEGEND = """Each row of a table counts pairs of records (estimation and validation, 20 s at 250 Hz, positions only).
*right*: the accepted set is the truth, effect and place (a law of hardware also by the name of the law that it refines:
friction with bristles or without, hysteresis of one slip element or two, a joint that stiffens or not, play whose
flanks pull or not). *tied*: the truth is in the tie set; or it is exactly the same on this plant as what was accepted
(gravity tilt, encoder offset and eccentric load on one joint; a late input and a late reading of the only sensor;
asymmetric Coulomb friction, and Coulomb friction with a bias; Coulomb friction of hardware, which is Dahl's law, and
hysteresis, which is that law where beta is 1); or nothing was accepted, and the report says that the truth cannot be
told from the nominal parameters (input gain: a common scale of all of them; an offset of a position without reference).
*wrong*: another set was accepted. *flagged*: the report says that something is missing, and names no cause: no effect
accepted, or those accepted called a stand-in. *missed*: nothing said. What the report says may be a part of what is
left is no accepted effect.
Truths: `bullet` and `pymunk` (their bodies and joints; what they do not have, actuators, sensors and forces on the
driven coordinate, is put around them in steps of 0.2 ms; `balanced`: pymunk upright under LQR), `hardware` (C: Dahl and
LuGre bristles, a joint that hardens and flanks that never pull, which the dictionary has too, and laws of another
formulation than its own: four slip elements, Hunt-Crossley contacts, a motor with back-EMF, current and voltage limits,
a command held by a slower clock), `fmu` (C behind FMI: the formulas of `laws`, with which it agrees to rounding),
`laws` (the dictionary's formulas in C, steps of 0.2 ms, friction with a true standstill, sharp corners). Sizes: nominal
is 6 to 10 % of the rms torque, quarter a fourth; noise: low 1e-4, high 1e-3 (rad, m); disturbance: unknown torque of 2
% of the rms torque, Gauss-Markov or not. A third of the records have a nominal structure that is a little wrong:
{structures}. Seven of these have a name in the dictionary (damping that depends on the position, damping and gain that
drift along a record, a drive whose gain falls with its command or ripples, a cyclic error and a bent scale of the
sensor), and an answer that names it beside what is hidden is right; a heavy rod and a drive that tires at speed have
none. Both models have viscous friction: it is not hidden."""
PART = " (the order is balanced within every part, so what is done is a fair sample)"
NAMED = ("payload_step", "backlash", "sensor_offset", "end_stop")  # Effects that the headline shows one by one.


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
        f"Made by `sysid-lab` on {seeds} seeds: {len(known)} of {planned} planned records done"
        f"{'' if len(known) == planned else PART}.",
        LEGEND.format(structures="; ".join(STRUCTURES.values())),
    ]
    single = _where(good, study="confusion")
    hidden = [row for row in single if row["truth"]]
    two = _where(good, study="two")
    nothing = [row for row in good if not row["truth"] and row["study"] in ("none", "confusion")]
    sections: tuple[tuple[str, Sequence[Row], Callable[[Sequence[Row]], Sequence[str]]], ...] = (
        ("One effect", hidden, _one_effect),
        ("Two effects at once", two, _two_effects),
        ("Laws that the dictionary does not have", _where(good, study="outside"), _outside),
        ("Nothing missing: false alarms", nothing, _alarms),
        ("Coverage of the 95 % intervals", [row for row in good if row["intervals"] not in ("", "0")], _coverage),
        ("Cost", [row for row in good if row["cpu_s"]], _cost),
        ("Every answer that was not right or tied", [*hidden, *two, *nothing] if single or two else [], _misses),
        ("Records without an answer", [row for row in known if row["status"] != "ok"], _failed),
    )
    for title, chosen, written in sections:
        if chosen:
            parts += [f"## {title}", *written(chosen)]
    return "\n\n".join(parts) + "\n"


def _where(rows: Iterable[Row], **values: str) -> list[Row]:
    """Return the rows that have these values."""
    return [row for row in rows if all(row[column] == value for column, value in values.items())]


def _failed(rows: Sequence[Row]) -> list[str]:
    """Return the records without an answer, with the reason."""
    return ["\n".join(f"- `{row['key']}`: {row['status']}: {row['reason']}" for row in rows)]


def _two_effects(rows: Sequence[Row]) -> list[str]:
    """Return the figures of records with two hidden effects, and their tables."""
    return [figures(rows), _table("disturbance", rows, _level), _table("effects", rows, lambda row: row["truth"])]


def _one_effect(hidden: Sequence[Row]) -> list[str]:
    """Return the figures of records with one hidden effect, and their tables by all that was varied."""
    parts = [figures(hidden)]
    for title, column in (
        ("plant", "plant"), ("size", "level"), ("noise", "noise"), ("disturbance", "disturbance"),
        ("truth by", "engine"), ("kind of disturbance", "shape"), ("nominal structure", "structure"),
    ):  # fmt: skip
        parts.append(_table(title, hidden, lambda row, column=column: _value(row, column)))  # type: ignore[misc]
    for name in NAMED:
        here = [row for row in hidden if row["truth"].startswith(name + "@")]
        if here:
            parts.append(_table(name.replace("_", " "), here, _cell))
    parts.append(_table("size, noise, disturbance", hidden, _cell))
    parts.append(_table("effect", hidden, lambda row: f"{row['plant']}: {row['truth']}"))
    return parts


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


def _value(row: Row, column: str) -> str:
    """Return the group of a row."""
    if column == "shape":
        return row["shape"] or "gauss-markov" if float(row["disturbance"]) else "none"
    return row[column] or "right" if column == "structure" else row[column]


def _level(row: Row) -> str:
    return f"{100 * float(row['disturbance']):g} %"


def _cell(row: Row) -> str:
    return f"{row['level']}, {row['noise']}, {100 * float(row['disturbance']):g} %"


def _numbers(rows: Iterable[Row], column: str) -> np.ndarray:
    """Return the known numbers of a column."""
    return np.array([float(row[column]) for row in rows if row[column]])


def _outside(rows: Sequence[Row]) -> list[str]:
    """Return how laws outside the dictionary were answered: a confident name is the only fault."""
    words = {
        "unexplained": "flagged: unexplained",
        "model_does_not_fit": "flagged: does not fit",
        "stand-in": "flagged: a stand-in",
        "confident": "confident name",
        "nothing_missing": "missed",
    }
    lines = [f"| law | records | {' | '.join(words.values())} |", "|---" * (2 + len(words)) + "|"]
    for name in [*sorted({row["truth"] for row in rows}), "all"]:
        said = [_said(row) for row in rows if name in (row["truth"], "all")]
        lines.append(f"| {name} | {len(said)} | {' | '.join(str(said.count(word)) for word in words)} |")
    named = [row for row in rows if _said(row) == "confident"]
    lines += [
        "",
        *(f"- `{row['key']}`: named {row['accepted']}, {row['residual_over_floor']} x floor" for row in named),
    ]
    return ["\n".join(lines).rstrip()]


def _said(row: Row) -> str:
    """Return how a report answered: its verdict, and for named effects whether it called them a stand-in."""
    if row["verdict"] != "effects_found":
        return row["verdict"]
    return "stand-in" if row["stand_in"] else "confident"


def _alarms(rows: Sequence[Row]) -> list[str]:
    """Return the count of false alarms by class with the exact upper bound."""
    lines = [
        "A false alarm is any accepted effect; where the nominal structure is a little wrong, something is missing, "
        "and any other effect than what is missing is a wrong name. "
        "The bound is the one-sided 95 % Clopper-Pearson bound.",
        "",
        "| class | records | false alarms | rate below | no effect, but said something is left |",
        "|---|---|---|---|---|",
    ]
    for name, here in _classes_of_alarms(rows).items():
        if here:
            alarms = sum(row["outcome"] == "wrong" for row in here)
            left = sum(row["verdict"] == "unexplained" for row in here)
            bound = 100 * upper_bound(alarms, len(here))
            lines.append(f"| {name} | {len(here)} | {alarms} | {bound:.2f} % | {left} |")
    return ["\n".join(lines)]


def _classes_of_alarms(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Return the records in which nothing is hidden by noise, by disturbance, by engine and by nominal structure."""
    sound = _where(rows, structure="")
    white = [row for row in sound if float(row["disturbance"]) == 0]
    shaken = [row for row in sound if float(row["disturbance"]) > 0]
    bent = [row for row in rows if row["structure"]]
    return {
        "white sensor noise alone": white,
        "of them, input recorded with noise": [row for row in white if _noisy(row)],
        "with 2 % unknown torque": shaken,
        "of them, input recorded with noise ": [row for row in shaken if _noisy(row)],
        **_grouped(shaken, lambda row: f"of them, {_value(row, 'shape')}"),
        **_grouped(sound, lambda row: f"{row['plant']}, truth by {row['engine']}"),
        **_grouped(bent, lambda row: f"nominal structure a little wrong: {row['structure']}"),
    }


def _grouped(rows: Sequence[Row], name: Callable[[Row], str]) -> dict[str, list[Row]]:
    """Return rows by name, in the order of the names."""
    return {group: [row for row in rows if name(row) == group] for group in sorted({name(row) for row in rows})}


def _noisy(row: Row) -> bool:
    return bool(row["input_noise"]) and float(row["input_noise"]) > 0


def _coverage(rows: Sequence[Row]) -> list[str]:
    """Return how many intervals hold the truth: in every record that was answered, right or wrong."""
    lines = [
        "Intervals of nominal and effect parameters in every answer, right or not; an accepted effect that is not "
        "there counts as an interval that does not hold the truth. 90 to 98 % is the aim. A parameter has a true value "
        "where the model has the truth in it: what is there was selected, and neither hardware's own formulation of a "
        "law nor a structure without a name is beside it. In the other answers the same name means something else in "
        "truth and model. The interval of the share takes parameters as independent.",
        "",
        "| class | records | intervals | hold the truth |",
        "|---|---|---|---|",
    ]
    classes: dict[str, Callable[[Row], bool]] = {
        "**the model has the truth in it, effects among it**": lambda row: _holds(row) and bool(row["accepted"]),
        "the model has the truth in it, nothing is missing": lambda row: _holds(row) and not row["accepted"],
        "every answer": lambda row: True,
        "nominal structure right": lambda row: not row["structure"],
        "nominal structure a little wrong": lambda row: bool(row["structure"]),
        "effects accepted": lambda row: bool(row["accepted"]),
        "effects accepted, right": lambda row: bool(row["accepted"]) and row["outcome"] == "right",
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
            lines.append(f"| {name} | {len(here)} | {total} | {share(sum(int(r['covered']) for r in here), total)} |")
    return ["\n".join(lines)]


def _holds(row: Row) -> bool:
    return row.get("holds_truth") == "yes"


def _cost(rows: Sequence[Row]) -> list[str]:
    """Return seconds for a record of 20 s."""
    lines = [
        "Seconds for a 20 s record. Rows of the studies: the diagnosis alone, in a process that is warm. Rows "
        "*command*: `sysid close-loop` in a process of its own, the whole tree counted, interpreter, imports and "
        "report too; *cold* with nothing compiled yet (to reach: 4 s pendulum, 8 s cart-pole, 30 s at most).",
        "",
        "| what | records | CPU median | CPU 90 % | CPU largest | wall median | wall largest |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, here in _groups_of_cost(rows).items():
        if here:
            cpu, wall = _numbers(here, "cpu_s"), _numbers(here, "wall_s")
            figures = [
                np.median(cpu),
                np.quantile(cpu, 0.9),
                cpu.max(),
                *([np.median(wall), wall.max()] if wall.size else []),
            ]
            cells = [f"{value:.1f}" for value in figures] + [""] * (5 - len(figures))
            lines.append(f"| {name} | {len(here)} | {' | '.join(cells)} |")
    return ["\n".join(lines)]


def _groups_of_cost(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Return the timed rows by what was hidden, by plant, and those of the command by plant, cold or around an FMU."""
    studied, cost = [row for row in rows if row["study"] != "cost"], _where(rows, study="cost")
    groups = {
        "nothing missing": _where(studied, truth=""),
        "one effect": [row for row in studied if row["study"] == "confusion" and row["truth"]],
        "two effects": _where(studied, study="two"),
        "outside the dictionary": _where(studied, study="outside"),
    }
    groups |= {f"all, {plant}": _where(studied, plant=plant) for plant in sorted({row["plant"] for row in rows})}
    for plant in sorted({row["plant"] for row in cost}):
        own = [row for row in cost if row["plant"] == plant and row["model"] != "fmu"]
        groups[f"command, {plant}"] = own
        groups[f"command, {plant}, cold"] = [
            {**row, "cpu_s": row["cpu_cold_s"], "wall_s": ""} for row in own if row["cpu_cold_s"]
        ]
        groups[f"around an FMU, {plant}"] = _where(cost, plant=plant, model="fmu")
    return groups


def _misses(rows: Sequence[Row]) -> list[str]:
    """Return every record that was not answered right or tied."""
    lines = ["| truth | record | answer | | error over oracle's |", "|---|---|---|---|---|"]
    for row in sorted(rows, key=lambda record: (record["plant"], record["truth"], record["key"])):
        if row["outcome"] not in ("right", "tied"):
            odd = [_value(row, "shape")] if float(row["disturbance"]) else []
            odd += [f"{row['structure']}"] if row["structure"] else []
            odd += ["noisy input"] if _noisy(row) else []
            where = ", ".join([row["plant"], row["engine"], _cell(row), *odd])
            answer = row["accepted"] or row["verdict"]
            how = f"{row['outcome']}{': ' if row['how'] else ''}{row['how']}"
            lines.append(f"| {row['truth'] or 'nothing'} | {where} | {answer} | {how} | {row['ratio']} |")
    return ["\n".join(lines) if len(lines) > 2 else "None."]
