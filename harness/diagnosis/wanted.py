"""The dictionary of one run as text: which effects are given, which are tried, and which are left out."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

from harness.effects.effect import Placed
from harness.errors import InputError, did_you_mean

_ITEM = re.compile(
    r"(?P<no>!?)\s*(?P<name>[\w*]+)\s*(?:(?:\(\s*(?P<in>[\w*]+)\s*\))|(?:@\s*(?P<at>[\w*]+)))?\s*(?P<maybe>\??)"
)
"""``!name(place)?`` or ``!name@place?``; a star stands for any letters."""


@dataclass(frozen=True)
class WantedEffect:
    """One entry of a run's dictionary."""

    # Patterns of the effect and of its port; ``*`` stands for any letters
    name: str
    place: str
    use: str  # {"given", "tried", "left out"}

    def names(self, placed: Placed) -> bool:
        """Return True for an effect that this entry means."""
        return fnmatchcase(placed.effect.name, self.name) and fnmatchcase(placed.at, self.place)

    def __str__(self) -> str:
        place = "" if self.place == "*" else f"({self.place})"
        return f"{'!' * (self.use == 'left out')}{self.name}{place}{'?' * (self.use == 'tried')}"


@dataclass(frozen=True)
class Wanted:
    """What a run wants of the dictionary: a given effect is part of the answer, whatever its evidence.

    Where anything is to be tried, nothing else is; what is left out is not tried.

    Attributes
    ----------
    items : tuple of Item

    Examples
    --------
    >>> wanted = Wanted.read("coulomb_friction(theta); *delay*?; !thermal_*")
    >>> [item.use for item in wanted.items], str(wanted)
    (['given', 'tried', 'left out'], 'coulomb_friction(theta); *delay*?; !thermal_*')
    """

    items: tuple[WantedEffect, ...] = ()

    @classmethod
    def read(cls, text: str) -> Wanted:
        """Read entries that are separated by semicolons or commas.

        Parameters
        ----------
        text : str
            ``NAME(PLACE)`` is given, ``NAME(PLACE)?`` tried, ``!NAME(PLACE)`` left out; without a place anywhere.

        Raises
        ------
        InputError
            If an entry cannot be read.
        """
        items = []
        for entry in filter(None, (part.strip() for part in re.split("[;,]", text))):
            found = _ITEM.fullmatch(entry)
            if found is None or (found["no"] and found["maybe"]):
                raise InputError(
                    "an entry of the dictionary of this run",
                    expected="NAME(PLACE) for what is given, NAME(PLACE)? for what is tried, !NAME(PLACE) for what is "
                    "left out",
                    got=repr(entry),
                    remedy="such as 'coulomb_friction(theta); *delay*?'; sysid list effects shows the names",
                )
            use = "left out" if found["no"] else "tried" if found["maybe"] else "given"
            items.append(WantedEffect(found["name"], found["in"] or found["at"] or "*", use))
        return cls(tuple(items))

    def __str__(self) -> str:
        return "; ".join(map(str, self.items))

    def chosen(self, candidates: Sequence[Placed]) -> tuple[list[Placed], list[Placed]]:
        """Return the effects that are given, and those that are tried.

        Parameters
        ----------
        candidates : sequence of Placed
            All that the run knows, at the ports of its model.

        Raises
        ------
        InputError
            If an entry means no effect at any port of the model, or a given one more than one.
        """
        for item in self.items:
            means = [placed for placed in candidates if item.names(placed)]
            if not means or (item.use == "given" and len(means) > 1):
                self._refuse(item, means, candidates)
        given = [placed for placed in candidates if self._uses(placed, "given")]
        wanted = any(item.use == "tried" for item in self.items)
        tried = [
            placed
            for placed in candidates
            if placed not in given
            and not self._uses(placed, "left out")
            and (not wanted or self._uses(placed, "tried"))
        ]
        return given, tried

    def _uses(self, placed: Placed, use: str) -> bool:
        """Return True for an effect that an entry of this use means."""
        return any(item.use == use and item.names(placed) for item in self.items)

    @staticmethod
    def _refuse(item: WantedEffect, means: Sequence[Placed], candidates: Sequence[Placed]) -> None:
        """Refuse an entry that means nothing here, or not one thing."""
        names = sorted({placed.effect.name for placed in candidates})
        places = sorted({placed.at for placed in candidates if fnmatchcase(placed.effect.name, item.name)})
        if means:
            remedy = f"name one: {', '.join(f'{placed.effect.name}({placed.at})' for placed in means[:8])}"
        elif places:
            remedy = f"it may stand at {', '.join(places)}"
        else:
            remedy = did_you_mean(item.name, names, "sysid list effects shows the names")
        raise InputError(
            f"{str(item)!r} in the dictionary of this run",
            expected="one effect at one port of the model"
            if item.use == "given"
            else "an effect at a port of the model",
            got=f"{len(means)} of them" if means else "none",
            remedy=remedy,
        )
