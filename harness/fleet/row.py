"""One row of a fleet: what the closed loop said of a record."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from typing import Any

import msgspec

from harness.errors import printable
from harness.fleet.records import FleetRecord


class FoundEffect(msgspec.Struct, frozen=True):
    """An accepted effect.

    ``size`` is the effect's first parameter with an interval (95 %), or else its first parameter; the lists hold all.
    ``ties`` are the effects that the record cannot tell from it, each ``effect@place``.
    """

    effect: str
    at: str
    parameter: str
    size: float | None
    low: float | None
    high: float | None
    unit: str
    ties: tuple[str, ...]
    parameters: tuple[str, ...]
    values: tuple[float | None, ...]
    lows: tuple[float | None, ...]
    highs: tuple[float | None, ...]
    units: tuple[str, ...]

    @property
    def place(self) -> str:
        """Where it is; the column of the table, because ``at`` is a word of SQL."""
        return self.at

    @property
    def name(self) -> str:
        """``effect@place``."""
        return f"{self.effect}@{self.at}"


class FleetRow(msgspec.Struct, kw_only=True):
    """A record and what came of it; None where a figure does not exist.

    ``error_before`` and ``error_after`` are the simulation errors on validation data as NRMSE, the worst output.
    """

    job: str
    record: str
    file: str
    machine: str = ""
    date: str | None = None
    status: str = "ok"
    reason: str = ""
    verdict: str = ""
    adequacy: str = ""
    stand_in: bool | None = None
    explained_share: float | None = None
    error_before: float | None = None
    error_after: float | None = None
    effects: tuple[FoundEffect, ...] = ()
    warnings: tuple[str, ...] = ()
    seconds: float = 0.0

    @property
    def day(self) -> str:
        """The date for a reader: without the time where that is midnight."""
        return (self.date or "").removesuffix("T00:00:00")

    @property
    def ok(self) -> bool:
        """True where the loop gave an answer."""
        return self.status == "ok"


def blank(record: FleetRecord, job: str, *, status: str = "ok", reason: str = "") -> FleetRow:
    """Return the row of a record of which nothing else is known."""
    return FleetRow(
        job=job,
        record=record.name,
        file=str(record.file),
        machine=record.machine,
        date=None if record.date is None else record.date.isoformat(),
        status=status,
        reason=printable(" ".join(reason.split()))[:400],
    )


def fill(row: FleetRow, data: Mapping[str, Any]) -> None:
    """Fill a row from the content of ``report.json``."""
    row.verdict, row.adequacy = data["verdict"], data.get("adequacy") or ""
    row.explained_share = data.get("explained_share")
    row.stand_in = bool(data["stand_in"]["flagged"]) if "stand_in" in data else None
    row.warnings = tuple(data.get("warnings", ()))
    row.error_before, row.error_after = (_worst(data["errors"][when]) for when in ("before", "after"))
    row.effects = tuple(_found(effect, ties) for effect, ties in zip(data["effects"], data["tie_sets"], strict=True))


def _found(effect: Mapping[str, Any], ties: list[Mapping[str, str]]) -> FoundEffect:
    """Return an accepted effect from its entry in the report."""
    parameters = effect["parameters"]
    known = [name for name, own in parameters.items() if own["low"] is not None and own["high"] is not None]
    main = (known or list(parameters))[0]
    own = parameters[main]
    return FoundEffect(
        effect["name"],
        effect["at"],
        main,
        own["value"],
        own["low"],
        own["high"],
        own["unit"],
        tuple(f"{tie['name']}@{tie['at']}" for tie in ties[1:]),
        tuple(parameters),
        *(tuple(each[key] for each in parameters.values()) for key in ("value", "low", "high", "unit")),
    )


def _worst(errors: Mapping[str, Any]) -> float | None:
    """Return the largest NRMSE of the outputs on validation data."""
    own = errors.get("simulation_error", {}).get("validation", {})
    known = [score["nrmse"] for score in own.values() if score.get("nrmse") is not None]
    return max(known, default=None)


def encoded(row: FleetRow) -> bytes:
    """Return a row as JSON."""
    return msgspec.json.encode(row)


def read(content: bytes) -> FleetRow:
    """Return a row from JSON.

    Raises ValueError, msgspec.DecodeError if it is none.
    """
    row = msgspec.json.decode(content, type=FleetRow)
    if row.date is not None:
        datetime.fromisoformat(row.date)
    for effect in row.effects:
        if {len(effect.parameters)} != set(map(len, (effect.values, effect.lows, effect.highs, effect.units))):
            raise ValueError(f"an effect {effect.name!r} with a value or a unit too few")
    return row
