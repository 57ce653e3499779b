"""What the public table holds: a cell for each set and column, stored as JSON and read back."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import msgspec

from harness.benchmark.public.rules import Rule, chosen_rules
from harness.data.whole_files import whole_file
from harness.errors import UNREADABLE, InputError

RESULTS = "public.json"
Status = Literal["ok", "missing", "not entered", "unfit", "failed"]


class PublicCell(msgspec.Struct, frozen=True, kw_only=True):
    """One set in one column, and what came of it.

    ``figures`` and ``whole_record`` are in the order of the rule's tests and in its unit: the initial state from the
    window, as the rule asks, and from the whole test record, which is another figure. ``tried`` lists what competed on
    the validation part, with its figure there; ``code`` begins the hash of the project that made it.
    """

    set: str
    column: str
    key: str
    code: str = ""
    status: Status
    reason: str = ""
    model: str = ""
    figures: list[float | None] = []
    whole_record: list[float | None] = []
    validation: float | None = None
    origin: str = ""
    seconds: float = 0.0
    tried: list[dict[str, Any]] = []


@dataclass(frozen=True, eq=False)
class PublicResult:
    """The public table.

    Parameters
    ----------
    rules : tuple of Rule
    cells : tuple of Cell
    versions : dict
    folder : Path
    """

    rules: tuple[Rule, ...]
    cells: tuple[PublicCell, ...]
    versions: dict[str, str]
    folder: Path

    @cached_property
    def by_set(self) -> dict[str, dict[str, PublicCell]]:
        """The cells by set and column."""
        found: dict[str, dict[str, PublicCell]] = {rule.id: {} for rule in self.rules}
        for cell in self.cells:
            found[cell.set][cell.column] = cell
        return found

    def __str__(self) -> str:
        ok = sum(cell.status == "ok" for cell in self.cells)
        sets = sum(any(cell.status == "ok" for cell in own.values()) for own in self.by_set.values())
        return f"public table: {sets} of {len(self.rules)} sets have figures of ours, {ok} of {len(self.cells)} cells"


def write_public(result: PublicResult) -> None:
    """Write the cells of a table into its folder."""
    content = {"versions": result.versions, "cells": msgspec.to_builtins(list(result.cells))}
    with whole_file(result.folder / RESULTS) as scratch:
        scratch.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_public(folder: str | Path) -> PublicResult:
    """Return a stored public table.

    Raises
    ------
    InputError
        If the folder holds none.
    """
    path = Path(folder) / RESULTS
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        cells = msgspec.convert(content["cells"], list[PublicCell])
    except (*UNREADABLE, KeyError, msgspec.ValidationError) as error:
        raise InputError(
            "a public table", expected=f"{RESULTS} that sysid wrote", got=" ".join(str(error).split())[:120],
            remedy="run sysid bench public first", file=path,
        ) from error  # fmt: skip
    return arranged(cells, content["versions"], Path(folder))


def arranged(cells: Sequence[PublicCell], versions: dict[str, str], folder: Path) -> PublicResult:
    """Return cells as a table, in the order of the rules."""
    rules = chosen_rules(sorted({cell.set for cell in cells}) or None)
    order = {rule.id: number for number, rule in enumerate(rules)}
    columns = {"black": 0, "grey": 1}
    inorder = sorted(cells, key=lambda cell: (order[cell.set], columns.get(cell.column, 2), cell.column))
    return PublicResult(rules, tuple(inorder), versions, folder)
