"""``python -m harness`` is the ``sysid`` command, for who has no scripts on the path."""

from __future__ import annotations

from harness.command import main

main()
