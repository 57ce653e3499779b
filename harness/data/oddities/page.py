"""What was found, for a person and for a program: sentences, rows, and a page with the odd rows marked."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from harness.data.oddities.examine import lines
from harness.display import STYLE, drawing, page, table
from harness.signals import Dataset, Oddity
from harness.units import own_record

_MOST = 1000  # Rows that are listed by number.


@dataclass(frozen=True, eq=False)
class DataCheck:
    """What ``check_data`` returns.

    Attributes
    ----------
    dataset : Dataset
        Examined; what is no reading is marked as missing.
    """

    dataset: Dataset

    @property
    def oddities(self) -> tuple[Oddity, ...]:
        """What was found."""
        return self.dataset.oddities or ()

    @property
    def faults(self) -> tuple[Oddity, ...]:
        """What the plant did not do."""
        return tuple(odd for odd in self.oddities if odd.fault)

    def __str__(self) -> str:
        return "\n".join(lines(self.oddities, faults=False)) or "nothing odd was found"

    def _repr_html_(self) -> str:
        return self._parts()

    def to_dict(self) -> dict[str, Any]:
        """Return what was found, as ``report.json`` holds it, the notes of the reader beside it."""
        return {
            "dataset": self.dataset.name,
            "oddities": oddities_data(self.dataset),
            "warnings": list(self.dataset.warnings),
        }

    def html(self) -> str:
        """Return a page by itself."""
        title = escape(f"records of {self.dataset.name}")
        return (
            f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
            f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style></head>'
            f"<body>{self._parts()}</body></html>\n"
        )

    def _parts(self) -> str:
        rows = [
            (odd.run, odd.channel, odd.words, "left out" if odd.used else "reported" if odd.fault else "no fault")
            for odd in self.oddities
        ]
        titles = ["run", "channel", "what is odd", "what is done"]
        found = table(titles, rows) if rows else "<p>nothing odd was found</p>"
        notes = table(["what was noticed on reading"], [[text] for text in self.dataset.warnings])
        return page(str(self.dataset), found, *odd_pictures(self.dataset), notes if self.dataset.warnings else "")


def oddities_data(dataset: Dataset) -> list[dict[str, Any]]:
    """Return what is odd about a data set as ``report.json`` holds it."""
    return [
        {
            "kind": odd.kind,
            "run": odd.run,
            "channel": odd.channel,
            "count": len(odd.rows),
            "rows": list(odd.rows[:_MOST]),
            "text": odd.words,
            "fault": odd.fault,
            "used": odd.used,
        }
        for odd in dataset.oddities or ()
    ]


def odd_pictures(dataset: Dataset) -> list[str]:
    """Return a drawing (SVG) of every channel with odd rows, these marked; what is odd of most rows is so of all."""
    marked: dict[tuple[int, str], set[int]] = {}
    for odd in dataset.oddities or ():
        if 0 < 2 * len(odd.rows) < len(dataset.runs[odd.run].trajectory):
            marked.setdefault((odd.run, odd.channel), set()).update(odd.rows)
    pictures = []
    for (run, name), rows in sorted(marked.items()):
        record = own_record(dataset.runs[run].trajectory, dataset.recorded)
        for channels, values in ((record.spec.inputs, record.u), (record.spec.outputs, record.y)):
            for column, channel in enumerate(channels):
                if channel.name == name:
                    label = f"run {run}: {channel}, {len(rows)} odd rows marked"
                    pictures.append(drawing(values[:, column], label, np.array(sorted(rows))))
    return pictures
