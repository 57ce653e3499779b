"""Inertial parameters from normal equations: semidefinite program, log-Cholesky, or least squares, beside a prior.

The problem of all methods: ``1/2 x'Gx - s'x + sum_b D(J_b, J0_b) / trust^2`` over x = inertial parameters of the
bodies, then friction; G and s weighted by the noise. The bodies are scaled by their prior, ``J = T K T'`` with
``J0 = T T'``, so that K = 1 is the prior and numbers are near 1.
"""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from harness.errors import FitError
from harness.physics.arms.inertia import from_pseudo_inertia, pseudo_inertia
from harness.signals import FloatArray

_CAREFUL: tuple[dict[str, Any], ...] = (
    {},
    {"iterative_refinement_max_iter": 50, "iterative_refinement_reltol": 1e-15, "iterative_refinement_abstol": 1e-15},
    {"static_regularization_constant": 1e-7},
    {"equilibrate_enable": False},
)
"""Options of the solver, tried in turn: now and then it fails by rounding where a program has no bound (1 of 62 for the
masses of a 7-axis arm), and solves it with more refinement of its linear systems."""
LEAST = 1e-6  # Smallest eigenvalue of K in the semidefinite program: a body a millionth of its prior in some direction.
NO_PRIOR = 1e-6  # Weight where no prior is wanted: as if the prior were trusted to a factor of a thousand.
ITERATIONS = 300
SETTLED = 1e-3
"""What a step of Newton's may still promise of the cost, a log-likelihood, where rounding ended the search."""
_ROWS, _COLUMNS = np.triu_indices(4)
_DIAGONAL = np.nonzero(_ROWS == _COLUMNS)[0]


@dataclass(frozen=True, eq=False)
class Bodies:
    """The free bodies, scaled by their prior."""

    prior: FloatArray  # (B, 10): Consistent
    scale: FloatArray = field(init=False)  # (B, 4, 4): T, lower triangular: ``J0 = T T'``
    maps: FloatArray = field(init=False)  # (B, 10, 16): From the entries of K to parameters
    boxes: Sequence[tuple[FloatArray, FloatArray] | None] = ()
    """sequence of (low (3,), high (3,)) or None: Box that holds the centre of mass and every part of a body [m], in its
    joint's frame.
    """

    def __post_init__(self) -> None:
        prior = np.asarray(self.prior, dtype=float).reshape(-1, 10)
        scale = np.linalg.cholesky(pseudo_inertia(prior))
        maps = np.empty((len(prior), 10, 16))
        for column in range(16):
            unit = np.zeros((4, 4))
            unit.flat[column] = 0.5
            unit = unit + unit.T
            maps[:, :, column] = from_pseudo_inertia(scale @ unit @ np.swapaxes(scale, 1, 2))
        object.__setattr__(self, "prior", prior)
        object.__setattr__(self, "scale", scale)
        object.__setattr__(self, "maps", maps)


@dataclass(frozen=True, eq=False)
class InertialProblem:
    """Weighted normal equations of bodies and friction."""

    # (k, k), (k,): G and s; the first 10 B unknowns are the bodies'
    gram: FloatArray
    side: FloatArray
    bodies: Bodies
    trust: float | None  # Relative standard deviation of the prior inertia; None: no prior
    positive: FloatArray  # array of bool (k - 10 B,): Which of the other unknowns cannot be negative

    @property
    def weight(self) -> float:
        """1 / trust^2; without a prior next to nothing, which keeps directions that nothing determines finite."""
        return NO_PRIOR if self.trust is None else self.trust**-2

    def cost(self, x: FloatArray) -> float:
        """Return the objective at x (k,), without the constant."""
        from harness.physics.arms.inertia import divergence

        own = x[: self.bodies.prior.size].reshape(-1, 10)
        prior = self.weight * float(np.sum(divergence(own, self.bodies.prior))) if self.weight else 0.0
        return float(0.5 * x @ self.gram @ x - self.side @ x) + prior


