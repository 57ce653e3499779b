"""The confusion matrix of a study as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from harness.data.whole_files import whole_file

NOTHING, SEVERAL = "nothing", "several"


def confusion_picture(rows: Sequence[dict[str, str]], path: Path) -> bool:
    """Draw truth against answer for the records with one effect or none, one panel for each plant.

    A tied answer counts as the truth; where nothing is hidden, the nominal structure is right. Returns False, and draws
    nothing, where there are no such rows.
    """
    single = [row for row in rows if row["status"] == "ok" and row["study"] in ("confusion", "none")]
    chosen = [row for row in single if row["truth"] or not row["structure"]]
    if not chosen:
        return False
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    plants = sorted({row["plant"] for row in chosen}, reverse=True)
    sizes = {plant: len({row["truth"] for row in chosen if row["plant"] == plant}) for plant in plants}
    figure = Figure(figsize=(4.5 + 0.28 * sum(sizes.values()), 3.5 + 0.22 * max(sizes.values())), layout="constrained")
    FigureCanvasAgg(figure)
    for place, plant in enumerate(plants):
        axes = figure.add_subplot(1, len(plants), place + 1)
        _draw_panel(axes, plant, [row for row in chosen if row["plant"] == plant])
        if place == 0:
            axes.set_ylabel("truth", fontsize=9)
    with whole_file(path) as scratch:
        figure.savefig(scratch, dpi=130, format="png")
    return True


def _draw_panel(axes: Any, plant: str, rows: Sequence[dict[str, str]]) -> None:
    """Draw truth against answer of one plant, coloured by the share of each truth."""
    truths = sorted({row["truth"] or NOTHING for row in rows})
    answers = [*truths, *sorted({_answer(row) for row in rows} - set(truths) - {SEVERAL}), SEVERAL]
    table = np.zeros((len(truths), len(answers)))
    for row in rows:
        table[truths.index(row["truth"] or NOTHING), answers.index(_answer(row))] += 1
    share = table / np.maximum(table.sum(axis=1, keepdims=True), 1)
    axes.imshow(share, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    for (i, j), count in np.ndenumerate(table):
        if count:
            shade = "white" if share[i, j] > 0.5 else "black"
            axes.text(j, i, f"{count:.0f}", ha="center", va="center", color=shade, fontsize=7)
    axes.set_xticks(range(len(answers)), [_words(answer) for answer in answers], rotation=90, fontsize=7)
    axes.set_yticks(range(len(truths)), [_words(truth) for truth in truths], fontsize=7)
    axes.set_title(f"{plant}: {len(rows)} records", fontsize=10)
    axes.set_xlabel("answer (tied counts as the truth)", fontsize=9)


def _answer(row: dict[str, str]) -> str:
    """Return the column of a row."""
    if row["outcome"] in ("right", "tied"):
        return row["truth"] or NOTHING
    if " + " in row["accepted"]:
        return SEVERAL
    return row["accepted"] or (NOTHING if row["verdict"] == "nothing_missing" else row["verdict"])


def _words(name: str) -> str:
    """Return a name as words."""
    return name.replace("_", " ").replace("@", " @ ")
