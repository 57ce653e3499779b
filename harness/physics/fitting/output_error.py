"""Output-error fits: the parameters with which a free run comes closest to what was measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt

from harness.errors import FitError, InputError
from harness.physics.compiled.windows import Windows, data_states
from harness.physics.fitting.fit_result import OutputErrorFit, Result, finish, objective
from harness.physics.fitting.levenberg import Minimised, log_scaled, minimise, minimise_states
from harness.signals import FloatArray, Trajectory

if TYPE_CHECKING:
    from harness.physics.compiled.simulator import Simulator
    from harness.physics.compiled.system import System

__all__ = ["OutputErrorFit", "fit_output_error", "simulate_error"]

_SAME_MINIMUM = 1e-3
# A window has at least so many samples, whatever the horizon says in seconds.
_SHORTEST = 25
# So many horizons are put in between where the way to the longest is too steep.
_MOST_INSERTED = 3
# What only prepares the next stage ends once a step lowers the cost by less than this part: starts of windows that are
# fitted together with the parameters right after, and parameters at horizons short of the last one.
_PREPARED_STATES, _PREPARED = 0.1, 1e-3
# The error of a fit grows with the horizon; a jump by more than this factor is another minimum.
_LARGEST_JUMP = 4.0


def fit_output_error(
    system: System,
    trajectories: Sequence[Trajectory],
    *,
    start: Mapping[str, float] | None = None,
    fixed: Sequence[str] = (),
    horizon: float | None = None,
    continuation: Sequence[float | None] = (2.0, 6.0, None),
    noise: Mapping[str, float] | None = None,
    starts: int = 1,
    rng: np.random.Generator | None = None,
    intersample: Literal["zoh", "foh", "smooth"] = "zoh",
    max_iterations: int = 60,
    x0: Sequence[FloatArray] | None = None,
    prefer_parameters_of: OutputErrorFit | None = None,
    substeps: int | None = None,
) -> OutputErrorFit:
    """Fit the parameters of a system so that free runs over windows come closest to the measured outputs.

    Levenberg-Marquardt on forward sensitivities; parameters that cannot be negative through their logarithm; every
    window has an initial state of its own, eliminated window by window; short windows first, then longer ones, because
    over a long horizon the error has many minima (multiple shooting in the sense of Bock 1983, without continuity).

    Parameters
    ----------
    system : System
        Its outputs must be those of the records, in order (see :meth:`System.with_outputs`).
    trajectories : sequence of Trajectory
        Separate records; nothing crosses a seam.
    start : mapping, optional
        Where some parameters start; the others start where the data (an equation-error fit) or the model say.
    fixed : sequence of str
        Parameters that stay, besides those that the system declares fixed.
    horizon : float, optional
        Length of the windows of the fit [s]; the whole record if None. Windows are for plants that integrate or are
        unstable.
    continuation : sequence
        Horizons on the way there [s]; those not shorter than ``horizon`` are left out. They are stretched for records
        with few samples a second.
    noise : mapping, optional
        Standard deviation of the sensor by output name: outputs weigh 1 / noise. Those not given are weighed by their
        own residual, which is the maximum-likelihood weight.
    starts : int
        Number of starts; from the second on they are drawn around the first, and the best minimum counts.
    rng : numpy.random.Generator
        For more than one start.
    intersample : {"zoh", "foh", "smooth"}
        How the input moves between samples.
    max_iterations : int
        At each horizon.
    x0 : sequence of array (nx,), optional
        Known initial states by record, not fitted (whole records only).
    prefer_parameters_of : OutputErrorFit, optional
        A fit of a smaller system: its parameters start the common ones.
    substeps : int, optional
        Runge-Kutta steps in a sample; chosen by the system's eigenvalues by default.

    Returns
    -------
    OutputErrorFit
        Also if it did not converge: look at ``converged`` and ``message``.

    Raises
    ------
    InputError
        If the outputs or inputs are not the system's, or a name is unknown.
    FitError
        If no start gives a finite simulation, or there are fewer data than parameters.

    Examples
    --------
    >>> from harness.physics.models import oscillator
    >>> from harness.signals import PlantSpec
    >>> system = oscillator().system()
    >>> u = np.random.default_rng(0).normal(size=(300, 1))
    >>> y = system.simulator(0.05, backend="casadi").rollout([2.0, 0.3, 5.0], [0.1, 0.0], u)
    >>> spec = PlantSpec(system.inputs, system.outputs, 0.05)
    >>> fit = fit_output_error(system, [Trajectory(np.arange(300) * 0.05, u, y, spec)])
    >>> [round(fit.parameters[name], 6) for name in ("m", "c", "k")]
    [2.0, 0.3, 5.0]
    """
    from harness.physics.compiled.simulator import default_substeps
    from harness.physics.fitting.start import first_values

    records = _checked(system, trajectories)
    dt = records[0].spec.sample_time
    given = dict(prefer_parameters_of.parameters) if prefer_parameters_of is not None else {}
    given = {name: value for name, value in given.items() if name in system.parameter_names}
    given.update(start or {})
    values = system.values(given)
    for name in fixed:
        system.parameter(name)
    free = np.array(
        [not parameter.fixed and parameter.name not in fixed for parameter in system.parameters], dtype=bool
    )
    scale = np.maximum(np.std(np.vstack([record.y for record in records]), axis=0), 1e-12)
    known = np.array([float((noise or {}).get(channel.name, np.nan)) for channel in system.outputs])
    guesses = first_values(system, records, values, free, set(given), intersample)
    steps = substeps or max(default_substeps(system, dt, guess) for guess in guesses)
    path = _path(horizon, continuation, dt, max(len(r) for r in records))
    sigma = np.where(np.isnan(known), 0.1 * scale, known)
    begun: list[FloatArray] = []
    while True:
        simulator = system.simulator(dt, intersample=intersample, substeps=steps)
        simulator.prepare()
        if not begun:
            first = _better(simulator, records, guesses, free, path[0], sigma)
            begun = [first, *_scattered(system, first, free, starts - 1, rng)]
        ended = [_follow(simulator, records, p, free, path, sigma, known, scale, max_iterations, x0) for p in begun]
        finite = _finite(system, ended)
        best = min(finite, key=lambda result: result.objective)
        needed = default_substeps(system, dt, best.solution.p)
        if substeps or needed <= steps:
            break
        # with too coarse steps a minimum may lie where the solver errs: on from there with those that it asks for
        steps, begun = needed, [result.solution.p for result in finite]
    alike = sum(abs(result.objective - best.objective) <= _SAME_MINIMUM * best.n_data for result in finite)
    return finish(system, best, free, alike if starts > 1 else None, max(starts, 1), intersample)


def simulate_error(
    system: System,
    parameters: Mapping[str, float],
    trajectories: Sequence[Trajectory],
    *,
    horizon: float | None,
    x0: Literal["estimated", "data"] | Sequence[FloatArray] = "estimated",
    intersample: Literal["zoh", "foh", "smooth"] = "zoh",
    substeps: int | None = None,
    continuation: Sequence[float | None] = (2.0, 6.0, None),
    noise: Mapping[str, float] | None = None,
) -> list[FloatArray]:
    """Return the error of free runs over windows with given parameters.

    Parameters
    ----------
    system : System
    parameters : mapping
        Values by name; those not given are the system's.
    trajectories : sequence of Trajectory
    horizon : float or None
        Window length [s]; None for whole records.
    x0 : "estimated", "data" or sequence of array (nx,)
        Initial states of the windows: fitted to each window (parameters held), read off the smoothed measurements, or
        given by record (whole records only).
    intersample, substeps, continuation, noise
        As in :func:`fit_output_error`.

    Returns
    -------
    list of array (N_i, ny)
        Measured minus predicted by record; NaN from where a run diverges.

    Raises
    ------
    InputError
        If the records do not fit the system.
    """
    from harness.physics.compiled.simulator import default_substeps

    records = _checked(system, trajectories)
    dt = records[0].spec.sample_time
    p = system.vector(parameters)
    simulator = system.simulator(dt, intersample=intersample, substeps=substeps or default_substeps(system, dt, p))
    scale = np.maximum(np.std(np.vstack([record.y for record in records]), axis=0), 1e-12)
    sigma = np.array([float((noise or {}).get(c.name, s)) for c, s in zip(system.outputs, scale, strict=True)])
    if not isinstance(x0, str):
        windows = Windows(simulator, records, None, sigma)
        given = np.array(list(x0), dtype=float).reshape(len(windows), system.nx)
        return windows.together(windows.evaluate(p, given, keep=True).residuals)
    states = [data_states(simulator, record, p)[0] for record in records]
    if x0 == "data":
        windows = Windows(simulator, records, horizon, sigma)
        return windows.together(windows.evaluate(p, windows.starts_from(states), keep=True).residuals)
    evaluation = None
    for length in _path(horizon, continuation, dt, max(len(r) for r in records)):
        windows = Windows(simulator, records, length, sigma)
        start = windows.starts_from(states)
        found = minimise_states(windows, p, start)
        evaluation = windows.evaluate(p, found, keep=True)
        states = _repaired(windows.together(evaluation.states), states)
    assert evaluation is not None
    return windows.together(evaluation.residuals)


def _finite(system: System, ended: Sequence[Result]) -> list[Result]:
    """Return the fits that did not diverge."""
    finite = [result for result in ended if np.isfinite(result.objective)]
    if not finite:
        raise FitError(
            f"output-error fit of {system.name}",
            expected="a start from which the simulation stays finite",
            got=f"{len(ended)} starts that all diverge",
            remedy="give start values nearer to the plant, or a shorter horizon",
        )
    return finite


# ---- one start --------------------------------------------------------------------------------------------------


def _follow(
    simulator: Simulator,
    records: list[Trajectory],
    guess: FloatArray,
    free: npt.NDArray[np.bool_],
    path: list[float | None],
    sigma: FloatArray,
    known: FloatArray,
    scale: FloatArray,
    max_iterations: int,
    x0: Sequence[FloatArray] | None,
) -> Result:
    """Fit at each horizon in turn, the weights following the residuals.

    Where a longer horizon does not converge or diverges, a horizon between is put in before it is tried again.
    """
    p = guess
    states = [data_states(simulator, record, p)[0] for record in records]
    best: Result | None = None
    record_length = max(len(record) for record in records) * simulator.dt
    waiting: list[float | None] = [None] if x0 is not None else list(path)
    target, done, inserted = waiting[-1], 0.0, 0
    while waiting:
        horizon = waiting.pop(0)
        span = record_length if horizon is None else horizon
        found, now = None, sigma
        stop = {"decrease": _PREPARED} if waiting else {}
        for attempt in range(4 if not waiting else 1):
            windows = Windows(simulator, records, horizon, now)
            if x0 is not None:
                start = np.array(list(x0), dtype=float).reshape(len(windows), simulator.nx)
            elif found is not None:
                start = found.solution.x0
            else:
                start = minimise_states(windows, p, windows.starts_from(states), 8, decrease=_PREPARED_STATES)
            here = p if found is None else found.solution.p
            solution = minimise(windows, here, start, free, max_iterations, states_free=x0 is None, **stop)
            if not np.isfinite(solution.evaluation.cost):
                break
            found = Result(solution, windows, objective(solution, windows), horizon, target, windows.n_data)
            rms = np.sqrt(solution.evaluation.squares / (windows.n_data / simulator.spec.ny))
            ratio = np.log(np.where(np.isnan(known), np.maximum(rms, 1e-12 * scale), known) / now)
            now = now * np.exp(ratio)
            if np.all(np.abs(ratio - np.mean(ratio)) < 0.02):
                break
            if attempt == 0 and not solution.converged:
                break
        good = found is not None and found.solution.converged and _grows_gently(found, best)
        if not good and done > 0 and span > 1.4 * done and inserted < _MOST_INSERTED:
            inserted += 1
            waiting = [float(np.sqrt(done * span)), horizon, *waiting]
            continue
        if found is None:
            continue
        best, p, sigma, done = found, found.solution.p, now, span
        states = _repaired(found.windows.together(found.solution.evaluation.states), states)
    if best is None:
        windows = Windows(simulator, records, path[0], sigma)
        rest = np.zeros((len(windows), simulator.nx))
        failed = Minimised(p, rest, windows.evaluate(p, rest), False, 0, "diverged")
        return Result(failed, windows, np.inf, path[0], target, windows.n_data)
    return best


def _grows_gently(now: Result, before: Result | None) -> bool:
    """Return True if no output's error is many times what it was at the shorter horizon."""
    if before is None:
        return True
    change = now.solution.evaluation.squares / np.maximum(before.solution.evaluation.squares, 1e-300)
    return bool(np.all(change < _LARGEST_JUMP**2))


