"""The closed loop over a fleet: many records, each a job; which effect is where, how large, and since when."""

from __future__ import annotations

from harness.fleet.records import FleetRecord, find_records, is_fleet
from harness.fleet.running import FleetResult, close_fleet, fleet_table
from harness.fleet.store import is_fleet_folder, query

__all__ = [
    "FleetRecord",
    "FleetResult",
    "close_fleet",
    "find_records",
    "fleet_table",
    "is_fleet",
    "is_fleet_folder",
    "query",
]
