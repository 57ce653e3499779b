"""Libraries of candidate functions for sparse regression: polynomials, sines and cosines, each with a name."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import Any

import numpy as np

from harness.signals import FloatArray
from harness.units import product
from identifiers.common.described import Described


@dataclass(frozen=True)
class Library(Described):
    """Monomials of the arguments up to a degree, optionally with sines and cosines of some of them.

    Examples
    --------
    >>> Library(("x", "u"), degree=2).names
    ('1', 'x', 'u', 'x^2', 'x u', 'u^2')
    >>> Library(("q",), degree=1, angles=(0,)).names
    ('1', 'sin(q)', 'cos(q)')
    """

    arguments: tuple[str, ...]  # Names of the columns that are given to it
    degree: int = 2  # Monomials up to this total degree, at least 1
    angles: tuple[int, ...] = ()
    """Columns that are angles: in the monomials their sine and cosine stand in place of the angle itself."""
    harmonics: int = 1  # Sine and cosine of ``1 .. harmonics`` times every angle.
    constant: bool = True  # The constant function too
    products: bool = True  # With False only powers of single arguments, no products of two

    @property
    def names(self) -> tuple[str, ...]:
        """Name of every function."""
        letters = _letters(self)
        texts = []
        for pick in _monomials(self):
            powers = [(letters[i], pick.count(i)) for i in sorted(set(pick))]
            texts.append(" ".join(name if n == 1 else f"{name}^{n}" for name, n in powers) or "1")
        return tuple(texts)

    def units(self, arguments: Sequence[str]) -> tuple[str, ...]:
        """Return the unit of every function, given those of the arguments; sines and cosines have none.

        Examples
        --------
        >>> Library(("q", "v", "u"), degree=2, angles=(0,)).units(("rad", "m/s", "N"))[2:8]
        ('1', 'm/s', 'N', 'm/s', 'N', 'm/s')
        >>> Library(("v", "u"), degree=2).units(("m/s", "N"))
        ('1', 'm/s', 'N', 'm^2/s^2', 'm N/s', 'N^2')
        """
        letters: list[str] = []
        for column, unit in enumerate(arguments):
            letters += ["1"] * (2 * self.harmonics) if column in self.angles else [unit]
        texts = []
        for pick in _monomials(self):
            texts.append(product((letters[i], pick.count(i)) for i in sorted(set(pick))))
        return tuple(texts)

    def __len__(self) -> int:
        return len(_monomials(self))

    def rows(self, values: Sequence[FloatArray], chosen: Sequence[int] | None = None) -> FloatArray:
        """Return the functions (p, ...) of arguments given one by one, each (...).

        Parameters
        ----------
        values : sequence of array (...)
            One for each argument.
        chosen : sequence of int, optional
            Only these functions, in this order.
        """
        letters: list[FloatArray] = []
        for column, x in enumerate(values):
            if column in self.angles:
                for k in range(1, self.harmonics + 1):
                    letters += [np.sin(k * x), np.cos(k * x)]
            else:
                letters.append(x)
        monomials = _monomials(self)
        wanted = range(len(monomials)) if chosen is None else chosen
        result = np.empty((len(wanted), *np.shape(values[0])))
        place: dict[tuple[int, ...], int] = {}
        # Each monomial is a shorter one times one letter where that one is there already.
        for row, index in enumerate(wanted):
            pick = monomials[index]
            place[pick] = row
            if not pick:
                result[row] = 1.0
            elif len(pick) == 1:
                result[row] = letters[pick[0]]
            elif pick[:-1] in place:
                np.multiply(result[place[pick[:-1]]], letters[pick[-1]], out=result[row, ...])
            else:
                np.multiply(letters[pick[0]], letters[pick[1]], out=result[row, ...])
                for i in pick[2:]:
                    result[row] *= letters[i]
        return result

    def source(self, coefficients: FloatArray) -> str:
        """Return Python source of ``value(sin, cos, x0, x1, ...)``: the sums with these coefficients (m, p), one each.

        Plain multiplications and additions, so that it runs on floats as on arrays.
        """
        n = len(self.arguments)
        lines = [f"def value(sin, cos, {', '.join(f'x{i}' for i in range(n))}):"]
        letters: list[str] = []
        for column in range(n):
            if column not in self.angles:
                letters.append(f"x{column}")
                continue
            for k in range(1, self.harmonics + 1):
                angle = f"x{column}" if k == 1 else f"{k}.0 * x{column}"
                for wave in ("sin", "cos"):
                    letters.append(f"{wave[0]}{column}_{k}")
                    lines.append(f"    {letters[-1]} = {wave}({angle})")
        results = []
        for row in coefficients:
            terms = []
            for value, pick in zip(row, _monomials(self), strict=True):
                if value != 0.0:
                    terms.append(" * ".join([repr(float(value)), *(letters[i] for i in pick)]))
            results.append(" + ".join(terms) or "0.0 * x0")
        lines.append(f"    return {', '.join(results)},")
        return "\n".join(lines)

    def __call__(self, values: FloatArray) -> FloatArray:
        """Return the functions (..., p) of arguments (..., n)."""
        return np.moveaxis(self.rows([values[..., i] for i in range(values.shape[-1])]), 0, -1)


class InLibrary:
    """A dataclass whose equations are sums of the functions of a library; compiled once, and not pickled."""

    library: Library
    coefficients: FloatArray

    @functools.cached_property
    def _equations(self) -> Callable[..., tuple[Any, ...]]:
        """The equations as a function of floats or arrays, made of numbers and our own names only."""
        names: dict[str, Any] = {}
        exec(compile(self.library.source(self.coefficients), "<library of functions>", "exec"), names)
        found: Callable[..., tuple[Any, ...]] = names["value"]
        return found

    def __getstate__(self) -> dict[str, Any]:
        fields: Any = self
        return {name: value for name, value in self.__dict__.items() if name in fields.__dataclass_fields__}


@functools.cache
def _letters(library: Library) -> tuple[str, ...]:
    """Return the names of what the monomials are made of."""
    names: list[str] = []
    for column, name in enumerate(library.arguments):
        if column in library.angles:
            for k in range(1, library.harmonics + 1):
                inside = name if k == 1 else f"{k} {name}"
                names += [f"sin({inside})", f"cos({inside})"]
        else:
            names.append(name)
    return tuple(names)


@functools.cache
def _monomials(library: Library) -> tuple[tuple[int, ...], ...]:
    """Return which letters each monomial multiplies; of one angle no two, since their product is a harmonic."""
    owner: list[int] = []
    for column in range(len(library.arguments)):
        owner += [column] * (2 * library.harmonics if column in library.angles else 1)
    found: list[tuple[int, ...]] = [()] if library.constant else []
    for degree in range(1, library.degree + 1):
        for pick in combinations_with_replacement(range(len(owner)), degree):
            turning = [owner[i] for i in pick if owner[i] in library.angles]
            if len(set(turning)) < len(turning) or (not library.products and len(set(pick)) > 1):
                continue
            found.append(pick)
    return tuple(found)


def equation_text(name: str, functions: Sequence[str], coefficients: FloatArray) -> str:
    """Return ``name = 0.5 x - 2 u``, the terms that are zero left out.

    Examples
    --------
    >>> equation_text("x'", ("1", "x", "u"), np.array([0.0, 0.5, -2.0]))
    "x' = 0.5 x - 2 u"
    """
    terms = [(c, f) for c, f in zip(coefficients, functions, strict=True) if c != 0.0]
    text = f"{name} ="
    for number, (value, function) in enumerate(terms):
        sign = "-" if value < 0 else "+"
        body = f"{abs(value):.6g}" + ("" if function == "1" else f" {function}")
        text += f" {sign} {body}" if number else f" {'-' if value < 0 else ''}{body}"
    return text if terms else f"{text} 0"
