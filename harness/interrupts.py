"""Ctrl-C: it raises KeyboardInterrupt and is remembered, whatever libraries make of the exception."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType
from typing import Any

__all__ = ["INTERRUPTED", "Interrupts"]

INTERRUPTED = 130
"""Exit status after Ctrl-C (128 and the number of the signal)."""


class Interrupts:
    """Ctrl-C raises KeyboardInterrupt and is remembered.

    Libraries turn the exception into one of their own where it meets them in a callback or in an import; whoever asks
    ``seen`` knows better. A second Ctrl-C, while things are being put away, waits for nothing. Where the signal is
    ignored (nohup), it stays ignored.
    """

    def __init__(self) -> None:
        self.seen = False
        self._before: Any = None

    def __enter__(self) -> Interrupts:
        here = threading.current_thread() is threading.main_thread()
        if here and signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
            self._before = signal.signal(signal.SIGINT, self._met)
        return self

    def __exit__(self, *exc: object) -> None:
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)

    def _met(self, _number: int, _frame: FrameType | None) -> None:
        if self.seen:
            signal.signal(signal.SIGINT, lambda *_: os._exit(INTERRUPTED))
        self.seen = True
        raise KeyboardInterrupt
