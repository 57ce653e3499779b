"""One decision for all linear fits: whether the data tell the model, or the input follows the outputs by a law."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from harness.algebra import divisor, orthonormal, unit_columns
from harness.errors import FitError
from harness.judgement import dependence_text, feedback_of
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.common.criteria import instruments_of
from identifiers.common.records import lagged, lagged_blocks
from identifiers.common.regression import Solution, solve

# Columns have rms 1: a combination ten times smaller is a near-dependence, one of size 1 is a signal by itself.
_WEAK = 0.1
# A louder residual does not hide a law: at most so much of it is counted against the law's coefficients.
_PENALTY = _WEAK**2
# A departure below this fraction of the inputs is rounding of the normal equations (the root of 1e-16, and room).
_EXACT = 1e-7
# Where one more lag of an input moves so much less than the lags before, it follows from them (the inputs of many
# records that step once move by the root of their length; a sweep sampled a thousand times too fast by 0.005).
_CLIFF = 1e-3
# Samples that are looked at for that, and how much of them is rounding.
_ROWS, _ROUNDING = 20_000, 1e-13
# A small combination is one of outputs if so much of its squared weights is theirs, and a signal if so much of its
# variance is foretold: least squares then finds at least half of what it does.
_OUTPUTS, _SIGNAL = 0.95, 0.5
# A dependence of lags in which outputs have less than this share is one of the inputs by themselves: no law.
_INPUTS = 0.1
# Earlier samples tell a combination of regressors where their F is so large: a fifth of the bias of least squares.
_STRONG = 5.0
# Probability of an F so large were the combination noise alone.
_DOUBT = 1e-5
# Instruments that depend on others up to this share of the largest are left out.
_DEPENDENT = 1e-10
# Lags of the inputs that depend on one another by themselves, up to so many times what a law of outputs leaves.
_ALONE = 2.0
# A ridge that is none: it only asks for exact laws too, where the solver answers dependent columns.
_TINY = 1e-30


class Columns:
    """Which column of a one-step regression is what.

    Parameters
    ----------
    spec : PlantSpec
    lags : int
        The columns are ``y[k], ..., y[k-lags+1], u[k], ..., u[k-lags+1]``, then a constant where there is one.
    delay : int
        Samples that an input takes to reach an output: the first inputs are then ``u[k-delay+1]``.
    """

    def __init__(self, spec: PlantSpec, lags: int = 1, delay: int = 1) -> None:
        ny, nu = spec.ny, spec.nu
        self.now = list(range(lags * ny, lags * ny + nu))
        self.output_of = {j * ny + i: i for j in range(lags) for i in range(ny)}
        self.names: list[str] = []
        for side, first in ((spec.outputs, 0), (spec.inputs, delay - 1)):
            for j in range(first, lags):
                self.names += [c.name if lags == 1 else f"{c.name}[k{f'-{j}' if j else ''}]" for c in side]
        self.names.append("1")

    @classmethod
    def lifted(cls, size: int, spec: PlantSpec) -> Columns:
        """Return the columns ``[z (size), u]`` of a state z that the same regression predicts."""
        made = cls(spec)
        made.now = list(range(size, size + spec.nu))
        made.output_of = {j: j for j in range(size)}
        made.names = [f"z{j + 1}" for j in range(size)] + [c.name for c in spec.inputs] + ["1"]
        return made


def refuse_feedback(solution: Solution, columns: Columns, least: float, what: str, *, ridge: float = 0.0) -> None:
    """Raise if the inputs depart from a law of the other regressors by no more than noise makes of that law.

    Under pure feedback ``u = K y`` the parts of A and B cannot be told apart. Sensor noise of size s then makes the
    input depart from the best law by K s, which fills the rank while the answer is wrong (Ljung 1999, sec. 13.4;
    Soderstrom & Stoica 1989, sec. 10.3). So the part of the inputs that the other regressors do not explain is
    compared, in its weakest combination, with the noise that the law would pass on. The noise is taken to be the
    equation's own residual, which is no less. An input that follows no law (open loop) is never refused, whatever the
    noise, nor one that departs from it by a tenth of its size: a controller that acts on the noisy outputs themselves
    gives consistent fits with any departure, and the two cases look alike.

    - ``solution``: of the one-step equations, least squares
    - ``least``: least ratio of departure to noise, about 2; 0 refuses nothing
    - ``what``: for messages
    - ``ridge``: tikhonov weight of the fit, which hides an exact law from its rank decision: then one is looked for
      here
    """
    if least <= 0 or not columns.now:
        return
    if found := _weak_law(solution, columns, least, ridge):
        null, rank, share = found
        raise _undetermined(null, solution.scale, columns, rank, share, what)


def _weak_law(solution: Solution, columns: Columns, least: float, ridge: float) -> tuple[FloatArray, int, float] | None:
    """Return the law (p,) that the inputs follow up to noise, the rank without it, and what departs from it."""
    r, size, noise = solution.factor, solution.scale, _noise(solution, columns)
    others = [j for j in range(r.shape[1]) if j not in columns.now]
    # The law that the true states could have had: one that only noise would need is not taken for a law.
    left = np.vstack([r[:, others], np.diag(np.minimum(noise[others], _PENALTY))])
    right = np.vstack([r[:, columns.now], np.zeros((len(others), len(columns.now)))])
    law = np.linalg.lstsq(left, right, rcond=1e-12)[0]
    residual = r[:, columns.now] - r[:, others] @ law
    passed = noise[others, None] * law
    # How much of the departure is noise, in the combination of inputs where that is most.
    departure, carried = residual.T @ residual, passed.T @ passed
    if ridge > 0:
        departure = departure - ridge * (np.eye(len(columns.now)) + law.T @ law)
        carried = carried + _EXACT**2 / least**2 * np.eye(len(columns.now))
    low, turned = np.linalg.eigh(departure)
    root = turned * np.sqrt(np.maximum(low, 1e-30))
    half = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(half @ carried @ half.T)
    chance = len(others) / solution.rows  # what a law fitted to chance passes on
    turns = half.T @ vectors
    shares = np.sqrt(np.clip(np.einsum("ij,ik,kj->j", turns, departure, turns), 0.0, None))
    shares = shares / np.linalg.norm(turns, axis=0)
    weak = (values - chance > 1.0 / least**2) & (shares < _WEAK)
    if not weak.any():
        return None
    turn = turns[:, int(np.flatnonzero(weak)[-1])]
    null = np.zeros(r.shape[1])
    null[columns.now], null[others] = turn, -law @ turn
    share = float(np.sqrt(max(turn @ departure @ turn, 0.0)) / max(np.linalg.norm(null), 1e-300))
    given = [j for j in range(r.shape[1]) if j not in columns.output_of]
    _, moved, turned = np.linalg.svd(r[:, given])
    if moved[-1] <= _ALONE * share:  # few lines: what outputs add to it is how their noise happened to lie
        null = np.zeros(r.shape[1])
        null[given], share = turned[-1], float(moved[-1])
    return null / size, r.shape[1] - int(weak.sum()), share


@dataclass(frozen=True)
class Dependence:
    """A combination of states and inputs that moves by no more than noise, and what else tells it."""

    text: str  # ``v = 2 q``
    strong: bool  # Earlier samples tell it so well that instrumental variables are nearly free of bias


def nearly_dependent(
    solution: Solution,
    columns: Columns,
    least: float,
    what: str,
    records: Sequence[Trajectory] = (),
) -> Dependence | None:
    """Return a combination of measured states that is no more than noise; raise if nothing else tells the model there.

    The residual of the equation holds what pushes the plant as well as the noise of the sensors, and only the latter is
    in the regressors. So a small combination of outputs is no noise where the sample before and the inputs foretell
    half of it: noise of the sensors is new at every sample.

    What sets a plant apart that its inputs keep near rest from one that a controller holds: where outputs foretell no
    input, earlier samples, which no sensor's noise of this one reaches, still tell what the combination does. Least
    squares is biased there, by all of it; instrumental variables are not, where the instruments are strong: their bias
    is that of least squares over the F of the regressors on the instruments (Staiger & Stock 1997, Econometrica 65:557,
    sec. 2).

    - ``solution, columns, least, what``: as of :func:`refuse_feedback`; here the outputs are the states (one lag)
    - ``records``: where the samples before are looked up; without them every combination that is small counts as noise
    - returns None where there is no such combination
    """
    if least <= 0:
        return None
    noise = _noise(solution, columns)
    _, values, right = np.linalg.svd(solution.factor)
    weak = (values < least * np.linalg.norm(right * noise, axis=1)) & (values < _WEAK)
    for row in np.flatnonzero(weak):
        weak[int(row)] = not _foretold(right[int(row)], solution, columns, records)
    if not weak.any():
        return None
    null = right[int(np.flatnonzero(weak)[-1])]
    if records and not feedback_of(records).found:
        strength, chance = _strength(solution, noise, records)
        if strength > _STRONG or chance < _DOUBT:
            return Dependence(dependence_text(null / solution.scale, solution.scale, columns.names), strength > _STRONG)
    rank = values.size - int(weak.sum())
    remedy = "add an excitation to what the controller commands, or leave an output out"
    raise _undetermined(null / solution.scale, solution.scale, columns, rank, float(values[-1]), what, remedy)


def _strength(solution: Solution, noise: FloatArray, records: Sequence[Trajectory]) -> tuple[float, float]:
    """Return the F of the regressors on earlier samples, in the direction that these tell least, and its chance."""
    from scipy.stats import f

    spec = records[0].spec
    regressors, instruments, _ = instruments_of(records, solution.scale.size > spec.ny + spec.nu)
    left = orthonormal(instruments, _DEPENDENT)
    if not left.size:
        return 0.0, 1.0
    rms = solution.scale / np.sqrt(solution.rows)
    _, seen, turned = np.linalg.svd(left.T @ (regressors / rms))
    count = left.shape[1]
    alone = count * float(np.sum((turned[-1] * noise) ** 2))
    strength = float(seen[-1] ** 2) / alone if alone > 0 else np.inf
    return strength, float(f.sf(strength, count, max(len(regressors) - count, 1)))


def _foretold(direction: FloatArray, solution: Solution, columns: Columns, records: Sequence[Trajectory]) -> bool:
    """Return True if a combination of outputs follows half from the sample before and the inputs: it is a signal."""
    seen = list(columns.output_of)
    if np.sum(direction[seen] ** 2) < _OUTPUTS:
        return False  # a law of an input, which a controller of some memory makes foretold as well
    before, now = [], []
    for record in records:
        if len(record) < 3:
            continue
        rows = np.hstack([lagged(record, 1), np.ones((len(record) - 1, 1))])[:, : direction.size]
        now.append(rows[1:] @ (direction / solution.scale))
        before.append(np.hstack([np.ones((len(rows) - 1, 1)), record.y[:-2], record.u[:-2], record.u[1:-1]]))
    if not now:
        return False
    known, wanted = np.concatenate(before), np.concatenate(now)
    wanted = wanted - wanted.mean()
    known = unit_columns(known)
    left = wanted - known @ np.linalg.lstsq(known, wanted, rcond=1e-10)[0]
    free = len(wanted) - known.shape[1]
    power = float(wanted @ wanted)
    return free > 0 and power > 0 and float(left @ left) / free < (1.0 - _SIGNAL) * power / len(wanted)


def excited_lags(records: Sequence[Trajectory], most: int) -> int:
    """Return the order of persistent excitation: lags of the inputs that move independently, at most so many.

    A constant is taken away first. m lines excite 2 m lags, a ramp one: the next lag follows from those. A smooth input
    excites each further lag less, in steps; that is no end, nor is rounding when it is reached that way (Ljung 1999,
    *System Identification*, definition 13.2; a model of order n asks for 2 n, theorem 13.1).

    Examples
    --------
    >>> from harness.signals import Channel
    >>> k, spec = np.arange(300.0), PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> lines = [Trajectory(k, (np.sin(0.3 * k) + np.sin(k))[:, None], k[:, None], spec)]
    >>> ramp = [Trajectory(k, k[:, None], k[:, None], spec)]
    >>> excited_lags(lines, 12), excited_lags(ramp, 12)
    (4, 1)
    """
    nu = records[0].spec.nu
    parts, left = [], _ROWS
    for record in records:
        u = record.u[: max(left, 0)]
        if len(u) >= most:
            view = np.lib.stride_tricks.sliding_window_view(u, most, axis=0)
            parts.append(view.transpose(0, 2, 1).reshape(len(view), -1))
            left -= len(u)
    if not parts or nu == 0:
        return most
    rows = np.concatenate(parts)
    spread = rows[:, :nu].std(axis=0)
    rows = (rows - rows.mean(axis=0)) / np.tile(divisor(spread), most)
    triangle = np.asarray(np.linalg.qr(rows, mode="r"), dtype=np.float64)
    before = 1.0
    for lags in range(1, most + 1):
        values = np.asarray(np.linalg.svd(triangle[:, : lags * nu], compute_uv=False), dtype=np.float64)
        least = float(values[-1] / values[0]) if values[0] > 0 else 0.0
        if least < _CLIFF * before:
            return lags - 1
        if least < _ROUNDING:
            break
        before = least
    return most


def unexcited(records: Sequence[Trajectory], needed: int) -> str:
    """Return what is wrong where the inputs excite fewer lags than a model asks for, in words; empty where they do."""
    lags = excited_lags(records, needed)
    if lags >= needed:
        return ""
    return (
        f"the inputs excite {lags} lags but the model needs {needed}: it rests more on how the record starts, "
        "and on its order, than on what the inputs do; use a richer input, or a lower order"
    )


def refuse_feedback_of_records(records: Sequence[Trajectory], lags: int, least: float, what: str) -> None:
    """Raise if the inputs follow the outputs by a law, for fits that are not linear one-step equations themselves.

    As :func:`refuse_feedback`, with the noise of each output taken to be no more than its fourth difference leaves
    (``/ sqrt(70)``, what white noise makes of it): the residual of a linear equation may be the plant's nonlinearity.

    - ``lags``: samples of the past that the fit uses
    - ``least, what``: as of :func:`refuse_feedback`
    """
    spec = records[0].spec
    few = sum(max(0, len(record) - lags) for record in records) <= 2 * (lags * (spec.ny + spec.nu) + 1)
    if spec.nu == 0 or few:
        return
    solution = solve(lambda: lagged_blocks(records, lags, offset=True), what, least_norm=True)
    rough = np.concatenate([np.diff(record.y, 4, axis=0) for record in records if len(record) > 4])
    noise = 1.4826 * np.median(np.abs(rough - np.median(rough, axis=0)), axis=0) / np.sqrt(70.0)
    quiet = replace(solution, residual_rms=np.minimum(solution.residual_rms, noise))
    refuse_feedback(quiet, Columns(spec, lags), least, what, ridge=_TINY)


def law_of_part(rows: FloatArray, targets: FloatArray, columns: Columns, least: float) -> str | None:
    """Return the law of the outputs that the inputs follow within a part of the samples, None where there is none.

    For fits that give some samples a model of their own (modes, regions): all samples may tell what the inputs do, and
    those of a part follow a law, as where the fast part of a motion from a start has died away in it.

    - ``rows`` (n, p): regressors of the part, those of ``columns`` without the constant
    - ``targets`` (n, ny): next outputs
    - ``least``: as of :func:`refuse_feedback`; 0 asks nothing

    Examples
    --------
    >>> from harness.signals import Channel
    >>> columns = Columns(PlantSpec((Channel("u"),), (Channel("y"),), 1.0))
    >>> y = 0.8 ** np.arange(30.0)[:, None]
    >>> law_of_part(np.hstack([y, -0.5 * y]), 0.8 * y, columns, 2.0)
    'u = -0.5 y'
    >>> law_of_part(np.hstack([y, np.cos(np.arange(30.0))[:, None]]), 0.8 * y, columns, 2.0)
    """
    if least <= 0 or len(rows) <= 2 * (rows.shape[1] + 1):
        return None
    with_constant = np.hstack([rows, np.ones((len(rows), 1))])
    solution = solve(lambda: [(with_constant, targets)], "part", least_norm=True)
    found = _weak_law(solution, columns, least, _TINY)
    if found is None or _of_inputs_alone(found[0] * solution.scale, columns):
        return None
    return dependence_text(found[0], solution.scale, columns.names)


def _noise(solution: Solution, columns: Columns) -> FloatArray:
    """Return the noise of each regressor relative to its rms (p,): inputs and constants are exact."""
    noise = np.zeros(solution.scale.size)
    rms = solution.scale / np.sqrt(solution.rows)
    for column, output in columns.output_of.items():
        noise[column] = solution.residual_rms[output] / rms[column]
    return noise


def _undetermined(
    null: FloatArray,
    size: FloatArray,
    columns: Columns,
    rank: int,
    share: float,
    what: str,
    remedy: str = "use a richer input, added to what a controller commands if there is one, or a lower order",
) -> FitError:
    """Return the refusal, with the direction that the data do not tell."""
    seen = list(columns.output_of)
    if len(seen) > len(columns.now) and _of_inputs_alone(null * size, columns):
        given = np.where(np.isin(np.arange(null.size), seen), 0.0, null)
        return FitError(
            f"{what}: the data do not determine the model",
            expected="inputs whose lags move in every direction",
            got=f"rank {rank} of {size.size}: {dependence_text(given, size, columns.names)} up to {share:.1e} of size",
            remedy="use a richer input (more lines, noise, PRBS), or a lower order",
        )
    law = dependence_text(null, size, columns.names)
    return FitError(
        f"{what}: the data do not determine the model",
        expected="inputs and states that move in every direction by more than noise",
        got=f"rank {rank} of {size.size}: {law} up to {share:.1e} of full size, which noise alone would leave",
        remedy=remedy,
    )


def _of_inputs_alone(unit: FloatArray, columns: Columns) -> bool:
    """Return True if outputs have next to no part in a dependence, its weights relative to what the columns move."""
    return bool(np.sum(unit[list(columns.output_of)] ** 2) < _INPUTS * np.sum(unit**2))
