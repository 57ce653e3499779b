"""Truth by other people's engines: Bullet's arm, Chipmunk's cart-pole, and the FMUs written by hand in C."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from harness import registry
from harness.rng import Streams, stream
from harness.signals import FloatArray
from sysid_lab.plan import Task
from sysid_lab.truths.applied import STEP, Law, force_law
from sysid_lab.truths.context import Hidden
from sysid_lab.truths.simulation import DT, SUBSTEPS

BALANCE_BAND = (0.1, 10.0)  # Of the force that is added to the controller's [Hz].
_STEPS = {"bullet": (160, 320), "pymunk": (160, 320)}
"""Steps of the engine in a sample, of two runs. Both engines err by the first power of the step, in damping most of
all: twice the finer run less the coarser one has no such error left (Richardson 1911; Hairer, Norsett & Wanner 1993,
sec. II.9). With 320 steps alone, a cart's damping is 6 standard deviations off beside a noise of 0.1 mm."""
OPTIONS = {
    ("bullet", "pendulum"): ("joint_friction",),
    ("fmu", "pendulum"): ("Fc", "Fs", "vs", "c2"),
    ("fmu", "cart-pole"): ("Fx", "Ftheta"),
    ("pymunk", "cart-pole"): ("friction_x", "friction_theta", "spring_x", "spring_theta"),
}


def engine_run(
    engine: str,
    plant: str,
    parameters: Mapping[str, float],
    options: Mapping[str, Any],
    force: FloatArray,
    start: FloatArray,
    truth: Mapping[str, float] | None = None,
) -> FloatArray:
    """Return the outputs (N, ny) of an engine at fine steps under a force (N,) from a start at rest.

    Parameters
    ----------
    engine : str
        ``bullet``, ``pymunk`` or ``fmu``.
    plant : str
    parameters : mapping
        In the words of the model.
    options : mapping
        The hidden effect in the words of any engine; those of this engine are taken.
    force : array (N,)
        Held over a fine step, ``SUBSTEPS`` of which are one sample.
    start : array (2 dof,)
        Coordinates, then rates (0).
    truth : mapping, optional
        Whose force is put on the driven coordinate besides (:func:`sysid_lab.truths.applied.force_law`), from what the
        engine shows, foretold to the middle of the next step.
    """
    own = {name: options[name] for name in OPTIONS[engine, plant] if name in options}

    def outputs(steps: int) -> FloatArray:
        made = _made(engine, plant, parameters, own, steps, fine=True)
        return _run(plant, engine, made, force, start, force_law(truth or {}, plant))  # a law may have a memory

    return _without_step(engine, outputs)


def _without_step(engine: str, run: Callable[[int], FloatArray]) -> FloatArray:
    """Return what an engine's runs with so many steps in a sample come to as the step goes to 0."""
    if engine not in _STEPS:
        return run(SUBSTEPS)
    coarse, fine = map(run, _STEPS[engine])
    return 2.0 * fine - coarse


def _run(
    plant: str, engine: str, options: Mapping[str, Any], force: FloatArray, start: FloatArray, law: Law | None
) -> FloatArray:
    """Return the outputs (N, ny) of one run."""
    names = ("theta",) if plant == "pendulum" else ("x", "theta")
    x0 = dict(zip(names, start.tolist(), strict=False))
    with registry.create("plants", _plant_name(engine, plant), **options) as made:
        y = np.empty((len(force), len(names)))
        y[0] = made.reset(rng=stream("study", "engine"), x0=x0)
        if law is None:
            y[1:] = made.rollout(force[:-1, None])
            return y
        before, rate, last = float(y[0, 0]), 0.0, 0.0
        for k, value in enumerate(force[:-1].tolist()):
            now = float(y[k, 0])
            rate, last, before = (now - before) / STEP, rate, now
            # of the middle of the step that the force is held over: half a step late it would brake, or drive
            middle = now + 0.5 * STEP * (rate + 0.75 * (rate - last)), 2.0 * rate - last, (k + 0.5) * STEP
            y[k + 1] = made.step(np.array([value + law(*middle, value)]))
    return y


def _plant_name(engine: str, plant: str) -> str:
    """Return the id of a registered plant."""
    return "arm-bullet" if engine == "bullet" else f"{plant}-{engine}"


def _made(
    engine: str, plant: str, parameters: Mapping[str, float], own: Mapping[str, Any], steps: int, *, fine: bool
) -> dict[str, Any]:
    """Return the options that make an engine's plant, with outputs at fine steps or at samples."""
    options: dict[str, Any] = {"sample_time": STEP if fine else DT, **own}
    if engine == "bullet":
        length = parameters["J"] * 9.81 / parameters["mgl"]  # a point mass: J = m l^2
        options.update(mass=parameters["mgl"] / (9.81 * length), length=length, joint_damping=parameters["b"])
    else:
        options.update(parameters)
    if engine == "fmu":
        options["substep"] = STEP
    else:
        options["substeps"] = steps // (SUBSTEPS if fine else 1)
    if engine == "pymunk":
        options["u_limit"] = math.inf
    return options


def balanced_run(
    task: Task,
    parameters: Mapping[str, float],
    hidden: tuple[Hidden, ...],
    noise: float,
    amplitude: float,
    use: str,
    samples: int,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return time, command and reading of Chipmunk's cart-pole balanced upright; the controller sees the noise.

    The controller's model is off by 10 %, as a user's would be.
    """
    from harness.rollout import run

    own: dict[str, Any] = {}
    for effect in hidden:
        own.update({name: effect.engine[name] for name in OPTIONS["pymunk", "cart-pole"] if name in effect.engine})
    known = {name: 1.1 * value for name, value in parameters.items()}

    def signals(steps: int) -> FloatArray:
        scenario: Any = registry.create(
            "scenarios",
            "cart-pole-lqr",
            samples=samples,
            amplitude=amplitude,
            band=BALANCE_BAND,
            noise=noise,
            sensor=(noise, noise),
            process_noise_ratio=task.disturbance or None,
            **known,
        )
        options = _made("pymunk", "cart-pole", parameters, own, steps, fine=False)
        with registry.create("plants", "cart-pole-pymunk", **options) as plant:
            record = run(plant, scenario, streams=Streams("study", task.key, task.seed), role=f"{use}/0").measured()
        return np.column_stack([record.t, record.u, record.y])

    found = _without_step("pymunk", signals)
    return found[:, 0], found[:, 1:2], found[:, 2:]
