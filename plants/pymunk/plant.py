"""What the pymunk plants share: stepping, rollouts, and snapshots by rebuilding the space."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from harness.protocols import Ability
from harness.signals import Channel, FloatArray, PlantSpec
from plants.base import BasePlant
from plants.checking import checked_inputs, initial_values, positive, refuse_input, refuse_option, whole

State = tuple[float, ...]  # Of each moving body: position x, y, velocity x, y, angle, angular velocity.


class PymunkPlant(BasePlant, ABC):
    """A plant with one input in a pymunk space.

    Subclasses say how the space is built from the state of its bodies (``_place``), how the bodies stand in named
    states (``_bodies_at``), what one sample of the input does (``_advance``, unless it pushes the first) and what is
    read.

    Parameters
    ----------
    sample_time : float
        Seconds between samples.
    substeps : int
        Engine steps for each sample.
    gravity : float
        In m/s^2.
    u_limit : float
        Declared range of the input in its unit, which scenarios use; nothing is clipped.
    outputs : sequence of str, optional
        States that are measured; default: positions and angles, and no rates.

    Raises
    ------
    InputError
        If an option is out of range, ``substeps`` is no positive integer, or an output is no state.
    """

    snapshot_tolerance = 1e-9
    """How far a continuation may be from an uninterrupted run; two continuations of one state are bit-identical."""

    # a subclass makes the spec of its options, and says where its states start unless x0 names them
    def __init__(
        self, spec: PlantSpec, substeps: int, start: Sequence[float], outputs: Sequence[str] | None = None
    ) -> None:
        substeps = whole("substeps", substeps)
        chosen = _chosen(spec, outputs)
        self._columns = None if chosen is None else np.array(chosen)
        if chosen is not None:
            spec = replace(spec, outputs=tuple(spec.states[column] for column in chosen))
        self._spec, self._substeps, self._default = spec, substeps, list(start)
        self._dt = spec.sample_time / self._substeps
        self._space: Any
        self._bodies: tuple[Any, ...]
        self._place(self._bodies_at(self._default))

    @property
    def abilities(self) -> frozenset[Ability]:
        """Snapshots (taking one rebuilds the space, see :meth:`get_state`), batch, truth."""
        return super().abilities

    def reset(self, *, rng: np.random.Generator, x0: Mapping[str, float] | None = None) -> FloatArray:
        """Start anew, from named states where given; returns ``y[0]`` (ny,). ``rng`` is not used."""
        self._need_open()
        self._place(self._bodies_at(initial_values(x0, self.spec.states, self._default)))
        return self._measured()

    def step(self, u: FloatArray) -> FloatArray:
        """Hold ``u`` (1,) for one sample time; returns the next output (ny,)."""
        if self._closed:
            self._need_open()
        if not (isinstance(u, np.ndarray) and u.shape == (1,) and math.isfinite(value := u.item())):
            refuse_input(u, self.spec)
        self._advance(value)
        return self._read() if self._columns is None else self.truth()[self._columns]

    def rollout(self, inputs: FloatArray) -> FloatArray:
        """Apply ``inputs`` (N, 1) from the present state; row k of the result (N, ny) is what ``step`` returned."""
        self._need_open()
        values = checked_inputs(inputs, self.spec)[:, 0].tolist()
        outputs = np.empty((len(values), self.spec.ny))
        for k, value in enumerate(values):
            self._advance(value)
            outputs[k] = self._measured()
        return outputs

    @abstractmethod
    def truth(self) -> FloatArray:
        """Return the true states (nx,)."""

    def get_state(self) -> State:
        """Return positions and velocities of all bodies.

        Chipmunk keeps impulses of the last step that cannot be read. So the space is built anew from these numbers
        when a state is taken: what follows equals what follows :meth:`set_state`, bit for bit, and differs from an
        undisturbed run by rounding (measured: 3e-13 after 8000 engine steps without contacts), which
        ``snapshot_tolerance`` declares.
        """
        self._need_open()
        state = tuple(
            number
            for body in self._bodies
            for number in (*body.position, *body.velocity, body.angle, body.angular_velocity)
        )
        self._place(state)
        return state

    def set_state(self, state: State) -> None:
        """Go back to a state of this same plant object."""
        self._need_open()
        self._place(state)

    @abstractmethod
    def _bodies_at(self, values: Sequence[float]) -> State:
        """Return the state of the bodies at named states, in the order of ``spec.states``."""

    @abstractmethod
    def _place(self, state: State) -> None:
        """Build ``_space`` and ``_bodies`` from a state."""

    def _advance(self, value: float) -> None:
        """Hold a horizontal force on the first body for one sample; Chipmunk forgets forces after every step."""
        body, step, dt, push = self._bodies[0], self._space.step, self._dt, (value, 0.0)
        for _ in range(self._substeps):
            body.force = push
            step(dt)

    @abstractmethod
    def _read(self) -> FloatArray:
        """Return the usual outputs."""

    def _measured(self) -> FloatArray:
        """Return the outputs (ny,)."""
        return self._read() if self._columns is None else self.truth()[self._columns]


def mechanism_spec(places: Sequence[Channel], unit: str, u_limit: float, sample_time: float) -> PlantSpec:
    """Return the spec of a mechanism: one input ``u``, places as outputs, and their rates as further states.

    Raises InputError if the limit or the sample time is not positive.

    - ``places``: positions and angles
    - ``unit``: of the input
    - ``u_limit``: declared range of the input; may be infinite

    Examples
    --------
    >>> spec = mechanism_spec([Channel("x", "m")], "N", 5.0, 0.02)
    >>> print(spec, "/", ", ".join(map(str, spec.states)))
    u [N] -> x [m] every 0.02 s / x [m], x_rate [m/s]
    """
    limit = positive("u_limit", u_limit, infinite=True)
    rates = tuple(Channel(f"{place.name}_rate", f"{place.unit}/s") for place in places)
    force = Channel("u", unit, -limit, limit)
    return PlantSpec((force,), tuple(places), positive("sample_time", sample_time), (*places, *rates))


def pin_forces(body: Any, other: Any, *, spring: float, damping: float, dry: float) -> list[Any]:
    """Return the constraints that act on a pin between two bodies: spring [N m/rad] and damping, dry friction [N m]."""
    import pymunk

    joints: list[Any] = []
    if spring or damping:
        joints.append(pymunk.DampedRotarySpring(body, other, 0.0, spring, damping))
    if dry:
        motor = pymunk.SimpleMotor(body, other, 0.0)
        motor.max_force = dry
        joints.append(motor)
    return joints


def _chosen(spec: PlantSpec, outputs: Sequence[str] | None) -> list[int] | None:
    """Return the numbers of the states that are measured; None where that is what the plant measures anyway."""
    if outputs is None:
        return None
    names, wanted = [channel.name for channel in spec.states], [outputs] if isinstance(outputs, str) else list(outputs)
    fine = bool(wanted) and len(set(wanted)) == len(wanted) and set(wanted) <= set(names)
    refuse_option("outputs", outputs, fine, f"names among {', '.join(names)}")
    return None if wanted == [channel.name for channel in spec.outputs] else [names.index(name) for name in wanted]


def put(body: Any, state: State) -> Any:
    """Put a body into its part of a state and return it."""
    body.position, body.velocity = (state[0], state[1]), (state[2], state[3])
    body.angle, body.angular_velocity = state[4], state[5]
    return body


def point_mass_pole(mass: float, length: float, moved: float) -> tuple[float, float, float]:
    """Return mass, centre and inertia of a body that moves as a point mass at the end of a pole.

    Chipmunk cannot hold a point mass on a stiff pin: its own inertia is 0. The same dynamics with well-conditioned
    bodies: take a mass ``moved`` from what carries the pin, add it to the pole, put the pole's centre at
    ``mass * length / (mass + moved)`` and give it the inertia ``mass * length^2 * moved / (mass + moved)``. Total
    mass, first and second moment about the pin stay what they were, so the equations of motion are the same.

    Examples
    --------
    >>> body, centre, inertia = point_mass_pole(0.2, 0.5, 0.2)
    >>> body, centre, round(inertia + body * centre**2, 12)
    (0.4, 0.25, 0.05)
    """
    body = mass + moved
    return body, mass * length / body, mass * length**2 * moved / body
