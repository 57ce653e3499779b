"""What a controller costs on a plant that need not be linear: quadratic cost of runs from many starts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, TypedDict, Unpack

import numpy as np

from harness.errors import PlantError
from harness.signals import FloatArray, PlantSpec

GONE = 1e6  # outputs beyond this count as gone: no cost of such a run means anything


class OutputFeedback(Protocol):
    """What acts on measured outputs."""

    def reset(self, y: FloatArray) -> None:
        """Begin at an output (ny,)."""
        ...

    def act(self, y: FloatArray) -> FloatArray:
        """Return the input (nu,) for the output (ny,) of this sample."""
        ...


class StateFeedback:
    """``u = u* - K (y - y*)`` within the ranges of the inputs: the local LQR where the outputs are the states.

    Parameters
    ----------
    spec : PlantSpec
        Declares the ranges.
    gain : array (nu, ny)
    target, hold : array (ny,), (nu,)
        Point to be held, and the inputs there.
    """

    def __init__(self, spec: PlantSpec, gain: FloatArray, target: FloatArray, hold: FloatArray) -> None:
        self.gain, self.target, self.hold = gain, target, hold
        self.low = np.array([channel.minimum for channel in spec.inputs])
        self.high = np.array([channel.maximum for channel in spec.inputs])

    def reset(self, y: FloatArray) -> None:
        """Begin; nothing is remembered."""

    def act(self, y: FloatArray) -> FloatArray:
        """Return the input (nu,)."""
        return np.asarray(np.clip(self.hold - self.gain @ (y - self.target), self.low, self.high))


class Regulation(TypedDict):
    """How long a run is, and how it is weighed."""

    steps: int  # Samples
    q: FloatArray  # (ny, ny): Weights of the outputs
    r: FloatArray  # (nu, nu): Weights of the inputs
    target: FloatArray  # (ny,): Point to be held
    hold: FloatArray  # (nu,): Inputs there


def regulation_costs(
    plant: Any, controller: OutputFeedback, starts: Sequence[Mapping[str, float]], **run: Unpack[Regulation]
) -> FloatArray:
    """Return ``sum (y - y*)' q (y - y*) + (u - u*)' r (u - u*)`` of a run from each start (M,).

    Infinite where the plant ends or its outputs leave every bound.

    Parameters
    ----------
    plant : Plant
    controller : Controller
    starts : sequence of mapping
        Initial states by name.
    **run : Regulation
        ``steps``, ``q``, ``r``, ``target`` and ``hold``.

    Examples
    --------
    >>> from plants.equations.linear import LinearPlant
    >>> plant, one = LinearPlant(A=[[0.5]], B=[[1.0]]), np.ones((1, 1))
    >>> still = StateFeedback(plant.spec, 0 * one, np.zeros(1), np.zeros(1))
    >>> point = {"target": np.zeros(1), "hold": np.zeros(1)}
    >>> regulation_costs(plant, still, [{"x1": 1.0}, {"x1": 2.0}], steps=50, q=one, r=one, **point).round(4)
    array([1.3333, 5.3333])
    """
    return np.array([regulation_steps(plant, controller, start, **run).sum() for start in starts])


def regulation_steps(
    plant: Any, controller: OutputFeedback, start: Mapping[str, float], **run: Unpack[Regulation]
) -> FloatArray:
    """Return what every sample of one run costs (steps,), as :func:`regulation_costs` adds it up.

    Where the plant ends, or its outputs leave every bound, the last of them is infinite and those after it are 0.
    """
    y, costs = np.asarray(plant.reset(rng=np.random.default_rng(0), x0=start), dtype=float), np.zeros(run["steps"])
    controller.reset(y)
    for k in range(run["steps"]):
        u = controller.act(y)
        away, pushed = y - run["target"], u - run["hold"]
        costs[k] = away @ run["q"] @ away + pushed @ run["r"] @ pushed
        try:
            y = np.asarray(plant.step(u), dtype=float)
        except PlantError:
            y = np.array([np.inf])
        if not np.all(np.abs(y) < GONE):
            costs[k] = np.inf
            break
    return costs
