"""Cart with two poles in series in pymunk."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from harness.signals import Channel, FloatArray
from plants.checking import positive, positives
from plants.pymunk.plant import PymunkPlant, State, mechanism_spec, pin_forces, point_mass_pole, put

FAR = 1e3  # Half length of the rail [m].


class PymunkDoubleCartPole(PymunkPlant):
    """Cart with a double pendulum of point masses; both angles are absolute, 0 hangs down.

    Parameters
    ----------
    mc, mp1, mp2 : float
        Masses of the cart and of the two points [kg].
    l1, l2 : float
        Lengths of the poles [m].
    bx, b1, b2 : float
        Viscous friction of the cart [N s/m], of the first and of the second joint [N m s/rad].
    friction_1, friction_2 : float
        Dry friction of the joints [N m].
    **engine
        The others are those of every plant in pymunk: :class:`plants.pymunk.plant.PymunkPlant`.

    Examples
    --------
    >>> print(PymunkDoubleCartPole().spec)
    u [N] -> x [m], theta1 [rad], theta2 [rad] every 0.01 s
    """

    def __init__(
        self,
        *,
        mc: float = 1.0,
        mp1: float = 0.2,
        mp2: float = 0.1,
        l1: float = 0.5,
        l2: float = 0.4,
        bx: float = 0.2,
        b1: float = 0.005,
        b2: float = 0.002,
        friction_1: float = 0.0,
        friction_2: float = 0.0,
        sample_time: float = 0.01,
        substeps: int = 20,
        gravity: float = 9.81,
        u_limit: float = 10.0,
        outputs: Sequence[str] | None = None,
    ) -> None:
        self.true_parameters = positives(mc=mc, mp1=mp1, mp2=mp2, l1=l1, l2=l2)
        self.true_parameters |= positives(bx=bx, b1=b1, b2=b2, zero=True)
        self._dry = tuple(positives(friction_1=friction_1, friction_2=friction_2, zero=True).values())
        self._gravity = positive("gravity", gravity, zero=True)
        # Each pole borrows mass at its pin from the body that carries it; see point_mass_pole.
        from_first, from_cart = min(mp2, mp1 / 2), min(mp1, mc / 2)
        outer = point_mass_pole(mp2, l2, from_first)
        inner = point_mass_pole(mp1 - from_first, l1, from_cart)
        self._cart_mass, self._poles = mc - from_cart, (inner, outer)
        places = (Channel("x", "m"), Channel("theta1", "rad"), Channel("theta2", "rad"))
        spec = mechanism_spec(places, "N", u_limit, sample_time)
        super().__init__(spec, substeps, [0.0] * 6, outputs)

    def truth(self) -> FloatArray:
        """Return x, theta1, theta2 and their rates (6,)."""
        self._need_open()
        cart, inner, outer = self._bodies
        positions = (cart.position.x, inner.angle, outer.angle)
        return np.array([*positions, cart.velocity.x, inner.angular_velocity, outer.angular_velocity])

    def _bodies_at(self, values: Sequence[float]) -> State:
        """Return the state of cart and poles."""
        x, theta1, theta2, v, w1, w2 = values
        state = [x, 0.0, v, 0.0, 0.0, 0.0]
        pin, pin_rate = (x, 0.0), (v, 0.0)
        lengths = self.true_parameters["l1"], self.true_parameters["l2"]
        for angle, rate, (_, centre, _), length in zip((theta1, theta2), (w1, w2), self._poles, lengths, strict=True):
            sine, cosine = math.sin(angle), math.cos(angle)
            state += [pin[0] + centre * sine, pin[1] - centre * cosine]
            state += [pin_rate[0] + centre * cosine * rate, pin_rate[1] + centre * sine * rate, angle, rate]
            pin = (pin[0] + length * sine, pin[1] - length * cosine)
            pin_rate = (pin_rate[0] + length * cosine * rate, pin_rate[1] + length * sine * rate)
        return tuple(state)

    def _place(self, state: State) -> None:
        """Build the space from the state of cart and poles."""
        import pymunk

        p = self.true_parameters
        (m1, centre1, inertia1), (m2, centre2, inertia2) = self._poles
        space = pymunk.Space()
        space.gravity = (0.0, -self._gravity)
        space.iterations = 30  # two pins in series converge more slowly than one
        cart = put(pymunk.Body(self._cart_mass, math.inf), state[:6])
        inner = put(pymunk.Body(m1, inertia1), state[6:12])
        outer = put(pymunk.Body(m2, inertia2), state[12:])
        rail = space.static_body
        joints: list[pymunk.Constraint] = [
            pymunk.GrooveJoint(rail, cart, (-FAR, 0.0), (FAR, 0.0), (0.0, 0.0)),
            pymunk.PivotJoint(cart, inner, (0.0, 0.0), (0.0, centre1)),
            pymunk.PivotJoint(inner, outer, (0.0, centre1 - p["l1"]), (0.0, centre2)),
        ]
        if p["bx"]:
            joints.append(pymunk.DampedSpring(rail, cart, (-FAR, 0.0), (0.0, 0.0), FAR, 0.0, p["bx"]))
        for body, other, damping, dry in (
            (cart, inner, p["b1"], self._dry[0]),
            (inner, outer, p["b2"], self._dry[1]),
        ):
            joints += pin_forces(body, other, spring=0.0, damping=damping, dry=dry)
        for joint in joints:
            joint.error_bias = 0.0
        space.add(cart, inner, outer, *joints)
        self._space, self._bodies = space, (cart, inner, outer)

    def _read(self) -> FloatArray:
        """Return x, theta1, theta2."""
        cart, inner, outer = self._bodies
        return np.array((cart.position[0], inner.angle, outer.angle))
