"""Acrobot balanced upright by LQR whose joint sensors are mounted with an offset."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from harness.errors import InputError, PlantError
from harness.protocols import Experiment
from harness.rng import Streams
from harness.signals import FloatArray, PlantSpec
from scenarios.conditions import Conditions

JOINTS = ("theta1", "theta2")


@dataclass(frozen=True, kw_only=True)
class AcrobotLqr(Conditions):
    """Acrobot held upright by LQR; the controller believes joint angles that are off by a constant.

    The controller knows the model ``acrobot`` (0 hangs down); rates that are not measured are filtered differences.
    The record holds the angles without the offset, so that the steady error can be read. The run starts near the true
    upright posture and ends with the status ``terminated`` if it falls.
    Other options: ``Conditions``.

    Parameters
    ----------
    offset : (theta1, theta2)
        What the controller's joint angles read too much [rad].
    weights : (theta1, theta2, theta1 rate, theta2 rate)
        Diagonal of Q; R is 1.
    parameters : mapping
        Of the controller's model, where they differ from the nominal ones.
    lean : float
        Angle of the first joint from upright at the start [rad].
    tilt : float
        Random part of that angle, within -+ ``tilt`` [rad].
    cutoff : float
        Corner of the difference filter [Hz].
    fall : float
        Angle of the first link from upright at which it counts as fallen [rad].

    Notes
    -----
    Exercise of Tedrake 2024, *Underactuated Robotics*, chapter on system identification: a constant offset leaves a
    steady error many times as large. From about 0.03 rad on the steady posture is unstable, and the lean from which
    the Acrobot is caught shrinks: 0.123 rad without an offset, 0.085 rad at 0.03, 0.001 rad at 0.04. With a lean of
    0.09 rad it falls from 0.03 on, as in the chapter.
    """

    offset: tuple[float, float] = (0.01, 0.01)
    weights: tuple[float, float, float, float] = (10.0, 10.0, 1.0, 1.0)
    parameters: dict[str, float] = field(default_factory=dict)
    lean: float = 0.0
    tilt: float = 1e-3
    cutoff: float = 30.0
    fall: float = math.pi / 2

    def prepare(self, spec: PlantSpec, *, streams: Streams, role: str) -> Experiment:
        """Return the experiment of one role; raises InputError if the plant is no Acrobot with measured rates."""
        names = [channel.name for channel in spec.outputs]
        if spec.nu != 1 or not set(JOINTS) <= set(names) or self.cutoff <= 0:
            raise InputError(
                "acrobot-lqr does not fit the plant",
                expected="one input and the outputs theta1 and theta2; cutoff > 0",
                got=f"{spec}; cutoff {self.cutoff}",
                remedy="use an Acrobot",
            )
        angles = [names.index(name) for name in JOINTS]
        rates = [next((names.index(f"{n}{s}") for s in ("_rate", "_dot") if f"{n}{s}" in names), None) for n in JOINTS]
        control = _Upright(self, spec, angles, rates)
        start = {"theta1": math.pi + self.lean + float(streams(f"{role}/tilt").uniform(-self.tilt, self.tilt))}
        still = np.zeros((self.length(spec), 1))
        return self.experiment(spec, still, streams=streams, role=role, controller=control, x0=start)

    def gain(self) -> FloatArray:
        """Return the gain (1, 4) of the linear-quadratic regulator about upright.

        Examples
        --------
        >>> AcrobotLqr().gain().shape
        (1, 4)
        """
        from scipy.linalg import solve_continuous_are

        A, B = self.upright()
        return np.asarray(B.T @ solve_continuous_are(A, B, np.diag(self.weights), np.eye(1)))

    def steady_gains(self) -> FloatArray:
        """Return by how much the steady angles (2,) move for each radian of offset in both joints, linearised."""
        A, B = self.upright()
        gain = self.gain()
        both = np.array([1.0, 1.0, 0.0, 0.0])
        return np.asarray(np.linalg.solve(A - B @ gain, (B @ gain @ both)))[:2]

    def upright(self) -> tuple[FloatArray, FloatArray]:
        """Return A (4, 4) and B (4, 1) of the controller's model about upright."""
        import casadi as ca

        from harness.physics.models import acrobot

        system: Any = acrobot().system()
        p = system.vector(self.parameters)
        f = system.upright(system.f)
        slopes = ca.Function("A", [system.x, system.u, system.p], [ca.jacobian(f, system.x), ca.jacobian(f, system.u)])
        A, B = slopes([math.pi, 0, 0, 0], [0], p)
        return np.asarray(A.full()), np.asarray(B.full())


class _Upright:
    """The controller of one run."""

    def __init__(self, scenario: AcrobotLqr, spec: PlantSpec, angles: list[int], rates: list[int | None]) -> None:
        self.offset = np.array(scenario.offset)
        self.gain, self.fall, self.spec, self.angles, self.rates = scenario.gain(), scenario.fall, spec, angles, rates
        self.share = 1 - math.exp(-2 * math.pi * scenario.cutoff * spec.sample_time)
        self.last: FloatArray | None = None
        self.rate = np.zeros(2)

    def __call__(self, t: float, y: FloatArray) -> FloatArray:
        """Return the torque (1,)."""
        read = y[self.angles] + self.offset - np.array([math.pi, 0.0])
        last = np.zeros(2) if self.last is None else self.last
        turned = (read - last + math.pi) % (2 * math.pi) - math.pi
        q = last + turned  # counted on from turn to turn: a link that went round once is not upright again
        if self.last is not None:
            self.rate = self.rate + self.share * (turned / self.spec.sample_time - self.rate)
        self.last = q
        if abs(q[0]) > self.fall:
            raise PlantError(f"the Acrobot fell after {t:.3g} s", status="terminated")
        v = [self.rate[k] if column is None else y[column] for k, column in enumerate(self.rates)]
        channel = self.spec.inputs[0]
        return np.asarray(np.clip(-self.gain @ np.array([*q, *v]), channel.minimum, channel.maximum), dtype=float)
