"""Calibrate an FMU on recorded data, as a black box, and say whether something is missing in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from harness.diagnosis.accept import Interval, block_interval
from harness.diagnosis.noise import NoiseFloor, noise_floors
from harness.diagnosis.residual_tests import detect, max_autocorrelation
from harness.errors import FitError, HarnessError, InputError
from harness.physics.parameters import Parameter
from harness.signals import Dataset, FloatArray, Trajectory

__all__ = ["FmuCalibration", "calibrate_fmu"]

EVALUATIONS = 60
# Relative step of finite differences: FMUs with solvers of their own are smooth to no more than about 1e-8.
_STEP = 1e-4
_BAD = 1e6


@dataclass(frozen=True, eq=False)
class FmuCalibration:
    """What :func:`calibrate_fmu` found.

    Attributes
    ----------
    parameters : dict
        Calibrated values, SI.
    intervals : dict
        Their 95 % intervals.
    converged : bool
    estimation, validation : tuple of array (N_i, ny)
        Measured minus simulated.
    initial_states : dict
        By use, for each run its fitted initial state by name.
    floors : tuple of NoiseFloor
    missing : bool
        The residual is above the noise, or coloured: the FMU lacks something. What, is searched by
        :func:`harness.diagnosis.close_loop`.
    """

    parameters: dict[str, float]
    intervals: dict[str, Interval]
    converged: bool
    estimation: tuple[FloatArray, ...]
    validation: tuple[FloatArray, ...]
    initial_states: dict[str, tuple[dict[str, float], ...]]
    floors: tuple[NoiseFloor, ...]
    missing: bool

    def __str__(self) -> str:
        shown = ", ".join(f"{name} = {value:.5g}" for name, value in self.parameters.items())
        rest = " and ".join(
            f"{np.sqrt(np.mean(np.concatenate(parts) ** 2)):.3g} on {use}"
            for use, parts in (("estimation", self.estimation), ("validation", self.validation))
        )
        words = (
            "more than noise: something is missing; sysid close-loop --model FILE.fmu names it"
            if self.missing
            else "no more than noise"
        )
        return f"{shown}; residual {rest}: {words}{'' if self.converged else '; the fit did not converge'}"


def calibrate_fmu(dataset: Dataset, path: str | Path, *, free: Sequence[str]) -> FmuCalibration:
    """Fit tunable parameters and initial states of an FMU by output error over whole records.

    Trust-region least squares (SciPy) on finite differences; the first part of each record first, because over a long
    horizon the error has many minima. The plant must be stable where it was operated.

    Parameters
    ----------
    dataset : Dataset
        Estimation and validation runs; its signals carry the names of the FMU's variables.
    path : path
        The FMU.
    free : sequence of str
        Tunable parameters to calibrate; the others stay as the FMU has them.

    Returns
    -------
    FmuCalibration

    Raises
    ------
    InputError
        If a name is no tunable parameter of the FMU, inputs are not held, or a use has no run.
    FitError
        If the FMU fails or diverges at its own parameters.

    Examples
    --------
    >>> from harness import registry
    >>> from harness.signals import PlantSpec, Run
    >>> from plants.mockups import mockup
    >>> runs, rng = [], np.random.default_rng(0)
    >>> for use in ("estimation", "validation"):
    ...     with registry.create("plants", "pendulum-fmu", sample_time=0.05, outputs=["theta"]) as plant:
    ...         u = 0.1 * rng.normal(size=(100, 1))
    ...         y = np.vstack([plant.reset(rng=rng, x0={"theta": 0.4}), plant.rollout(u[:-1])])
    ...         y += 1e-3 * rng.normal(size=y.shape)
    ...         record = Trajectory(np.arange(100) * 0.05, u, y, PlantSpec(plant.spec.inputs, plant.spec.outputs, 0.05))
    ...     runs.append(Run(record, use, use))
    >>> found = calibrate_fmu(Dataset(runs=tuple(runs), name="swing"), mockup("pendulum"), free=["b"])
    >>> round(found.parameters["b"], 2), found.converged
    (0.02, True)
    """
    from harness import registry

    spec = dataset.spec
    made = registry.create(
        "plants",
        "fmu",
        path=path,
        sample_time=spec.sample_time,
        inputs=[one.name for one in spec.inputs],
        outputs=[one.name for one in spec.outputs],
    )
    with made as plant:
        _check(dataset, plant, path)
        parameters = _parameters(plant.describe(path), free, path)
        floors = noise_floors(dataset)
        spread = np.std(np.concatenate([run.y for run in dataset.estimation]), axis=0)
        weights = np.array([f.value or max(0.1 * s, 1e-12) for f, s in zip(floors, spread, strict=True)])
        fit = _Fit(plant, parameters, _settable(plant), weights)
        inside = [run.measured() for run in dataset.estimation]
        outside = [run.measured() for run in dataset.validation]
        start = np.array([one.value for one in parameters])
        values, states, converged = fit.solve(start, inside, fixed=False)
        _, other, _ = fit.solve(values, outside, fixed=True)
        estimation = [fit.residual(values, x, run) for x, run in zip(states, inside, strict=True)]
        validation = [fit.residual(values, x, run) for x, run in zip(other, outside, strict=True)]
        jacobian = [fit.jacobian(values, x, run) for x, run in zip(states, inside, strict=True)]
    names = [one.name for one in parameters]
    intervals = block_interval(values, jacobian, estimation) if names else []
    return FmuCalibration(
        dict(zip(names, map(float, values), strict=True)),
        dict(zip(names, intervals, strict=True)),
        converged,
        tuple(one * weights for one in estimation),
        tuple(one * weights for one in validation),
        {"estimation": fit.named(states), "validation": fit.named(other)},
        floors,
        _something_left(estimation, validation, floors, weights),
    )


class _Fit:
    """Free runs of one FMU against records."""

    def __init__(self, plant: Any, parameters: Sequence[Parameter], states: Sequence[str], weights: FloatArray) -> None:
        self.plant, self.parameters, self.states, self.weights = plant, tuple(parameters), tuple(states), weights
        self._rng = np.random.default_rng(0)  # an FMU draws nothing

    def named(self, states: Sequence[FloatArray]) -> tuple[dict[str, float], ...]:
        """Return initial states by name."""
        return tuple(dict(zip(self.states, map(float, one), strict=True)) for one in states)

    def residual(self, values: FloatArray, x0: FloatArray, run: Trajectory) -> FloatArray:
        """Return the weighted residual (N, ny), huge where the FMU fails or diverges."""
        try:
            for one, value in zip(self.parameters, values, strict=True):
                self.plant.set_parameter(one.name, float(value))
            first = self.plant.reset(rng=self._rng, x0=self.named([x0])[0])
            y = np.vstack([first, self.plant.rollout(run.u[:-1])])
        except HarnessError:
            return np.full(run.y.shape, _BAD)
        rest: FloatArray = (run.y - y) / self.weights
        return rest if np.isfinite(rest).all() else np.full(run.y.shape, _BAD)

    def solve(
        self, values: FloatArray, runs: Sequence[Trajectory], *, fixed: bool
    ) -> tuple[FloatArray, list[FloatArray], bool]:
        """Return parameters, the initial state of each run, and whether the fit converged."""
        states = [self._guess(run) for run in runs]
        longest, done = max(len(run) for run in runs), True
        for count in dict.fromkeys(max(int(part * longest), min(longest, 50)) for part in (0.08, 0.2, 0.45, 1.0)):
            first = [run[: min(count, len(run))] for run in runs]
            # the initial states by themselves, then everything together
            for held in (True,) if fixed else (True, False):
                values, states, done = self._descend(values, states, first, held)
        return values, states, done

    def jacobian(self, values: FloatArray, x0: FloatArray, run: Trajectory) -> FloatArray:
        """Return the derivative (N, ny, np) of the weighted outputs, what the initial state can do taken out."""
        z = np.concatenate([values, x0])
        low, high = self._bounds(0)
        columns = []
        for k in range(z.size):
            h = _STEP * max(abs(z[k]), 1e-3 if k < len(values) else 0.1)
            ends = np.array([z[k] - h, z[k] + h])
            if k < len(values):
                ends = np.clip(ends, low[k], high[k])
            sides = []
            for end in ends:
                moved = z.copy()
                moved[k] = end
                sides.append(self.residual(moved[: len(values)], moved[len(values) :], run))
            columns.append((sides[0] - sides[1]).ravel() / (ends[1] - ends[0]))
        matrix = np.array(columns).T.reshape(run.y.size, z.size)
        own, by_x = matrix[:, : len(values)], matrix[:, len(values) :]
        if by_x.shape[1]:
            left, sizes, _ = np.linalg.svd(by_x, full_matrices=False)
            left = left[:, sizes > 1e-10 * max(sizes.max(initial=0.0), 1e-300)]
            own = own - left @ (left.T @ own)
        return own.reshape(*run.y.shape, len(values))

    def _guess(self, run: Trajectory) -> FloatArray:
        """Return an initial state from the first sample: measured states as they are, the others 0."""
        names = [channel.name for channel in run.spec.outputs]
        return np.array([run.y[0, names.index(one)] if one in names else 0.0 for one in self.states])

    def _bounds(self, count: int) -> tuple[FloatArray, FloatArray]:
        """Return the bounds of the parameters and of so many unbounded numbers."""
        low = [one.minimum for one in self.parameters] + [-np.inf] * count
        high = [one.maximum for one in self.parameters] + [np.inf] * count
        return np.array(low), np.array(high)

    def _descend(
        self, values: FloatArray, states: list[FloatArray], runs: Sequence[Trajectory], held: bool
    ) -> tuple[FloatArray, list[FloatArray], bool]:
        """Fit the initial states and, unless they are held, the parameters."""
        from scipy.optimize import least_squares

        n, nx = (0 if held else len(values)), len(self.states)
        if n + nx == 0:
            return values, states, True

        def parts(z: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
            return (values if held else z[:n]), list(z[n:].reshape(len(runs), nx))

        def residual(z: FloatArray) -> FloatArray:
            p, x = parts(z)
            return np.concatenate([self.residual(p, x[k], run).ravel() for k, run in enumerate(runs)])

        low, high = self._bounds(len(runs) * nx)
        skip = len(values) - n
        size = np.concatenate([np.maximum(np.abs(values[:n]), 1e-3), np.full(len(runs) * nx, 0.1)])
        z = np.concatenate([np.zeros(0) if held else values, *states])
        # a start on a bound is moved inside, so that a difference can be taken
        z = np.clip(z, low[skip:] + 1e-6 * size, high[skip:] - 1e-6 * size)
        found = least_squares(
            residual, z, bounds=(low[skip:], high[skip:]), x_scale=size, max_nfev=EVALUATIONS, diff_step=[_STEP]
        )
        if np.abs(found.fun).max() >= _BAD:
            raise FitError(
                "calibration of an FMU",
                expected="simulations that stay finite",
                got="a run that fails or diverges",
                remedy="give start values nearer to the plant, or shorter records",
            )
        p, x = parts(np.asarray(found.x, dtype=float))
        return p, x, bool(found.status > 0)


def _something_left(
    estimation: Sequence[FloatArray],
    validation: Sequence[FloatArray],
    floors: Sequence[NoiseFloor],
    weights: FloatArray,
) -> bool:
    """Decide by effect size whether the residual is more than noise."""
    for parts in (estimation, validation):
        joined = np.concatenate(list(parts))
        for k, floor in enumerate(floors):
            level = float(np.sqrt(np.mean(joined[:, k] ** 2)) * weights[k])
            acf = max(max_autocorrelation(one[:, k]) for one in parts)
            if detect(level / floor.value if floor.value else None, acf, min(len(one) for one in parts)):
                return True
    return False


def _check(dataset: Dataset, plant: Any, path: Any) -> None:
    """Refuse what a black box cannot do."""
    for use in ("estimation", "validation"):
        if not dataset.using(use):
            raise _refuse(path, f"no {use} run", "at least one", "none", f'mark a run as use = "{use}"')
    if dataset.intersample != "zoh":
        raise _refuse(
            path,
            "an FMU as nominal model",
            "inputs that are held (intersample 'zoh')",
            repr(dataset.intersample),
            "resample the records, or write the model as equations",
        )
    if plant.spec.feedthrough:
        raise _refuse(
            path,
            "an FMU as nominal model",
            "outputs that do not depend on the input of the same instant",
            "direct feedthrough",
            "measure other outputs",
        )


def _settable(plant: Any) -> tuple[str, ...]:
    """Return the states whose start values the FMU lets us set, one by one."""
    rng = np.random.default_rng(0)
    kept: list[str] = []
    for channel in plant.spec.states:
        try:
            plant.reset(rng=rng, x0={channel.name: 0.0})
        except HarnessError:
            continue
        kept.append(channel.name)
    plant.reset(rng=rng)
    return tuple(kept)


def _parameters(described: Mapping[str, Any], free: Sequence[str], path: Any) -> tuple[Parameter, ...]:
    """Return the tunable parameters to calibrate, with the FMU's own values and bounds."""
    tunable = {
        one["name"]: one
        for one in described["variables"]
        if one["causality"] == "parameter" and one["variability"] == "tunable" and one["start"] is not None
    }
    found = []
    for name in free:
        if name not in tunable:
            known = ", ".join(tunable) or "none"
            raise _refuse(path, "parameter to calibrate", f"a tunable one ({known})", repr(name), "correct the name")
        one = tunable[name]
        low, high = (one[key] for key in ("minimum", "maximum"))
        found.append(
            Parameter(
                name,
                one["si_unit"] or "1",
                float(one["start"]),
                -np.inf if low is None else float(low),
                np.inf if high is None else float(high),
            )
        )
    return tuple(found)


def _refuse(path: Any, what: str, expected: str, got: str, remedy: str) -> InputError:
    """Return a refusal that names the FMU."""
    return InputError(what, expected=expected, got=got, remedy=remedy, file=path)
