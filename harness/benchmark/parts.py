"""What a suite is made of: parts, groups, how they are scored; and the cells and tasks that come of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from harness.errors import printable

RECORDING, RECORDED = "recording:", "recorded"
"""Prefix of a plant that is a recording, and the scenario that goes with it."""


class SuitePart(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A plant, scenario or identifier of a suite: the id of a registered part, its options, its name in the table.

    A plant may also be a file (``.fmu``, ``.toml`` of a coupling, ``.ssp``), relative to the suite, or a recording
    (``recording:emps``) under the scenario ``recorded``: models are fitted to its estimation runs and scored on its
    test runs, or else its validation runs; its noise is its own, so one seed is enough.

    ``streams`` names the random streams (by default the name; of a file without a label, what is in it): parts with
    one name there meet the same random numbers.
    ``at`` is filled by the axes of a group.
    """

    id: str
    options: dict[str, Any] = {}
    label: str = ""
    streams: str = ""
    at: dict[str, float] = {}

    @property
    def stream(self) -> str:
        """What keys its random streams."""
        return self.streams or self.name

    @property
    def name(self) -> str:
        """What the table calls it: the label, or else the id."""
        return printable(self.label or self.id)


class ScoreSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How the models of a group are scored.

    ``horizon`` is that of the simulation error in s (the whole record without it); ``runs`` and ``held_out`` count the
    records that a model is fitted to and scored on. ``control`` asks for the columns of control too: what the design on
    a linear model costs on the true plant, and what learning to control costs. ``curve`` is the number of lengths of
    the stream at which the regret is drawn, each against the best fixed model of the samples so far: few where that is
    a long fit.
    """

    horizon: float | None = None
    runs: int = 1
    held_out: int = 1
    control: bool = False
    curve: int = 40


class Group(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Every plant of a group meets every scenario, every identifier and every seed.

    ``axes`` gives options several values: ``{"scenarios.noise" = [0.0, 0.01, 0.1]}``.
    """

    plants: tuple[SuitePart, ...]
    scenarios: tuple[SuitePart, ...]
    identifiers: tuple[SuitePart, ...]
    name: str = ""
    seeds: tuple[int, ...] | None = None
    score: ScoreSettings = ScoreSettings()
    time_limit: float | None = None
    axes: dict[str, tuple[int | float, ...]] = {}


class Suite(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A benchmark: groups, the seeds of those that name none, and seconds that one cell may take.

    ``cell_seconds`` is the mean CPU time of a cell as its author measured it: what ``--dry-run`` goes by before any
    cell has run.
    """

    name: str
    groups: tuple[Group, ...]
    description: str = ""
    seeds: tuple[int, ...] = (0, 1, 2)
    time_limit: float = 60.0
    cell_seconds: float | None = None


class Cell(msgspec.Struct, frozen=True):
    """One row of the table, still to be computed; ``job`` is a hash of everything that decides its result."""

    job: str
    identifier: SuitePart


class Task(msgspec.Struct, frozen=True):
    """The cells of one plant, scenario and seed: they share their data, so one worker does them together."""

    plant: SuitePart
    scenario: SuitePart
    seed: int
    score: ScoreSettings
    time_limit: float
    cells: tuple[Cell, ...]

    @property
    def title(self) -> str:
        """For the progress bar."""
        return f"{self.plant.name} / {self.scenario.name} / seed {self.seed}"


KINDS = ("plants", "scenarios", "identifiers")


def axes_problem(axes: Mapping[str, Sequence[float]]) -> str:
    """Return the first fault of the axes of a group in words; empty where there is none.

    Examples
    --------
    >>> axes_problem({"scenarios.noise": [0.0, 0.1]})
    ''
    >>> axes_problem({"noise": [0.0, 0.1]})
    "axis 'noise' names no kind: write plants.OPTION, scenarios.OPTION or identifiers.OPTION"
    """
    for name, values in axes.items():
        kind, dot, option = name.partition(".")
        if kind not in KINDS or not dot or not option:
            return f"axis {name!r} names no kind: write plants.OPTION, scenarios.OPTION or identifiers.OPTION"
        if not values or len(set(values)) != len(values):
            return f"axis {name!r} needs different values, at least one"
    return ""


def expanded(group: Group) -> Group:
    """Return the group with every part once for each combination of values along its axes.

    The label tells the values. The random streams of a part stay those of its name without them, so that the points of
    an axis are paired: the same excitation and the same noise, scaled.
    """
    if not group.axes:
        return group
    parts = {kind: tuple(getattr(group, kind)) for kind in KINDS}
    for name, values in group.axes.items():
        kind, _, option = name.partition(".")
        parts[kind] = tuple(_at(part, name, option, value) for part in parts[kind] for value in values)
    return msgspec.structs.replace(group, **parts, axes={})


def _at(part: SuitePart, name: str, option: str, value: float) -> SuitePart:
    """Return a part at one point of an axis."""
    text = f"{value:g}" if isinstance(value, float) else str(value)
    base, bracket, inside = part.name.partition(" [")
    inside = f"{inside.removesuffix(']')}, " if bracket else ""
    return msgspec.structs.replace(
        part,
        options={**part.options, option: value},
        label=f"{base} [{inside}{option} {text}]",
        streams=part.streams or part.name,
        at={**part.at, name: float(value)},
    )
