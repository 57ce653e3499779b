"""Cart in front of a soft wall in pymunk: two modes, of which one begins where the cart touches the wall."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from harness.signals import Channel, FloatArray
from plants.checking import positives
from plants.pymunk.plant import PymunkPlant, State, mechanism_spec, put

FAR = 1000.0
"""Where springs are anchored [m]: a cart beside its spring's line changes its length by less than rounding."""


class PymunkCartWall(PymunkPlant):
    """A cart on a rail, held by a weak spring, runs into a soft wall; the input is the force on the cart.

    Away from the wall ``m x'' = u - b x' - k x``; beyond ``wall`` the wall pushes back with ``-K (x - wall)`` besides.
    So the sampled plant is affine in two regions, but for the samples in which the cart touches or leaves the wall. The
    springs and the damper are Chipmunk's, the wall's cut off where it would pull.

    Parameters
    ----------
    m : float
        Mass of the cart [kg].
    b : float
        Viscous friction [N s/m].
    k : float
        Stiffness of the spring that holds the cart about 0 [N/m].
    wall : float
        Where the wall begins [m].
    wall_stiffness : float
        K [N/m].
    outputs : sequence of str, optional
        States that are measured; default: x alone.
    **engine
        The others are those of every plant in pymunk: :class:`plants.pymunk.plant.PymunkPlant`.

    Examples
    --------
    >>> print(PymunkCartWall().spec)
    u [N] -> x [m] every 0.02 s
    """

    def __init__(
        self,
        *,
        m: float = 1.0,
        b: float = 1.0,
        k: float = 4.0,
        wall: float = 0.2,
        wall_stiffness: float = 200.0,
        sample_time: float = 0.02,
        substeps: int = 20,
        u_limit: float = 5.0,
        outputs: Sequence[str] | None = None,
    ) -> None:
        self.true_parameters = positives(m=m) | positives(b=b, k=k, wall_stiffness=wall_stiffness, zero=True)
        self.wall = float(wall)
        spec = mechanism_spec([Channel("x", "m")], "N", u_limit, sample_time)
        super().__init__(spec, substeps, [0.0, 0.0], outputs)

    def truth(self) -> FloatArray:
        """Return x and x_rate (2,)."""
        self._need_open()
        (cart,) = self._bodies
        return np.array([cart.position.x, cart.velocity.x])

    def _bodies_at(self, values: Sequence[float]) -> State:
        """Return the state of the cart."""
        x, rate = values
        return (x, 0.0, rate, 0.0, 0.0, 0.0)

    def _place(self, state: State) -> None:
        """Build the space from the state of the cart."""
        import pymunk

        p = self.true_parameters
        space = pymunk.Space()
        cart = put(pymunk.Body(p["m"], math.inf), state)
        rail = space.static_body
        held = pymunk.DampedSpring(rail, cart, (-FAR, 0.0), (0.0, 0.0), FAR, p["k"], p["b"])
        wall = pymunk.DampedSpring(rail, cart, (self.wall + FAR, 0.0), (0.0, 0.0), FAR, p["wall_stiffness"], 0.0)
        wall.force_func = _pushes_only
        space.add(cart, held, wall)
        self._space, self._bodies = space, (cart,)

    def _read(self) -> FloatArray:
        """Return x."""
        return np.array([self._bodies[0].position.x])


def _pushes_only(spring: Any, distance: float) -> float:
    """Return the force of a spring that never pulls."""
    return max(float((spring.rest_length - distance) * spring.stiffness), 0.0)
