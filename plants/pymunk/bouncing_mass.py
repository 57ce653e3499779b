"""A mass on a spring above a rigid floor in pymunk: it flies, hits, and bounces with a coefficient of restitution."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from harness.errors import InputError
from harness.signals import Channel, FloatArray
from plants.checking import positive, positives, refuse_option
from plants.pymunk.plant import PymunkPlant, State, mechanism_spec, put

FAR = 1000.0  # Where the spring is anchored [m], as in :mod:`plants.pymunk.soft_wall`.

RADIUS = 0.05


class PymunkBouncingMass(PymunkPlant):
    """A mass on a spring that hits a rigid floor; the input is a force upwards.

    Above the floor ``m z'' = u - b z' - k (z - rest) - m g``; at ``z = 0`` the rate jumps from ``z'`` to ``-e z'``. The
    contact is Chipmunk's. A ceiling, if there is one, is a second wall with a restitution of its own.

    Parameters
    ----------
    m : float
        Mass [kg].
    b : float
        Viscous friction [N s/m].
    k : float
        Stiffness of the spring [N/m].
    rest : float
        Height at which the spring is relaxed [m].
    restitution : float
        e, 0 to 1.
    ceiling : float, optional
        Height at which the mass hits a ceiling [m].
    ceiling_restitution : float
        That of the ceiling, at most the floor's.
    outputs : sequence of str, optional
        States that are measured; default: z and z_rate.
    **engine
        The others are those of every plant in pymunk: :class:`plants.pymunk.plant.PymunkPlant`.

    Examples
    --------
    >>> print(PymunkBouncingMass().spec)
    u [N] -> z [m], z_rate [m/s] every 0.01 s
    """

    def __init__(
        self,
        *,
        m: float = 1.0,
        b: float = 0.2,
        k: float = 20.0,
        rest: float = 0.5,
        restitution: float = 0.8,
        ceiling: float | None = None,
        ceiling_restitution: float = 0.5,
        sample_time: float = 0.01,
        substeps: int = 100,
        gravity: float = 9.81,
        u_limit: float = 10.0,
        outputs: Sequence[str] | None = ("z", "z_rate"),
    ) -> None:
        refuse_option("restitution", restitution, 0 <= restitution <= 1, "0 to 1")
        if ceiling is not None and not (ceiling > 0.3 and 0 <= ceiling_restitution <= restitution):
            raise InputError(
                "options ceiling and ceiling_restitution",
                expected=f"above the start at 0.3 m, and 0 to {restitution:g}, the floor's",
                got=f"{ceiling!r}, {ceiling_restitution!r}",
                remedy="correct them",
            )
        self._ceiling = None if ceiling is None else (float(ceiling), float(ceiling_restitution))
        self.true_parameters = positives(m=m) | positives(b=b, k=k, zero=True) | {"restitution": float(restitution)}
        self._rest, self._gravity = float(rest), positive("gravity", gravity, zero=True)
        spec = mechanism_spec([Channel("z", "m")], "N", u_limit, sample_time)
        super().__init__(spec, substeps, [0.3, 0.0], outputs)

    def truth(self) -> FloatArray:
        """Return z and z_rate (2,)."""
        self._need_open()
        (mass,) = self._bodies
        return np.array([mass.position.y - RADIUS, mass.velocity.y])

    def _bodies_at(self, values: Sequence[float]) -> State:
        """Return the state of the mass."""
        z, rate = values
        return (0.0, z + RADIUS, 0.0, rate, 0.0, 0.0)

    def _place(self, state: State) -> None:
        """Build the space from the state of the mass."""
        import pymunk

        p = self.true_parameters
        space = pymunk.Space()
        space.gravity = (0.0, -self._gravity)
        space.collision_slop = 1e-6  # Chipmunk's default of 0.1 is for pixels
        mass, ground = put(pymunk.Body(p["m"], math.inf), state), space.static_body
        shape, floor = pymunk.Circle(mass, RADIUS), pymunk.Segment(ground, (-1.0, -1.0), (1.0, -1.0), 1.0)
        shape.elasticity, floor.elasticity = p["restitution"], 1.0  # Chipmunk multiplies the two
        anchor = (0.0, self._rest + RADIUS + FAR)
        spring = pymunk.DampedSpring(ground, mass, anchor, (0.0, 0.0), FAR, p["k"], p["b"])
        space.add(mass, shape, floor, spring)
        if self._ceiling is not None:
            top = self._ceiling[0] + 2 * RADIUS + 1.0
            above = pymunk.Segment(ground, (-1.0, top), (1.0, top), 1.0)
            above.elasticity = self._ceiling[1] / (p["restitution"] or 1.0)
            space.add(above)
        self._space, self._bodies = space, (mass,)

    def _advance(self, value: float) -> None:
        """Hold a force for one sample."""
        (mass,), step, dt = self._bodies, self._space.step, self._dt
        for _ in range(self._substeps):
            mass.force = (0.0, value)
            step(dt)

    def _read(self) -> FloatArray:
        """Return z."""
        return np.array([self._bodies[0].position.y - RADIUS])
