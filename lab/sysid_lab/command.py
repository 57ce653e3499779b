"""Where the ``sysid-lab`` command begins: as ``sysid`` does, with commands of its own."""

from __future__ import annotations

from collections.abc import Sequence

from harness import command


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; every failure is one line on standard error and an exit status."""
    command.main(arguments, cli="sysid_lab.cli")
