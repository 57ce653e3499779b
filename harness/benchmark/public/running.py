"""The public table is run: set by set and column by column, what is finished kept by its content."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec

from harness.benchmark.public.blackbox import chosen
from harness.benchmark.public.choices import BlackChoices, GreyChoice, SetChoices, read_choices
from harness.benchmark.public.greybox import repaired
from harness.benchmark.public.reading import PublicSplit, downloaded, found_in, read
from harness.benchmark.public.result import RESULTS, PublicCell, PublicResult, arranged, read_public, write_public
from harness.benchmark.public.rules import Rule, chosen_rules
from harness.benchmark.public.scores import figure, simulated
from harness.benchmark.public.tables import write_tables
from harness.benchmark.store import versions
from harness.data.whole_files import whole_file
from harness.errors import HarnessError, InputError, refuse_unknown
from harness.fingerprint import fingerprint, own_code
from harness.protocols import Model
from harness.signals import FloatArray, Trajectory

COLUMNS = ("black", "grey", "peers")


def bench_public(
    *,
    sets: Sequence[str] | None = None,
    only: str | None = None,
    out: str | Path = "results/public",
    choices: str | Path | None = None,
    download: bool = False,
    resume: bool = False,
    progress: Callable[[int, int, str], None] | None = None,
) -> PublicResult:
    """Run the public table, or a part of it, and write it: JSON, CSV, Markdown, LaTeX and a page.

    Parameters
    ----------
    sets : sequence of str, optional
        Ids of :data:`harness.benchmark.public.rules.RULES`; by default all.
    only : {"black", "grey", "peers"}, optional
        One column.
    out : path
        Folder. A finished cell is kept there; with ``resume`` it is read back if data, rule, choices and version are
        those of then. What other runs left of other sets or columns stays in the table.
    choices : path, optional
        A file like ``choices.toml`` in place of the declared entries.
    download : bool
        Get missing sets through the official loader (extra ``download``).
    resume : bool
    progress : callable, optional
        Called as ``progress(done, total, what)``.

    Raises
    ------
    InputError
        If a set, a column or the choices cannot be used, or the folder holds a table and ``resume`` is not given.
    """
    rules = chosen_rules(sets)
    if only is not None:
        refuse_unknown("column", only, COLUMNS, remedy="choose one", place="--only")
    entered = read_choices(choices)
    folder = Path(out)
    if (folder / RESULTS).is_file() and not resume:
        raise InputError(
            "folder of the public table", expected="an empty one", got="a finished table", file=folder,
            remedy="give --resume to keep what has not changed, or another --out",
        )  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    asked = COLUMNS if only is None else (only,)
    jobs = [(rule, entry) for rule in rules for entry in _entries(entered.get(rule.id, SetChoices()), asked)]
    splits: dict[str, PublicSplit | str] = {}
    cells = []
    for done, (rule, (column, entry)) in enumerate(jobs):
        what = f"{rule.id}, {column}"
        if progress is not None:
            progress(done, len(jobs), what)
        if rule.id not in splits:
            splits[rule.id] = _data(rule, download)

        def say(text: str, done: int = done, what: str = what) -> None:
            if progress is not None:
                progress(done, len(jobs), f"{what}: {text}")

        cells.append(_cell(rule, column, entry, splits[rule.id], folder, resume, say))
    if progress is not None:
        progress(len(jobs), len(jobs), "done")
    return _written(cells, folder)


Entry = BlackChoices | GreyChoice | None


def _entries(choice: SetChoices, asked: Sequence[str]) -> list[tuple[str, Entry]]:
    """Return the columns of a set, with what is entered: peers have a column each."""
    found: list[tuple[str, Entry]] = []
    if "black" in asked:
        found.append(("black", choice.black))
    if "grey" in asked:
        found.append(("grey", choice.grey))
    if "peers" in asked and choice.black is not None:
        for peer in choice.peers:
            found.append((peer.id, BlackChoices(validation=choice.black.validation, candidates=[peer])))
    return found


def _data(rule: Rule, download: bool) -> PublicSplit | str:
    """Return a set, or why there is none."""
    try:
        place = found_in(rule)
        if place is not None:
            return read(rule, place)
        return downloaded(rule) if download else rule.where
    except InputError as error:
        return str(error)


def _cell(
    rule: Rule,
    column: str,
    entry: Entry,
    split: PublicSplit | str,
    folder: Path,
    resume: bool,
    say: Callable[[str], None],
) -> PublicCell:
    """Return a cell, read back where nothing that it rests on has changed."""
    if isinstance(split, str):
        return PublicCell(set=rule.id, column=column, key="", status="missing", reason=split)
    if entry is None:
        return PublicCell(set=rule.id, column=column, key="", status="not entered", reason="nothing is declared for it")
    if rule.metric != "window":
        return PublicCell(
            set=rule.id, column=column, key="", status="not entered",
            reason="scored over horizons from every sample, for which no identifier is entered",
        )  # fmt: skip
    key = fingerprint(rule.id, rule.window, rule.scale, split, msgspec.to_builtins(entry), own_code())
    kept = folder / "cells" / f"{rule.id}-{column}.json"
    if resume and kept.is_file():
        found = msgspec.json.decode(kept.read_bytes(), type=PublicCell)
        if found.key == key and found.status == "ok":
            return found
    began = time.perf_counter()
    try:
        if isinstance(entry, GreyChoice):
            cell = _grey(rule, column, key, entry, split, folder, say)
        else:
            cell = _black(rule, column, key, entry, split, say)
    except HarnessError as error:
        cell = PublicCell(
            set=rule.id, column=column, key=key, status="failed", reason=_line(error), origin=split.origin
        )
    cell = msgspec.structs.replace(cell, seconds=time.perf_counter() - began, code=own_code()[:8])
    kept.parent.mkdir(exist_ok=True)
    with whole_file(kept) as scratch:
        scratch.write_bytes(msgspec.json.format(msgspec.json.encode(cell), indent=1))
    return cell


def _black(
    rule: Rule, column: str, key: str, entry: BlackChoices, split: PublicSplit, say: Callable[[str], None]
) -> PublicCell:
    """Return the cell of identifiers among which the validation part chooses."""
    model, best, tried = chosen(rule, split.train, entry.validation, entry.candidates, say)
    shown = [msgspec.to_builtins(one) for one in tried]
    if model is None or best is None:
        reason = "; ".join(f"{one.identifier} {one.options}: {one.reason}" for one in tried)
        return PublicCell(
            set=rule.id, column=column, key=key, status="unfit", reason=_line(reason), origin=split.origin, tried=shown
        )
    options = ", ".join(f"{name} {_shown(value)}" for name, value in best.options.items())
    return PublicCell(
        set=rule.id,
        column=column,
        key=key,
        status="ok",
        model=f"{best.identifier} ({options})" if options else best.identifier,
        validation=best.figure,
        origin=split.origin,
        tried=shown,
        **_figures(rule, split, model, lambda one: one),
    )


def _grey(
    rule: Rule, column: str, key: str, entry: GreyChoice, split: PublicSplit, folder: Path, say: Callable[[str], None]
) -> PublicCell:
    """Return the cell of the loop's repaired physics; its report stays in ``loops/``, named by what it rests on."""
    place = folder / "loops" / f"{rule.id}-{key[:8]}"
    place.parent.mkdir(exist_ok=True)
    found = repaired(rule, split.train, entry, place, lambda share, what: say(f"{what} ({100 * share:.0f} %)"))
    words = found.words + ("" if found.refitted else "; parameters of the loop")
    figures = _figures(rule, split, found.model, found.signals.of)
    return PublicCell(set=rule.id, column=column, key=key, status="ok", model=words, origin=split.origin, **figures)


