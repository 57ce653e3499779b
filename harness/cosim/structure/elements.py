"""Elements of the XML of a system, by their names without a namespace."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any


def local(element: Any) -> str:
    """Return the name of an XML element without its namespace, which SSP 1.0 and 2.0 share."""
    tag = str(element.tag)
    return tag.rpartition("}")[2]


def children(element: Any, *names: str) -> Iterator[Any]:
    """Yield the children below a path of names: ``children(e, "Connectors", "Connector")``."""
    for child in () if element is None else element:
        if local(child) == names[0]:
            if len(names) == 1:
                yield child
            else:
                yield from children(child, *names[1:])


def first(element: Any, *names: str) -> Any:
    """Return the first such child, or None."""
    return next(children(element, *names), None)


def truth(text: str | None) -> bool:
    """Return a boolean of XML."""
    return text is not None and text.strip() in ("true", "1")
