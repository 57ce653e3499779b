"""Iterative learning control: a better input at every repetition, from a linear model along the trajectory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

import numpy as np

from harness.errors import InputError, PlantError
from harness.models.analysis import Findings, Takes
from harness.protocols import Model
from harness.signals import FloatArray


class LiftedMap(Protocol):
    """What changes of all inputs of a run do to all its outputs."""

    def lifted(self) -> FloatArray:
        """Return the map (N ny, N nu)."""
        ...


@dataclass(frozen=True, eq=False)
class TimeVarying:
    """``dx+ = A[k] dx + B[k] du``, ``dy = C[k] dx + D[k] du`` about a trajectory of N samples.

    Parameters
    ----------
    a_matrices, b_matrices, c_matrices, d_matrices : array (N, nx, nx), (N, nx, nu), (N, ny, nx), (N, ny, nu)
    """

    a_matrices: FloatArray
    b_matrices: FloatArray
    c_matrices: FloatArray
    d_matrices: FloatArray

    def lifted(self) -> FloatArray:
        """Return the map (N ny, N nu) from changes of all inputs to changes of all outputs."""
        n, nx = self.a_matrices.shape[:2]
        ny, nu = self.d_matrices.shape[1:]
        found = np.zeros((n, ny, n, nu))
        moved = np.zeros((nx, n, nu))
        for k in range(n):
            found[k] = np.tensordot(self.c_matrices[k], moved, axes=1)
            found[k, :, k] += self.d_matrices[k]
            moved = np.tensordot(self.a_matrices[k], moved, axes=1)
            moved[:, k] += self.b_matrices[k]
        return found.reshape(n * ny, n * nu)

    def frozen(self, k: int = 0) -> TimeVarying:
        """Return the time-invariant model of one sample, for all samples."""
        n = len(self.a_matrices)
        parts = (self.a_matrices, self.b_matrices, self.c_matrices, self.d_matrices)
        return TimeVarying(*(np.repeat(part[k : k + 1], n, axis=0) for part in parts))


def linearised_along(model: Model, x0: FloatArray, u: FloatArray, *, size: float = 1e-5) -> TimeVarying:
    """Return a model linearised along its own run, by central differences.

    Parameters
    ----------
    model : Model
    x0 : array (nx,)
    u : array (N, nu)
    size : float
        Step of the differences, relative to the largest size that each state and input reaches (1 where it is zero).
    """
    n, nu = u.shape
    nx = np.size(x0)
    states = np.empty((n, nx))
    x = np.asarray(x0, dtype=float)
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(n):
            states[k] = x
            x = model.step(x, u[k])
    if not np.isfinite(states).all():
        raise InputError(
            "trajectory to linearise along", expected="a finite run", got="one that diverges", remedy="change the input"
        )
    steps = [size * np.where((top := np.abs(part).max(axis=0)) > 0, top, 1.0) for part in (states, u)]

    def jacobian(of: Callable[[FloatArray, FloatArray], FloatArray], which: int) -> FloatArray:
        columns = []
        for j, step in enumerate(steps[which]):
            push = np.zeros(nx if which == 0 else nu)
            push[j] = step
            sides = [(states + s * push, u) if which == 0 else (states, u + s * push) for s in (1.0, -1.0)]
            columns.append((of(*sides[0]) - of(*sides[1])) / (2 * step))
        return np.stack(columns, axis=-1) if columns else np.zeros((n, model.spec.ny, 0))

    return TimeVarying(
        jacobian(model.step, 0), jacobian(model.step, 1), jacobian(model.output, 0), jacobian(model.output, 1)
    )


@dataclass(frozen=True, eq=False)
class LearnedInput:
    """What repetitions brought."""

    inputs: FloatArray  # (N, nu): The input of the best repetition
    errors: tuple[float, ...]
    """Root mean square error of the outputs at each repetition, each relative to the weights; inf where it diverged."""


def learn_input(
    run: Callable[[FloatArray], FloatArray],
    reference: FloatArray,
    first: FloatArray,
    model: Callable[[FloatArray], LiftedMap] | LiftedMap,
    *,
    repetitions: int = 14,
    effort: float = 1e-4,
    weights: FloatArray | None = None,
) -> LearnedInput:
    """Learn the input that makes a plant follow a reference, by repeating it and correcting with a model.

    Norm-optimal iterative learning control (Amann, Owens & Rogers 1996, IEE Proc. D 143:217; Bristow, Tharayil &
    Alleyne 2006, IEEE Control Systems 26:96): the change of the input minimises the error that the model foretells plus
    ``effort`` times its own square. The model need only be right about the direction in which inputs move outputs along
    the trajectory; the error itself is measured.

    Parameters
    ----------
    run : callable
        ``run(u (N, nu)) -> y (N, ny)``: one repetition of the plant, always from the same start.
    reference : array (N, ny)
    first : array (N, nu)
        Input of the first repetition.
    model : LiftedMap or callable
        The model along the trajectory (a TimeVarying), or ``model(u) -> LiftedMap`` for one along that of each input.
    repetitions : int
        After the first.
    effort : float
        Relative to the mean square gain of the model.
    weights : array (ny,), optional
        Errors are divided by these; ones by default.
    """
    size = np.ones(reference.shape[1]) if weights is None else np.asarray(weights, dtype=float)
    u = np.array(first, dtype=float)
    best, errors = (np.inf, u), []
    for _ in range(repetitions + 1):
        with np.errstate(over="ignore", invalid="ignore"):
            y = np.asarray(run(u), dtype=float)
        miss = ((reference - y) / size).ravel()
        error = float(np.sqrt(np.mean(miss**2))) if np.isfinite(y).all() else float("inf")
        errors.append(error)
        if error < best[0]:
            best = (error, u)
        if not np.isfinite(error):
            break
        gain = (model(u) if callable(model) else model).lifted()
        gain = (gain.reshape(len(u), -1, gain.shape[1]) / size[:, None]).reshape(gain.shape)
        gram = gain.T @ gain
        damping = effort * float(np.trace(gram)) / len(gram)
        u = u + np.linalg.solve(gram + damping * np.eye(len(gram)), gain.T @ miss).reshape(u.shape)
    return LearnedInput(best[1], tuple(errors))


@dataclass(frozen=True)
class _Tried:
    """The map that small changes of every input show on runs of a believed plant."""

    gain: FloatArray

    def lifted(self) -> FloatArray:
        return self.gain


@dataclass(frozen=True)
class IterativeLearning:
    """A motion learned by repeating it on a plant, corrected with a plant that is believed.

    Norm-optimal iterative learning control (Amann, Owens & Rogers 1996, IEE Proc. D 143:217).
    The first output is to rise to a height and come back, always from rest. The input is planned on the believed plant,
    run on the true one, and corrected after every repetition (:func:`learn_input`).

    Parameters
    ----------
    believed : mapping
        Options of the believed plant that differ from those of the true one; needed, such as ``parameters``.
    height : float
        Of the motion, in the unit of the first output.
    duration : float
        [s].
    repetitions : int
        After the first.
    effort : float
        What changes of the input cost, relative to the mean square gain of the model.
    """

    takes: ClassVar[Takes] = "maker"
    believed: dict[str, Any] = field(default_factory=dict)
    height: float = 1.0
    duration: float = 4.0
    repetitions: int = 10
    effort: float = 1e-4

    def of(self, subject: Any, *, rng: np.random.Generator) -> Findings:
        """Return the error at every repetition, beside that of the plan on the believed plant."""
        if not self.believed or self.duration <= 0 or self.repetitions < 1:
            raise InputError(
                "iterative learning",
                expected="believed options, duration > 0, repetitions >= 1",
                got=f"believed={self.believed}, duration={self.duration}, repetitions={self.repetitions}",
                remedy="say what is believed of the plant, such as -O believed.parameters={mgl = 0.8}",
            )
        with subject() as plant, subject(**self.believed) as belief:
            spec = plant.spec
            count = max(round(self.duration / spec.sample_time), 2)
            if count > _LONGEST:
                raise InputError(
                    "iterative learning",
                    expected=f"at most {_LONGEST} samples of motion",
                    got=str(count),
                    remedy="choose a larger sample_time or a shorter duration",
                )
            shape = np.sin(np.pi * np.clip(1.1 * np.arange(count) / (count - 1), 0.0, 1.0)) ** 2
            wanted = self.height * shape[:, None]

            def repeated(which: Any, u: FloatArray) -> FloatArray:
                y = np.full((len(u), 1), np.inf)
                y[0] = np.asarray(which.reset(rng=np.random.default_rng(0)))[:1]
                try:
                    for k in range(len(u) - 1):
                        y[k + 1] = which.step(u[k])[:1]
                except PlantError:
                    return y
                return y

            def tried(u: FloatArray) -> _Tried:
                here = repeated(belief, u)
                gain = np.zeros((count, count * spec.nu))
                for place in range(gain.shape[1]):
                    push = np.zeros(gain.shape[1])
                    push[place] = _PUSH
                    gain[:, place] = ((repeated(belief, u + push.reshape(u.shape)) - here) / _PUSH)[:, 0]
                return _Tried(gain)

            start = np.zeros((count, spec.nu))
            plan = learn_input(
                lambda u: repeated(belief, u), wanted, start, tried, repetitions=_PLANNED, effort=self.effort
            )
            learned = learn_input(
                lambda u: repeated(plant, u),
                wanted,
                plan.inputs,
                tried(plan.inputs),
                repetitions=self.repetitions,
                effort=self.effort,
            )
        rows = [{"repetition": k, "error rms": error} for k, error in enumerate(learned.errors)]
        unit = spec.outputs[0].unit
        text = (
            f"planned to {min(plan.errors):.3g} {unit} on the believed plant; {learned.errors[0]:.3g} {unit} at first "
            f"on the true one, {min(learned.errors):.3g} {unit} at best of {len(learned.errors)} repetitions"
        )
        words = [text]
        if min(learned.errors) > 0.5 * learned.errors[0]:
            words.append("hardly better: the believed plant points the wrong way somewhere along the motion")
        return Findings("iterative learning", rows, words, {"input": learned.inputs, "reference": wanted})


_LONGEST = 200  # Samples of a motion: the model along it is tried input by input.
_PLANNED = 8  # Repetitions on the believed plant, which cost nothing.
_PUSH = 1e-4  # Change of an input by which the model along a motion is tried, in its unit.
