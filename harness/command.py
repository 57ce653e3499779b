"""Where the ``sysid`` command begins: Ctrl-C means the same from the first moment to the last."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from harness.interrupts import INTERRUPTED, Interrupts

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; every failure is one line on standard error and an exit status."""
    with Interrupts() as interrupts:
        try:
            from harness.cli import run

            status = run(arguments, interrupts)
        except KeyboardInterrupt:
            print("sysid: interrupted", file=sys.stderr)
            status = INTERRUPTED
    sys.exit(status)
