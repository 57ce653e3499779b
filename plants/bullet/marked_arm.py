"""A camera that sees a marker on an arm, or on the arm a target, whose joint sensors are mounted with an offset."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from harness.errors import InputError
from harness.protocols import Ability
from harness.signals import Channel, FloatArray, PlantSpec
from plants.base import BasePlant
from plants.checking import checked_inputs, positive

if TYPE_CHECKING:
    from harness.physics.arms.marked_arm import Eye


class MarkedArmPlant(BasePlant):
    """Pairs <q, p>: joint readings go in, the place of a marker on the last body comes out; nothing moves by itself.

    Parameters
    ----------
    model : str
        ``iiwa`` or a URDF file; or ``hand``, whose readings are its own pose.
    marker : (x, y, z)
        In the frame of the last body [m].
    pose : bool
        Whether the camera tells the orientation of what it sees too, as the x and the y axis of the marker.
    eye : {"room", "hand"}
        Where the camera is: it sees the marker, or it is on the last body and sees a target that stands.
    hidden : mapping, optional
        True parameters where they differ from the URDF: ``{"offset2": 0.01, "length3": 0.43}``.
    sample_time : float
        Time between two pairs [s].
    reach : float
        Declared range of the readings of joints without limits [rad or m], which scenarios use.

    Raises
    ------
    InputError
        If the URDF cannot be read, the arm branches, or a parameter is unknown.

    Examples
    --------
    >>> import importlib.util
    >>> if importlib.util.find_spec("pybullet_data"):
    ...     plant = MarkedArmPlant(hidden={"offset2": 0.01})
    ...     assert [channel.name for channel in plant.spec.outputs] == ["marker_x", "marker_y", "marker_z"]
    """

    abilities: frozenset[Ability] = frozenset({"feedthrough", "batch"})

    def __init__(
        self,
        *,
        model: str = "iiwa",
        marker: Sequence[float] = (0.05, 0.0, 0.1),
        pose: bool = False,
        eye: Eye = "room",
        hidden: Mapping[str, float] | None = None,
        sample_time: float = 0.1,
        reach: float = np.pi,
    ) -> None:
        from harness.physics.arms.marked_arm import marked_arm

        self._arm = marked_arm(model, marker, pose=pose, eye=eye)
        self._parameters = self._arm.vector(hidden)
        inputs = []
        for channel, joint in zip(self._arm.arm.positions, self._arm.arm.arm.moving, strict=True):
            low, high = (joint.lower, joint.upper) if np.isfinite(joint.lower) else (-reach, reach)
            inputs.append(Channel(channel.name, channel.unit, low, high))
        time = positive("sample_time", sample_time)
        self._spec = PlantSpec(tuple(inputs), self._arm.channels, time, feedthrough=True)

    def reset(self, *, rng: np.random.Generator, x0: Mapping[str, float] | None = None) -> FloatArray:
        """Return the marker with all readings 0; there is no state to set."""
        if x0:
            raise InputError(
                "initial states of an arm with a marker",
                expected="none: the readings are inputs",
                got=", ".join(x0),
                remedy="leave x0 out",
            )
        return self.output(np.zeros(self.spec.nu))

    def output(self, u: FloatArray) -> FloatArray:
        """Return the marker (3,) at readings (n,)."""
        places = self.rollout(np.asarray(u, dtype=float)[None])
        return np.asarray(places[0])

    def step(self, u: FloatArray) -> FloatArray:
        """Return the marker (3,) at readings (n,), one sample later."""
        return self.output(u)

    def rollout(self, inputs: FloatArray) -> FloatArray:
        """Return the markers (N, 3) at readings (N, n)."""
        return self._arm.places(checked_inputs(inputs, self.spec), self._parameters)