def by_semidefinite_program(problem: InertialProblem, *, objective: FloatArray | None = None) -> FloatArray:
    """Return x (k,) by a semidefinite program (cvxpy, Clarabel): the global optimum among consistent bodies.

    Raises FitError if the solver does not end at an optimum.

    - ``objective`` (k,): minimise this linear function instead, the data being exact (``R x = R x_LS``): how far the
      constraints alone bound a parameter that the motion does not show
    """
    program = _Program(problem)
    if objective is None:
        return program.solved(program.cost)
    size = np.linalg.norm(program.root, axis=1, keepdims=True)
    exact = (program.root / size) @ program.x == program.known / size[:, 0]
    return program.solved(objective @ program.x, exact, linear=objective)


class _Program:
    """The unknowns of a problem in cvxpy, what limits them, and their cost."""

    def __init__(self, problem: InertialProblem) -> None:
        # its stubs miss most of its functions
        self.cp: Any = importlib.import_module("cvxpy")
        cp, prior = self.cp, problem.bodies.prior
        count, others = len(prior), problem.side.size - prior.size
        blocks = [cp.Variable((4, 4), symmetric=True) for _ in range(count)]
        free = cp.Variable(max(others, 1))
        parts = [problem.bodies.maps[b] @ cp.vec(blocks[b], order="C") for b in range(count)]
        self.x = cp.hstack([*parts, free[:others]]) if others else cp.hstack(parts)
        self.limits = [block >> LEAST * np.eye(4) for block in blocks]
        rows = np.nonzero(problem.positive)[0] if others else np.zeros(0)
        self.limits += [free[rows] >= 0] if rows.size else []
        for b, box in enumerate(problem.bodies.boxes):
            if box is not None:
                self.limits += _inside(parts[b], *box)
        self.root, self.known = _root(problem.gram, problem.side)
        # Measured from the prior: the numbers of the solver stay near those that the answer moves by.
        base = np.concatenate([prior.ravel(), np.zeros(others)])
        self.misfit = 0.5 * cp.sum_squares(self.root @ (self.x - base) - (self.known - self.root @ base))
        self.cost = self.misfit
        if problem.weight:
            self.cost = self.cost + problem.weight * sum(cp.trace(block) - cp.log_det(block) for block in blocks)

    def solved(self, cost: Any, *limits: Any, linear: FloatArray | None = None) -> FloatArray:
        """Return where a cost is least; of a ``linear`` one that has no least value, its infinite terms."""
        cp, failed = self.cp, None
        for options in _CAREFUL:
            task = cp.Problem(cp.Minimize(cost), [*self.limits, *limits])
            try:
                with warnings.catch_warnings():
                    # "may be inaccurate": judged below by what the answer costs, not by a warning
                    warnings.simplefilter("ignore", UserWarning)
                    task.solve(solver=cp.CLARABEL, **options)
                break
            except cp.error.SolverError as error:
                failed = error
        else:
            raise _unsolved(str(failed)) from failed
        if linear is not None and task.status in ("unbounded", "unbounded_inaccurate"):
            return np.array(
                [-np.inf if coefficient > 0 else np.inf if coefficient < 0 else 0.0 for coefficient in linear]
            )
        if self.x.value is None or task.status not in ("optimal", "optimal_inaccurate"):
            raise _unsolved(str(task.status))
        return np.asarray(self.x.value, dtype=float).ravel()


