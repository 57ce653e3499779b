"""A motion that is repeated: a plant under feedback about a plan, seen by noisy sensors, moved by limited actuators."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.errors import PlantError
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.control.planning import Limits, Moves

_GONE = 1e3  # A repetition has left the motion where an output is so many times the largest reference away.

_QUIET = 1e-4
"""Least sensor noise that an observer is designed for, relative to the largest reference: with none it would
differentiate."""


@dataclass(frozen=True, eq=False)
class Observer:
    """``x+ = A x + B u``, corrected by ``M (y - C x)`` where an output is seen: departures from a plan."""

    a: FloatArray  # (nx, nx)
    b: FloatArray  # (nx, nu)
    c: FloatArray  # (ny, nx)
    correction: FloatArray  # (nx, ny): M

    @classmethod
    def of(cls, parts: tuple[FloatArray, FloatArray, FloatArray], pushed: FloatArray, noise: float) -> Observer | None:
        """Return the stationary Kalman filter; None where there is none.

        Parameters
        ----------
        parts : (A, B, C)
        pushed : array (nx, nx)
            Covariance of what moves the state unseen.
        noise : float
            Standard deviation of each output.
        """
        from scipy.linalg import LinAlgError, solve_discrete_are

        a, b, c = parts
        sensor = noise**2 * np.eye(len(c))
        try:
            spread = solve_discrete_are(a.T, c.T, pushed, sensor)
        except (LinAlgError, ValueError):
            return None
        return cls(a, b, c, np.asarray(np.linalg.solve(c @ spread @ c.T + sensor, c @ spread).T))


@dataclass(frozen=True, eq=False)
class MotionPlan:
    """Inputs and outputs of a motion, and the feedback that holds it."""

    # (N, nu), (N, ny): Departures from the operating point
    inputs: FloatArray
    outputs: FloatArray
    gains: FloatArray  # (N, nu, nx): Of the departure that the observer sees
    observer: Observer


@dataclass(frozen=True, eq=False)
class Repetition:
    """One repetition; all departures from the operating point."""

    record: Trajectory  # What the sensors saw and the actuators did
    outputs: FloatArray  # (N, ny): Without noise; infinite from where it left
    asked: FloatArray  # (N, nu): What the controller asked of the actuators

    @property
    def stayed(self) -> bool:
        """Whether it came to its end."""
        return bool(np.isfinite(self.outputs).all())


class Repeated:
    """A plant that repeats a motion from the same start."""

    def __init__(
        self,
        plant: Any,
        start: Mapping[str, float],
        *,
        samples: int,
        limits: Limits,
        noise: float,
        varied: Mapping[str, float],
        size: float,
    ) -> None:
        self.plant, self.start, self.samples, self.limits = plant, dict(start), samples, limits
        self.noise, self.varied, self.size = noise, dict(varied), size
        self.point = np.asarray(plant.reset(rng=np.random.default_rng(0), x0=self.start), dtype=float)
        spec = plant.spec
        self.spec = PlantSpec(spec.inputs, spec.outputs, spec.sample_time)
        self.times = np.arange(samples) * spec.sample_time

    def play(
        self, plan: MotionPlan, rng: np.random.Generator | None, excitation: FloatArray | None = None
    ) -> Repetition:
        """Return one repetition of a plan; without ``rng`` nothing is noisy and every start is the same."""
        n, nu, ny = self.samples, self.spec.nu, self.spec.ny
        x0 = dict(self.start)
        if rng is not None:
            for name, spread in self.varied.items():
                x0[name] = x0.get(name, 0.0) + spread * float(rng.normal())
        y = np.asarray(self.plant.reset(rng=rng or np.random.default_rng(0), x0=x0), dtype=float) - self.point
        seen, true = np.full((n, ny), np.inf), np.full((n, ny), np.inf)
        asked, applied = np.zeros((n, nu)), np.zeros((n, nu))
        noise = np.zeros((n, ny)) if rng is None else self.noise * rng.normal(size=(n, ny))
        push = np.zeros((n, nu)) if excitation is None else excitation
        watch = plan.observer
        x, before = np.zeros(len(watch.a)), np.zeros(nu)
        last = n
        for k in range(n):
            true[k], seen[k] = y, y + noise[k]
            x = x + watch.correction @ (seen[k] - plan.outputs[k] - watch.c @ x)
            asked[k] = plan.inputs[k] - plan.gains[k] @ x + push[k]
            applied[k] = before = self.limits.next(before, asked[k])
            x = watch.a @ x + watch.b @ (before - plan.inputs[k])
            if k == n - 1:
                break
            try:
                y = np.asarray(self.plant.step(before), dtype=float) - self.point
            except PlantError:
                y = np.full(ny, np.inf)
            if not np.abs(y).max() <= _GONE * self.size:
                last = k + 1
                break
        record = Trajectory(self.times[:last], applied[:last], seen[:last], self.spec)
        return Repetition(record, true, asked)

    def map_of(self, plan: MotionPlan, push: float) -> tuple[Repetition, Moves]:
        """Return the noise-free repetition of a plan, and what changes of its feed-forward do, by forward differences.

        Infinite where a repetition leaves.
        """
        here = self.play(plan, None)
        size = plan.inputs.size
        inputs, outputs = np.empty((size, size)), np.empty((plan.outputs.size, size))
        for place in range(size):
            moved = np.zeros(size)
            moved[place] = push
            other = self.play(plan, None, moved.reshape(plan.inputs.shape))
            inputs[:, place] = ((other.asked - here.asked) / push).ravel()
            outputs[:, place] = ((other.outputs - here.outputs) / push).ravel()
        return here, Moves(outputs, inputs)


def quiet(size: float, noise: float) -> float:
    """Return the noise that an observer is designed for."""
    return max(noise, _QUIET * size)
