"""What an analysis is: it looks at one thing (a plant, a model's equations, records) and says what it found."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, Protocol, runtime_checkable

import numpy as np

from harness.display import page, table
from harness.errors import InputError
from harness.signals import Dataset

Takes = Literal["process", "maker", "definition", "data", "records"]
"""What an analysis looks at: a process (a plant, or a fitted model in its file), a maker of plants
``make(**options)``, the equations of a model (:class:`harness.physics.System`), or a data set; ``"records"``: a data
set, a fitted model in its file or a physical model by its name, whose records are planned."""


def as_dataset(subject: Any, what: str) -> Dataset:
    """Return the data set that an analysis was given; refuse anything else."""
    if not isinstance(subject, Dataset):
        raise InputError(what, expected="a data set", got=type(subject).__name__, remedy="give records")
    return subject


@dataclass(frozen=True, eq=False)
class Findings:
    """What an analysis found.

    Parameters
    ----------
    title : str
    rows : sequence of mapping
        A table: numbers and short texts by column.
    words : sequence of str
        What the table means, in sentences.
    details : mapping
        Arrays and numbers for Python and JSON.
    draw : callable, optional
        Returns a matplotlib figure of it.
    """

    title: str
    rows: Sequence[Mapping[str, Any]]
    words: Sequence[str] = ()
    details: Mapping[str, Any] = field(default_factory=dict)
    draw: Callable[[], Any] | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description."""
        plain = {
            name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in self.details.items()
        }
        return {"title": self.title, "rows": [dict(row) for row in self.rows], "words": list(self.words), **plain}

    def plot(self) -> Any:
        """Draw it; returns the matplotlib figure.

        Raises
        ------
        InputError
            If this analysis has no picture.
        """
        if self.draw is None:
            raise InputError(
                f"picture of {self.title}",
                expected="an analysis with a picture",
                got="a table only",
                remedy="leave -o out",
            )
        return self.draw()

    def __repr__(self) -> str:
        return f"<Findings: {self.title}>"

    def _repr_html_(self) -> str:
        shown = table(list(self.rows[0]), [tuple(row.values()) for row in self.rows]) if self.rows else ""
        return page(self.title, shown, *(f"<p>{text}</p>" for text in self.words))


@runtime_checkable
class Analysis(Protocol):
    """Looks at one thing. Options are frozen; ``of`` changes nothing outside."""

    takes: ClassVar[Takes]

    def of(self, subject: Any, *, rng: np.random.Generator) -> Findings:
        """Return the findings.

        Raises InputError if the subject is none that it can look at.
        """
        ...
