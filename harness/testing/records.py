"""Strategies of what surrounds a system in a test: excitations, sensor noise, recordings with defects, mechanisms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from hypothesis import strategies as st

from harness.signals import FloatArray, Trajectory

if TYPE_CHECKING:
    from harness.effects import Placed
    from harness.physics import System

EXCITATIONS = ("white", "binary", "steps", "multisine", "chirp")
"""Kinds of :func:`excitations`: all are persistent enough for a model of a few states."""
NOISES = ("white", "coloured", "quantised", "outliers")  # Kinds of :func:`noises`.
DEFECTS = ("gap", "stuck", "spikes", "saturated", "exchanged", "scaled", "delayed", "drifting")
"""Kinds of :func:`defective_recordings`."""


@st.composite
def excitations(
    draw: Any, samples: int = 200, inputs: int = 1, kinds: tuple[str, ...] = EXCITATIONS, amplitude: float = 1.0
) -> FloatArray:
    """Draw an input (samples, inputs) of one kind, between -amplitude and amplitude.

    Parameters
    ----------
    samples, inputs : int
    kinds : tuple of str
        Among :data:`EXCITATIONS`.
    amplitude : float

    Examples
    --------
    >>> from hypothesis import given
    >>> @given(excitations(50, 2, amplitude=0.3))
    ... def bounded(u):
    ...     assert u.shape == (50, 2) and abs(u).max() <= 0.3
    >>> bounded()
    """
    kind = draw(st.sampled_from(kinds))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    k = np.arange(samples)
    columns = []
    for _ in range(inputs):
        if kind == "white":
            column = rng.uniform(-1, 1, samples)
        elif kind == "binary":
            column = np.where(np.repeat(rng.random(samples // 2 + 1) < 0.5, 2)[:samples], 1.0, -1.0)
        elif kind == "steps":
            hold = int(rng.integers(5, 15))
            column = np.repeat(rng.uniform(-1, 1, samples // hold + 1), hold)[:samples]
        elif kind == "multisine":
            lines = np.arange(1, max(samples // 5, 2))
            column = np.cos(2 * np.pi * np.outer(k, lines) / samples + rng.uniform(0, 2 * np.pi, lines.size)).sum(
                axis=1
            )
            column /= np.abs(column).max()
        else:
            low, high = 0.005 * (1 + rng.random()), 0.4
            column = np.sin(2 * np.pi * (low * k + 0.5 * (high - low) * k**2 / samples) + rng.uniform(0, 2 * np.pi))
        columns.append(amplitude * column)
    result: FloatArray = np.column_stack(columns) if columns else np.zeros((samples, 0))
    return result


@dataclass(frozen=True)
class Noise:
    """Sensor noise of one kind; ``ratio`` is its size relative to the standard deviation of each output.

    Call it with a record: it returns the record with noisy outputs (the true states are kept).
    """

    kind: str
    ratio: float
    seed: int

    def __call__(self, record: Trajectory) -> Trajectory:
        """Return the record with noise on its real outputs."""
        rng = np.random.default_rng(self.seed)
        size = self.ratio * record.y.std(axis=0)
        size[[channel.kind != "real" for channel in record.spec.outputs]] = 0.0
        white = rng.normal(size=record.y.shape)
        if self.kind == "quantised":
            step = np.where(
                size > 0, np.sqrt(12.0) * size, 1.0
            )  # a uniform error of step q has the deviation q/sqrt(12)
            y = np.where(size > 0, step * np.round(record.y / step), record.y)
        elif self.kind == "outliers":
            y = record.y + size * np.where(rng.random(record.y.shape) < 0.03, 20.0, 0.3) * white
        else:
            if self.kind == "coloured":
                for row in range(1, len(white)):  # first order, kept at unit variance
                    white[row] = 0.9 * white[row - 1] + np.sqrt(1 - 0.9**2) * white[row]
            y = record.y + size * white
        return Trajectory(record.t, record.u, y, record.spec, record.x)


@st.composite
def noises(draw: Any, least: float = 1e-3, most: float = 0.1, kinds: tuple[str, ...] = NOISES) -> Noise:
    """Draw a sensor noise with a ratio to the outputs between ``least`` and ``most``.

    Examples
    --------
    >>> from hypothesis import given
    >>> @given(noises(most=0.05))
    ... def small(noise):
    ...     assert noise.kind in NOISES and 1e-3 <= noise.ratio <= 0.05
    >>> small()
    """
    ratio = float(np.exp(draw(st.floats(np.log(least), np.log(most)))))
    return Noise(draw(st.sampled_from(kinds)), min(max(ratio, least), most), draw(st.integers(0, 2**32 - 1)))


@dataclass(frozen=True)
class Defective:
    """A recording with a defect.

    Parameters
    ----------
    kind : str
        Among :data:`DEFECTS`.
    column : int
        Output in which it is.
    records : tuple of Trajectory
        One record, or two on the sides of a gap.
    """

    kind: str
    column: int
    records: tuple[Trajectory, ...]


@st.composite
def defective_recordings(draw: Any, record: Trajectory, kinds: tuple[str, ...] = DEFECTS) -> Defective:
    """Draw what a bad measurement makes of a record of at least 40 samples.

    A gap (two records), a sensor that is stuck, has spikes, saturates, drifts or comes late, an output in thousandths
    of its unit, or two outputs exchanged (where there are two).

    Examples
    --------
    >>> from hypothesis import given
    >>> from harness.signals import Channel, PlantSpec
    >>> spec = PlantSpec((), (Channel("q", "m"),), 0.1)
    >>> clean = Trajectory(np.arange(60) * 0.1, np.zeros((60, 0)), np.sin(np.arange(60))[:, None], spec)
    >>> @given(defective_recordings(clean))
    ... def changed(found):
    ...     assert len(found.records) == 2 or not np.array_equal(found.records[0].y, clean.y)
    >>> changed()
    """
    n, ny = record.y.shape
    kind = draw(st.sampled_from([k for k in kinds if k != "exchanged" or ny > 1]))
    column = draw(st.integers(0, ny - 1))
    start = draw(st.integers(n // 4, n // 2))
    if kind == "gap":
        rest = record[start + n // 8 :]
        return Defective(kind, column, (record[:start], rest))
    y = record.y.copy()
    one, spread = y[:, column], float(record.y[:, column].std()) or 1.0
    if kind == "stuck":
        one[start : start + n // 4] = one[start]
    elif kind == "spikes":
        rows = draw(st.lists(st.integers(1, n - 2), min_size=1, max_size=5, unique=True))
        one[rows] += 20.0 * spread
    elif kind == "saturated":
        one[:] = np.clip(one, one.mean() - 0.8 * spread, one.mean() + 0.8 * spread)
    elif kind == "exchanged":
        y = np.roll(y, 1, axis=1)
    elif kind == "scaled":
        one *= 1000.0
    elif kind == "delayed":
        late = draw(st.integers(1, 5))
        one[late:] = record.y[:-late, column]
    else:
        one += np.linspace(0.0, 3.0 * spread, n)
    return Defective(kind, column, (Trajectory(record.t, record.u, y, record.spec, record.x),))


@st.composite
def mechanisms(draw: Any, names: tuple[str, ...] = ("pendulum", "cart-pole", "oscillator", "drive")) -> System:
    """Draw a built-in mechanism with parameters between half and twice their usual values, within their bounds.

    Examples
    --------
    >>> from hypothesis import given, settings
    >>> @settings(max_examples=3, deadline=None)
    ... @given(mechanisms(("oscillator",)))
    ... def rolls_out(system):
    ...     simulator = system.simulator(0.01, backend="casadi")
    ...     assert np.isfinite(simulator.rollout(system.vector(), np.zeros(system.nx), np.ones((50, system.nu)))).all()
    >>> rolls_out()
    """
    from harness.physics import load_model

    system = load_model(draw(st.sampled_from(names)))
    values = {
        one.name: float(np.clip(one.value * draw(st.floats(0.5, 2.0)), one.minimum, one.maximum))
        for one in system.parameters
    }
    return system.with_parameters(values)


def placed_effects(system: System, wanted: Callable[[Placed], bool] = lambda placed: True) -> st.SearchStrategy[Placed]:
    """Return a strategy of the physical effects that fit a system, each at a port of it.

    Parameters
    ----------
    system : System
    wanted : callable
        Leaves out what a test has no use for.

    Examples
    --------
    >>> from harness.physics import load_model
    >>> from hypothesis import given, settings
    >>> pendulum = load_model("pendulum")
    >>> @settings(max_examples=3)
    ... @given(placed_effects(pendulum, lambda placed: "friction" in placed.effect.name))
    ... def at_the_joint(placed):
    ...     assert placed.at == "theta"
    >>> at_the_joint()
    """
    from harness.effects import place_all

    return st.sampled_from([placed for placed in place_all(system) if wanted(placed)])
