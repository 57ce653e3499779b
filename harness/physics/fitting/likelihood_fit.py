"""Maximum-likelihood fits of grey boxes with process and measurement noise: where they start, and the fit itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from harness.errors import FitError
from harness.physics.compiled.kalman_pass import PassNoise
from harness.physics.compiled.simulator import default_substeps
from harness.physics.compiled.windows import data_states
from harness.physics.fitting.likelihood import Likelihood
from harness.physics.fitting.maximum import LikelihoodFit, NoiseModel, Point
from harness.physics.fitting.start import first_values
from harness.signals import FloatArray, Trajectory

if TYPE_CHECKING:
    from harness.physics.compiled.simulator import Intersample
    from harness.physics.compiled.system import System

SHARES = (0.02, 0.3)  # Latent forces that a first fit starts from, as shares of the typical force.
FADES_AFTER = 20.0  # Samples after which the latent force of a first fit has faded.
FIRST = 400  # Samples that are smoothed for a first guess of the initial state.
LONGEST = 5.0  # A latent force fades within the record divided by this: slower ones are parameters.


def fit_likelihood(
    system: System,
    trajectories: Sequence[Trajectory],
    *,
    start: Mapping[str, float] | None = None,
    fixed: Sequence[str] = (),
    latent: bool = True,
    white: bool = True,
    intersample: Intersample = "zoh",
) -> tuple[Likelihood, LikelihoodFit]:
    """Return the likelihood of a system's parameters, process and measurement noise unknown, and its maximum.

    Every equation of motion (every rate, where there are none) is disturbed by a latent Gauss-Markov force and a white
    one; sensors have white noise. Parameters, initial states and noise are estimated together (Kristensen, Madsen &
    Jorgensen 2004, *Parameter estimation in stochastic grey-box models*, Automatica 40:225). Where the
    maximum asks for finer steps of the solver than its start did, the search goes on from there with these: with too
    coarse ones a maximum may lie where the solver errs, at the edge of its stability. Raises FitError if the filter
    stays finite from no start.

    - ``system``: its outputs must be those of the records, in order
    - ``trajectories``: separate records; nothing crosses a seam
    - ``start``: where some parameters start; the others start where equation errors are least, or where the model says
    - ``fixed``: parameters that stay, besides those that the system declares fixed
    - ``latent``: False for measurement noise only: output error
    - ``white``: False for a latent force without a white part
    - ``intersample`` {"zoh", "foh", "smooth"}

    Examples
    --------
    >>> from harness.physics.models import oscillator
    >>> from harness.signals import PlantSpec
    >>> system = oscillator().system()
    >>> rng = np.random.default_rng(0)
    >>> u = np.repeat(rng.normal(size=(60, 1)), 10, axis=0)
    >>> y = system.simulator(0.02, backend="casadi").rollout([2.0, 0.3, 5.0], [0.1, 0.0], u)
    >>> data = Trajectory(np.arange(600) * 0.02, u, y + 0.002 * rng.normal(size=y.shape),
    ...                   PlantSpec(system.inputs, system.outputs, 0.02))
    >>> likelihood, fit = fit_likelihood(system, [data])
    >>> [round(fit.parameters[name], 2) for name in ("m", "c", "k")], round(float(fit.point.noise.r[0]), 4)
    ([2.0, 0.3, 5.0], 0.002)
    """
    records = list(trajectories)
    dt = records[0].spec.sample_time
    given = dict(start or {})
    free = np.array([not (parameter.fixed or parameter.name in fixed) for parameter in system.parameters], dtype=bool)
    vectors = first_values(system, records, {**system.values(), **given}, free, set(given), intersample)
    scale = force_scale(system, records, intersample)
    spread = np.concatenate([record.y for record in records]).std(axis=0)
    longest = max(len(record) for record in records) * dt / LONGEST
    model = NoiseModel(scale, np.maximum(spread, 1e-12), latent, white, shortest=dt, longest=max(longest, 2 * dt))
    noises = first_noises(model, sensor_noise(records), dt)
    points = [
        Point(p, x0, noise)
        for p in vectors
        for x0 in [[first_state(system, record, p, intersample) for record in records]]
        for noise in noises
    ]
    steps = max(default_substeps(system, dt, p) for p in vectors)
    while True:
        likelihood = Likelihood(system, records, model, fixed=fixed, intersample=intersample, substeps=steps)
        best = _likeliest(likelihood, points)
        needed = default_substeps(system, dt, best.point.p)
        if needed <= steps:
            return likelihood, best
        steps, points = needed, [best.point]


def _likeliest(likelihood: Likelihood, points: Sequence[Point]) -> LikelihoodFit:
    """Return the highest of the maxima that are reached from some points."""
    best: LikelihoodFit | None = None
    for point in points:
        try:
            found = likelihood.maximise(point)
        except FitError:
            continue
        if best is None or found.nll < best.nll:
            best = found
    if best is None:
        raise FitError(
            f"maximum likelihood of {likelihood.system.name}",
            expected="a start from which the filter stays finite",
            got="a diverging state",
            remedy="check units and signs of the records, or give start values",
        )
    return likelihood.past_forces(best, exact=True)


def first_noises(model: NoiseModel, sensors: FloatArray, dt: float) -> list[PassNoise]:
    """Return noises to start from: little latent force, and much."""
    tau = np.full(len(model.force_scale), float(np.clip(FADES_AFTER * dt, model.shortest, model.longest)))
    shares = SHARES if model.latent else SHARES[:1]
    return [PassNoise(sensors, share * model.force_scale, tau, 0.01 * model.force_scale) for share in shares]


def first_state(system: System, record: Trajectory, p: FloatArray, intersample: Intersample) -> FloatArray:
    """Return the initial state (nx,) from the beginning of a record; hidden states where effects say."""
    simulator = system.simulator(record.spec.sample_time, intersample=intersample)
    found = data_states(simulator, record[: min(len(record), FIRST)], p)[0][0]
    return np.asarray(np.where(np.isfinite(found), found, 0.0))


def force_scale(
    system: System, records: Sequence[Trajectory], intersample: Intersample, values: Mapping[str, float] | None = None
) -> FloatArray:
    """Return the typical size of the force on every equation of motion, or of every rate, from smoothed records.

    ``values`` are those of the parameters, the declared ones by default.
    """
    p = system.vector(values)
    dt = records[0].spec.sample_time
    simulator = system.simulator(dt, intersample=intersample)
    states = [data_states(simulator, record, p)[0] for record in records]
    rates = np.concatenate([np.gradient(x, dt, axis=0) for x in states])
    if system.coordinates:
        a = ca.SX.sym("a", len(system.coordinates))
        parts = [ca.mtimes(system.mass_matrix, a), system.input_forces]
        arguments = [system.x, system.u, system.p, system.t, a]
        function = ca.Function("forces", arguments, [system.upright(part) for part in parts])
        n = sum(map(len, records))
        x, u = np.concatenate(states), np.concatenate([record.u for record in records])
        t = np.concatenate([record.t for record in records])
        moved = rates[:, [coordinate.v for coordinate in system.coordinates]]
        found = function.map(n)(x.T, u.T, np.tile(p[:, None], n), t, moved.T)
        sizes = [np.sqrt(np.mean(force.full() ** 2, axis=1)) for force in found]
        size = np.maximum(*sizes)
    else:
        size = np.sqrt(np.mean(rates**2, axis=0))[: system.nx - system.hidden_count]
    usual = float(size.max(initial=0.0)) or 1.0
    return np.asarray(np.where(size > 1e-9 * usual, size, usual))


def sensor_noise(records: Sequence[Trajectory]) -> FloatArray:
    """Return a first guess of the sensor noise (ny,): 4th differences, but at least a millionth of the signal."""
    weight = np.sqrt(70.0)
    spread = np.concatenate([record.y for record in records]).std(axis=0)
    found = []
    for column in range(len(spread)):
        read = [record.readings[:, column] for record in records]  # of held readings the fresh ones only
        parts = [np.abs(np.diff(one[np.isfinite(one)], n=4)) for one in read]
        steps = np.concatenate(parts)
        found.append(1.4826 * np.median(steps) / weight if steps.size else 0.01 * spread[column])
    return np.asarray(np.clip(found, 1e-6 * spread + 1e-15, None))
