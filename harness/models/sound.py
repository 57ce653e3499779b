"""Whether the numbers of a stored model are ones."""

from __future__ import annotations

from typing import Any

import numpy as np

from harness.models.determined import bands_of

__all__ = ["refuse_unsound"]

LARGEST = 1e150
"""Size above which the square of a number overflows, and with it whatever is computed from it."""


def refuse_unsound(model: Any) -> None:
    """Refuse a model that was read with matrices or offsets that are no numbers, or with bands that are none.

    Raises
    ------
    ValueError
        If one is NaN or too large to be squared; whoever reads the file names it.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> refuse_unsound(SimpleNamespace(a_matrix=np.array([[0.5]])))
    >>> refuse_unsound(SimpleNamespace(a_matrix=np.array([[np.nan]])))
    Traceback (most recent call last):
    ValueError: a_matrix holds nan
    """
    bands_of(model)
    for name, value in vars(model).items() if hasattr(model, "__dict__") else ():
        if isinstance(value, np.ndarray) and value.dtype.kind == "f":
            wrong = value[~(np.abs(value) <= LARGEST)]
            if wrong.size:
                raise ValueError(f"{name} holds {wrong[0]:g}")
