"""A block that a pusher slides over a table, in pymunk: contact with friction, and the contact force measured."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from harness.protocols import Ability
from harness.signals import Channel, FloatArray
from plants.checking import positive, positives
from plants.pymunk.plant import PymunkPlant, State, mechanism_spec, put

HALF = 0.05  # Half the side of the block and of the pusher [m]: their centres are this far from the faces that touch.


class PymunkPushedBlock(PymunkPlant):
    """A passive block on a table; a pusher on a rail, driven by a force, meets it and pushes it, never pulls it.

    The block slides with Coulomb friction on the table (Chipmunk's contact, friction ``mu`` and gravity); nothing
    drives it but the contact, whose force is measured as the mean over the sample that has passed. So
    ``m x'' = f - mu m g sgn(x')``, in which mass and friction are told apart only by the measured force f: scaled
    together they move the block alike (Fazeli et al. 2017, Int. J. Robotics Res. 36(13-14):1437).

    Under a push below the friction the block creeps by about 1 mm/s: so Chipmunk takes overlaps away.

    Parameters
    ----------
    m : float
        Mass of the block [kg].
    mu : float
        Coefficient of friction between block and table.
    pusher : float
        Mass of the pusher [kg].
    damping : float
        Viscous friction of the pusher's rail [N s/m].
    gap : float
        Between pusher and block at the start [m].
    **engine
        The others are those of every plant in pymunk: :class:`plants.pymunk.plant.PymunkPlant`.

    Examples
    --------
    >>> print(PymunkPushedBlock().spec)
    u [N] -> x [m], x_pusher [m], f [N] every 0.01 s
    """

    def __init__(
        self,
        *,
        m: float = 2.0,
        mu: float = 0.4,
        pusher: float = 1.0,
        damping: float = 5.0,
        gap: float = 0.01,
        sample_time: float = 0.01,
        substeps: int = 20,
        u_limit: float = 30.0,
    ) -> None:
        self.true_parameters = positives(m=m, pusher=pusher) | positives(mu=mu, damping=damping, zero=True)
        start = positive("gap", gap, zero=True)
        spec = mechanism_spec((Channel("x", "m"), Channel("x_pusher", "m")), "N", u_limit, sample_time)
        spec = replace(spec, outputs=(*spec.outputs, Channel("f", "N")))
        self._force = 0.0
        super().__init__(spec, substeps, [start, 0.0, 0.0, 0.0], None)

    @property
    def abilities(self) -> frozenset[Ability]:
        """Batch and truth; no snapshots: what Chipmunk keeps of a contact cannot be read."""
        return frozenset({"batch", "truth"})

    def truth(self) -> FloatArray:
        """Return x, x_pusher and their rates (4,)."""
        self._need_open()
        block, pusher = self._bodies
        return np.array([block.position.x, pusher.position.x + 2 * HALF, block.velocity.x, pusher.velocity.x])

    def _bodies_at(self, values: Sequence[float]) -> State:
        """Return the states of block and pusher."""
        x, y, rate, push_rate = values
        return (x, 0.0, rate, 0.0, 0.0, 0.0, y - 2 * HALF, 0.0, push_rate, 0.0, 0.0, 0.0)

    def _place(self, state: State) -> None:
        """Build the space from the states of block and pusher."""
        import pymunk

        p = self.true_parameters
        space = pymunk.Space()
        space.gravity = (0.0, -9.81)
        space.collision_slop, space.collision_bias = 0.0, 0.0
        table = pymunk.Segment(space.static_body, (-1000.0, -HALF - 1.0), (1000.0, -HALF - 1.0), 1.0)
        table.friction = 1.0
        block = put(pymunk.Body(p["m"], math.inf), state[:6])
        pusher = put(pymunk.Body(p["pusher"], math.inf), state[6:])
        faces = [pymunk.Poly.create_box(body, (2 * HALF, 2 * HALF)) for body in (block, pusher)]
        faces[0].friction = p["mu"]
        # the pusher hangs on its rail and glides along the block's face without friction of its own
        rail = pymunk.GrooveJoint(space.static_body, pusher, (-1000.0, 0.0), (1000.0, 0.0), (0.0, 0.0))
        faces[1].friction = 0.0
        faces[1].filter = pymunk.ShapeFilter(categories=2)
        table.filter = pymunk.ShapeFilter(mask=pymunk.ShapeFilter.ALL_MASKS() ^ 2)
        space.add(table, block, pusher, *faces, rail)
        self._space, self._bodies = space, (block, pusher)
        self._force = 0.0

    def _advance(self, value: float) -> None:
        """Hold a force on the pusher for one sample, and add up what the contact passes on."""
        (_, pusher), step, dt = self._bodies, self._space.step, self._dt
        mass, damping, passed = self.true_parameters["pusher"], self.true_parameters["damping"], 0.0
        for _ in range(self._substeps):
            before = pusher.velocity.x
            drive = value - damping * before
            pusher.force = (drive, 0.0)
            step(dt)
            # what the pusher did not keep it gave to the block; Chipmunk's own sums count kept impulses twice
            passed += drive * dt - mass * (pusher.velocity.x - before)
        self._force = passed / self._spec.sample_time

    def _read(self) -> FloatArray:
        """Return positions and the contact force."""
        block, pusher = self._bodies
        return np.array([block.position.x, pusher.position.x + 2 * HALF, self._force])
