"""Python values turned into the types and units of an FMU's variables, or refused."""

from __future__ import annotations

from typing import Any

from harness.errors import InputError
from plants.fmu.archive import FmuFile


def encode(file: FmuFile, variable: Any, value: Any, scale: float = 1.0, offset: float = 0.0) -> Any:
    """Return a Python value as the FMU's type, or refuse it.

    Parameters
    ----------
    file : FmuFile
        For the message.
    variable : fmpy.model_description.ModelVariable
        What is set.
    value : number, str, bool or sequence
        In SI; a string for enumerations may be the item's name.
    scale, offset : float
        SI = scale * (value of the FMU) + offset.
    """
    wanted = 1
    for n in variable.shape or ():
        wanted *= int(n)
    if variable.shape:
        import numpy as np

        items = np.asarray(value, dtype=object).ravel().tolist()
        if len(items) == 1 and wanted > 1:
            items = items * wanted
        if len(items) != wanted and variable.dimensions:
            raise _unfit(file, variable, f"{wanted} values", f"{len(items)}")
        return [_scalar(file, variable, item, scale, offset) for item in items]
    return _scalar(file, variable, value, scale, offset)


def _unfit(file: FmuFile, variable: Any, expected: str, got: str) -> InputError:
    return InputError(
        f"value of {variable.name!r}", expected=expected, got=got, remedy="correct the value", file=file.path
    )


def _scalar(file: FmuFile, variable: Any, value: Any, scale: float, offset: float) -> Any:
    """Return one value as the FMU's type."""
    kind = variable.type
    if hasattr(value, "item"):
        value = value.item()
    if kind == "String":
        if not isinstance(value, str):
            raise _unfit(file, variable, "a text", repr(value))
        return value
    if kind == "Binary":
        try:
            return bytes.fromhex(value) if isinstance(value, str) else bytes(memoryview(value))
        except (ValueError, TypeError):
            raise _unfit(file, variable, "bytes, or pairs of hexadecimal digits", repr(value)) from None
    if kind == "Enumeration" and isinstance(value, str):
        items = variable.declaredType.items if variable.declaredType is not None else []
        found = [int(item.value) for item in items if item.name == value]
        if not found:
            raise _unfit(file, variable, f"one of {', '.join(str(i.name) for i in items)}", repr(value))
        return found[0]
    if kind == "Boolean":
        if value in (True, False, 0, 1):
            return bool(value)
        raise _unfit(file, variable, "true or false", repr(value))
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise _unfit(file, variable, "a number", repr(value))
    if kind in ("Real", "Float64", "Float32"):
        if value != value or value in (float("inf"), float("-inf")):
            raise _unfit(file, variable, "a finite number", repr(value))
        return (float(value) - offset) / scale
    if float(value) != int(value):
        raise _unfit(file, variable, "a whole number", repr(value))
    return int(value)
