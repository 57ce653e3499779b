"""Records for a task: drawn parameters, an excitation that moves the plant well, a truth simulated by somebody else."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.rng import stream
from harness.signals import Channel, Dataset, FloatArray, PlantSpec, Run, Trajectory, Use
from sysid_lab.engines import BALANCE_BAND, OPTIONS, balanced_run, engine_run
from sysid_lab.plan import NOISE, Task
from sysid_lab.truths.applied import STEP, actuated
from sysid_lab.truths.context import PRE, Context, Hidden, rms
from sysid_lab.truths.disturbances import disturbance, named, natural_frequency
from sysid_lab.truths.hardware import as_hardware
from sysid_lab.truths.hidden import falling_damping, force_size, hide, hide_outside, sagging_gain
from sysid_lab.truths.simulation import DT, SUBSTEPS, Motion, simulate

SAMPLES = 5040
"""Of one record: 20 s at 250 Hz. Every 2nd to 10th row make as long a record, in which slow changes take as long."""
BAND = (0.1, 3.0)  # Of the multisine [Hz].
_ANGLE = Channel("theta", "rad", period=2 * math.pi)
SPECS = {
    "pendulum": PlantSpec((Channel("u", "N m"),), (_ANGLE,), DT),
    "cart-pole": PlantSpec((Channel("u", "N"),), (Channel("x", "m"), _ANGLE), DT),
}
USES: tuple[Use, ...] = ("estimation", "validation")
_CUTS = ("sensor_saturation", "sensor_rectification")
"""Errors of a sensor that come after those that bend its reading, wherever these belong."""
_HEAVY_ROD = 0.03  # Inertia of the pole beyond that of a point mass, over it.


@dataclass(frozen=True, eq=False)
class Records:
    """The records of a task and the truth behind them.

    Attributes
    ----------
    dataset : Dataset
    parameters : dict
        True nominal parameters, in the words of the model.
    hidden : tuple of Hidden
    noise : float
        Standard deviation of the sensors [rad, m].
    peak : float
        Largest angle of the estimation record [deg].
    known : tuple of Hidden
        All that the dictionary has: what is hidden, and how the nominal structure is wrong where that has a name.
    """

    dataset: Dataset
    parameters: dict[str, float]
    hidden: tuple[Hidden, ...]
    noise: float
    peak: float
    known: tuple[Hidden, ...] = ()


def make_records(task: Task, *, samples: int = SAMPLES) -> Records:
    """Return the records of a task; all random numbers are keyed by the task.

    Raises
    ------
    PlantError
        If the truth leaves every bound.
    InputError
        If an effect has no truth.
    """
    key = ("study", task.key, task.seed)
    parameters = _draw_parameters(task.plant, stream(*key, "parameters"))
    values = _truth_values(task.plant, parameters)
    noise = NOISE.get(task.noise) or float(np.exp(stream(*key, "noise-level").uniform(*np.log(list(NOISE.values())))))
    if task.engine == "balanced":
        return _balanced(task, parameters, noise, samples)
    commands, starts = {}, {}
    draw = stream(*key, "excitation")
    target = math.radians(draw.uniform(70.0, 120.0) if task.plant == "pendulum" else draw.uniform(40.0, 90.0))
    for use in USES:
        wave = multisine(samples, DT, draw, BAND)
        wave = np.concatenate([wave[-PRE:], wave])
        start = _start(task.plant, draw)
        commands[use], starts[use] = _scaled(values, wave, start, target), start
    context = Context(task.plant, values, simulate(values, commands["estimation"], start=starts["estimation"]),
                      commands["estimation"])  # fmt: skip
    hidden = _hidden(task, context, stream(*key, "effects"))
    wrong = _structure(task, context)
    values = values | {name: value for effect in wrong for name, value in effect.truth.items()}
    runs, peak = [], 0.0
    for use in USES:
        u = commands[use]
        shaken = disturbance(task.shape, len(u), DT, natural_frequency(values), stream(*key, use, "disturbance"))
        unknown = task.disturbance * rms(u) * shaken
        reading = _simulated(task, parameters, values, hidden, use, u, unknown, starts[use])
        y = _measured(task.plant, (*hidden, *wrong), reading[PRE:], noise, stream(*key, use, "noise"))
        t: FloatArray = np.arange(samples, dtype=np.float64) * DT
        recorded = u[PRE:] + task.input_noise * rms(u) * stream(*key, use, "input-noise").standard_normal(samples)
        runs.append(Run(Trajectory(t, recorded[:, None], y, SPECS[task.plant]), use, use))
        peak = peak or math.degrees(float(np.abs(reading[:, -1]).max()))
    known = (*hidden, *wrong) if named(task.structure, task.plant) else hidden
    return Records(Dataset(task.key, tuple(runs)), _of_the_model(task, parameters), hidden, noise, peak, known)


def multisine(n: int, dt: float, rng: np.random.Generator, band: tuple[float, float]) -> FloatArray:
    """Return a multisine with random phases, period ``n dt``, lines over a band [Hz] and an rms of 1."""
    length = n * dt
    lines = np.arange(math.ceil(band[0] * length), math.floor(band[1] * length) + 1) / length
    phases = rng.uniform(0, 2 * np.pi, lines.size)
    wave = np.cos(2 * np.pi * np.outer(np.arange(n) * dt, lines) + phases).sum(axis=1)
    return np.asarray(wave * math.sqrt(2 / lines.size))


def _of_the_model(task: Task, parameters: dict[str, float]) -> dict[str, float]:
    """Return the true parameters in the words of the model: a heavy rod is a lighter point mass, farther out."""
    if task.structure != "heavy-rod":
        return parameters
    more = 1.0 + _HEAVY_ROD
    mass = parameters["mp"] / more
    return {**parameters, "mp": mass, "l": parameters["l"] * more, "mc": parameters["mc"] + parameters["mp"] - mass}


def _draw_parameters(plant: str, rng: np.random.Generator) -> dict[str, float]:
    """Return nominal parameters in the words of the model."""

    def between(low: float, high: float) -> float:
        return math.exp(rng.uniform(math.log(low), math.log(high)))

    if plant == "pendulum":
        mass, length = between(0.5, 2.0), between(0.2, 0.5)
        J, mgl = mass * length**2, mass * 9.81 * length
        return {"J": J, "b": 2 * between(0.02, 0.1) * math.sqrt(J * mgl), "mgl": mgl}
    mc, mp, length = between(0.5, 2.0), between(0.15, 0.5), between(0.3, 0.7)
    hinge = 2 * between(0.005, 0.03) * mp * length**2 * math.sqrt(9.81 / length)
    return {"mc": mc, "mp": mp, "l": length, "bx": (mc + mp) * between(0.3, 1.5), "btheta": hinge}


def _truth_values(plant: str, parameters: Mapping[str, float]) -> dict[str, float]:
    """Return them in the words of the truth."""
    if plant == "pendulum":
        return {"J": parameters["J"], "mgl": parameters["mgl"], "b0": parameters["b"]}
    common = {name: parameters[name] for name in ("mc", "mp", "l")}
    return {"dof": 2.0, **common, "b0": parameters["bx"], "b1": parameters["btheta"]}


def _start(plant: str, rng: np.random.Generator) -> FloatArray:
    """Return where a record begins: hanging, a little aside, at rest."""
    angle = rng.uniform(-0.3, 0.3)
    return np.array([angle, 0.0]) if plant == "pendulum" else np.array([0.0, angle, 0.0, 0.0])


def _scaled(values: Mapping[str, float], wave: FloatArray, start: FloatArray, target: float) -> FloatArray:
    """Return a command that brings the angle to about a largest excursion, by bisection on the truth."""
    own = values.get("mgl") or (values["mc"] + values["mp"]) * 9.81
    low, high = 0.0, 4.0 * own
    for _ in range(9):
        middle = 0.5 * (low + high)
        angle = simulate(values, middle * wave, start=start, substeps=2).q[:, -1]
        low, high = (middle, high) if np.abs(angle).max() < target else (low, middle)
    return low * wave


def _hidden(task: Task, context: Context, rng: np.random.Generator) -> tuple[Hidden, ...]:
    """Return what is hidden, with its sizes."""
    make = hide_outside if task.study == "outside" else hide
    found = tuple(make(*_split(name), task.level, context, rng) for name in task.effects)
    if task.engine != "hardware":
        return found
    return tuple(as_hardware(effect, context, force_size(task.level, context, effect.at)) for effect in found)


def _structure(task: Task, context: Context) -> tuple[Hidden, ...]:
    """Return what is in the truth and in no model: how the nominal structure is a little wrong."""
    if not task.structure:
        return ()
    driven = "theta" if task.plant == "pendulum" else "x"
    u, q, v = context.u, context.q(driven), context.v(driven)
    name, _, at = (named(task.structure, task.plant) or f"{task.structure}@{driven}").partition("@")
    if task.structure == "eccentric-encoder":
        values = {"A": 0.002, "k": 2.0, "phi": 1.0}
        return (Hidden(name, at, {}, values, sensor=lambda y: y + 0.002 * np.sin(2 * y + 1.0)),)
    if task.structure == "bent-scale":
        return (Hidden(name, at, {}, {"b": 0.002}, sensor=lambda y: y + 0.002 * y**2),)
    if task.structure == "uneven-damping":  # the cosine's bend: the dictionary has a parabola
        uneven = 0.01 * rms(u) / rms(np.cos(q) * v)
        return (Hidden(name, at, {"und0": uneven}, {"c1": 0.0, "c2": -0.5 * uneven}, exact=False),)
    if task.structure == "drooping-drive":
        droop = 0.01 * rms(u) / rms(u**2)
        return (Hidden(name, at, {"droop": droop}, {"c": droop}),)
    if task.structure == "warming-damper":
        middle = (PRE + 0.5 * (len(u) - PRE)) * DT
        fall = 1 - np.arange(len(u)) * DT / middle
        return (falling_damping(at, 0, 0.01 * rms(u) / rms(fall * v), middle),)
    if task.structure == "sagging-supply":
        return (sagging_gain(at, u, 0.01),)
    if task.structure == "rippling-drive":
        size = 0.01 * rms(u) / rms(u * np.cos(5 * q))
        return (Hidden(name, at, {"ripple0": size}, {"a": size, "k": 5.0, "phi": 0.5 * math.pi}),)
    if task.structure == "tiring-drive":
        return (Hidden(name, at, {"tire0": 0.01 * rms(u) / rms(u * v)}),)
    return (Hidden(name, at, {"rod": _HEAVY_ROD}),)


def _split(effect: str) -> tuple[str, str]:
    name, _, at = effect.partition("@")
    return name, at


def _simulated(
    task: Task,
    parameters: Mapping[str, float],
    values: Mapping[str, float],
    hidden: tuple[Hidden, ...],
    use: str,
    u: FloatArray,
    disturbance: FloatArray,
    start: FloatArray,
) -> FloatArray:
    """Return the coordinates (N, ny) as the sensors see them, before what sensors do to them.

    An engine has what it has itself; the others are put around it in fine steps.
    """
    outside = task.engine in ("bullet", "pymunk", "fmu")
    own = set(OPTIONS[task.engine, task.plant]) if outside else set()
    options: dict[str, Any] = {}
    applied = dict(values)
    for effect in hidden:
        if effect.engine.keys() & own:
            options.update(effect.engine)
        else:
            applied.update(effect.truth)
            applied.update(effect.own.get(use, {}))
    if not outside:
        motion: Motion = simulate(applied, u, start=start, disturbance=disturbance)
        return motion.reading
    force = actuated(applied, u) + np.repeat(disturbance, SUBSTEPS)
    y = engine_run(task.engine, task.plant, parameters, options, force, start, applied)
    samples = np.arange(len(u)) * SUBSTEPS
    late = [round(applied.get(f"sdelay{i}", 0.0) / STEP) for i in range(y.shape[1])]
    return np.column_stack([y[np.maximum(samples - late[i], 0), i] for i in range(y.shape[1])])


def _measured(
    plant: str, hidden: tuple[Hidden, ...], reading: FloatArray, noise: float, rng: np.random.Generator
) -> FloatArray:
    """Return what is recorded: the sensors' errors in their order, then noise; rounding comes last."""
    names = [channel.name for channel in SPECS[plant].outputs]
    y = reading.copy()
    for effect in sorted(hidden, key=lambda one: one.name in _CUTS):
        if effect.sensor is not None and not effect.late:
            y[:, names.index(effect.at)] = effect.sensor(y[:, names.index(effect.at)])
    y = y + noise * rng.standard_normal(y.shape)
    for effect in hidden:
        if effect.sensor is not None and effect.late:
            y[:, names.index(effect.at)] = effect.sensor(y[:, names.index(effect.at)])
    return y


