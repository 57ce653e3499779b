"""Ball on a beam in pymunk: a rolling contact."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from harness.errors import InputError
from harness.signals import Channel, FloatArray
from plants.checking import positive, positives
from plants.pymunk.plant import PymunkPlant, State, mechanism_spec, pin_forces, put


class PymunkBallBeam(PymunkPlant):
    """A ball rolls on a beam that turns about its middle; the input is the torque on the beam.

    While the ball rolls without slipping on a beam that is held at the angle alpha, it accelerates by
    ``g sin(alpha) / (1 + k)``, where ``k = ball_inertia / (m radius^2)`` is 2/5 for a solid ball. The outputs are the
    ball's position along the beam (its centre, from the middle) and the beam's angle, positive counterclockwise: a
    positive angle makes the ball roll towards negative r.

    Parameters
    ----------
    m, radius : float
        The ball's mass [kg] and radius [m]; its inertia is that of a solid ball.
    inertia : float
        The beam's inertia about its pin [kg m^2].
    b : float
        Viscous friction of the pin [N m s/rad].
    friction : float
        Coefficient of the contact: the ball slips beyond it.
    spring : float
        Stiffness of a rotary spring on the pin [N m/rad].
    dry : float
        Dry friction of the pin [N m].
    length : float
        Of the beam [m]; beyond its ends the ball falls.
    **engine
        The others are those of every plant in pymunk: :class:`plants.pymunk.plant.PymunkPlant`.

    Examples
    --------
    >>> print(PymunkBallBeam().spec)
    u [N m] -> r [m], alpha [rad] every 0.01 s
    """

    snapshot_tolerance = 1e-3
    """Wider than for plants without contacts: measured 3e-13 while the ball rolls, 1.4e-4 where it leaves the beam."""

    def __init__(
        self,
        *,
        m: float = 0.1,
        radius: float = 0.02,
        inertia: float = 0.02,
        b: float = 0.05,
        friction: float = 0.8,
        spring: float = 0.0,
        dry: float = 0.0,
        length: float = 2.0,
        sample_time: float = 0.01,
        substeps: int = 20,
        gravity: float = 9.81,
        u_limit: float = 0.5,
        outputs: Sequence[str] | None = None,
    ) -> None:
        self.true_parameters = positives(m=m, radius=radius, inertia=inertia)
        self.true_parameters |= positives(b=b, friction=friction, zero=True)
        self._spring, self._dry = positive("spring", spring, zero=True), positive("dry", dry, zero=True)
        self._length, self._gravity = positive("length", length), positive("gravity", gravity, zero=True)
        if length <= 4 * radius:
            raise InputError(
                "length of the beam", expected="more than two balls", got=f"{length:g} m", remedy="lengthen it"
            )
        spec = mechanism_spec((Channel("r", "m"), Channel("alpha", "rad")), "N m", u_limit, sample_time)
        super().__init__(spec, substeps, [0.0] * 4, outputs)

    def truth(self) -> FloatArray:
        """Return r, alpha and their rates (4,)."""
        self._need_open()
        beam, ball = self._bodies
        x, y = ball.position
        vx, vy = ball.velocity
        cosine, sine, w = math.cos(beam.angle), math.sin(beam.angle), beam.angular_velocity
        # r = e . p with e = (cos, sin); its rate has a part from the turning of e.
        r_rate = vx * cosine + vy * sine + w * (y * cosine - x * sine)
        return np.array([x * cosine + y * sine, beam.angle, r_rate, w])

    def _bodies_at(self, values: Sequence[float]) -> State:
        """Return the state of beam and ball, rolling."""
        r, alpha, r_rate, alpha_rate = values
        cosine, sine, high = math.cos(alpha), math.sin(alpha), self.true_parameters["radius"]
        x, y = r * cosine - high * sine, r * sine + high * cosine
        vx, vy = r_rate * cosine - alpha_rate * y, r_rate * sine + alpha_rate * x
        return (0.0, 0.0, 0.0, 0.0, alpha, alpha_rate, x, y, vx, vy, -r / high, alpha_rate - r_rate / high)

    def _place(self, state: State) -> None:
        """Build the space from the state of beam and ball."""
        import pymunk

        p = self.true_parameters
        space = pymunk.Space()
        space.gravity = (0.0, -self._gravity)
        space.collision_slop = 1e-6  # Chipmunk's default of 0.1 is for pixels
        space.collision_bias = 1e-12
        beam = put(pymunk.Body(1.0, p["inertia"]), state[:6])
        ball = put(pymunk.Body(p["m"], 0.4 * p["m"] * p["radius"] ** 2), state[6:])
        half = self._length / 2
        surface = pymunk.Poly(beam, [(-half, 0.0), (half, 0.0), (half, -0.02), (-half, -0.02)])
        round_shape = pymunk.Circle(ball, p["radius"])
        for shape in (surface, round_shape):
            shape.friction, shape.elasticity = math.sqrt(p["friction"]), 0.0  # Chipmunk multiplies the two
        pin = pymunk.PivotJoint(space.static_body, beam, (0.0, 0.0), (0.0, 0.0))
        joints = [pin, *pin_forces(space.static_body, beam, spring=self._spring, damping=p["b"], dry=self._dry)]
        for joint in joints:
            joint.error_bias = 0.0
        space.add(beam, ball, surface, round_shape, *joints)
        self._space, self._bodies = space, (beam, ball)

    def _advance(self, value: float) -> None:
        """Hold a torque on the beam for one sample."""
        beam, step, dt = self._bodies[0], self._space.step, self._dt
        for _ in range(self._substeps):
            beam.torque = value
            step(dt)

    def _read(self) -> FloatArray:
        """Return r and alpha."""
        beam, ball = self._bodies
        (x, y), alpha = ball.position, beam.angle
        return np.array((x * math.cos(alpha) + y * math.sin(alpha), alpha))
