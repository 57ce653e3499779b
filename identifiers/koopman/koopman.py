"""Extended dynamic mode decomposition with control: a Koopman model, linear in functions of the outputs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.algebra import column_norms, divisor
from harness.errors import FitError, InputError, refuse_unknown
from harness.judgement import refuse_law
from harness.models.determined import KEY, determined_bands
from harness.models.lqr import spectral_radius
from harness.models.spread import Matrices, Spread
from harness.scoring import same_language
from harness.signals import FloatArray, PlantSpec, Trajectory
from harness.specs import spec_from_dict, spec_to_dict
from identifiers.common.described import Described
from identifiers.common.excitation import Columns, refuse_feedback
from identifiers.common.judge.told import told
from identifiers.common.named import wrong_options
from identifiers.common.neighbours import LARGEST, coefficients_without, spread_of
from identifiers.common.normal import NormalEquations
from identifiers.common.one_step_estimate import lifted_estimate
from identifiers.common.records import learnable, missing_notes, recent
from identifiers.common.regression import Solution, solve
from identifiers.common.stability import clip_eigenvalues, nearest_stable
from identifiers.koopman.learned import Stretch, learned_functions
from identifiers.linear.arx import solution_notes
from identifiers.sparse.stlsq import eliminate

_BLOCK = 50_000
BIAS_OF_FUNCTIONS = (
    "functions of noisy outputs are no exact regressors, and a dictionary that is not closed errs by itself: "
    "neither is in the spread"
)
"""What is said beside every spread of a lifted model."""
IDLE = 1e-3
"""Probability of what functions add to the prediction of an output, were they idle, above which it is left to chance:
errors that are correlated in time, which say more than they know, keep functions rather than lose them."""
STRETCHES = 10  # Into which records are cut, at least, where functions are learned: every fifth is held out.
_USERS: dict[str, Callable[[FloatArray], FloatArray]] = {}


def register_functions(name: str, functions: Callable[[FloatArray], FloatArray]) -> None:
    """Make functions of the user known, for the option ``functions`` of ``edmdc`` and for models read from files.

    A stored model holds the name only, so that reading one never runs code of the file.

    Parameters
    ----------
    name : str
    functions : callable
        Takes arguments (..., n), outputs in their own units and delays as ``edmdc`` stacks them, and returns (..., m).

    Examples
    --------
    >>> register_functions("energy", lambda y: y[..., :1] ** 2)
    >>> registered("energy")(np.array([[3.0]])).tolist()
    [[9.0]]
    """
    _USERS[name] = functions


def registered(name: str) -> Callable[[FloatArray], FloatArray]:
    """Return the functions registered under a name.

    Raises
    ------
    InputError
        If there are none.
    """
    remedy = "call identifiers.koopman.koopman.register_functions(name, functions) first"
    refuse_unknown(f"functions {name!r} of a Koopman dictionary", name, _USERS, remedy=remedy)
    return _USERS[name]


def _users(name: str, arguments: FloatArray) -> FloatArray:
    """Return what functions of the user give (..., m), or say that their shape is wrong."""
    found = np.asarray(registered(name)(arguments), dtype=float)
    if found.shape[:-1] != arguments.shape[:-1] or found.ndim != arguments.ndim:
        raise InputError(
            f"functions {name!r} of a Koopman dictionary",
            expected=f"an array of shape {(*arguments.shape[:-1], 'm')}",
            got=str(found.shape),
            remedy="keep the leading axes and put the functions on the last",
        )
    return found


@lru_cache(maxsize=64)
def _monomials(n: int, degree: int) -> npt.NDArray[np.intp]:
    """Return the factors (m, degree) of all monomials of a degree in n arguments."""
    return np.array(list(combinations_with_replacement(range(n), degree)), dtype=np.intp)


@dataclass(frozen=True)
class Lifting(Described):
    """Functions of the outputs (and their past) that lift them to a Koopman state.

    The lifted state starts with the arguments themselves, so that the output is read off without error.

    Parameters
    ----------
    degree : int
        Monomials up to this degree.
    trigonometric : bool
        Sine and cosine of every argument.
    centres : tuple of tuple of float
        Centres of radial functions in the scaled arguments.
    scale : tuple of float
        The arguments are divided by these first.
    width : float
        Of Gaussian radial functions ``exp(-r^2 / (2 width^2))``; 0 takes thin-plate splines ``r^2 log r``.
    fourier : int
        Sines and cosines of ``pi j z`` for j = 1 .. fourier of every scaled argument z (its range is -1 .. 1).
    functions : tuple of str
        Names of functions of the user, see :func:`register_functions`.
    units : tuple of tuple of float
        Learned functions ``tanh(b + w' z)`` of the scaled arguments z, a row ``[b, w]`` for each.
    """

    degree: int = 1
    trigonometric: bool = False
    centres: tuple[tuple[float, ...], ...] = ()
    scale: tuple[float, ...] = ()
    width: float = 0.0
    fourier: int = 0
    functions: tuple[str, ...] = ()
    units: tuple[tuple[float, ...], ...] = ()

    def lift(self, arguments: FloatArray) -> FloatArray:
        """Return the lifted state (..., nz) of arguments (..., n)."""
        z = arguments / np.asarray(self.scale)
        n = z.shape[-1]
        parts = [z, np.ones((*z.shape[:-1], 1))]
        for degree in range(2, self.degree + 1):
            parts.append(np.prod(z[..., _monomials(n, degree)], axis=-1))
        if self.trigonometric:
            parts += [np.sin(arguments), np.cos(arguments) - 1.0]
        if self.centres:
            distance = np.linalg.norm(z[..., None, :] - np.asarray(self.centres), axis=-1)
            if self.width > 0:
                parts.append(np.exp(-0.5 * (distance / self.width) ** 2))
            else:
                parts.append(distance**2 * np.log(divisor(distance)))
        for j in range(1, self.fourier + 1):
            parts += [np.sin(np.pi * j * z), np.cos(np.pi * j * z)]
        if self.units:
            weights = np.asarray(self.units)
            parts.append(np.tanh(weights[:, 0] + z @ weights[:, 1:].T))
        parts += [_users(name, arguments) for name in self.functions]
        return np.concatenate(parts, axis=-1)

    def names(self, arguments: Sequence[str], size: int) -> list[str]:
        """Return the names of the functions, given those of the arguments and the number of functions.

        Examples
        --------
        >>> Lifting(2, scale=(1.0, 1.0)).names(["a", "b"], 6)
        ['a', 'b', '1', 'a a', 'a b', 'b b']
        """
        names = [*arguments, "1"]
        for degree in range(2, self.degree + 1):
            names += [" ".join(pick) for pick in combinations_with_replacement(arguments, degree)]
        if self.trigonometric:
            names += [f"{what}({argument})" for what in ("sin", "cos") for argument in arguments]
        names += [f"radial {j + 1}" for j in range(len(self.centres))]
        for j in range(1, self.fourier + 1):
            names += [f"{what}({j} pi {argument})" for what in ("sin", "cos") for argument in arguments]
        names += [f"learned {j + 1}" for j in range(len(self.units))]
        return names + [f"function {j + 1} of {', '.join(self.functions)}" for j in range(size - len(names))]


@dataclass(frozen=True, eq=False)
class KoopmanModel:
    """``z+ = A z + B u`` on lifted outputs; the state is ``[z, past outputs and inputs]``.

    A seen output replaces the present one and the state is lifted anew; in free run the lifted state moves linearly.
    """

    spec: PlantSpec
    a_matrix: FloatArray
    b_matrix: FloatArray
    dictionary: Lifting
    delays: int
    notes: dict[str, Any] = field(default_factory=dict)
    spread: Spread | None = None

    @property
    def matrices(self) -> Matrices:
        """A, B, C, D between inputs and outputs in free run, where the lifted state moves linearly."""
        ny = self.spec.ny
        c = np.zeros((ny, self.lifted))
        c[:, :ny] = np.diag(np.asarray(self.dictionary.scale)[:ny])
        return self.a_matrix, self.b_matrix, c, np.zeros((ny, self.spec.nu))

    @property
    def burn_in(self) -> int:
        """Samples until the lifted state has seen its whole past; none without delays."""
        return self.delays if self.delays > 1 else 0

    @property
    def lifted(self) -> int:
        """Dimension of the lifted state."""
        return int(self.a_matrix.shape[0])

    @property
    def constant(self) -> int:
        """Which of the lifted states is the constant function: it comes after the arguments."""
        return len(self.dictionary.scale)

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

    def filtered(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the states (N, nx), each lifted when its output was seen, under u (N, nu) and y (N, ny)."""
        return self._state(recent(x[self.lifted :], self.delays, u, y))

    def _state(self, past: FloatArray) -> FloatArray:
        return np.concatenate([self.dictionary.lift(past), past], axis=-1)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description."""
        return {
            "kind": "koopman",
            "spec": spec_to_dict(self.spec),
            "a_matrix": self.a_matrix.tolist(),
            "b_matrix": self.b_matrix.tolist(),
            "dictionary": self.dictionary.to_dict(),
            "delays": self.delays,
            "notes": self.notes,
            **({} if self.spread is None else {"spread": self.spread.to_dict(self)}),
        }

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> KoopmanModel:
        """Return the model of a description."""
        spec = spec_from_dict(content["spec"])
        without = {"width": 0.0, "fourier": 0, "functions": (), "units": ()}
        dictionary = Lifting.from_dict({**without, **content["dictionary"]})
        for name in dictionary.functions:
            registered(name)
        a = np.array(content["a_matrix"], dtype=float)
        b = np.array(content["b_matrix"], dtype=float).reshape(a.shape[0], spec.nu)
        model = cls(spec, a, b, dictionary, int(content["delays"]), dict(content.get("notes", {})))
        kept = content.get("spread")
        return model if kept is None else replace(model, spread=Spread.from_dict(kept, model.matrices))


@dataclass(frozen=True)
class Edmdc:
    """Extended DMD with control: a linear map between lifted outputs, driven by the input.

    Williams, Kevrekidis & Rowley 2015 (J. Nonlinear Sci. 25:1307, eq. 13); Korda & Mezic 2018 (Automatica 93:149,
    eq. 18). An output that follows its arguments linearly, as far as the records tell, does so in the model; the notes
    name it (``"linear"``).

    Parameters
    ----------
    degree : int
        Monomials of the outputs up to this degree; more is not always better.
    trigonometric : bool
        Sine and cosine of the outputs too, for angles.
    radial : int
        Number of radial functions, their centres drawn from the data.
    width : float
        Width of Gaussian radial functions, in arguments scaled to -1 .. 1; 0 takes thin-plate splines.
    fourier : int
        Sines and cosines of so many harmonics of every scaled argument.
    functions : tuple of str
        Functions of the user by the name they were registered under (:func:`register_functions`).
    learned : int
        So many functions that are learned (:func:`identifiers.koopman.learned.learned_functions`): those with which
        free runs over ``horizon`` samples err least. They are left out where they do not pay on stretches that are held
        out; the notes say both errors.
    horizon : int
        Samples ahead for which functions are learned.
    threshold : float
        Sparse Koopman matrices: entries whose loss raises the residual least are dropped, one at a time, while it stays
        below this fraction of the lifted function or 1.22 times its value without dropping
        (:func:`identifiers.sparse.stlsq.eliminate`). 0 keeps all.
    delays : int
        Number of past samples among the arguments (1: none).
    stable : bool
        Nearest stable model where a free run would grow: all eigenvalues but that of the constant function, which is 1,
        within radius 0.999. Not with ``threshold``: the nearest stable matrix is not sparse.
    ridge : float
        Tikhonov weight relative to the scaled columns; lifted columns are often nearly dependent.
    least_excitation : float
        As of ``least-squares``.
    """

    degree: int = 2
    trigonometric: bool = False
    radial: int = 0
    width: float = 0.0
    fourier: int = 0
    functions: tuple[str, ...] = ()
    learned: int = 0
    horizon: int = 20
    threshold: float = 0.0
    delays: int = 1
    stable: bool = False
    ridge: float = 1e-10
    least_excitation: float = 2.0

    @told
    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> KoopmanModel:
        """Return the lifted linear model."""
        what = "edmdc"
        self._check_options()
        records, spec = learnable(trajectories, samples=self.delays + 2, what=what)
        refuse_law(records, what, self.least_excitation)
        arguments = [_arguments(record, self.delays) for record in records]
        together = np.concatenate(arguments)
        dictionary = self._dictionary(together, rng)
        learning: dict[str, Any] = {}
        if self.learned:
            dictionary, learning = self._with_learned(dictionary, records, arguments, rng)

        def blocks() -> Iterator[tuple[FloatArray, FloatArray]]:
            for record, rows in zip(records, arguments, strict=True):
                for start in range(0, len(rows) - 1, _BLOCK):
                    lifted = dictionary.lift(rows[start : start + _BLOCK + 1])
                    held = record.u[self.delays - 1 + start :][: len(lifted) - 1]
                    yield np.hstack([lifted[:-1], held]), lifted[1:]

        solution = solve(blocks, what, ridge=self.ridge, rank_tolerance=1e-14)
        size = solution.coefficients.shape[1]
        lifted_columns = Columns.lifted(size, spec)
        refuse_feedback(solution, lifted_columns, self.least_excitation, what, ridge=self.ridge)
        theta, notes = (
            solution.coefficients.T,
            {**solution_notes(solution), **missing_notes(trajectories, records)} | learning,
        )
        idle = _idle(solution, together.shape[1] + 1, spec) if self.threshold == 0 else []
        kept = [k for k in range(len(solution.coefficients)) if not together.shape[1] < k < size]

        def idle_blocks() -> Iterator[tuple[FloatArray, FloatArray]]:
            for phi, target in blocks():
                yield phi[:, kept], target[:, idle]

        lean = solve(idle_blocks, what, ridge=self.ridge, rank_tolerance=1e-14) if idle else None
        if lean is not None:
            values = solution.coefficients.copy()
            values[:, idle] = 0.0
            values[np.ix_(kept, idle)] = lean.coefficients
            solution, theta = replace(solution, coefficients=values), values.T
            notes["linear"] = [spec.outputs[output].name for output in idle]
        if self.threshold > 0:
            theta, notes["terms"] = self._sparse(blocks, size + spec.nu, size)
        elif self.stable and (settled := _settled(solution, together.shape[1])) is not None:
            theta, notes["stabilized"] = settled, True
        elif (
            estimate := lifted_estimate(dictionary.names(_names(spec, self.delays), size), spec, solution)
        ) is not None:
            notes["estimate"] = estimate.to_dict()
        model = KoopmanModel(spec, theta[:, :size], theta[:, size:], dictionary, self.delays, notes)
        if size <= LARGEST:
            notes[KEY] = determined_bands(model.matrices, records)
        if self.threshold > 0 or "stabilized" in notes:
            return model
        found = coefficients_without(blocks, solution)
        if found is not None and lean is not None and (near := coefficients_without(idle_blocks, lean)) is not None:
            found[0][:, :, idle] = 0.0
            found[0][np.ix_(range(len(near[0])), kept, idle)] = near[0]
        return _with_spread(model, found)

    def _check_options(self) -> None:
        """Refuse options that go beyond their ranges, or not together."""
        counts = min(self.radial, self.fourier, self.learned) >= 0 and self.horizon >= 1
        if self.degree < 1 or self.delays < 1 or not counts or not 0 <= self.threshold < 1:
            raise wrong_options(
                self,
                "edmdc",
                "degree >= 1, delays >= 1, radial, fourier and learned >= 0, horizon >= 1, 0 <= threshold < 1",
                "degree delays radial fourier learned horizon threshold",
            )
        if self.stable and self.threshold > 0:
            raise FitError(
                "edmdc: stable and threshold together",
                expected="one of them",
                got=f"stable=True, threshold={self.threshold}",
                remedy="leave out threshold: the nearest stable matrix is not sparse",
            )

    def _dictionary(self, together: FloatArray, rng: np.random.Generator) -> Lifting:
        """Return the functions over the scale of the arguments (N, k), centres drawn among them."""
        scale = divisor(np.abs(together).max(axis=0))
        centres: tuple[tuple[float, ...], ...] = ()
        if self.radial:
            picked = rng.choice(len(together), size=min(self.radial, len(together)), replace=False)
            centres = tuple(tuple(map(float, row)) for row in together[np.sort(picked)] / scale)
        return Lifting(
            self.degree,
            self.trigonometric,
            centres,
            tuple(map(float, scale)),
            self.width,
            self.fourier,
            tuple(self.functions),
        )

    def _with_learned(
        self,
        dictionary: Lifting,
        records: Sequence[Trajectory],
        arguments: Sequence[FloatArray],
        rng: np.random.Generator,
    ) -> tuple[Lifting, dict[str, Any]]:
        """Return the dictionary with the functions that were learned, and what their search says of itself."""
        size = np.asarray(dictionary.scale)
        force = divisor(np.abs(np.concatenate([record.u for record in records])).max(axis=0, initial=0.0))
        stretches = []
        for record, rows in zip(records, arguments, strict=True):
            parts = max(1, min(-(-STRETCHES // len(records)), len(rows) // (2 * self.horizon)))
            for cut in np.array_split(np.arange(len(rows)), parts):
                if len(cut) > self.horizon:
                    inputs = record.u[self.delays - 1 :][cut] / force
                    stretches.append(Stretch(rows[cut] / size, dictionary.lift(rows[cut]), inputs))
        if len(stretches) < 2:
            raise FitError(
                "edmdc: too little to learn functions from",
                expected=f"two stretches and more of over {self.horizon} samples, one of which is held out",
                got=f"{len(stretches)} in records of {', '.join(str(len(record)) for record in records[:4])} samples",
                remedy="record longer, lower horizon, or choose the dictionary (learned=0)",
            )
        found = learned_functions(stretches, records[0].spec.ny, self.learned, self.horizon, self.ridge, rng=rng)
        said = {"kept": len(found.units), "held_out_before": found.before, "held_out_after": found.after}
        return replace(dictionary, units=found.units), {"learned": said}

    def _sparse(
        self, blocks: Callable[[], Iterator[tuple[FloatArray, FloatArray]]], p: int, m: int
    ) -> tuple[FloatArray, int]:
        """Return the lifted matrix [A B] with the entries that do not count left out, and how many are left."""
        sums = NormalEquations.of(((phi.T, target.T) for phi, target in blocks()), p, m)
        coefficients, support = eliminate(sums, self.threshold)
        return coefficients.T, int(support.sum())


def _idle(solution: Solution, first: int, spec: PlantSpec) -> list[int]:
    """Return the outputs that the functions beyond their arguments and a constant foretell no better than by chance.

    The F test of these functions together (Seber & Lee 2003, *Linear Regression Analysis*, theorem 4.1), output by
    output: in a model of more they hold noise alone, which grows with their degree outside of the records.

    - ``solution``: of all functions
    - ``first``: number of the first of these functions among the columns
    """
    from scipy.stats import f

    p, size = solution.coefficients.shape
    count, free = size - first, solution.rows - p
    if count < 1 or free < 1:
        return []
    theta = solution.coefficients[:, : spec.ny] * solution.scale[:, None]
    kept = np.r_[:first, size:p]
    whole = solution.factor @ theta
    part = solution.factor[:, kept]
    lost = np.sum((whole - part @ np.linalg.lstsq(part, whole, rcond=1e-14)[0]) ** 2, axis=0)
    noise = solution.residual_rms[: spec.ny] ** 2 * solution.rows / free
    with np.errstate(divide="ignore", invalid="ignore"):
        chances = f.sf(lost / count / noise, count, free)
    return [int(output) for output in np.flatnonzero(chances > IDLE)]


def _with_spread(model: KoopmanModel, found: tuple[FloatArray, float] | None) -> KoopmanModel:
    """Return the model with what the regression finds without one stretch of the records each."""
    if found is None:
        return model
    size, (_, _, c, d) = model.lifted, model.matrices
    near = [(one[:size].T, one[size:].T, c, d) for one in found[0]]
    spread = spread_of(near, factor=found[1], warning=BIAS_OF_FUNCTIONS)
    return replace(model, spread=spread)


def _names(spec: PlantSpec, delays: int) -> list[str]:
    """Return the names of the arguments, as they are stacked."""
    names = [c.name + (f"[k-{j}]" if j else "") for j in range(delays) for c in spec.outputs]
    return names + [f"{c.name}[k-{j}]" for j in range(1, delays) for c in spec.inputs]


def _settled(solution: Solution, constant: int) -> FloatArray | None:
    """Return the nearest lifted matrix [A B] whose free runs do not grow, None where the fit's own do not.

    The constant function keeps itself and drives the others as an input does; theirs is the part that must be stable.
    """
    size = solution.coefficients.shape[1]
    moving_functions = np.delete(np.arange(size), constant)
    order = np.concatenate([moving_functions, [constant], np.arange(size, len(solution.coefficients))])
    theta = solution.coefficients[order][:, moving_functions]
    if spectral_radius(theta[: size - 1]) < 1.0:
        return None
    factor = (solution.factor * solution.scale)[:, order]
    weights = 1.0 / column_norms(factor[:, : size - 1])
    nearest = nearest_stable(theta, factor, size - 1, clip_eigenvalues, weights)
    whole = np.zeros_like(solution.coefficients)
    whole[np.ix_(order, moving_functions)] = nearest
    whole[constant, constant] = 1.0
    return whole.T


def _arguments(record: Trajectory, delays: int) -> FloatArray:
    """Return rows ``[y[k], ..., y[k - d + 1], u[k - 1], ..., u[k - d + 1]]`` for k = d - 1 .. N - 1."""
    n = len(record)
    parts = [record.y[delays - 1 - j : n - j] for j in range(delays)]
    parts += [record.u[delays - 1 - j : n - j] for j in range(1, delays)]
    return np.hstack(parts)
