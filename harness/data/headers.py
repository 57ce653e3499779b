"""Titles of columns: a name, and a unit in brackets behind it."""

from __future__ import annotations

import re

__all__ = ["split_header"]

_HEADER = re.compile(r"^(?P<name>.*?)\s*\[(?P<unit>[^\[\]]*)\]\s*$")


def split_header(header: str) -> tuple[str, str | None]:
    """Return name and unit of a column title.

    Examples
    --------
    >>> split_header("u [N m]"), split_header("theta")
    (('u', 'N m'), ('theta', None))
    """
    found = _HEADER.match(header)
    if found is None or not found["name"]:
        return header.strip(), None
    return found["name"].strip(), found["unit"].strip() or "1"
