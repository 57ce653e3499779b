"""Parts of a coupling that are known by name when they break, also when they end the process."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, cast

from harness.errors import PlantError
from harness.protocols import Plant
from harness.supervision.whereabouts import at_work_on, marker


class Watched:
    """A plant as it is, but that it names itself: before each call to who may outlive it, and in its PlantErrors."""

    def __init__(self, plant: Plant, name: str) -> None:
        self._plant, self._name, self._mark = plant, name, marker(name)

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._plant, name)
        if not callable(found):
            return found
        mark, own = self._mark, self._name

        def call(*arguments: Any, **options: Any) -> Any:
            mark()
            try:
                return found(*arguments, **options)
            except PlantError as error:
                raise by_name(error, own) from error

        self.__dict__[name] = call  # found at once the next time
        return call


def watched(plant: Plant, name: str) -> Plant:
    """Return a plant that is known by a name, or the same one if it has a name already."""
    return plant if isinstance(plant, Watched) else cast(Plant, Watched(plant, name))


def made(make: Callable[[str, dict[str, Any]], Plant], id: str, options: Mapping[str, Any], name: str) -> Plant:
    """Return a part that is made under its name, and keeps it."""
    at_work_on(name)
    try:
        return watched(make(id, dict(options)), name)
    except PlantError as error:
        raise by_name(error, name) from error
    finally:
        at_work_on("")


def by_name(error: PlantError, name: str) -> PlantError:
    """Return the error of a part with its name before it."""
    return PlantError(f"part {name!r}: {error}", status=error.status)
