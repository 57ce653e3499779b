"""Cart-pole in pymunk (Chipmunk): a cart on a rail, a pole on a pin, and constraints that can hide an effect."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from harness.signals import Channel, FloatArray
from plants.checking import positive, positives
from plants.pymunk.plant import PymunkPlant, State, mechanism_spec, point_mass_pole, put

FAR = 1e3  # Half length of the rail without end stops [m].


class PymunkCartPole(PymunkPlant):
    """Cart with a hanging point-mass pole in pymunk; theta is absolute, 0 hangs down.

    The pole's body is that of :func:`plants.pymunk.plant.point_mass_pole`: exactly the point mass, well-conditioned.
    With ``error_bias = 0`` (position errors are corrected at once) the error falls with the first power of the step;
    ``benchmarks/bench_engines.py`` prints its size.

    Every hidden effect is somebody else's code: a constraint of Chipmunk.

    Parameters
    ----------
    mc, mp, l : float
        Cart's mass [kg], pole's mass [kg], pole's length [m].
    bx, btheta : float
        Viscous friction of the cart [N s/m] (a damped spring without stiffness) and of the pole [N m s/rad] (a
        damped rotary spring).
    spring_x, spring_theta : float
        Stiffness of a spring between rail and cart [N/m] and between rail and pole [N m/rad], at rest at 0.
    friction_x, friction_theta : float
        Dry friction of the cart [N] and of the pin [N m] (velocity constraints with bounded force).
    stop_x, stop_theta : float, optional
        End stops at plus and minus these positions [m, rad].
    slack : float
        Play of the pin along the rail [m]: the pole hangs on a short groove of this length in the cart. The mass
        lent to the pole (half the cart's, at most the pole's) then rides on the pin instead of the cart.
    **engine
        The others are those of every plant in pymunk: :class:`plants.pymunk.plant.PymunkPlant`.

    Examples
    --------
    >>> with PymunkCartPole() as plant:
    ...     start = plant.reset(rng=np.random.default_rng(0), x0={"theta": 0.1})
    ...     y = plant.step(np.array([1.0]))
    >>> print(plant.spec)
    u [N] -> x [m], theta [rad] every 0.01 s
    """

    def __init__(
        self,
        *,
        mc: float = 1.0,
        mp: float = 0.2,
        l: float = 0.5,  # noqa: E741 - the length's name in the equations and in the model
        bx: float = 0.2,
        btheta: float = 0.005,
        sample_time: float = 0.01,
        substeps: int = 20,
        gravity: float = 9.81,
        spring_x: float = 0.0,
        spring_theta: float = 0.0,
        friction_x: float = 0.0,
        friction_theta: float = 0.0,
        stop_x: float | None = None,
        stop_theta: float | None = None,
        slack: float = 0.0,
        u_limit: float = 10.0,
        outputs: Sequence[str] | None = None,
    ) -> None:
        self.true_parameters = positives(mc=mc, mp=mp, l=l) | positives(bx=bx, btheta=btheta, zero=True)
        self._hidden = positives(spring_x=spring_x, spring_theta=spring_theta, slack=slack, zero=True)
        self._hidden |= positives(friction_x=friction_x, friction_theta=friction_theta, zero=True)
        self._stop_x = FAR if stop_x is None else positive("stop_x", stop_x)
        self._stop_theta = None if stop_theta is None else positive("stop_theta", stop_theta)
        self._gravity = positive("gravity", gravity, zero=True)
        spec = mechanism_spec((Channel("x", "m"), Channel("theta", "rad")), "N", u_limit, sample_time)
        if slack:
            slip = (Channel("slip", "m", -slack / 2, slack / 2), Channel("slip_rate", "m/s"))
            spec = replace(spec, states=(*spec.states, *slip))
        # Any share works (measured: 0.1 to 0.5 of the cart change the error by a few percent of itself).
        self._moved = min(mp, mc / 2)
        self._body_mass, self._centre, self._inertia = point_mass_pole(mp, l, self._moved)
        super().__init__(spec, substeps, [0.0] * len(spec.states), outputs)

    def truth(self) -> FloatArray:
        """Return x, theta, x_rate, theta_rate and, with slack, slip and slip_rate of the pin."""
        self._need_open()
        cart, pole = self._bodies
        values = [cart.position.x, pole.angle, cart.velocity.x, pole.angular_velocity]
        if self._hidden["slack"]:
            arm = self._centre
            values.append(pole.position.x - arm * math.sin(pole.angle) - values[0])
            values.append(pole.velocity.x - arm * math.cos(pole.angle) * pole.angular_velocity - values[2])
        return np.array(values)

    def _read(self) -> FloatArray:
        """Return x and theta."""
        cart, pole = self._bodies
        return np.array((cart.position[0], pole.angle))

    def _bodies_at(self, values: Sequence[float]) -> State:
        """Return the state of cart and pole."""
        x, theta, x_rate, theta_rate, *slip = values
        offset, offset_rate = slip or (0.0, 0.0)
        arm, sine, cosine = self._centre, math.sin(theta), math.cos(theta)
        pole = (x + offset + arm * sine, -arm * cosine)
        pole_rate = (x_rate + offset_rate + arm * cosine * theta_rate, arm * sine * theta_rate)
        return (x, 0.0, x_rate, 0.0, 0.0, 0.0, *pole, *pole_rate, theta, theta_rate)

    def _place(self, state: State) -> None:
        """Build the space from the state of cart and pole."""
        import pymunk

        p, hidden = self.true_parameters, self._hidden
        space = pymunk.Space()
        space.gravity = (0.0, -self._gravity)
        cart = put(pymunk.Body(p["mc"] - self._moved, math.inf), state[:6])
        pole = put(pymunk.Body(self._body_mass, self._inertia), state[6:])
        rail, hang = space.static_body, (0.0, self._centre)
        joints: list[pymunk.Constraint] = [
            pymunk.GrooveJoint(rail, cart, (-self._stop_x, 0.0), (self._stop_x, 0.0), (0.0, 0.0))
        ]
        if hidden["slack"]:
            half = hidden["slack"] / 2
            joints.append(pymunk.GrooveJoint(cart, pole, (-half, 0.0), (half, 0.0), hang))
        else:
            joints.append(pymunk.PivotJoint(cart, pole, (0.0, 0.0), hang))
        if p["bx"] or hidden["spring_x"]:
            joints.append(pymunk.DampedSpring(rail, cart, (-FAR, 0.0), (0.0, 0.0), FAR, hidden["spring_x"], p["bx"]))
        if p["btheta"] or hidden["spring_theta"]:
            joints.append(pymunk.DampedRotarySpring(rail, pole, 0.0, hidden["spring_theta"], p["btheta"]))
        if self._stop_theta is not None:
            joints.append(pymunk.RotaryLimitJoint(rail, pole, -self._stop_theta, self._stop_theta))
        for joint in joints:
            joint.error_bias = 0.0
        if hidden["friction_theta"]:
            motor = pymunk.SimpleMotor(rail, pole, 0.0)
            motor.max_force = hidden["friction_theta"]
            joints.append(motor)
        if hidden["friction_x"]:
            # A groove across the rail, too weak to hold: it resists motion along the rail and takes no load.
            brake = pymunk.GrooveJoint(rail, cart, (0.0, -FAR), (0.0, FAR), (0.0, 0.0))
            brake.max_force, brake.max_bias = hidden["friction_x"], 0.0
            joints.append(brake)
        space.add(cart, pole, *joints)
        self._space, self._bodies = space, (cart, pole)
