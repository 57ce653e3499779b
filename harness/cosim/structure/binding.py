"""Values bound to the variables of a system: by its file, by outer systems, by who runs it."""

from __future__ import annotations

from typing import Any

from harness.cosim.structure.arriving import Arriving
from harness.cosim.structure.conversion import Chain, LinearConversion, Unit, change_of_unit
from harness.cosim.structure.flat import (
    REALS,
    FlatComponent,
    Way,
    dotted,
    each,
)
from harness.cosim.structure.model import (
    Connector,
    Mapped,
    Value,
)
from harness.cosim.structure.walk import FIXED, Place, Walk


class Bound:
    """Values of connectors with their units; those of FMUs stand in the components."""

    def __init__(self, walk: Walk, arriving: Arriving) -> None:
        self.walk, self.arriving = walk, arriving
        self.values: dict[Place, tuple[Any, Unit | None]] = {}

    def bind(self, parameters: dict[str, Any]) -> None:
        """Hand out values: those of outer systems and later bindings go last and win (sec. 5.2.2)."""
        unheard: dict[str, None] = {}
        for way, value in sorted(self.walk.bindings, key=lambda one: -len(one[0])):
            if not self._give(way, value, given=False):
                unheard[dotted(way, value.name)] = None
        for name, content in parameters.items():
            if not self._give((), Value(name, content), given=True):
                known = [f"{c.label}.{n}" for c in self.walk.components.values() for n in c.rows]
                raise self.walk.refused(
                    f"parameter {name!r}", "COMPONENT.NAME" if len(known) > 9 else ", ".join(known), ""
                )
        if unheard:
            listed = ", ".join(list(unheard)[:8]) + (", ..." if len(unheard) > 8 else "")
            self.walk.notes.append(
                f"values that name nothing in the system, passed over as the standard says: {listed}"
            )

    def _give(self, way: Way, value: Value, *, given: bool) -> bool:
        """Set every variable of a name (several may share it); returns whether there is one."""
        heard = False
        for place, connector in list(self.walk.connectors.items()):
            if place[0] in self.walk.components or place[0][: len(way)] != way:
                continue
            if dotted(place[0][len(way) :], place[1]) == value.name:
                unit = connector.unit or value.unit
                content = value.value if not given or unit is None else each(value.value, Chain().then(unit.from_si))
                landed = self._landed(value, content, connector, unit)
                self.values[place] = (landed, unit)
                heard = True
        for inner, component in self.walk.components.items():
            if inner[: len(way)] != way:
                continue
            head = "".join(f"{name}." for name in inner[len(way) :])
            name = value.name.removeprefix(head)
            if not value.name.startswith(head) or name not in component.rows:
                continue
            place, row = (inner, name), component.rows[name]
            connector = self.walk.connectors.get(place) or self.walk.variable(inner, None, name)
            if given:
                self.put(component, row, value.value)
            else:
                landed = self._landed(value, value.value, connector, connector.unit)
                if self.walk.physical[place] and connector.unit is not None:
                    landed = each(landed, Chain().then(connector.unit.to_si))
                self.put(component, row, landed)
            heard = True
        return heard

    def _landed(self, value: Value, content: Any, target: Connector, unit: Unit | None) -> Any:
        """Return a value at its target: units first, then the transformation (sec. 7.1)."""
        if value.unit is not None and unit is not None and not value.suppress:
            change = change_of_unit(value.unit, unit)
            if change is None:
                raise self.walk.refused(
                    f"unit of parameter {value.name!r}", f"one that converts to {unit}", str(value.unit)
                )
            content = each(content, Chain().then(change))
        if isinstance(value.change, LinearConversion):
            if target.type not in (*REALS, None):
                raise self.walk.refused("LinearTransformation", "a real number", f"{value.name!r}: {target.type}")
            return each(content, Chain().then(value.change))
        if value.change is not None:
            return self._mapped(value.change, content, target)
        return content

    def _mapped(self, change: Mapped, content: Any, target: Connector) -> Any:
        """Return a parameter's value after a mapping transformation."""
        if isinstance(content, list):
            return [self._mapped(change, one, target) for one in content]
        if isinstance(content, str) or change.kind == "Enumeration":
            return dict(change.entries).get(str(content), content)
        source = Connector(target.name, "", None, None, target.items)
        found = self.arriving.table(change, source, source)(float(content))
        return bool(found) if isinstance(content, bool) else int(found) if isinstance(content, int) else found

    def number(self, place: Place) -> Any:
        """Return the value of a connector; an item of an enumeration as its number where it is known."""
        content, _ = self.values[place]
        items = self.walk.connectors[place].items or {}
        return items.get(content, content) if isinstance(content, str) else content

    def put(self, component: FlatComponent, row: dict[str, Any], value: Any) -> None:
        """Give a value to a variable of an FMU: a parameter, or a start value."""
        group = component.parameters if row["causality"] in FIXED else component.start
        if row["type"] in REALS or not isinstance(value, float) or not value.is_integer():
            group[row["name"]] = value
        else:
            group[row["name"]] = int(value)
