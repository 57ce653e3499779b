"""Columns inside files that hold more than plain columns: ``Y_id{0}[0]``, ``runs{2}.theta``, ``log/drive[:,1]``."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.data.tables.cells import say_truths
from harness.errors import InputError
from harness.signals import FloatArray

_STEP = re.compile(r"\{(\d+)\}|\[\s*(\d+)\s*(?:,\s*:\s*)?\]|\[\s*:\s*,\s*(\d+)\s*\]|\.([A-Za-z_]\w*)")


@dataclass(frozen=True)
class Selector:
    """A variable and the way into it.

    ``steps`` are ``("cell", i)``, ``("row", i)``, ``("column", i)`` or ``("field", name)``; indices count from 0.
    """

    variable: str
    steps: tuple[tuple[str, int | str], ...] = ()


def parse_selector(text: str) -> Selector:
    """Read the text of a selector.

    ``NAME{i}`` is cell i of a MAT cell array (counted down the columns), ``NAME.field`` a field of a struct,
    ``NAME[i]`` (or ``NAME[i,:]``) row i of a matrix, or element i of a row of structs, and ``NAME[:,i]`` its column i.
    They may be chained; indices count from 0. Raises InputError if the text is no selector.

    Examples
    --------
    >>> parse_selector("Y_id{0}[1]")
    Selector(variable='Y_id', steps=(('cell', 0), ('row', 1)))
    >>> parse_selector("log/drive[:,2]")
    Selector(variable='log/drive', steps=(('column', 2),))
    """
    start = min((text.find(sign) for sign in "{[." if sign in text), default=len(text))
    variable, remaining = text[:start].strip(), text[start:].strip()
    steps: list[tuple[str, int | str]] = []
    while remaining:
        found = _STEP.match(remaining)
        if found is None:
            break
        cell, row, column, field = found.groups()
        if field is not None:
            steps.append(("field", field))
        else:
            kind = "cell" if cell is not None else "row" if row is not None else "column"
            steps.append((kind, int(next(number for number in (cell, row, column) if number is not None))))
        remaining = remaining[found.end() :].strip()
    if remaining or not variable:
        raise InputError(
            "column selector",
            expected="NAME, NAME{cell}, NAME[row], NAME[:,column] or NAME.field, chained, counted from 0",
            got=repr(text),
            remedy="correct it",
        )
    return Selector(variable, tuple(steps))


def vector(
    value: Any,
    selector: Selector,
    *,
    resolve: Callable[[Any], Any] = lambda value: value,
    notes: list[str] | None = None,
) -> FloatArray:
    """Follow a selector into a value, down to one column of numbers.

    Raises InputError if a step does not fit the value, or what is found is not one column of numbers.

    - ``value`` array-like: the variable as the file's reader gave it
    - ``selector``: the way into it
    - ``resolve``: turns what a cell holds into an array (HDF5 keeps references)
    - ``notes``: gets a sentence where true and false are read as numbers
    - returns array (N,): Float64

    Examples
    --------
    >>> vector(np.arange(6).reshape(2, 3), parse_selector("Y[1]")).tolist()
    [3.0, 4.0, 5.0]
    """
    so_far = selector.variable
    for kind, index in selector.steps:
        value, so_far = resolve(_step(value, kind, index, so_far)), so_far + _written(kind, index)
    array = np.asarray(resolve(value))
    if array.dtype.kind not in "biuf" or array.size != max(array.shape, default=1):
        raise InputError(
            f"{so_far} is not one column of numbers",
            expected="a vector",
            got=f"{array.dtype.name} of shape {array.shape}",
            remedy=_way_in(so_far, array),
        )
    if array.dtype.kind == "b" and notes is not None:
        say_truths(notes, so_far)
    return np.array(array.reshape(-1), dtype=np.float64)


def _way_in(so_far: str, array: Any) -> str:
    """Return what can be done about a value that is no column of numbers."""
    if array.dtype.kind == "c" or "real" in (array.dtype.names or ()):
        return "store real and imaginary part as variables of their own"
    if array.dtype.names:
        return f"choose inside it, e.g. {so_far}.{array.dtype.names[0]}"
    if array.dtype == object and array.size:
        return f"choose inside it, e.g. {so_far}{{0}}"
    if array.dtype.kind in "biuf" and array.ndim == 2:
        return f"choose inside it, e.g. {so_far}[0] or {so_far}[:,0]"
    if array.dtype.kind in "biuf" and array.ndim == 3 and array.shape[1] == 1:
        return f"choose inside it, e.g. {so_far}[0]"
    return "store it as a vector of numbers"


def _step(value: Any, kind: str, index: int | str, so_far: str) -> Any:
    """Return what one step of a selector leads to, or refuse it."""
    array = np.asarray(value)
    found = _in_field(array, index) if isinstance(index, str) else _in_place(array, kind, index)
    if found is not None:
        return found
    names = array.dtype.names or ()
    raise InputError(
        f"{so_far}{_written(kind, index)} is not there",
        expected={
            "field": f"a struct with the field {index}",
            "cell": f"a cell array with more than {index} cells",
        }.get(kind, f"a matrix with more than {index} {kind}s"),
        got=f"fields {', '.join(names)}" if kind == "field" and names else f"{array.dtype.name} of shape {array.shape}",
        remedy="correct the selector; indices count from 0",
    )


def _in_field(array: Any, name: str) -> Any:
    """Return a field of a struct; None if it has none of that name."""
    if name not in (array.dtype.names or ()):
        return None
    inner = array[name]
    return inner.reshape(-1)[0] if inner.size == 1 and inner.dtype == object else inner


def _in_place(array: Any, kind: str, index: int) -> Any:
    """Return a cell, row or column by its number; None where there is none."""
    numbers = array.dtype.kind in "biuf"
    if kind == "cell":
        cells = array.reshape(-1, order="F") if array.dtype == object or array.dtype.names else ()
        return cells[index] if index < len(cells) else None
    if kind == "row" and array.dtype.names and (array.ndim == 1 or 1 in array.shape):
        return array.reshape(-1)[index] if index < array.size else None
    if kind == "row" and array.ndim == 3 and array.shape[1] == 1 and numbers:  # Simulink's
        return array[index] if index < array.shape[0] else None
    if array.ndim != 2 or not numbers or index >= array.shape[0 if kind == "row" else 1]:
        return None
    return array[index] if kind == "row" else array[:, index]


def _written(kind: str, index: int | str) -> str:
    """Return a step as it is written."""
    return {"cell": f"{{{index}}}", "row": f"[{index}]", "column": f"[:,{index}]", "field": f".{index}"}[kind]


_NAMED = ("Name", "name", "label", "Label", "BlockName", "blockName")  # Fields that hold what a signal is called.
_HELD = ("Data", "data", "values", "Values")  # Fields that hold its readings.
_OF_UNIT = ("Unit", "unit", "Units", "units")


def called_inside(variables: Mapping[str, Any]) -> dict[str, tuple[str, str]]:
    """Return by name the selectors and units of signals in rows of structs, each of which has a name and readings.

    So dSPACE's recorders write them (``Name``, ``Data``, ``Unit``), and Simulink's scopes (``label``, ``values``). A
    name that two signals have is left out.

    Examples
    --------
    >>> rows = np.zeros(2, dtype=[("label", object), ("values", object)])
    >>> rows["label"], rows["values"] = ["u", "y"], [np.arange(2.0), np.arange(3.0)]
    >>> called_inside({"scope": rows})
    {'u': ('scope.values{0}', ''), 'y': ('scope.values{1}', '')}
    """
    found: list[tuple[str, str, str]] = []
    for title, value in variables.items():
        _look_for_names(title, np.asarray(value), found, 0)
    names = [name for name, *_ in found]
    return {name: (way, unit) for name, way, unit in found if names.count(name) == 1 and name not in variables}


def _look_for_names(so_far: str, array: Any, found: list[tuple[str, str, str]], depth: int) -> None:
    """Add name, selector and unit of every signal inside a struct."""
    fields = array.dtype.names or ()
    name, held, unit = (next((one for one in some if one in fields), None) for some in (_NAMED, _HELD, _OF_UNIT))
    if name is not None and held is not None:
        rows = array.reshape(-1, order="F")
        for k, row in enumerate(rows):
            said, stated = _text(row[name]), _text(row[unit]) if unit is not None else ""
            if said and np.asarray(row[held]).dtype.kind in "biuf":
                found.append((said, f"{so_far}.{held}" + (f"{{{k}}}" if len(rows) > 1 else ""), stated))
    for field in fields if depth < _DEEPEST and array.size == 1 else ():
        _look_for_names(f"{so_far}.{field}", np.asarray(array.reshape(-1)[0][field]), found, depth + 1)


_DEEPEST = 4  # Structs inside structs that are looked into.


def _text(value: Any) -> str:
    """Return the text in a field; empty where it holds none."""
    inner = np.asarray(value).reshape(-1)
    return str(inner[0]).strip() if inner.size == 1 and isinstance(inner[0], str) else ""
