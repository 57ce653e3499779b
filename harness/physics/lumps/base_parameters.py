"""Base parameters as an analysis: which combinations of a mechanism's parameters its motion can show."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from harness.errors import InputError, refuse_unknown
from harness.models.analysis import Findings, Takes
from harness.physics.lumps.lumped_model import lumped
from harness.physics.symbolic.mechanism import Mechanism


@dataclass(frozen=True)
class BaseParameters:
    """Combinations of a mechanism's parameters that motion and torque determine, and parameters that no motion shows.

    The base parameters of Gautier 1991 (*J. Robotic Systems* 8:485); inputs are taken as known.

    Parameters
    ----------
    known : mapping
        Parameters whose value is known from elsewhere (a scale, a ruler), by name.

    Examples
    --------
    >>> from harness.physics import load_model
    >>> found = BaseParameters().of(load_model("pendulum"), rng=np.random.default_rng(0))
    >>> [row["combination"] for row in found.rows]
    ['mgl', 'J', 'b']
    """

    takes: ClassVar[Takes] = "definition"
    known: dict[str, float] = field(default_factory=dict)

    def of(self, subject: Any, *, rng: np.random.Generator) -> Findings:
        """Return the combinations, each with the parameters in it."""
        mechanism = getattr(subject, "mechanism", None)
        if not isinstance(mechanism, Mechanism):
            raise InputError(
                f"base parameters of {getattr(subject, 'name', type(subject).__name__)}",
                expected="a mechanism (sysid list models) or a URDF",
                got="equations of another kind",
                remedy="write it as a Mechanism",
            )
        names = {str(symbol) for symbol in mechanism.p}
        refuse_unknown("known parameters", self.known, sorted(names))
        found = lumped(mechanism, known=self.known)
        rows = []
        inside: dict[str, int] = {}
        for text, combination in zip(found.names, found.combinations, strict=True):
            parts = sorted(names & {str(symbol) for symbol in combination.free_symbols})
            for part in parts:
                inside[part] = inside.get(part, 0) + 1
            rows.append({"combination": text, "parameters": ", ".join(parts[:8]) + (", ..." if len(parts) > 8 else "")})
        alone = {row["combination"] for row in rows}
        hidden = sorted(names - set(inside) - set(self.known))
        tied = sorted(name for name in inside if name not in alone)
        words = [f"{len(rows)} combinations of {len(names)} parameters can be found from motion and inputs"]
        if tied:
            words.append(f"seen in combinations only: {', '.join(tied)}")
        if hidden:
            words.append(f"shown by no motion: {', '.join(hidden)}")
        return Findings(f"base parameters of {mechanism.name}", rows, words)
