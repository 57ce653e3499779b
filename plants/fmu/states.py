"""States that an FMU keeps for us as bytes, and back."""

from __future__ import annotations

import hashlib
import math
import struct

from harness.errors import InputError
from plants.fmu.instance import Instance
from plants.fmu.snapshot import Snapshot

HEAD = struct.Struct("<8s16sqd")  # mark, digest of the FMU's token and kind, samples since reset, next event or NaN
MARK = b"sysidfmu"


def packed(instance: Instance, state: Snapshot) -> bytes:
    """Return a state as bytes that an instance of the same FMU takes back.

    Raises
    ------
    InputError
        If the FMU does not offer it.
    PlantError
        If it fails to.
    """
    _need_offer(instance)
    try:
        body: bytes = instance.fmu.serializeFMUState(state.pointer)
    except Exception as error:
        raise instance.failure("the state cannot be serialised", error) from error
    event = math.nan if state.next_event is None else state.next_event
    return HEAD.pack(MARK, _digest(instance), state.k, event) + body


def unpacked(instance: Instance, data: bytes) -> Snapshot:
    """Return a state of this instance from the bytes of :func:`packed`.

    Raises
    ------
    InputError
        If the FMU does not offer it, or the bytes are not of this FMU.
    PlantError
        If it fails to.
    """
    _need_offer(instance)
    mark, digest, k, event = HEAD.unpack_from(data) if len(data) >= HEAD.size else (b"", b"", 0, math.nan)
    if mark != MARK or digest != _digest(instance):
        raise InputError(
            "a serialised state",
            expected="bytes that serialize_state of a plant of this FMU returned",
            got="those of another FMU" if mark == MARK else f"{len(data)} other bytes",
            remedy="serialise a state of this FMU, of the same version and kind",
            file=instance.file.path,
        )
    try:
        pointer = instance.fmu.deserializeFMUState(data[HEAD.size :])
    except Exception as error:
        raise instance.failure("the state cannot be deserialised", error) from error
    made = instance.kept(pointer)
    made.k = k
    made.next_event = None if math.isnan(event) else event
    return made


def _digest(instance: Instance) -> bytes:
    """Return what tells one FMU from another."""
    text = f"{instance.file.description.guid} {instance.version} {instance.kind}"
    return hashlib.sha256(text.encode()).digest()[:16]


def _need_offer(instance: Instance) -> None:
    """Refuse FMUs that do not serialise states."""
    if instance.version == 1 or not instance.interface.canSerializeFMUstate:
        raise InputError(
            "serialised states",
            expected="an FMU with canSerializeFMUState",
            got="one without",
            remedy="use get_state and set_state, or replay the inputs from reset",
            file=instance.file.path,
        )
