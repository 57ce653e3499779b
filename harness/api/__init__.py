"""The commands of ``sysid`` as Python calls of the same names; the command line is a thin layer above this room.

A file for each purpose: ``records``, ``running``, ``fitting``, ``loops``, ``comparing``, ``analysing``, ``benches``,
``checking``, ``exporting``; what another room has under the name of the command is that room's. Names are loaded when
they are asked for, and the heavy rooms inside the calls, so that asking for help stays fast. A new command is a call in
one of these files, a line here, and its words in :mod:`harness.cli`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from harness.extras import on_demand

if TYPE_CHECKING:
    from harness.api.analysing import analyse
    from harness.api.benches import plan_bench, query, stored_public
    from harness.api.checking import agreement, check, vet
    from harness.api.comparing import arx_orders, compare, modes, order, spectrum
    from harness.api.exporting import equations, export, export_fmu
    from harness.api.fitting import (
        DEFAULT_IDENTIFIER,
        UNDRIVEN_IDENTIFIER,
        calibrate,
        default_identifier,
        identify,
        identify_response,
    )
    from harness.api.identified import Identified
    from harness.api.loops import close_loop, isolability, learn_residual
    from harness.api.records import check_data, load_dataset, new_dataset
    from harness.api.running import halve, simulate
    from harness.benchmark import bench, table
    from harness.benchmark.public import bench_public
    from harness.comparison import compare_reports
    from harness.fitted import FittedModel, load_model
    from harness.fleet import close_fleet
    from harness.parts.contents import describe_file
    from harness.parts.files import describe_fmu, describe_system
    from harness.parts.listing import LISTED, describe_part, list_parts
    from harness.scaffold import new

__all__ = [
    "DEFAULT_IDENTIFIER",
    "LISTED",
    "UNDRIVEN_IDENTIFIER",
    "FittedModel",
    "Identified",
    "agreement",
    "analyse",
    "arx_orders",
    "bench",
    "bench_public",
    "calibrate",
    "check",
    "check_data",
    "close_fleet",
    "close_loop",
    "compare",
    "compare_reports",
    "default_identifier",
    "describe_file",
    "describe_fmu",
    "describe_part",
    "describe_system",
    "equations",
    "export",
    "export_fmu",
    "halve",
    "identify",
    "identify_response",
    "isolability",
    "learn_residual",
    "list_parts",
    "load_dataset",
    "load_model",
    "modes",
    "new",
    "new_dataset",
    "order",
    "plan_bench",
    "query",
    "simulate",
    "spectrum",
    "stored_public",
    "table",
    "vet",
]

_ROOMS = {
    "analysing": ("analyse",),
    "benches": ("plan_bench", "query", "stored_public"),
    "checking": ("agreement", "check", "vet"),
    "comparing": ("arx_orders", "compare", "modes", "order", "spectrum"),
    "exporting": ("equations", "export", "export_fmu"),
    "fitting": (
        "DEFAULT_IDENTIFIER",
        "UNDRIVEN_IDENTIFIER",
        "calibrate",
        "default_identifier",
        "identify",
        "identify_response",
    ),
    "identified": ("Identified",),
    "loops": ("close_loop", "isolability", "learn_residual"),
    "records": ("check_data", "load_dataset", "new_dataset"),
    "running": ("halve", "simulate"),
    ".fitted": ("FittedModel", "load_model"),
    ".parts.contents": ("describe_file",),
    ".parts.files": ("describe_fmu", "describe_system"),
    ".parts.listing": ("LISTED", "describe_part", "list_parts"),
    ".benchmark": ("bench", "table"),
    ".benchmark.public": ("bench_public",),
    ".fleet": ("close_fleet",),
    ".comparison": ("compare_reports",),
    ".scaffold": ("new",),
}
__getattr__ = on_demand(__name__, {name: room for room, names in _ROOMS.items() for name in names})
