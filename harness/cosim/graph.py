"""Which parts act on which within one instant: direct feedthrough, its order and its cycles."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from harness.cosim.wiring import Part, Wire

__all__ = ["followers", "reached_at_once", "strong_components"]


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
    """Return the strongly connected components in topological order (Tarjan 1972, SIAM J. Comput. 1:146)."""
    index: dict[int, int] = {}
    low: dict[int, int] = {}
    stack: list[Part] = []
    done: list[list[Part]] = []

    def visit(node: Part) -> None:
        index[id(node)] = low[id(node)] = len(index)
        stack.append(node)
        for follower in followers(node):
            if id(follower) not in index:
                visit(follower)
                low[id(node)] = min(low[id(node)], low[id(follower)])
            elif follower in stack:
                low[id(node)] = min(low[id(node)], index[id(follower)])
        if low[id(node)] == index[id(node)]:
            group: list[Part] = []
            while not group or group[-1] is not node:
                group.append(stack.pop())
            done.append(group[::-1])

    for node in nodes:
        if id(node) not in index:
            visit(node)
    return done[::-1]
