"""Eigenfunctions of a lifted model as an analysis: what grows, what dies away, and over the plane of two outputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from harness.errors import InputError
from harness.models.analysis import Findings, Takes
from harness.models.lifted import eigenfunctions
from harness.options import check_options


@dataclass(frozen=True)
class EigenfunctionsOfModel:
    """Koopman eigenfunctions of a model of ``edmdc``, the slowest first, and a picture of them over two outputs.

    Williams, Kevrekidis & Rowley 2015 (*J. Nonlinear Sci.* 25:1307, eq. 14).

    Parameters
    ----------
    count : int
        Functions that are listed and drawn.
    low, high : sequence of float, optional
        Corners of the plane that is drawn, in the units of the two outputs; by default as far as the records went.
    """

    takes: ClassVar[Takes] = "process"
    count: int = 6
    low: Sequence[float] | None = None
    high: Sequence[float] | None = None

    def of(self, subject: Any, *, rng: np.random.Generator) -> Findings:
        """Return modulus, frequency and time constant of the functions."""
        found = eigenfunctions(subject)
        check_options(self, "eigenfunctions", count=">= 1")
        dt, rows = subject.spec.sample_time, []
        for value in found.values[: self.count]:
            size = abs(value)
            rows.append(
                {
                    "modulus": float(size),
                    "frequency [Hz]": float(abs(np.angle(value)) / (2 * np.pi * dt)),
                    "time constant [s]": float(-dt / np.log(size)) if 0 < size < 1 else None,
                }
            )
        growing = int(np.sum(np.abs(found.values) > 1.0))
        words = [
            f"{len(found.values)} functions (of a complex pair one), the constant left out; {growing} of them grow"
        ]
        reach = np.asarray(getattr(subject.dictionary, "scale", np.ones(subject.spec.ny)), dtype=float)[:2]
        low = -reach if self.low is None else np.asarray(self.low, dtype=float)
        high = reach if self.high is None else np.asarray(self.high, dtype=float)
        if low.shape != high.shape or np.any(low >= high):
            raise InputError(
                "corners of the plane", expected="low below high", got=f"{low}, {high}", remedy="correct the options"
            )
        details = {"real": found.values.real, "imaginary": found.values.imag}
        return Findings("eigenfunctions", rows, words, details, lambda: found.plot(low, high, count=self.count))