def _better(
    simulator: Simulator,
    records: list[Trajectory],
    guesses: list[FloatArray],
    free: npt.NDArray[np.bool_],
    horizon: float | None,
    sigma: FloatArray,
) -> FloatArray:
    """Return where a few iterations over short windows lead from the most promising guess.

    The windows span a few swings of the fastest motion: over many swings a model that does not move at all beats one
    whose period is a little wrong.
    """
    if len(guesses) == 1:
        return guesses[0]
    found: list[tuple[float, FloatArray]] = []
    for guess in guesses:
        p, cost = guess, np.inf
        for length in dict.fromkeys((_few_swings(simulator, guess, horizon), horizon)):
            windows = Windows(simulator, records, length, sigma)
            states = [data_states(simulator, record, p)[0] for record in records]
            start = minimise_states(windows, p, windows.starts_from(states), 6, decrease=_PREPARED_STATES)
            solution = minimise(windows, p, start, free, 12)
            cost = solution.evaluation.cost
            if not np.isfinite(cost):
                break
            p = solution.p
        found.append((cost, p))
    return min(found, key=lambda candidate: candidate[0])[1]


def _few_swings(simulator: Simulator, p: FloatArray, horizon: float | None) -> float | None:
    """Return the length of windows over a few swings of the fastest motion [s], not above the horizon."""
    import casadi as ca

    system = simulator.system
    jacobian = ca.Function("A", [system.x, system.u, system.p, system.t], [ca.jacobian(system.f, system.x)])
    a = jacobian(np.zeros(system.nx), np.zeros(system.nu), p, 0.0).full()
    speed = np.abs(np.linalg.eigvals(a)).max(initial=0.0) if np.isfinite(a).all() else 0.0
    if speed == 0.0:
        return horizon
    length = max(30.0 / speed, _SHORTEST * simulator.dt)
    return length if horizon is None or length < 0.75 * horizon else horizon


