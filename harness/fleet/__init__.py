"""The closed loop over a fleet: many records, each a job; which effect is where, how large, and since when.

Names are loaded when they are asked for: whether a source is a fleet is asked of every record.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from harness.extras import on_demand

if TYPE_CHECKING:
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

_WHERE = {
    "FleetRecord": "records",
    "FleetResult": "running",
    "close_fleet": "running",
    "find_records": "records",
    "fleet_table": "running",
    "is_fleet": "records",
    "is_fleet_folder": "store",
    "query": "store",
}

__getattr__ = on_demand(__name__, _WHERE)
