"""Dynamic mode decomposition with control, and extended DMD (Koopman) with control."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import combinations_with_replacement
from typing import Any

import numpy as np

from harness.errors import FitError
from harness.scoring import same_language
from harness.signals import FloatArray, PlantSpec, Trajectory
from harness.specs import spec_from_dict, spec_to_dict
from identifiers.linear import LinearModel, lag_model
from identifiers.records import lagged_blocks, moving, real_signals, usable
from identifiers.regression import Solution, solve

__all__ = ["Dictionary", "Dmdc", "Edmdc", "KoopmanModel"]

_BLOCK = 50_000


@dataclass(frozen=True)
class Dmdc:
    """Dynamic mode decomposition with control: a linear map between snapshots.

    ``y[k+1] = A y[k] + B u[k]`` on the leading principal directions of the outputs (Proctor, Brunton & Kutz 2016, SIAM
    J. Appl. Dyn. Syst. 15:142, sec. 3.3). Several records are used without a pair that crosses a seam.

    Parameters
    ----------
    rank : int, optional
        Number of principal directions; all outputs without it.
    delays : int
        Number of snapshots stacked (1: none); positions alone need 2 or more.
    total : bool
        Total DMD: snapshot pairs are first projected on their common leading subspace, which removes the bias of noise
        on the outputs (Hemati et al. 2017, Theor. Comput. Fluid Dyn. 31:349). Needs ``rank`` and ``delays = 1``.
    offset : bool
        Fit a constant too, for motion around an operating point.
    ridge : float
        Tikhonov weight.

    Examples
    --------
    >>> from harness.signals import Channel
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> u = np.array([[1.0], [-1.0], [2.0], [0.5], [0.0]])
    >>> y = np.zeros((5, 1))
    >>> for k in range(4):
    ...     y[k + 1] = 0.5 * y[k] + 2.0 * u[k]
    >>> Dmdc().fit([Trajectory(np.arange(5.0), u, y, spec)], rng=np.random.default_rng(0)).eigenvalues.real.round(9)
    array([0.5])
    """

    rank: int | None = None
    delays: int = 1
    total: bool = False
    offset: bool = False
    ridge: float = 0.0

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> LinearModel:
        """Return a linear model in the coordinates of the principal directions."""
        what = "dmdc"
        if self.delays < 1 or (self.total and (self.rank is None or self.delays != 1)):
            raise FitError(
                f"{what}: options",
                expected="delays >= 1; with total=True a rank and delays = 1",
                got=f"delays={self.delays}, rank={self.rank}, total={self.total}",
                remedy="correct the options",
            )
        records, spec = usable(trajectories, samples=self.delays + 2, what=what)
        real_signals(spec, what)
        moving(records, what, inputs=False)
        if self.rank is None:
            solution = solve(lambda: lagged_blocks(records, self.delays, offset=self.offset), what, ridge=self.ridge)
            return lag_model(spec, solution, self.delays, self.offset)
        if self.delays > 1:
            raise FitError(
                f"{what}: rank and delays together",
                expected="one of them",
                got=f"rank={self.rank}, delays={self.delays}",
                remedy="use rank with many outputs, delays with few",
            )
        return self._reduced(records, spec, what)

    def _reduced(self, records: Sequence[Trajectory], spec: PlantSpec, what: str) -> LinearModel:
        """Fit on the leading directions of the outputs."""
        ny, nu = spec.ny, spec.nu
        rank = ny if self.rank is None else int(self.rank)
        if not 1 <= rank <= ny:
            raise FitError(f"{what}: rank", expected=f"1 to {ny}", got=str(rank), remedy="correct it")
        before = np.concatenate([one.y[:-1] for one in records])
        after = np.concatenate([one.y[1:] for one in records])
        inputs = np.concatenate([one.u[:-1] for one in records])
        if self.total:
            common = np.hstack([before, after, inputs])
            left, _, _ = np.linalg.svd(common, full_matrices=False)
            leading = left[:, : min(rank + nu, left.shape[1])]
            before, after = leading @ (leading.T @ before), leading @ (leading.T @ after)
        directions = np.linalg.svd(before, full_matrices=False)[2][:rank].T
        rows = np.hstack([before @ directions, inputs] + ([np.ones((len(before), 1))] if self.offset else []))
        solution = solve(lambda: [(rows, after @ directions)], what, ridge=self.ridge)
        theta = solution.coefficients.T
        return LinearModel(
            spec,
            theta[:, :rank],
            theta[:, rank : rank + nu],
            directions,
            np.zeros((ny, nu)),
            directions.T,
            theta[:, -1] if self.offset else np.zeros(rank),
            np.zeros(ny),
            notes=_notes(solution),
        )


@dataclass(frozen=True)
class Dictionary:
    """Functions of the outputs (and their past) that lift them to a Koopman state.

    The lifted state starts with the arguments themselves, so that the output is read off without error.

    Parameters
    ----------
    degree : int
        Monomials up to this degree.
    trigonometric : bool
        Sine and cosine of every argument.
    centres : tuple of tuple of float
        Centres of thin-plate splines ``r^2 log r`` in the scaled arguments.
    scale : tuple of float
        The arguments are divided by these first.
    """

    degree: int = 1
    trigonometric: bool = False
    centres: tuple[tuple[float, ...], ...] = ()
    scale: tuple[float, ...] = ()

    def lift(self, arguments: FloatArray) -> FloatArray:
        """Return the lifted state (..., nz) of arguments (..., n)."""
        z = arguments / np.asarray(self.scale)
        n = z.shape[-1]
        parts = [z, np.ones((*z.shape[:-1], 1))]
        for degree in range(2, self.degree + 1):
            rows = [np.prod(z[..., list(pick)], axis=-1) for pick in combinations_with_replacement(range(n), degree)]
            parts.append(np.stack(rows, axis=-1))
        if self.trigonometric:
            parts += [np.sin(arguments), np.cos(arguments) - 1.0]
        if self.centres:
            distance = np.linalg.norm(z[..., None, :] - np.asarray(self.centres), axis=-1)
            parts.append(distance**2 * np.log(np.where(distance > 0, distance, 1.0)))
        return np.concatenate(parts, axis=-1)


@dataclass(frozen=True, eq=False)
class KoopmanModel:
    """``z+ = A z + B u`` on lifted outputs; the state is ``[z, past outputs and inputs]``.

    A seen output replaces the present one and the state is lifted anew; in free run the lifted state moves linearly.
    """

    spec: PlantSpec
    a_matrix: FloatArray
    b_matrix: FloatArray
    dictionary: Dictionary
    delays: int
    notes: dict[str, Any] = field(default_factory=dict)

    @property
    def burn_in(self) -> int:
        """Samples until the lifted state has seen its whole past; none without delays."""
        return self.delays if self.delays > 1 else 0

    @property
    def lifted(self) -> int:
        """Dimension of the lifted state."""
        return int(self.a_matrix.shape[0])

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the state (nx,) at the first sample; the past is the straight line through the first samples."""
        same_language(self.spec, data)
        back = np.arange(self.delays)[:, None]
        slope = np.zeros(self.spec.ny)
        few = min(len(data), 2 * self.delays)
        if self.delays > 1 and few > 1:
            slope = np.polyfit(np.arange(few), data.y[:few], 1)[0]
        held = np.tile(data.u[0], self.delays - 1)
        return self._state(np.concatenate([(data.y[0] - back * slope).ravel(), held]))

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the output (..., ny), the first arguments of the lifted state."""
        y: FloatArray = x[..., : self.spec.ny] * np.asarray(self.dictionary.scale)[: self.spec.ny]
        return y

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next state (..., nx)."""
        z, past = x[..., : self.lifted], x[..., self.lifted :]
        moved = z @ self.a_matrix.T + u @ self.b_matrix.T
        ny, nu = self.spec.ny, self.spec.nu
        seen, held = past[..., : self.delays * ny], past[..., self.delays * ny :]
        parts = [moved, self.output(moved, u), seen[..., : (self.delays - 1) * ny]]
        if self.delays > 1:
            parts += [np.broadcast_to(u, (*x.shape[:-1], nu)), held[..., : (self.delays - 2) * nu]]
        return np.concatenate(parts, axis=-1)

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the state (..., nx) lifted from the output just seen."""
        past = x[..., self.lifted + self.spec.ny :]
        return self._state(np.concatenate([np.broadcast_to(y, (*x.shape[:-1], self.spec.ny)), past], axis=-1))

    def _state(self, past: FloatArray) -> FloatArray:
        return np.concatenate([self.dictionary.lift(past), past], axis=-1)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description."""
        return {
            "kind": "koopman",
            "spec": spec_to_dict(self.spec),
            "a_matrix": self.a_matrix.tolist(),
            "b_matrix": self.b_matrix.tolist(),
            "dictionary": {
                "degree": self.dictionary.degree,
                "trigonometric": self.dictionary.trigonometric,
                "centres": [list(centre) for centre in self.dictionary.centres],
                "scale": list(self.dictionary.scale),
            },
            "delays": self.delays,
            "notes": self.notes,
        }

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> KoopmanModel:
        """Return the model of a description."""
        spec = spec_from_dict(content["spec"])
        given = content["dictionary"]
        dictionary = Dictionary(
            int(given["degree"]),
            bool(given["trigonometric"]),
            tuple(tuple(map(float, centre)) for centre in given["centres"]),
            tuple(map(float, given["scale"])),
        )
        a = np.array(content["a_matrix"], dtype=float)
        b = np.array(content["b_matrix"], dtype=float).reshape(a.shape[0], spec.nu)
        return cls(spec, a, b, dictionary, int(content["delays"]), dict(content.get("notes", {})))