# ---- small things ------------------------------------------------------------------------------------------------


def _checked(system: System, trajectories: Sequence[Trajectory]) -> list[Trajectory]:
    """Return the records, or refuse those that do not speak the system's language."""
    records = [record.measured() for record in trajectories]
    if not records:
        raise InputError("no records", expected="at least one trajectory", got="none", remedy="give the records")
    spec = records[0].spec
    for what, ours, theirs in (("inputs", system.inputs, spec.inputs), ("outputs", system.outputs, spec.outputs)):
        if [channel.name for channel in ours] != [channel.name for channel in theirs]:
            raise InputError(
                f"{what} of the record",
                expected=f"{', '.join(channel.name for channel in ours) or 'none'}, "
                f"the {what} of {system.name}, in this order",
                got=", ".join(channel.name for channel in theirs) or "none",
                remedy="rename the signals, or choose the system's outputs with with_outputs",
            )
    for record in records:
        if record.spec.sample_time != spec.sample_time:
            raise InputError(
                "sample times differ",
                expected=f"{spec.sample_time:g} s",
                got=f"{record.spec.sample_time:g} s",
                remedy="resample explicitly",
            )
        if len(record) < 3:
            raise FitError(
                "record too short", expected="at least 3 samples", got=str(len(record)), remedy="record longer"
            )
    return records


