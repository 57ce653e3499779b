"""Between the instants of a coupling: signals as lines within a step, and steps as short as their error asks for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np

from harness.cosim.wiring import Part
from harness.errors import InputError, PlantError

Hold = Literal["constant", "linear"]

MOST = 1024  # Exchanges within a communication step at most.


class SignalLines:
    """Real signals of parts as lines within a step; a part that holds its input gets the mean over the step.

    - ``count``: outputs of all parts, ny
    """

    def __init__(self, parts: Sequence[Part], count: int) -> None:
        channels = [channel for part in parts for channel in part.plant.spec.outputs]
        self._real = [channel.kind == "real" for channel in channels]
        self.rates = [0.0] * count

    def forget(self) -> None:
        """Begin anew: nothing is known of how signals move."""
        self.rates[:] = [0.0] * len(self.rates)

    def extrapolated(self, start: list[float], h: float) -> list[float]:
        """Return the signals in the middle of a step [s], as they moved in the last one."""
        ny = len(self.rates)
        return [*(x + 0.5 * h * rate for x, rate in zip(start[:ny], self.rates, strict=True)), *start[ny:]]

    def interpolate(self, middle: list[float], start: list[float], now: list[float], part: Part) -> None:
        """Put the mean of old and new values for those of a part that has stepped."""
        for i in range(part.outputs.start, part.outputs.stop):
            middle[i] = 0.5 * (start[i] + now[i]) if self._real[i] else now[i]

    def remember(self, start: list[float], now: list[float], h: float) -> None:
        """Take how signals moved in a step of h [s]; what is no real number does not move."""
        for i, real in enumerate(self._real):
            self.rates[i] = (now[i] - start[i]) / h if real else 0.0


class Controlled:
    """Communication steps halved until halving changes little, with rollback.

    A step is made in n exchanges and, from the same state, in 2 n; their difference is the estimate of the error
    (step doubling, Hairer, Norsett & Wanner 1993, *Solving Ordinary Differential Equations I*, sec. II.4). The finer
    one stands; it is the coarser one whose error is kept below the bound.

    Raises InputError if a part cannot, or there is a delay, another rate, several passes.

    - ``parts``: their plants tell that they can step parts of a sample (``divides``, ``step_part``) and be rolled back
    - ``error``: relative to one more than the size of a signal
    - ``late``: delayed wires
    """

    def __init__(self, parts: Sequence[Part], error: float, late: Sequence[object], iterations: int) -> None:
        if not error > 0:
            raise InputError("error of a step", expected="a positive number", got=repr(error), remedy="1e-4, say")
        unable = [
            part.name
            for part in parts
            if not getattr(part.plant, "divides", False) or "snapshots" not in part.plant.abilities or part.every > 1
        ]
        if unable or late or iterations > 1:
            raise InputError(
                "error-controlled communication step",
                expected="parts of one rate that take variable steps and give their state, one pass, no delayed wires",
                got=f"not so: {', '.join(unable)}" if unable else "a delayed wire" if late else "several passes",
                remedy="leave error out, and halve the step (--halve)",
            )
        self._error = float(error)
        self._count = 1
        self.exchanges = 0
        """Made in all, those that were rolled back too."""

    def forget(self) -> None:
        """Begin a run anew."""
        self._count, self.exchanges = 1, 0

    def step(
        self,
        take: Callable[[], Any],
        put: Callable[[Any], None],
        through: Callable[[int], None],
        signals: Callable[[], Sequence[float]],
    ) -> None:
        """Make one communication step; ``through(n)`` makes it in n exchanges."""
        before, count = take(), self._count
        coarse: np.ndarray[Any, Any] | None = None
        while True:
            if coarse is None:
                through(count)
                coarse = np.array(signals())
            put(before)
            through(2 * count)
            fine = np.array(signals())
            self.exchanges += 3 * count
            off = float(np.max(np.abs(fine - coarse) / (1.0 + np.abs(fine)), initial=0.0))
            if off <= self._error:
                break
            if 4 * count > MOST:
                words = "take hold = 'linear', a shorter step or a larger error"
                raise PlantError(f"{MOST} exchanges in a communication step leave an error of {off:.2g}: {words}")
            count, coarse = 2 * count, fine
        self._count = max(count // 2, 1) if off < 0.25 * self._error else count
