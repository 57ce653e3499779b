"""The compass gait: two legs that walk down a slope; at heel strike they change roles and the rates jump."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from harness.errors import PlantError
from harness.signals import Channel, FloatArray, PlantSpec
from plants.base import BasePlant
from plants.checking import checked_inputs, initial_values, positive

_BISECTIONS = 40
"""Halvings of an engine step in which the foot strikes."""


class CompassGait(BasePlant):
    """Goswami's compass gait (Goswami, Thuilot & Espiau 1998, *Int. J. Robotics Research* 17, sec. 2 and app.).

    ``stance`` and ``swing`` are the angles of the legs from the vertical, positive with the foot ahead of the hip; the
    input is a torque at the hip that swings one leg forward against the other. Heel strike is ``stance + swing =
    -2 slope`` with the swing leg in front and coming down; angular momentum about the new foot, and of the other leg
    about the hip, is kept, and the legs change names. Scuffing in mid-swing is ignored, as usual.

    Parameters
    ----------
    m, m_hip : float
        Masses of a leg and of the hip [kg].
    a, b : float
        From the foot to the leg's mass, and from there to the hip [m].
    slope : float
        Of the ground [rad].
    gravity : float
    sample_time : float
    substeps : int
        Runge-Kutta steps for each sample.
    u_limit : float
        Declared range of the torque [N m]; nothing is clipped.

    Examples
    --------
    >>> print(CompassGait().spec)
    u [N m] -> stance [rad], swing [rad], stance_rate [rad/s], swing_rate [rad/s] every 0.01 s
    """

    def __init__(
        self,
        *,
        m: float = 5.0,
        m_hip: float = 10.0,
        a: float = 0.5,
        b: float = 0.5,
        slope: float = 0.0525,
        gravity: float = 9.81,
        sample_time: float = 0.01,
        substeps: int = 5,
        u_limit: float = 0.5,
    ) -> None:
        self.true_parameters = {
            name: positive(name, value) for name, value in (("m", m), ("m_hip", m_hip), ("a", a), ("b", b))
        }
        self.slope, self._gravity = positive("slope", slope, zero=True), positive("gravity", gravity)
        angles = (Channel("stance", "rad"), Channel("swing", "rad"))
        states = (*angles, Channel("stance_rate", "rad/s"), Channel("swing_rate", "rad/s"))
        hip = Channel("u", "N m", -u_limit, u_limit)
        self._spec = PlantSpec((hip,), states, positive("sample_time", sample_time), states)
        self._dt, self._substeps = sample_time / int(positive("substeps", substeps)), int(substeps)
        self._default = [0.2187, -0.3234, -1.0918, -0.3772]  # just after a strike of its limit cycle at 3 degrees
        self._x = np.array(self._default)

    def impact(self, x: FloatArray) -> FloatArray:
        """Return the state (4,) just after a heel strike from the one just before it (equations of the appendix)."""
        p = self.true_parameters
        m, hip, a, b = p["m"], p["m_hip"], p["a"], p["b"]
        length, c = a + b, math.cos(x[1] - x[0])
        before = np.array([[-m * a * b, -m * a * b + (hip * length**2 + 2 * m * a * length) * c], [0.0, -m * a * b]])
        after = np.array(
            [
                [m * b * (b - length * c), m * length * (length - b * c) + m * a**2 + hip * length**2],
                [m * b**2, -m * b * length * c],
            ]
        )
        swing_rate, stance_rate = np.linalg.solve(after, before @ np.array([x[3], x[2]]))
        return np.array([x[1], x[0], stance_rate, swing_rate])

    def reset(self, *, rng: np.random.Generator, x0: Mapping[str, float] | None = None) -> FloatArray:
        """Start anew, from named states where given; returns ``y[0]`` (4,). ``rng`` is not used."""
        self._need_open()
        self._x = np.array(initial_values(x0, self.spec.states, self._default))
        return self._x.copy()

    def step(self, u: FloatArray) -> FloatArray:
        """Hold the torque ``u`` (1,) for one sample time; returns the next state (4,).

        Raises
        ------
        PlantError
            If the walker has fallen over or the plant is closed.
        """
        self._need_open()
        torque = float(checked_inputs(np.atleast_2d(u), self.spec)[0, 0])
        for _ in range(self._substeps):
            self._x = self._moved(self._x, torque, self._dt)
        if np.abs(self._x[:2]).max() > 0.5 * math.pi:
            raise PlantError("the walker has fallen over", status="diverged")
        return self._x.copy()

    def rollout(self, inputs: FloatArray) -> FloatArray:
        """Apply ``inputs`` (N, 1) from the present state; row k of the result (N, 4) is what ``step`` returned."""
        checked = checked_inputs(inputs, self.spec)
        return np.array([self.step(row) for row in checked]).reshape(len(checked), 4)

    def truth(self) -> FloatArray:
        """Return the state (4,)."""
        self._need_open()
        return self._x.copy()

    def get_state(self) -> Any:
        """Return the state."""
        self._need_open()
        return self._x.copy()

    def set_state(self, state: Any) -> None:
        """Go back to a state."""
        self._need_open()
        self._x = np.array(state)

    def _moved(self, x: FloatArray, torque: float, dt: float) -> FloatArray:
        """Return the state ``dt`` later, over a heel strike where there is one."""
        new = self._flowed(x, torque, dt)
        if not (self._height(x) > 0.0 >= self._height(new) and new[0] < new[1]):
            return new
        low, high = 0.0, dt
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self._height(self._flowed(x, torque, middle)) > 0.0 else (low, middle)
        return self._flowed(self.impact(self._flowed(x, torque, high)), torque, dt - high)

    def _height(self, x: FloatArray) -> float:
        """Return what is positive while the swing foot, ahead of the stance foot, is above the ground."""
        return float(math.cos(x[0] + self.slope) - math.cos(x[1] + self.slope)) * (1.0 if x[1] > x[0] else -1.0)

    def _flowed(self, x: FloatArray, torque: float, dt: float) -> FloatArray:
        """Return the state ``dt`` later without a strike (Runge and Kutta's classical step)."""
        a = self._rate(x, torque)
        b = self._rate(x + 0.5 * dt * a, torque)
        c = self._rate(x + 0.5 * dt * b, torque)
        d = self._rate(x + dt * c, torque)
        return np.asarray(x + dt / 6.0 * (a + 2 * b + 2 * c + d))

    def _rate(self, x: FloatArray, torque: float) -> FloatArray:
        """Return the derivative of the state."""
        p, g = self.true_parameters, self._gravity
        m, hip, a, b = p["m"], p["m_hip"], p["a"], p["b"]
        length, (stance, swing, v, w) = a + b, x.tolist()
        c, s = math.cos(stance - swing), math.sin(stance - swing)
        mass = m * b * b, -m * length * b * c, hip * length**2 + m * (length**2 + a * a)
        right_swing = torque - m * length * b * s * v * v - m * b * g * math.sin(swing)
        right_stance = -torque + m * length * b * s * w * w + (hip * length + m * a + m * length) * g * math.sin(stance)
        det = mass[0] * mass[2] - mass[1] ** 2
        return np.array(
            [
                v,
                w,
                (mass[0] * right_stance - mass[1] * right_swing) / det,
                (mass[2] * right_swing - mass[1] * right_stance) / det,
            ]
        )