@dataclass(frozen=True)
class Edmdc:
    """Extended DMD with control: a linear map between lifted outputs, driven by the input.

    Williams, Kevrekidis & Rowley 2015 (J. Nonlinear Sci. 25:1307, eq. 13); Korda & Mezic 2018 (Automatica 93:149,
    eq. 18).

    Parameters
    ----------
    degree : int
        Monomials of the outputs up to this degree; more is not always better.
    trigonometric : bool
        Sine and cosine of the outputs too, for angles.
    radial : int
        Number of thin-plate splines, their centres drawn from the data.
    delays : int
        Number of past samples among the arguments (1: none).
    ridge : float
        Tikhonov weight relative to the scaled columns; lifted columns are often nearly dependent.
    """

    degree: int = 2
    trigonometric: bool = False
    radial: int = 0
    delays: int = 1
    ridge: float = 1e-10

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> KoopmanModel:
        """Return the lifted linear model."""
        what = "edmdc"
        if self.degree < 1 or self.delays < 1 or self.radial < 0:
            raise FitError(
                f"{what}: options",
                expected="degree >= 1, delays >= 1, radial >= 0",
                got=f"degree={self.degree}, delays={self.delays}, radial={self.radial}",
                remedy="correct the options",
            )
        records, spec = usable(trajectories, samples=self.delays + 2, what=what)
        real_signals(spec, what)
        moving(records, what, inputs=False)
        arguments = [_arguments(one, self.delays) for one in records]
        together = np.concatenate(arguments)
        scale = np.abs(together).max(axis=0)
        scale = np.where(scale > 0, scale, 1.0)
        centres: tuple[tuple[float, ...], ...] = ()
        if self.radial:
            picked = rng.choice(len(together), size=min(self.radial, len(together)), replace=False)
            centres = tuple(tuple(map(float, row)) for row in together[np.sort(picked)] / scale)
        dictionary = Dictionary(self.degree, self.trigonometric, centres, tuple(map(float, scale)))

        def blocks() -> Iterator[tuple[FloatArray, FloatArray]]:
            for record, rows in zip(records, arguments, strict=True):
                for start in range(0, len(rows) - 1, _BLOCK):
                    lifted = dictionary.lift(rows[start : start + _BLOCK + 1])
                    held = record.u[self.delays - 1 + start :][: len(lifted) - 1]
                    yield np.hstack([lifted[:-1], held]), lifted[1:]

        solution = solve(blocks, what, ridge=self.ridge, rank_tolerance=1e-14)
        theta = solution.coefficients.T
        size = theta.shape[0]
        return KoopmanModel(spec, theta[:, :size], theta[:, size:], dictionary, self.delays, _notes(solution))


def _arguments(record: Trajectory, delays: int) -> FloatArray:
    """Return rows ``[y[k], ..., y[k - d + 1], u[k - 1], ..., u[k - d + 1]]`` for k = d - 1 .. N - 1."""
    n = len(record)
    parts = [record.y[delays - 1 - j : n - j] for j in range(delays)]
    parts += [record.u[delays - 1 - j : n - j] for j in range(1, delays)]
    return np.hstack(parts)


def _notes(solution: Solution) -> dict[str, Any]:
    """Return what a report should say of a regression."""
    return {"condition": solution.condition, "method": solution.method, "samples": solution.rows}
