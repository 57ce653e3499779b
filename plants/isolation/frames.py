"""What travels between a plant in a child process and its caller: frames with a length, answers of declared types.

The caller never unpickles what the child sends: foreign code in the child controls those bytes. Orders go the other
way as pickles, because the caller is trusted.
"""

from __future__ import annotations

import socket
import struct
import time

import msgspec
import numpy as np

from harness.errors import FitError, HarnessError, InputError, PlantError, PluginError
from harness.protocols import Ability
from harness.signals import FloatArray, PlantSpec

_LENGTH = struct.Struct("<Q")
_STATUSES = ("diverged", "crashed", "timeout", "terminated")
_LONGEST = 2000  # characters of a text from a child


class Trouble(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An error of the project as plain text."""

    kind: str
    text: str = ""
    status: str = ""
    expected: str = ""
    got: str = ""
    remedy: str = ""
    file: str | None = None
    place: str | None = None


class Made(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a new plant says of itself."""

    spec: PlantSpec
    abilities: tuple[Ability, ...]
    snapshot_tolerance: float | None = None
    input_starts: tuple[float, ...] = ()
    beyond: tuple[str, ...] = ()
    drives: bool = False


class Reply(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """The answer to one order: numbers as bytes of float64, row by row.

    ``notes`` are what the plant has to say beside it; ``renew`` asks for a new process, in which the order is given
    again.
    """

    values: bytes = b""
    truth: bytes = b""
    number: int = 0
    made: Made | None = None
    trouble: Trouble | None = None
    notes: tuple[str, ...] = ()
    renew: bool = False


def send(channel: socket.socket, body: bytes, *, limit: float | None = None) -> None:
    """Send one frame.

    Raises OSError if the other side is gone (``TimeoutError`` if it does not take the frame within ``limit`` seconds).
    """
    channel.settimeout(limit)
    channel.sendall(_LENGTH.pack(len(body)) + body)


def receive(channel: socket.socket, *, largest: int | None = None, limit: float | None = None) -> bytes:
    """Return one frame.

    Raises OSError if the other side is gone (``EOFError``), too slow (``TimeoutError``), or announces more than
    ``largest``.

    - ``largest``: most bytes that a frame may have
    - ``limit``: longest time [s] for the whole frame
    """
    end = None if limit is None else time.monotonic() + limit
    (length,) = _LENGTH.unpack(_exactly(channel, _LENGTH.size, end))
    if largest is not None and length > largest:
        raise OSError(f"a frame of {length} bytes")
    return _exactly(channel, length, end)


def _exactly(channel: socket.socket, n: int, end: float | None) -> bytes:
    """Return the next n bytes."""
    body = bytearray(n)
    view, done = memoryview(body), 0
    while done < n:
        if end is not None:
            left = end - time.monotonic()
            if left <= 0:
                raise TimeoutError
            channel.settimeout(left)
        else:
            channel.settimeout(None)
        got = channel.recv_into(view[done:])
        if not got:
            raise EOFError
        done += got
    return bytes(body)


def array_of(values: bytes, shape: tuple[int, ...]) -> FloatArray:
    """Return the numbers of an answer.

    Raises ValueError if there are not as many as the shape needs.

    Examples
    --------
    >>> array_of(np.array([1.0, 2.0]).tobytes(), (2, 1)).tolist()
    [[1.0], [2.0]]
    """
    return np.frombuffer(values, dtype=np.float64).reshape(shape).copy()


def trouble(error: HarnessError) -> Trouble:
    """Return an error as what can travel."""
    if isinstance(error, InputError):
        file = None if error.file is None else str(error.file)
        kind = "FitError" if isinstance(error, FitError) else "InputError"
        return Trouble(kind, error.what, error.status, error.expected, error.got, error.remedy, file, error.place)
    kind = "PluginError" if isinstance(error, PluginError) else "PlantError"
    return Trouble(kind, str(error), error.status)


def raised(content: Trouble) -> HarnessError:
    r"""Return the error of what has travelled; texts of the child come without control characters, and short.

    Examples
    --------
    >>> print(raised(trouble(InputError("a", expected="b", got="c\x1b[2J", remedy="d"))))
    a: expected b, got c[2J; remedy: d
    """
    if content.kind in ("InputError", "FitError"):
        return (FitError if content.kind == "FitError" else InputError)(
            plain(content.text),
            expected=plain(content.expected),
            got=plain(content.got),
            remedy=plain(content.remedy),
            file=None if content.file is None else plain(content.file),
            place=None if content.place is None else plain(content.place),
        )
    if content.kind == "PluginError":
        return PluginError(plain(content.text))
    status = content.status if content.status in _STATUSES else "crashed"
    return PlantError(plain(content.text), status=status)


def plain(text: str) -> str:
    """Return a text that is safe to print on a terminal."""
    return "".join(c if c.isprintable() else " " * c.isspace() for c in text[:_LONGEST])
