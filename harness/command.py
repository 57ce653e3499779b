"""Where the ``sysid`` command begins: Ctrl-C means the same from the first moment to the last."""

from __future__ import annotations

import atexit
import gc
import importlib
import os
import sys
from collections.abc import Sequence

from harness.supervision.interrupts import INTERRUPTED, Interrupts

COLLECTED = 50_000
"""New objects between two runs of the garbage collector; 700, as usual, costs 4 % of a short diagnosis."""


def main(arguments: Sequence[str] | None = None, *, cli: str = "harness.cli.app") -> None:
    """Run the command line of a module; every failure is one line on standard error and an exit status."""
    if arguments is None:  # a process of its own
        atexit.register(_leave)
    usual = gc.get_threshold()
    gc.set_threshold(COLLECTED, *usual[1:])
    try:
        with Interrupts() as interrupts:
            try:
                from harness.supervision.workers import THREAD_VARIABLES

                for name in THREAD_VARIABLES if arguments is None else ():
                    os.environ.setdefault(name, "1")  # matrices are small: more threads wait for each other
                status = importlib.import_module(cli).run(arguments, interrupts)
            except KeyboardInterrupt:
                print("sysid: interrupted", file=sys.stderr)
                status = INTERRUPTED
    finally:
        gc.set_threshold(*usual)
    sys.exit(status)


def _leave() -> None:
    """Let the system free the memory at once; collecting it first takes 8 % of a short diagnosis."""
    if "duckdb" not in sys.modules:  # its bindings call what was not collected a leak
        gc.freeze()
