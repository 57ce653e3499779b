"""The last few things that were asked for."""

from __future__ import annotations

from collections import OrderedDict
from typing import TypeVar

K = TypeVar("K")
V = TypeVar("V")


class Recent(OrderedDict[K, V]):
    """The last few values that were put, by key; what came before them is forgotten.

    Examples
    --------
    >>> known = Recent[str, int](2)
    >>> known["a"], known["b"], known["c"] = 1, 2, 3
    >>> list(known)
    ['b', 'c']
    """

    def __init__(self, most: int = 64) -> None:
        super().__init__()
        self.most = most

    def __setitem__(self, key: K, value: V) -> None:
        super().__setitem__(key, value)
        while len(self) > self.most:
            self.popitem(last=False)
