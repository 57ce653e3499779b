"""Orders of polynomial models as a user gives them: a number, a list by input or output, or a matrix of both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from harness.errors import FitError
from harness.signals import PlantSpec
from identifiers.linear.polynomials.model import Orders

Counts = int | list[int] | list[list[int]]
"""A number for all; one for each input (nb, nf, nk) or output (na, nc, nd); or rows of outputs, columns of inputs."""

LETTERS = {"arx": "ab", "armax": "abc", "oe": "bf", "bj": "bcdf"}
"""Polynomials that a structure has (Ljung 1999, table 4.1)."""


def orders_by_output(
    structure: str, spec: PlantSpec, given: Mapping[str, Counts | None], order: int, what: str
) -> list[Orders]:
    """Return the orders of every output's model.

    Raises FitError if a number is no whole number from 0 on, a list or matrix has another size, or the structure has no
    such polynomial.

    - ``structure`` {"arx", "armax", "oe", "bj"}
    - ``given``: ``na``, ``nb``, ``nc``, ``nd``, ``nf``, ``nk``; None takes the order, of ``nk`` 1. A number for ``nf``
      is one F that all inputs share, a list or a matrix one for each.
    - ``what``: for messages

    Examples
    --------
    >>> from harness.signals import Channel
    >>> spec = PlantSpec((Channel("u"), Channel("v")), (Channel("y"),), 1.0)
    >>> orders_by_output("oe", spec, {"nf": [2, 1], "nk": [1, 4]}, 2, "example")[0].starts_x
    (2, 5)
    """
    letters = LETTERS[structure]
    for name, value in given.items():
        if value is not None and name != "nk" and name[1] not in letters:
            raise FitError(
                f"{what}: {name} of {structure}",
                expected=f"orders {', '.join('n' + letter for letter in letters)} and nk",
                got=f"{name}={value}",
                remedy="leave it out, or take a structure that has it",
            )

    def of(letter: str) -> Counts:
        value = given.get(f"n{letter}")
        return order if value is None else value

    def counts(letter: str) -> list[int]:
        return by_output(f"n{letter}", of(letter), spec, what) if letter in letters else [0] * spec.ny

    na, nc, nd = (counts(letter) for letter in "acd")
    delays = given.get("nk")
    nb = by_pair("nb", of("b"), spec.ny, spec.nu, what)
    nk = by_pair("nk", 1 if delays is None else delays, spec.ny, spec.nu, what)
    nf: list[tuple[int, ...]] = [()] * spec.ny
    if "f" in letters:
        shared = isinstance(of("f"), int) or spec.nu == 1
        nf = [row[:1] if shared else row for row in by_pair("nf", of("f"), spec.ny, spec.nu, what)]
    return [Orders(na[i], nb[i], nc[i], nd[i], nf[i], nk[i]) for i in range(spec.ny)]


def by_output(name: str, value: Counts, spec: PlantSpec, what: str) -> list[int]:
    """Return a number for each output, of a number for all or a list."""
    found: list[Any] = [value] * spec.ny if isinstance(value, int) else list(value)
    if len(found) != spec.ny or not all(_whole(one) for one in found):
        raise _wrong(name, value, f"a whole number from 0 on, or {spec.ny}, one for each output", what)
    return [int(one) for one in found]


def by_pair(name: str, value: Counts, ny: int, columns: int, what: str) -> list[tuple[int, ...]]:
    """Return for each output a number for each column (an input, or an output of the past).

    - ``value``: a number for all, one for each column, or rows of outputs
    - ``what``: for messages
    """
    rows: list[Any]
    if isinstance(value, int):
        rows = [[value] * columns] * ny
    elif all(_whole(one) for one in value):
        rows = [list(value)] * ny
    else:
        rows = list(value)
    fine = len(rows) == ny and all(
        isinstance(row, Sequence) and len(row) == columns and all(map(_whole, row)) for row in rows
    )
    if not fine:
        wanted = f"a whole number from 0 on, a list of {columns} by channel, or {ny} rows of {columns}"
        raise _wrong(name, value, wanted, what)
    return [tuple(int(one) for one in row) for row in rows]


def _whole(value: object) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and int(value) >= 0


def _wrong(name: str, value: object, wanted: str, what: str) -> FitError:
    return FitError(f"{what}: {name}", expected=wanted, got=str(value), remedy="correct it")