def by_log_cholesky(problem: InertialProblem) -> FloatArray:
    """Return x (k,) by Newton's method in log-Cholesky coordinates of K: consistent at every step, no constraint.

    The other unknowns are linear: for given bodies the best ones, none below nothing where that is asked, are known
    (variable projection; Golub & Pereyra 1973, *SIAM J. Numer. Anal.* 10:413). From the prior on, in trust regions; the
    same optimum as the semidefinite program wherever that lies inside its bounds.

    Raises FitError if it does not converge.
    """
    from scipy.optimize import minimize, nnls

    count = len(problem.bodies.prior)
    root, known = _root(problem.gram, problem.side)
    rows, others = root[:, : 10 * count], root[:, 10 * count :]
    free = ~np.asarray(problem.positive, dtype=bool)
    halves = np.concatenate([others, -others[:, free]], axis=1)  # of what may have either sign

    def at(z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return U, x, the misfit, and by how much each body's K changes the data's part (symmetric)."""
        U = _factor(z.reshape(count, 10))
        own = np.einsum("bij,bj->bi", problem.bodies.maps, (U @ np.swapaxes(U, 1, 2)).reshape(count, 16)).ravel()
        found = nnls(halves, known - rows @ own)[0] if halves.shape[1] else np.zeros(0)
        joints = found[: others.shape[1]]
        joints[free] -= found[others.shape[1] :]
        miss = rows @ own + others @ joints - known
        by_K = np.einsum("bij,bi->bj", problem.bodies.maps, (rows.T @ miss).reshape(count, 10)).reshape(count, 4, 4)
        by_K = 0.5 * (by_K + np.swapaxes(by_K, 1, 2)) + problem.weight * np.eye(4)
        return U, np.concatenate([own, joints]), miss, by_K

    def value_and_gradient(z: FloatArray) -> tuple[float, FloatArray]:
        U, _, miss, B = at(z)
        prior = float(np.sum(U**2)) - 2 * float(np.sum(z.reshape(count, 10)[:, _DIAGONAL])) - 4 * count
        gradient = 2 * (B @ U)[:, _ROWS, _COLUMNS]
        gradient[:, _DIAGONAL] *= U[:, range(4), range(4)]
        gradient[:, _DIAGONAL] -= 2 * problem.weight
        return 0.5 * float(miss @ miss) + problem.weight * prior, gradient.ravel()

    def curvature(z: FloatArray) -> FloatArray:
        U, x, _, B = at(z)
        jacobian, local = np.zeros((2, 10 * count, 10 * count))
        for b in range(count):
            part = slice(10 * b, 10 * b + 10)
            chain = np.ones(10)
            chain[_DIAGONAL] = U[b, range(4), range(4)]
            for row in range(10):
                unit = np.zeros((4, 4))
                unit[_ROWS[row], _COLUMNS[row]] = chain[row]
                moved = unit @ U[b].T
                jacobian[part, 10 * b + row] = problem.bodies.maps[b] @ (moved + moved.T).ravel()
            same = _COLUMNS[:, None] == _COLUMNS[None, :]
            block = 2 * B[b][np.ix_(_ROWS, _ROWS)] * same * np.outer(chain, chain)
            block[_DIAGONAL, _DIAGONAL] += 2 * (B[b] @ U[b]).diagonal() * U[b].diagonal()
            local[part, part] = block
        moved = rows @ jacobian
        following = np.linalg.qr(others[:, (x[10 * count :] != 0) | free])[0]
        moved -= following @ (following.T @ moved)
        return np.asarray(moved.T @ moved + local)

    start = np.zeros(10 * count)
    scale = max(abs(value_and_gradient(start)[0]), 1.0)
    search: Any = minimize  # its stubs do not know this method's arguments
    found = search(
        lambda z: value_and_gradient(z)[0] / scale,
        start,
        jac=lambda z: value_and_gradient(z)[1] / scale,
        hess=lambda z: curvature(z) / scale,
        method="trust-exact",
        options={"maxiter": ITERATIONS, "gtol": 1e-3 / scale},
    )
    z = np.asarray(found.x)
    gradient = value_and_gradient(z)[1]
    # rounding of the misfit may stop it just before, where a step would gain next to nothing
    if not found.success and not 0.5 * gradient @ np.linalg.lstsq(curvature(z), gradient)[0] < SETTLED:
        raise _unsolved(str(found.message))
    return at(z)[1]


def _factor(theta: FloatArray) -> FloatArray:
    """Return the upper triangular factors (B, 4, 4) of log-Cholesky coordinates (B, 10)."""
    U = np.zeros((len(theta), 4, 4))
    U[:, _ROWS, _COLUMNS] = theta
    U[:, range(4), range(4)] = np.exp(theta[:, _DIAGONAL])
    return U


def by_least_squares(problem: InertialProblem, kept: FloatArray) -> FloatArray:
    """Return x (k,) by least squares in given directions (columns of kept (k, r)), at the prior in the others."""
    start = np.concatenate([problem.bodies.prior.ravel(), np.zeros(problem.side.size - problem.bodies.prior.size)])
    root, known = _root(problem.gram, problem.side)
    rows = root @ kept
    size = np.linalg.norm(rows, axis=0)
    move = np.linalg.lstsq(rows / size, known - root @ start, rcond=None)[0] / size
    return np.asarray(start + kept @ move)


def extent_of(problem: InertialProblem, direction: FloatArray) -> tuple[float, float]:
    """Return least and largest ``direction @ x`` among bodies that reproduce the data exactly (maybe infinite).

    - ``problem``: its prior does not count
    - ``direction`` (k,)
    """
    chosen = np.asarray(direction) != 0
    low = by_semidefinite_program(problem, objective=direction)[chosen]
    high = by_semidefinite_program(problem, objective=-direction)[chosen]
    return float(direction[chosen] @ low), float(direction[chosen] @ high)


def interval_of(problem: InertialProblem, direction: FloatArray, slack: float) -> tuple[float, float]:
    """Return least and largest ``direction @ x`` among bodies whose cost is within a slack of the least.

    With half the quantile of chi square with one degree of freedom (1.92 for 95 %) these are profile likelihood
    intervals (Venzon & Moolgavkar 1988, *Applied Statistics* 37:87) beside the limits and the prior of the problem.

    - ``direction`` (k,)
    - ``slack``: in units of the cost
    """
    program = _Program(problem)
    program.solved(program.cost)
    told = program.misfit if problem.trust is None else program.cost
    within = (told - float(told.value)) / slack <= 1.0
    size = float(np.abs(direction) @ np.abs(program.x.value)) or 1.0
    chosen = np.asarray(direction) != 0
    ends = [program.solved(sign * (direction / size) @ program.x, within, linear=sign * direction) for sign in (1, -1)]
    low, high = (float(direction[chosen] @ end[chosen]) for end in ends)
    return low, high


def _inside(p: object, low: FloatArray, high: FloatArray) -> list[object]:
    """Return the constraints of a body (10,) in a box: centre of mass, and second moments within its ellipsoid.

    Any density in the box has ``h`` between the corners times m, and ``tr(Q J) >= 0`` with Q of the ellipsoid through
    the corners (Wensing, Kim & Slotine 2018, eq. 15).
    """
    middle, half = 0.5 * (low + high), np.maximum(0.5 * (high - low), 1e-4)
    mass, first = p[0], p[1:4]  # type: ignore[index]
    # second moments about the frame: S = tr(I)/2 - I
    xx, yy, zz = p[4], p[7], p[9]  # type: ignore[index]
    second = [0.5 * (yy + zz - xx), 0.5 * (xx + zz - yy), 0.5 * (xx + yy - zz)]
    limits: list[object] = []
    reach = 0.0
    for axis in range(3):
        limits += [first[axis] <= high[axis] * mass, first[axis] >= low[axis] * mass]
        about = second[axis] - 2 * middle[axis] * first[axis] + middle[axis] ** 2 * mass
        limits.append(about <= half[axis] ** 2 * mass)
        reach = reach + about / half[axis] ** 2
    # the ellipsoid through the corners has the half axes sqrt(3) times those of the box
    limits.append(reach <= 3 * mass)
    return limits


def _root(gram: FloatArray, side: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return R and r with ``R'R = G`` and ``R'r = s``, rows without information left out."""
    size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    values, vectors = np.linalg.eigh(gram / np.outer(size, size))
    keep = values > 1e-13 * values[-1]
    root = (np.sqrt(values[keep])[:, None] * vectors[:, keep].T) * size
    known = (vectors[:, keep].T @ (side / size)) / np.sqrt(values[keep])
    return root, known


def _unsolved(got: str) -> FitError:
    return FitError(
        "inertial parameters",
        expected="an optimum",
        got=got,
        remedy="give a prior (trust), record richer motion, or free fewer bodies",
    )
