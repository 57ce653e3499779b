"""What plants in this process have in common: a spec, and an end after which they are not used."""

from __future__ import annotations

from typing import Self

from harness.errors import PlantError
from harness.protocols import Ability
from harness.signals import PlantSpec


class BasePlant:
    """A plant that is open until it is closed; a subclass sets ``_spec``, and overrides what is otherwise with it."""

    _spec: PlantSpec
    _closed = False

    @property
    def spec(self) -> PlantSpec:
        """Channels and sample time."""
        return self._spec

    @property
    def abilities(self) -> frozenset[Ability]:
        """Snapshots (bit for bit, a generator included), batch, truth; feedthrough where the spec says so."""
        found: set[Ability] = {"snapshots", "batch", "truth"}
        found |= {"batch-truth"} if hasattr(self, "rollout_truth") else set()
        return frozenset(found | {"feedthrough"} if self.spec.feedthrough else found)

    def close(self) -> None:
        """Refuse further use; may be called twice."""
        self._closed = True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _need_open(self) -> None:
        """Refuse the use of a closed plant."""
        if self._closed:
            raise PlantError("the plant is closed: make a new one", status="terminated")
