"""The search: from several starts, over longer and longer beginnings of the records, the best minimum counts.

Over a whole record the error of an oscillation has many minima; over its beginning it has few.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from harness.calibration.runs import RecordSimulator
from harness.errors import FitError
from harness.physics.compiled.windows import Windows
from harness.physics.definition.parameters import Parameter
from harness.physics.fitting.fit_result import OutputErrorFit, Result, finish, objective
from harness.physics.fitting.levenberg import minimise, minimise_states
from harness.signals import FloatArray, Trajectory

PARTS = (8, 3)  # A record's beginnings that are fitted first are so many times shorter.
SHORTEST = 50  # Samples that a beginning has at least: fewer hardly hold the motion of an excited system.
ITERATIONS = 60
PREPARED = 1e-3  # Relative decrease of the cost at which a fit that only prepares the next one ends.
WEIGHINGS = 4  # How often outputs are weighed anew by their residuals.
SAME = 1e-2  # Sums of squares that differ by less than this part are those of the same minimum.
EQUAL = 1e-6  # Errors below this part of the deviation of the records are none, whatever their ratio.
SLEEP = 1e-12  # Share of the largest information on a start of a state below which one counts as telling nothing.
DRAWS = 4  # Draws for each start: the one that fits the first beginning best is followed.


def best_fit(
    runs: RecordSimulator,
    records: Sequence[Trajectory],
    guesses: Sequence[tuple[FloatArray, FloatArray]],
    noise: Mapping[str, float],
    progress: Callable[[float, str], None],
) -> tuple[OutputErrorFit, tuple[int, int]]:
    """Return the best of the fits from several starts, and how many of how many reached its minimum.

    Parameters
    ----------
    runs : FreeRuns
    records : sequence of Trajectory
    guesses : sequence of (array (np,), array (records, nx))
        Where parameters and states start.
    noise : mapping
        Standard deviation of the sensor by output, where it is known.
    progress : callable
        ``progress(share, what)``.

    Raises
    ------
    FitError
        If the model breaks from every start, or there are fewer readings than unknowns.
    """
    count = sum(record.y.size for record in records)
    unknown = runs.np + guesses[0][1].size
    if count <= unknown:
        raise FitError(
            "too few readings",
            expected=f"more than {unknown}, the parameters and starts to be found",
            got=str(count),
            remedy="record longer, or free less",
        )
    scale = np.maximum(np.std(np.vstack([record.y for record in records]), axis=0), 1e-12)
    results = []
    for number, (p, x0) in enumerate(guesses):
        progress(number / len(guesses), f"start {number + 1} of {len(guesses)}")
        results.append(_followed(runs, records, p, x0, noise, _path(records), together=number > 0))
        # the beginning may tell less than nothing, and starts that suit wrong parameters lead astray
        if number == 0 or results[-1] is None or _asleep(results[-1]):
            results.append(_followed(runs, records, p, x0, noise, [None], together=True))
    finite = [result for result in results if result is not None]
    if not finite:
        raise FitError(
            "calibration",
            expected="start values from which the model runs through the records",
            got=f"none of {len(guesses)}: {runs.broken or 'its outputs are not finite'}",
            remedy="give other start values (--start), or bounds that keep the model sound (--bound)",
        )
    best = min(finite, key=lambda result: result.objective)
    squares = [float(np.sum(one.solution.evaluation.squares / scale**2)) for one in finite]
    alike = sum(one <= (1 + SAME) * min(squares) + EQUAL**2 * count for one in squares)
    runs.central = True
    fit = finish(runs.system, best, np.ones(runs.np, dtype=bool), None, len(results), "zoh")  # type: ignore[arg-type]
    return fit, (alike, len(results))


def _asleep(result: Result) -> bool:
    """Return True if a start of a state ended where it moves nothing, as a level below the floor of its tank."""
    solution = result.solution
    gram = solution.evaluation.gram[:, solution.p.size :, solution.p.size :]
    told = np.diagonal(gram, axis1=1, axis2=2)
    return bool(told.size and (told <= SLEEP * told.max()).any())


def _path(records: Sequence[Trajectory]) -> list[int | None]:
    """Return how many samples are fitted, in turn; None: all."""
    longest = max(map(len, records))
    steps = [max(SHORTEST, longest // part) for part in PARTS]
    return [*dict.fromkeys(step for step in steps if step < 0.75 * longest), None]


def _windows(runs: RecordSimulator, records: Sequence[Trajectory], length: int | None, sigma: FloatArray) -> Windows:
    """Return the beginnings of records."""
    return Windows(runs, [record[:length] for record in records], None, sigma)  # type: ignore[arg-type]


def _followed(
    runs: RecordSimulator,
    records: Sequence[Trajectory],
    p: FloatArray,
    x0: FloatArray,
    noise: Mapping[str, float],
    path: Sequence[int | None],
    *,
    together: bool = False,
) -> Result | None:
    """Return where one start leads; None where the model breaks.

    ``together``: the starts of the states are not suited to the first parameters before all are searched together.
    """
    scale = np.maximum(np.std(np.vstack([record.y for record in records]), axis=0), 1e-12)
    known = np.array([noise.get(channel.name, np.nan) for channel in runs.system.outputs])
    sigma = np.where(np.isnan(known), 0.1 * scale, known)
    free = np.ones(runs.np, dtype=bool)
    best: Result | None = None
    for length in path:
        last = length is None
        for weighing in range(WEIGHINGS if last else 1):
            windows = _windows(runs, records, length, sigma)
            if runs.nx and weighing == 0 and not together:
                x0 = minimise_states(windows, p, x0, 8, decrease=0.1)
            stop = {} if last else {"decrease": PREPARED}
            solution = minimise(windows, p, x0, free, ITERATIONS, states_free=runs.nx > 0, **stop)
            if not np.isfinite(solution.evaluation.cost):
                break
            p, x0 = solution.p, solution.x0
            if last:
                best = Result(solution, windows, objective(solution, windows), None, None, windows.n_data)
            rms = np.sqrt(solution.evaluation.squares / (windows.n_data / runs.system.ny))
            now = np.where(np.isnan(known), np.maximum(rms, 1e-7 * scale), known)
            ratio = np.log(now / sigma)
            sigma = now
            if np.all(np.abs(ratio - np.mean(ratio)) < 0.02):
                break
    return best


def drawn(
    windows: Windows,
    parameters: Sequence[Parameter],
    count: int,
    x0: FloatArray,
    hidden: Sequence[bool],
    rng: np.random.Generator,
    *,
    spread: float = 1.0,
) -> list[tuple[FloatArray, FloatArray]]:
    """Return so many starts: the declared one, and for each other the best of some drawn within the bounds.

    - ``windows``: what the draws are compared on: the :func:`beginnings` of records, or short windows
    - ``parameters``: all of the model; fixed ones stay
    - ``x0`` (W, nx): where the states start
    - ``hidden`` sequence of bool (nx,): states that no output shows: their starts are drawn by a factor, too
    - ``spread``: standard deviation of the logarithm of what is drawn around a declared value
    """
    plain = np.array([parameter.value for parameter in parameters])
    nothing = np.zeros(0, dtype=np.intp)
    found = [(plain, x0)]
    for _ in range(count - 1):
        draws = [
            (
                np.array([p.value if p.fixed else _draw(p, rng, spread) for p in parameters]),
                np.where(np.array(hidden, dtype=bool), x0 * np.exp(rng.normal(size=x0.shape)), x0),
            )
            for _ in range(DRAWS)
        ]
        costs = [windows.trial(*draw, columns=nothing).cost for draw in draws]
        found.append(draws[int(np.argmin(costs))])
    return found


def beginnings(runs: RecordSimulator, records: Sequence[Trajectory]) -> Windows:
    """Return the first beginnings of records that are fitted, weighed by the deviation of their outputs."""
    sigma = np.maximum(np.std(np.vstack([record.y for record in records]), axis=0), 1e-12)
    return _windows(runs, records, _path(records)[0], sigma)


def _draw(parameter: Parameter, rng: np.random.Generator, spread: float) -> float:
    """Return a value within the bounds: spread over all of them where both are given, else around the declared one."""
    low, high, value = parameter.minimum, parameter.maximum, parameter.value
    if low > 0 and np.isfinite(high):
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))
    if parameter.positive:
        return float(np.clip(value * np.exp(spread * rng.normal()), low, high))
    if np.isfinite(low) and np.isfinite(high):
        return float(rng.uniform(low, high))
    return float(np.clip(value + max(abs(value), 1e-3) * rng.normal(), low, high))


def estimated_starts(
    runs: RecordSimulator, records: Sequence[Trajectory], p: FloatArray, x0: FloatArray, sigma: FloatArray
) -> FloatArray:
    """Return the starts of the states (records, nx) that suit given parameters best."""
    return minimise_states(_windows(runs, records, None, sigma), p, x0) if runs.nx and records else x0
