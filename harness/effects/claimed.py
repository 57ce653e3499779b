"""The force that an effect adds along a measured motion: hidden states, delays and sensors included.

A block with a state of its own, a delay, or a small error of a coordinate's sensor has no equation form, yet what it
does to the balance of forces follows from the measured motion and the inputs: its states are simulated along them, a
sensor's error is undone in them.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from harness.effects.along import Signals, along, hidden_states, residual_function
from harness.effects.compose import compose
from harness.effects.effect import Effect, Placed
from harness.effects.places import port_of
from harness.effects.sampled import delay
from harness.signals import FloatArray

if TYPE_CHECKING:
    from harness.physics.compiled.system import System

SHORTEST = 0.05
"""Time constants of hidden states below this share of a sample are taken as this: no motion shows them."""
KEPT = 8
"""Simulations of hidden states that are remembered: derivatives to other parameters ask for the same again."""


def _undo_offset(signals: Signals, row: int, value: float) -> Signals:
    q = signals.q.copy()
    q[:, row] -= value
    return replace(signals, q=q)


def _undo_gain(signals: Signals, row: int, value: float) -> Signals:
    moved = {}
    for name in ("q", "v", "a"):
        array = getattr(signals, name).copy()
        array[:, row] /= 1.0 + value
        moved[name] = array
    return replace(signals, **moved)


def _undo_delay(signals: Signals, row: int, value: float) -> Signals:
    moved = {}
    for name in ("q", "v", "a"):
        array = getattr(signals, name).copy()
        array[:, row] = delay(array[::-1, row], value, signals.dt)[::-1]
        moved[name] = array
    return replace(signals, **moved)


SENSORS = {"sensor_offset": _undo_offset, "sensor_gain": _undo_gain, "sensor_delay": _undo_delay}
"""Errors of sensors that can be undone in a measured motion."""


def claimable(system: System, placed: Placed) -> bool:
    """Return True if what an effect does to the balance of forces follows from the measured motion.

    False for resonances of hidden masses, rounding, rectified or saturated sensors, tanks, sensors of other things than
    coordinates. Raises InputError if the effect does not fit its port.
    """
    effect, port = placed.effect, port_of(system, placed)
    if not effect.linearises or not system.coordinates or port.kind == "process" or effect.sampled == "quantise":
        return False
    if port.kind == "output":
        return effect.name in SENSORS and placed.at in {coordinate.name for coordinate in system.coordinates}
    return True


def _whole(system: System, placed: Placed, sizes: Mapping[str, float]) -> System:
    """Return a system with an effect, made once: where its parameters start makes no difference."""
    known: dict[tuple[Effect, str], System] = system.__dict__.setdefault("_with_effects", {})
    key = placed.effect, placed.at
    if key not in known:
        known[key] = compose(system, [placed], sizes={"": sizes})
    return known[key]


def _base(system: System, signals: Signals, p: FloatArray) -> FloatArray:
    """Return the residual of a system along a motion; those last asked for are kept."""
    known: list[tuple[Signals, bytes, FloatArray]] = system.__dict__.setdefault("_residuals", [])
    for motion, values, base in known:
        if motion is signals and values == p.tobytes():
            return base
    base = along(residual_function(system), system, signals, p, None, signals.a)
    known[:] = [*known[-KEPT + 1 :], (signals, p.tobytes(), base)]
    return base


class ClaimedForce:
    """The force that one effect adds to a system along motions, made once.

    - ``system``: mechanical, without the effect and without hidden states
    - ``placed``: the effect and its port; :func:`claimable`
    - ``sizes``: sizes of the data at that port

    Examples
    --------
    >>> from harness.effects.laws.actuator import input_delay
    >>> from harness.physics.models import pendulum
    >>> t = np.arange(4) * 0.1
    >>> still = Signals(t, t[:, None], np.zeros((4, 1)), np.zeros((4, 1)), np.zeros((4, 1)))
    >>> late = ClaimedForce(pendulum().system(), Placed(input_delay, "u"), {})
    >>> late(still, {"tau": 0.1}).round(6)[2].tolist()
    [-0.1]
    """

    def __init__(self, system: System, placed: Placed, sizes: Mapping[str, float]) -> None:
        self.system, self.placed = system, placed
        self.start = placed.effect.complete(placed.values, sizes)
        self.sensor = next(
            (row for row, coordinate in enumerate(system.coordinates) if coordinate.name == placed.at), None
        )
        self.undo = SENSORS.get(placed.effect.name)
        self._known: dict[tuple[float, ...], tuple[FloatArray | None, FloatArray]] = {}
        self.whole = system if self.undo else _whole(system, placed.with_values(self.start), sizes)

    def __call__(
        self, signals: Signals, values: Mapping[str, float], parameters: Mapping[str, float] | None = None
    ) -> FloatArray:
        """Return the force on each coordinate (N, n) [force units].

        - ``signals``: the motion; hidden states are simulated along it from rest
        - ``values``: parameters of the effect by short name; those not given have their start values
        - ``parameters``: values of the system's parameters
        """
        known = dict(parameters or {})
        own = {**self.start, **values}
        for declared in self.placed.effect.parameters if self.placed.effect.states else ():
            if declared.unit == "s" and declared.minimum >= 0:
                own[declared.name] = max(own[declared.name], SHORTEST * signals.dt)
        nominal = self.system.vector(known)
        base = _base(self.system, signals, nominal)
        if self.undo is not None:
            assert self.sensor is not None
            parameter = self.placed.effect.parameters[0]
            moved = self.undo(signals, self.sensor, own[parameter.name] - (parameter.neutral or 0.0))
            return np.asarray(base - along(residual_function(self.system), self.system, moved, nominal, None, moved.a))
        p = self.whole.vector({**known, **{self.placed.name(key): value for key, value in own.items()}})
        moved = signals
        if self.placed.effect.sampled == "input_delay":
            column = [channel.name for channel in self.system.inputs].index(self.placed.at)
            u = signals.u.copy()
            u[:, column] = delay(u[:, column], own[self.placed.effect.parameters[0].name], signals.dt)
            moved = replace(signals, u=u)
        hidden = self._hidden(moved, own, p)
        return np.asarray(base - along(residual_function(self.whole), self.whole, moved, p, hidden, moved.a))

    def _hidden(self, signals: Signals, own: Mapping[str, float], p: FloatArray) -> FloatArray | None:
        """Return the hidden states along a motion; those last asked for are kept."""
        if not self.placed.effect.states:
            return None
        key = (id(signals.t), *own.values(), *(p if self._wide else ()))
        if key not in self._known:
            while len(self._known) >= KEPT:
                del self._known[next(iter(self._known))]
            self._known[key] = (hidden_states(self.whole, signals, p), signals.t)  # time kept: its id stays its own
        return self._known[key][0]

    @functools.cached_property
    def _wide(self) -> bool:
        """Do the rates of the hidden states depend on parameters of the system."""
        import casadi as ca

        symbols = dict(zip(self.whole.parameter_names, ca.vertsplit(self.whole.p), strict=True))
        others = ca.vertcat(*(symbols[name] for name in self.system.parameter_names))
        return bool(ca.depends_on(self.whole.rates, others))
