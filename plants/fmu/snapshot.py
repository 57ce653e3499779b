"""A state that an FMU keeps for us, freed once."""

from __future__ import annotations

import ctypes
import weakref
from typing import Any, Protocol


class Keeper(Protocol):
    """What keeps a state: a loaded instance."""

    fmu: Any
    dead: bool


class Snapshot:
    """A state that the FMU keeps for us; freed with this object, or with the instance."""

    def __init__(self, owner: Keeper, pointer: ctypes.c_void_p) -> None:
        self.owner = weakref.ref(owner)
        self.pointer: ctypes.c_void_p | None = pointer
        self.k = 0
        self.next_event: float | None = None  # [s], FMI 3.0 in event mode

    def free(self) -> None:
        """Give the memory back to the FMU."""
        owner, pointer, self.pointer = self.owner(), self.pointer, None
        if owner is not None and pointer is not None and owner.fmu is not None and not owner.dead:
            owner.fmu.freeFMUState(pointer)

    def __del__(self) -> None:
        self.free()
