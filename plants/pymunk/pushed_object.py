"""An object that a fingertip pushes over a table and turns, in pymunk: two frictions, the contact force measured."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from harness.protocols import Ability
from harness.signals import Channel, FloatArray
from plants.checking import checked_inputs, positive, positives, refuse_input, refuse_option
from plants.pymunk.plant import PymunkPlant, State, mechanism_spec, put

HALF = 0.05  # Half the side of the square object [m].

TIP = 0.01  # Radius of the fingertip [m].

FOOT = 0.035  # The object stands on four feet, each so far from its middle along both sides [m].

_STIFFNESS, _DAMPING = 400.0, 40.0
"""With which the finger follows the place it aims at across its push [N/m, N s/m]: critically damped for 1 kg."""

_CREEP = 2.5e-3  # Speed [m/s] below which the friction of a foot falls to nothing, so that steps of 0.25 ms are stable.

_FEET = tuple((i, j) for i in (-1, 1) for j in (-1, 1))


class PymunkPushedObject(PymunkPlant):
    """A square object on four feet, seen from above; a round fingertip pushes it along x, and turns it by aiming aside.

    ``u`` drives the finger along x; across, a servo holds it at ``aim`` beside the middle of the object. Nothing moves
    the object but the contact: a force with friction between tip and side (``mu_tip``: the tip sticks within the
    friction cone, or slides on its edge), measured as the mean over the sample that has passed, and Coulomb friction
    under every foot (``mu`` times its share of the weight), which opposes sliding and turning together. The contact is
    Chipmunk's; the feet are computed here, as joints of Chipmunk with a greatest force do not slip against their own
    motion but as far as 20 degrees beside it. It starts at rest before the finger.

    Under a push below the friction it creeps by up to 2.5 mm/s.

    Parameters
    ----------
    m : float
        Mass of the object [kg].
    J : float, optional
        Moment of inertia about its centre of mass [kg m^2]; that of an even square plate by default.
    com_x, com_y : float
        Place of its centre of mass from its middle, along its sides [m]; the feet share the weight accordingly.
    mu : float
        Coefficient of friction between feet and table.
    mu_tip : float
        Coefficient of friction between tip and object.
    pusher : float
        Mass of the finger [kg].
    damping : float
        Viscous friction of its drive [N s/m].
    gap : float
        Between tip and object at the start [m].
    **engine
        The others are those of every plant in pymunk: :class:`plants.pymunk.plant.PymunkPlant`.

    Raises
    ------
    InputError
        If an option is out of range, or the centre of mass does not lie between the feet.

    Examples
    --------
    >>> print(PymunkPushedObject().spec)
    u [N], aim [m] -> x [m], y [m], theta [rad], x_pusher [m], y_pusher [m], fx [N], fy [N] every 0.01 s
    """

    def __init__(
        self,
        *,
        m: float = 2.0,
        J: float | None = None,
        com_x: float = 0.0,
        com_y: float = 0.0,
        mu: float = 0.4,
        mu_tip: float = 0.3,
        pusher: float = 1.0,
        damping: float = 5.0,
        gap: float = 0.01,
        sample_time: float = 0.01,
        substeps: int = 40,
        u_limit: float = 30.0,
        aim_limit: float = 0.02,
    ) -> None:
        mass = positive("m", m)
        for name, value in (("com_x", com_x), ("com_y", com_y)):
            refuse_option(name, value, abs(value) < FOOT, f"less than {FOOT:g} m: between the feet")
        self.true_parameters = positives(m=m, J=2.0 * mass * HALF**2 / 3.0 if J is None else J, pusher=pusher)
        self.true_parameters |= {"com_x": float(com_x), "com_y": float(com_y)}
        self.true_parameters |= positives(mu=mu, mu_tip=mu_tip, damping=damping, zero=True)
        aside = positive("aim_limit", aim_limit)
        units = {"x": "m", "y": "m", "theta": "rad", "x_pusher": "m", "y_pusher": "m"}
        spec = mechanism_spec([Channel(name, unit) for name, unit in units.items()], "N", u_limit, sample_time)
        inputs = (*spec.inputs, Channel("aim", "m", -aside, aside))
        spec = replace(spec, inputs=inputs, outputs=(*spec.outputs, Channel("fx", "N"), Channel("fy", "N")))
        start = [positive("gap", gap, zero=True) + HALF + TIP, 0.0, 0.0, *([0.0] * 7)]
        self._force = np.zeros(2)
        self._middle = (-float(com_x), -float(com_y))
        self._feet = [
            (
                i * FOOT - com_x,
                j * FOOT - com_y,
                0.25 * (1 + i * com_x / FOOT) * (1 + j * com_y / FOOT) * mu * mass * 9.81,
            )
            for i, j in _FEET
        ]
        super().__init__(spec, substeps, start, None)

    @property
    def abilities(self) -> frozenset[Ability]:
        """Batch and truth; no snapshots: what Chipmunk keeps of a contact cannot be read."""
        return frozenset({"batch", "truth"})

    def step(self, u: FloatArray) -> FloatArray:
        """Hold ``u`` (2,) for one sample time; returns the next output (7,); raises as :class:`PymunkPlant` does."""
        self._need_open()
        if not (isinstance(u, np.ndarray) and u.shape == (2,) and np.isfinite(u).all()):
            refuse_input(u, self.spec)
        self._hold(*u.tolist())
        return self._read()

    def rollout(self, inputs: FloatArray) -> FloatArray:
        """Apply ``inputs`` (N, 2) from the present state; row k of the result (N, 7) is what ``step`` returned."""
        self._need_open()
        outputs = np.empty((len(inputs), self.spec.ny))
        for k, (push, aim) in enumerate(checked_inputs(inputs, self.spec).tolist()):
            self._hold(push, aim)
            outputs[k] = self._read()
        return outputs

    def truth(self) -> FloatArray:
        """Return x, y, theta of the object's middle, x and y of the finger, and their rates (10,)."""
        self._need_open()
        block, tip = self._bodies
        middle = block.local_to_world(self._middle)
        rate = block.velocity_at_local_point(self._middle)
        return np.array([
            *middle, block.angle, *tip.position, *rate, block.angular_velocity, *tip.velocity,
        ])  # fmt: skip

    def _bodies_at(self, values: Sequence[float]) -> State:
        """Return the states of object and finger."""
        x, y, theta, px, py, vx, vy, rate, pvx, pvy = values
        return (x, y, vx, vy, theta, rate, px, py, pvx, pvy, 0.0, 0.0)

    def _place(self, state: State) -> None:
        """Build the space from the states of the middle of the object and of the finger."""
        import pymunk

        p = self.true_parameters
        space = pymunk.Space()
        space.collision_slop, space.collision_bias = 0.0, 0.0
        # a contact that opens for a step is forgotten: Chipmunk would keep its impulse without applying it, and allow
        # friction of the kept one, far outside the cone
        space.collision_persistence = 1
        # moments, feet and sides are given about the centre of mass, where Chipmunk has the origin of a body
        com = (p["com_x"], p["com_y"])
        c, s = math.cos(state[4]), math.sin(state[4])
        arm = (c * com[0] - s * com[1], s * com[0] + c * com[1])
        moved = (state[0] + arm[0], state[1] + arm[1], state[2] - state[5] * arm[1], state[3] + state[5] * arm[0])
        block = put(pymunk.Body(p["m"], p["J"]), (*moved, *state[4:6]))
        tip = put(pymunk.Body(p["pusher"], math.inf), state[6:])
        corners = [(i * HALF - com[0], j * HALF - com[1]) for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        side, end = pymunk.Poly(block, corners), pymunk.Circle(tip, TIP)
        side.friction, end.friction = p["mu_tip"], 1.0
        space.add(block, tip, side, end)
        self._space, self._bodies = space, (block, tip)
        self._force = np.zeros(2)

    def _advance(self, value: float) -> None:
        """Hold a push, aimed at the middle, for one sample."""
        self._hold(value, 0.0)

    def _hold(self, push: float, aim: float) -> None:
        """Hold push and aim for one sample, and add up what the contact passes on."""
        (block, tip), step, dt = self._bodies, self._space.step, self._dt
        mass, damping = self.true_parameters["pusher"], self.true_parameters["damping"]
        passed = np.zeros(2)
        for _ in range(self._substeps):
            before = tip.velocity
            across = block.local_to_world(self._middle)[1] + aim - tip.position.y
            drive = (push - damping * before.x, _STIFFNESS * across - _DAMPING * before.y)
            tip.force = drive
            block.force, block.torque = self._friction(block)
            step(dt)
            # what the finger did not keep it gave to the object
            passed += np.array(drive) * dt - mass * np.array([*(tip.velocity - before)])
        self._force = passed / self._spec.sample_time

    def _friction(self, block: Any) -> tuple[tuple[float, float], float]:
        """Return force and torque about the centre of mass of the friction under the feet."""
        (vx, vy), rate, angle = block.velocity, block.angular_velocity, block.angle
        c, s = math.cos(angle), math.sin(angle)
        fx = fy = torque = 0.0
        for along, across, level in self._feet:
            ax, ay = c * along - s * across, s * along + c * across
            px, py = vx - rate * ay, vy + rate * ax
            slope = -level / max(math.hypot(px, py), _CREEP)
            fx, fy = fx + slope * px, fy + slope * py
            torque += slope * (ax * py - ay * px)
        return (fx, fy), torque

    def _read(self) -> FloatArray:
        """Return places, angle and the contact force."""
        return np.array([*self.truth()[:5], *self._force])
