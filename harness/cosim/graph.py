"""Which parts act on which within one instant: direct feedthrough, its order and its cycles."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from harness.cosim.wiring import Part, Wire
from harness.signals import FloatArray

PASSES = 50  # of an iteration, before it is given up
NUDGE = 1e-7  # of a signal, relative; about the root of the rounding error


def newton(miss: Callable[[FloatArray], FloatArray], start: FloatArray, tolerance: float) -> FloatArray | None:
    """Return the values (n,) at which ``miss`` is zero, or None where they are not found.

    - ``miss``: from values (n,) to how far they are from agreeing (n,)
    - ``start`` (n,): where to begin
    - ``tolerance``: relative to one more than the size of each value

    Examples
    --------
    >>> root = newton(lambda x: x**2 - 2.0, np.array([1.0]), 1e-12)
    >>> root is not None and float(root[0].round(9))
    1.414213562
    >>> newton(lambda x: x**2 + 1.0, np.array([1.0]), 1e-12) is None
    True
    """
    values, gap = start.copy(), miss(start)
    for _ in range(PASSES):
        scale = 1.0 + np.abs(values)
        if np.all(np.abs(gap) <= tolerance * scale):
            return values
        jacobian = np.empty((len(values), len(values)))
        for j in range(len(values)):
            nudged = values.copy()
            nudged[j] += NUDGE * scale[j]
            jacobian[:, j] = (miss(nudged) - gap) / (NUDGE * scale[j])
        values = values + np.linalg.lstsq(jacobian, -gap, rcond=None)[0]
        gap = miss(values)
    return None


def followers(part: Part, parts: Sequence[Part], wires: Sequence[Wire]) -> list[Part]:
    """Return the parts with direct feedthrough that an undelayed wire leads to from this part."""
    found: list[Part] = []
    for wire in wires:
        if wire.external or wire.delay or not part.outputs.start <= wire.source < part.outputs.stop:
            continue
        target = _owner(wire, parts)
        if target.feeds_through and target not in found:
            found.append(target)
    return found


def reached_at_once(parts: Sequence[Part], wires: Sequence[Wire]) -> list[Part]:
    """Return the parts whose outputs depend on an external input within the same instant."""
    reached: list[Part] = []
    for wire in wires:
        if wire.external and not wire.delay:
            target = _owner(wire, parts)
            if target.feeds_through and target not in reached:
                reached.append(target)
    for part in reached:
        reached += [p for p in followers(part, parts, wires) if p not in reached]
    return reached


def _owner(wire: Wire, parts: Sequence[Part]) -> Part:
    """Return the part whose input a wire drives."""
    return next(p for p in parts if p.inputs.start <= wire.target < p.inputs.stop)


def strong_components(nodes: Sequence[Part], followers: Callable[[Part], list[Part]]) -> list[list[Part]]:
    """Return the strongly connected components in topological order, each in the order of ``nodes``."""
    from graphlib import TopologicalSorter

    import numpy as np
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    if not nodes:
        return []
    places = {id(node): place for place, node in enumerate(nodes)}
    edges = np.array(
        [(place, places[id(one)]) for place, node in enumerate(nodes) for one in followers(node)], dtype=np.intp
    ).reshape(-1, 2)
    graph = csr_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(len(nodes), len(nodes)))
    count, labels = connected_components(graph, directed=True, connection="strong")
    order: TopologicalSorter[int] = TopologicalSorter({group: set() for group in range(count)})
    for before, after in labels[edges].tolist():
        if before != after:
            order.add(after, before)
    return [
        [node for node, label in zip(nodes, labels, strict=True) if label == group] for group in order.static_order()
    ]
