"""Free runs of an FMU as a pass of the likelihood: nothing disturbs the plant, so the innovations are output errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from numpy.typing import ArrayLike

from harness.blackbox.simulator import FmuSimulator, Loan
from harness.physics.compiled.kalman_pass import Filtered, PassNoise
from harness.physics.compiled.latent import LatentForce
from harness.signals import FloatArray, Trajectory


@dataclass(eq=False)
class StateRun(Filtered):
    """A free run with the states (K, nx) that it went through, and how to push its inputs.

    Attributes
    ----------
    x : array (K, nx)
    pushed : callable
        From what is added to the FMU's inputs (K, nu) to the outputs (K, ny).
    """

    x: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    pushed: Callable[[FloatArray], FloatArray] = field(default=lambda extra: extra, repr=False)


class FreePass:
    """Simulates records with an FMU and effects around it; a :class:`harness.physics.compiled.kalman_pass.Pass`."""

    def __init__(self, simulator: FmuSimulator) -> None:
        self.simulator = simulator
        system = simulator.system
        self.forces: tuple[LatentForce, ...] = ()
        self.nl, self.substeps = 0, 1
        self.dt, self.ny, self.parameter_count, self.start_size = simulator.dt, system.ny, system.np, system.nx
        self.state_names = tuple(channel.name for channel in system.states)
        self.parameter_names = system.parameter_names
        self.lent: Mapping[int, list[Loan]] = {}
        """Derivatives that first steps go without, by the identity of a record; they lend each other theirs."""
        self._period = np.array([channel.period or 0.0 for channel in system.outputs])

    def __call__(
        self,
        record: Trajectory,
        p: ArrayLike,
        x0: ArrayLike,
        noise: PassNoise,
        *,
        columns: npt.NDArray[np.intp] | None = None,
        keep: bool = False,
        by_noise: bool = False,
    ) -> Filtered | None:
        """Simulate a record; see :meth:`harness.physics.compiled.kalman_pass.KalmanPass.__call__`.

        Derivatives are difference quotients of whole runs.
        """
        p, x0 = np.ascontiguousarray(p, dtype=float), np.ascontiguousarray(x0, dtype=float)
        j = None
        if columns is None:
            x, y = self._run(record, p, x0)
        else:
            seen, gradient = self.simulator.sampled.inputs(record.u[None], p[None], True)
            with self.simulator.deriving(columns, self.lent.get(id(record))):
                states, outputs, s = self.simulator.windows(p[None], x0[None], seen, gradient, record.t[:1])
            assert s is not None
            x, y, j = states[0], outputs[0], -s[0][..., columns]
            if not np.isfinite(j).all():
                return None
        if not np.isfinite(y).all():
            return None
        e = record.y - y
        turning = self._period > 0
        e[:, turning] = (e[:, turning] + self._period[turning] / 2) % self._period[turning] - self._period[turning] / 2
        variance = np.broadcast_to(noise.r**2, e.shape).copy()
        if j is not None:
            j = np.where(np.isfinite(e)[..., None], j, 0.0)
        if not keep:
            made = Filtered(e, variance, j)
            if by_noise:  # a free run does not depend on the noise
                made.e_noise = np.zeros((*e.shape, self.ny))
                made.s_noise = np.broadcast_to(2 * np.eye(self.ny), made.e_noise.shape)
            return made
        return StateRun(e, variance, j, x=x, pushed=lambda extra: self._pushed(record, p, x0, extra))

    def take_own(self) -> None:
        """Take derivatives of its own from now on."""
        self.lent = {}
        self.simulator.forget()

    def _run(self, record: Trajectory, p: FloatArray, x0: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return states and outputs of a free run; where only the noise changes nothing is simulated again."""
        seen = self.simulator.sampled.inputs(record.u[None], p[None], False)[0][0]
        x, y = self.simulator.kept_run(p, x0, seen, float(record.t[0]))
        return x, self.simulator.sampled.outputs(y[None], None, p[None])[0][0]

    def _pushed(self, record: Trajectory, p: FloatArray, x0: FloatArray, extra: FloatArray) -> FloatArray:
        """Return the outputs of a run with something added to the FMU's inputs."""
        seen = self.simulator.sampled.inputs(record.u[None], p[None], False)[0][0]
        y = self.simulator.run(p, x0, seen, float(record.t[0]), extra)[1]
        return np.asarray(self.simulator.sampled.outputs(y[None], None, p[None])[0][0])