def _path(horizon: float | None, continuation: Sequence[float | None], dt: float, longest: int) -> list[float | None]:
    """Return the horizons in their order, the last one that asked for (None where it is the whole record)."""
    record = longest * dt
    target = None if horizon is None or horizon >= record else max(float(horizon), 2 * dt)
    steps = [float(length) for length in continuation if length is not None]
    stretch = max(1.0, 2 * _SHORTEST * dt / min(steps)) if steps else 1.0
    end = record if target is None else target
    path: list[float | None] = [length * stretch for length in steps if length * stretch < 0.75 * end]
    return [*path, target]


def _scattered(
    system: System, guess: FloatArray, free: npt.NDArray[np.bool_], count: int, rng: np.random.Generator | None
) -> list[FloatArray]:
    """Return starts drawn around a guess: positive parameters by a factor, others by their size."""
    if count <= 0:
        return []
    if rng is None:
        raise InputError("several starts", expected="rng", got="none", remedy="give rng=numpy.random.default_rng(seed)")
    logarithmic = log_scaled(system)
    found = []
    for _ in range(count):
        draw = rng.normal(size=guess.shape)
        moved = np.where(logarithmic, guess * np.exp(0.5 * draw), guess + 0.3 * np.abs(guess) * draw)
        low = np.array([parameter.minimum for parameter in system.parameters])
        high = np.array([parameter.maximum for parameter in system.parameters])
        found.append(np.where(free, np.clip(moved, low, high), guess))
    return found


def _repaired(states: list[FloatArray], before: list[FloatArray]) -> list[FloatArray]:
    """Return the states, those of diverged windows replaced by what was there before."""
    return [np.where(np.isfinite(new), new, old) for new, old in zip(states, before, strict=True)]