def _balanced(task: Task, parameters: Mapping[str, float], noise: float, samples: int) -> Records:
    """Return records of the cart-pole balanced upright by LQR in pymunk."""
    key = ("study", task.key, task.seed)
    mass = parameters["mc"] + parameters["mp"]
    amplitude = 6.0 * mass
    # The motion under feedback is not known before it was run, so sizes refer to a likely one.
    u = 0.4 * amplitude * multisine(samples, DT, stream(*key, "size"), BALANCE_BAND)
    angle = 0.1 * multisine(samples, DT, stream(*key, "size-angle"), (0.2, 2.0))
    position = 0.1 * multisine(samples, DT, stream(*key, "size-position"), (0.1, 1.0))
    q = np.column_stack([position, angle])
    v = np.gradient(q, DT, axis=0)
    likely = Motion(q, v, q, u)
    context = Context(task.plant, _truth_values(task.plant, parameters), likely, u)
    hidden = _hidden(task, context, stream(*key, "effects"))
    runs, peak = [], 0.0
    for use in USES:
        t, u, y = balanced_run(task, parameters, hidden, noise, amplitude, use, samples)
        u = u + task.input_noise * rms(u) * stream(*key, use, "input-noise").standard_normal(u.shape)
        runs.append(Run(Trajectory(t, u, y, SPECS[task.plant]), use, use))
        peak = peak or math.degrees(float(np.abs(y[:, 1]).max()))
    return Records(Dataset(task.key, tuple(runs)), dict(parameters), hidden, noise, peak, hidden)
