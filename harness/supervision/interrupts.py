"""Ctrl-C as the ``sysid`` command hears it: the same from the first moment to the last."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType
from typing import Any

INTERRUPTED = 130  # Exit status after Ctrl-C (128 and the number of the signal).


class Interrupts:
    """Ctrl-C raises KeyboardInterrupt and is remembered.

    Libraries turn the exception into one of their own where it meets them in a callback or in an import; whoever asks
    ``seen`` knows better. A second Ctrl-C, while things are being put away, waits for nothing. Where the signal is
    ignored (nohup), it stays ignored.
    """

    listening: Interrupts | None = None
    """What hears Ctrl-C at the moment."""

    def __init__(self) -> None:
        self.seen = False
        self._before: Any = None

    def __enter__(self) -> Interrupts:
        here = threading.current_thread() is threading.main_thread()
        if here and signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
            self._before = signal.signal(signal.SIGINT, self._met)
            Interrupts.listening = self
        return self

    def __exit__(self, *exc: object) -> None:
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)
            Interrupts.listening = None

    def _met(self, _number: int, _frame: FrameType | None) -> None:
        if self.seen:
            signal.signal(signal.SIGINT, lambda *_: os._exit(INTERRUPTED))
        self.seen = True
        raise KeyboardInterrupt


def stop_if_asked() -> None:
    """Raise KeyboardInterrupt once more if Ctrl-C was heard and a library swallowed it; long work asks now and then."""
    if Interrupts.listening is not None and Interrupts.listening.seen:
        raise KeyboardInterrupt