def _figures(
    rule: Rule, split: PublicSplit, model: Model, signals: Callable[[Trajectory], Trajectory]
) -> dict[str, Any]:
    """Return the figures of a model on the test records: from the window, and with the whole record for its start."""

    def over(window: int | None) -> list[float | None]:
        values: list[float | None] = []
        for group in split.tests:
            outputs: list[FloatArray] = [simulated(model, signals(one), window) for one in group]
            value = figure(rule, [one.y for one in group], outputs)
            values.append(value if value < float("inf") else None)
        return values

    return {"figures": over(rule.window), "whole_record": over(None)}


def _written(cells: Sequence[PublicCell], folder: Path) -> PublicResult:
    """Write the table with what earlier runs left of other sets and columns, and return it."""
    known = {(cell.set, cell.column): cell for cell in _earlier(folder)}
    known |= {(cell.set, cell.column): cell for cell in cells}
    result = arranged(list(known.values()), versions(), folder)
    write_public(result)
    write_tables(result)
    return result


def _earlier(folder: Path) -> tuple[PublicCell, ...]:
    """Return the cells that a folder holds."""
    return read_public(folder).cells if (folder / RESULTS).is_file() else ()


def _shown(value: Any) -> str:
    """Return an option in few letters."""
    return f"{value:g}" if isinstance(value, float) else str(value)


def _line(text: object) -> str:
    """Return a reason on one line of bounded length."""
    return " ".join(str(text).split())[:400]
