"""A compass gait in pymunk: its feet meet a slope, and what the impact does is left to the engine."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from harness.errors import PlantError
from harness.signals import Channel, FloatArray
from plants.checking import positive, positives
from plants.pymunk.plant import PymunkPlant, State, mechanism_spec, point_mass_pole, put

FOOT = 1e-4  # Radius of a foot [m]: a point for the walker, which rolls by this times an angle.

FLOOR = 1.0  # Half of the thickness of the slope [m]: a foot is never through it.

REACH = 1000.0  # Half of the length of the slope [m].


class PymunkCompassGait(PymunkPlant):
    """A compass gait (Goswami, Thuilot & Espiau 1998, *Int. J. Robotics Research* 17, sec. 2) on the engine's contacts.

    Two legs, each with a mass and half of the hip's, are pinned at the hip. A foot in front that comes down hits the
    slope without restitution and does not slip; from there on it is the stance foot, and the legs change names.
    ``stance`` and ``swing`` are angles from the vertical, positive with the foot ahead of the hip; the input is a
    torque at the hip that swings one leg forward against the other. Scuffing in mid-swing is ignored, as usual: a foot
    meets the slope only once it has been above it in front.

    Parameters
    ----------
    m, m_hip : float
        Masses of a leg and of the hip [kg].
    a, b : float
        From the foot to the leg's mass, and from there to the hip [m].
    slope : float
        Of the ground [rad].
    **engine
        The others are those of every plant in pymunk: :class:`plants.pymunk.plant.PymunkPlant`.

    Examples
    --------
    >>> print(PymunkCompassGait().spec)
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
        sample_time: float = 0.01,
        substeps: int = 100,
        gravity: float = 9.81,
        u_limit: float = 0.5,
        outputs: Sequence[str] | None = ("stance", "swing", "stance_rate", "swing_rate"),
    ) -> None:
        self.true_parameters = positives(m=m, m_hip=m_hip, a=a, b=b)
        self.slope, self._gravity = positive("slope", slope, zero=True), positive("gravity", gravity)
        self._length = a + b
        self._mass, self._centre, self._inertia = point_mass_pole(m, b, m_hip / 2)
        angles = (Channel("stance", "rad"), Channel("swing", "rad"))
        spec = mechanism_spec(angles, "N m", u_limit, sample_time)
        # just after a strike of its limit cycle at 3 degrees
        super().__init__(spec, substeps, [0.2187, -0.3234, -1.0918, -0.3772], outputs)

    def truth(self) -> FloatArray:
        """Return the angles and rates of stance and swing leg (4,)."""
        self._need_open()
        stance, swing = self._bodies
        return np.array([stance.angle, swing.angle, stance.angular_velocity, swing.angular_velocity])

    def _bodies_at(self, values: Sequence[float]) -> State:
        """Return the state of stance and swing leg, the stance foot at the origin."""
        stance, swing, stance_rate, swing_rate = values
        hip = -self._length * math.sin(stance), self._length * math.cos(stance)
        rate = -self._length * math.cos(stance) * stance_rate, -self._length * math.sin(stance) * stance_rate
        legs: list[float] = []
        for angle, turns in ((stance, stance_rate), (swing, swing_rate)):
            along, up = self._centre * math.sin(angle), self._centre * math.cos(angle)
            legs += [hip[0] + along, hip[1] - up, rate[0] + up * turns, rate[1] + along * turns, angle, turns]
        return tuple(legs)

    def _place(self, state: State) -> None:
        """Build the space from the state of the legs, the stance leg first."""
        import pymunk

        space = pymunk.Space()
        space.gravity = (0.0, -self._gravity)
        space.collision_slop, space.iterations = 1e-7, 40
        ground, (down, along) = space.static_body, (math.sin(self.slope), math.cos(self.slope))
        above, below = ((side * along - FLOOR * down, -side * down - FLOOR * along) for side in (-REACH, REACH))
        floor = pymunk.Segment(ground, above, below, FLOOR)  # its upper face passes through the origin
        floor.friction = 1.0
        legs = [put(pymunk.Body(self._mass, self._inertia), state[6 * k : 6 * k + 6]) for k in range(2)]
        self._feet = {}
        self._never = pymunk.ShapeFilter(mask=0)
        self._meets = pymunk.ShapeFilter(group=1)  # the slope, and never the other foot
        for leg in legs:
            foot = pymunk.Circle(leg, FOOT, (0.0, self._centre - self._length + FOOT))
            foot.friction, foot.elasticity, foot.filter = 1e3, 0.0, self._meets
            self._feet[leg] = foot
            space.add(leg, foot)
        hip = pymunk.PivotJoint(*legs, (0.0, self._centre), (0.0, self._centre))
        hip.error_bias = 0.0
        space.add(floor, hip)
        self._space, self._bodies, self._armed = space, (legs[0], legs[1]), False
        self._feet[legs[1]].filter = self._never

    def _advance(self, value: float) -> None:
        """Hold a torque for one sample."""
        step, dt = self._space.step, self._dt
        for _ in range(self._substeps):
            stance, swing = self._bodies
            if not self._armed and swing.angle > stance.angle and self._height() > 0.0:
                self._armed, self._feet[swing].filter = True, self._meets
            stance.torque, swing.torque = -value, value
            step(dt)
            if self._armed and self._struck(swing):
                self._bodies, self._armed = (swing, stance), False
                self._feet[stance].filter = self._never
        if max(abs(leg.angle) for leg in self._bodies) > 0.5 * math.pi:
            raise PlantError("the walker has fallen over", status="diverged")

    def _height(self) -> float:
        """Return how far the swing foot is above the stance foot, across the slope [m]."""
        stance, swing = (math.cos(leg.angle + self.slope) for leg in self._bodies)
        return self._length * (stance - swing)

    def _struck(self, leg: Any) -> bool:
        """Return whether the engine has a contact of a foot with the slope."""
        met: list[Any] = []
        leg.each_arbiter(met.append)
        return bool(met)

    def _read(self) -> FloatArray:
        """Return the angles of both legs."""
        return np.array([leg.angle for leg in self._bodies])
